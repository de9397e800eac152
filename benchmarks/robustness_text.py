"""What docs/robustness.md says around its figures."""

from __future__ import annotations

HEADER = """# Robustness

How wrong masks and poses may be, and which masks to trust. With the default learner, `em`, a quarter of the objects
wrong in every view costs {cost}.
`report.json` names the views that are [least reliable](#which-masks-to-trust). The node's [depth
gating](#somebody-walks-through-the-room) takes out people who walk through a room.

Made by `python benchmarks/robustness.py{quick}`, which measures everything here again, in {minutes} minutes.
Machine: {machine}.

- **Masks** are drawn wrong from true ones (`benchmarks/wrong_masks.py`, `benchmarks/view_errors.py`), each kind of
  error at a strength from 0 to 1, one draw per row. Learners see the wrong masks of train views only.
- **Score:** rendered label maps of the test views against the true ones, without refinement (mIoU, as in
  [results.md](results.md)).
- **"FlashSplat's rule"** is votes made hard, on the same operator from the same views.
- **Demo scene:** the one of `make demo-local`, 30 views of 400 x 300, 9 objects and a background, which missed objects
  become.
- **Real scene:** Replica `apartment_0`, 105 views of 320 x 320, 40 objects and no background; missed objects become
  what fills most of the view.

What learning takes is in [BENCHMARK.md](../BENCHMARK.md); six scenes, one strength each, are in
[regret.md](regret.md).
"""

BAR = """## A quarter of the objects wrong

15 % of the objects missed in every view and 10 % under another id of the view, edges off by up to 3 px; all train
views. "As they came" are the wrong masks that lie beside the real scene; the others are drawn anew.

{table}

What each error costs alone. Swapped pairs, in which two objects of a view have exchanged ids, are not among those
above. The last three columns are the mIoU of other learners, the first of them `em` that does not [move outlines to
edges of the scene](method.md#learners).

{parts}
"""

CURVES = """### {title}

Learnt from {views} views, scored on {tests}. Empty: not measured, since the gradient learner is slow.

![mIoU by kind and strength of error](pictures/{plot})

{table}
"""

RELIABILITY = """## Which masks to trust

A view's *reliability* is the share of its pixels whose label the other views predict: `MaskChecker` takes one step of
EM from the learnt probabilities, without the summand of this view. Here every view has errors of random strength, up to
those above, and a fifth of the views is bad: ids exchanged by half of the objects or more, all ids passed on, half of
the objects missed or more, or the mask 30 to 60 px, times a random share, beside its image.

"Worst found": of the fifth of the views with the fewest right pixels, how many are among the fifth of the least
reliable. Errors are of the reliability against the true share of right pixels, in points.

{table}

![reliability of each view against its true share of right pixels](pictures/reliability.svg)

The two worst views of the demo scene: the mask, what the other views say, and in red where they differ.

![the two worst views](pictures/worst_views.png)
"""

OCCLUDER = """## Somebody walks through the room

The node's `depth_gating` makes unknown what a measured depth contradicts (`gsseg_core/raster/depth_gating.py`, here
with default tolerances, a scene unit being a metre): "gated" below.

In every train view somebody stands between the camera and the scene, elsewhere in each
(`benchmarks/moving_occluder.py`). The masks show them as a class of its own, whose votes go to what is behind. A depth
camera measures the same pixels, with noise of 1 % of the depth, and nothing in 3 % of them. Of the demo scene it
measures the solids that its Gaussians were made of; of the real one Gaussians, as there is no other truth. mIoU is over
the classes of the scene, without refinement. The last columns: pixels of the person, how many of these gating makes
unknown, and how many of the others.

{table}
"""
