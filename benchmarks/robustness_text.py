"""What docs/robustness.md says around its figures."""

from __future__ import annotations

HEADER = """# Robustness

This page shows how wrong masks and poses may be, and which masks to trust. If a quarter of the objects are wrong in
every view, this costs the default learner, `em`, {cost}.
`report.json` names the [least reliable](#which-masks-to-trust) views. The node's [depth
gating](#somebody-walks-through-the-room) removes people who walk through a room.

`python benchmarks/robustness.py{quick}` measures everything on this page again and writes it, in {minutes} minutes.
Machine: {machine}.

- **Masks** are drawn wrong from true ones (`benchmarks/wrong_masks.py`, `benchmarks/view_errors.py`), each kind of
  error at a strength from 0 to 1, one draw per row. Learners see the wrong masks of train views only.
- **Score:** rendered label maps of the test views against the true ones, without refinement (mIoU, as in
  [results.md](results.md)).
- **"FlashSplat's rule"** is votes made hard, on the same operator from the same views.
- **Demo scene:** the one of `make demo-local`, 30 views of 400 x 300, 9 objects and a background. Missed objects become
  background.
- **Real scene:** Replica `apartment_0`, 105 views of 320 x 320, 40 objects and no background. Missed objects become the
  object that fills most of the view.

[BENCHMARK.md](../BENCHMARK.md) has the cost of learning; [regret.md](regret.md) has six scenes with one strength each.
"""

BAR = """## A quarter of the objects wrong

Every view misses 15 % of the objects, has 10 % under another id of the view, and has edges off by up to 3 px; `em`
learns from all train views. "As they came" are the wrong masks in the folder of the real scene; the others are drawn
again.

{table}

The next table has the cost of each error alone. Swapped pairs, in which two objects of a view exchange ids, are not
part of the errors above. The last three columns are the mIoU of other learners. The first of these is `em` without
[moving outlines to edges of the scene](method.md#learners).

{parts}
"""

CURVES = """### {title}

Learnt from {views} views, scored on {tests}. Empty: not measured, since the gradient learner is slow.

![mIoU by kind and strength of error](pictures/{plot})

{table}
"""

RELIABILITY = """## Which masks to trust

A view's *reliability* is the share of its pixels whose label the other views predict: `MaskChecker` takes one step of
EM from the learnt probabilities, without the term of this view. Here every view has errors of random strength, up to
those above. In addition, a fifth of the views is bad: half of the objects or more exchange ids, no object keeps its id,
half of the objects or more are missed, or the mask is shifted by 30 to 60 px times a random share.

"Worst found" is how many of the fifth of the views with the fewest right pixels are among the least reliable fifth.
Errors compare the reliability with the true share of right pixels, in points.

{table}

![reliability of each view against its true share of right pixels](pictures/reliability.svg)

The two worst views of the demo scene: the mask, the prediction of the other views, and in red where they differ.

![the two worst views](pictures/worst_views.png)
"""

OCCLUDER = """## Somebody walks through the room

The node's `depth_gating` makes pixels unknown that a measured depth contradicts (`gsseg_core/raster/depth_gating.py`,
here with default tolerances, a scene unit being a metre). The rows "gated" have it.

In every train view a person stands between the camera and the scene, in a different place each time
(`benchmarks/moving_occluder.py`). The masks show the person as a class of its own, whose votes go to the scene behind.
A depth camera measures the same pixels, with noise of 1 % of the depth, and no depth in 3 % of them. In the demo scene
it measures the solids from which the Gaussians were made; in the real scene the Gaussians, as there is no other truth.
mIoU is over the classes of the scene, without refinement. The last columns have the pixels of the person, the share of
these that gating makes unknown, and that of the others.

{table}
"""
