"""What docs/robustness.md says around its figures."""

from __future__ import annotations

HEADER = """# Robustness

Made by `python benchmarks/robustness.py{quick}`, which measures everything here again, in {minutes} minutes.
Machine: {machine}.

Masks are drawn wrong from true ones (`benchmarks/wrong_masks.py`, `benchmarks/view_errors.py`), each kind of error
at a strength from 0 to 1. Learners see the wrong masks of train views only; rendered label maps of the test views are
scored against the true ones, without refinement (mIoU, as in [results.md](results.md)). "FlashSplat's rule" is votes
made hard, on the same operator from the same views. The demo scene is the one of `make demo-local`: 30 views of 400 x
300, 9 objects and a background, which missed objects become. The real one is Replica `apartment_0`: 105 views of 320 x
320, 40 objects and no background; missed objects become what fills most of the view. One draw of errors per row. What
learning takes is in [BENCHMARK.md](../BENCHMARK.md); five scenes, one strength each, are in [regret.md](regret.md).
"""

BAR = """## A quarter of the objects wrong

15 % of the objects missed in every view and 10 % under another id of the view, edges off by up to 3 px; all train
views. "As they came" are the wrong masks that lie beside the real scene; the others are drawn anew.

{table}

What each error costs alone; swapped pairs, in which two objects of a view have exchanged ids, are not among those
above. The last three columns are the mIoU of other learners; `em` moves outlines to edges of the scene
(`gsseg_core/learn/em/boundary_alignment.py`), the first of the three does not.

{parts}
"""

CURVES = """### {title}

Learnt from {views} views, scored on {tests}. Empty: not measured, since the gradient learner is slow.

![mIoU by kind and strength of error](pictures/{plot})

{table}
"""

RELIABILITY = """## Which masks to trust

`check_views` predicts each view's mask from all the other views: one step of EM from the learnt probabilities without
the summand of this view. A view's reliability is the share of its pixels whose label is the one predicted. Here every
view has errors of random strength, up to those above, and a fifth of the views is bad: ids exchanged by half of the
objects or more, all ids passed on, half of the objects missed or more, or the mask 30 to 60 px, times a random share,
beside its image.

"Worst found": of the fifth of the views with the fewest right pixels, how many are among the fifth of the least
reliable. Errors are of the reliability against the true share of right pixels, in points.

{table}

![reliability of each view against its true share of right pixels](pictures/reliability.svg)

The two worst views of the demo scene: the mask, what the other views say, and in red where they differ.

![the two worst views](pictures/worst_views.png)
"""

OCCLUDER = """## Somebody walks through the room

In every train view somebody stands between the camera and the scene, elsewhere in each
(`benchmarks/moving_occluder.py`), and the masks show them as a class of its own, whose votes go to what is behind. A
depth camera measures the same pixels, with noise of 1 % of the depth, and nothing in 3 % of them; of the demo scene it
measures the solids that its Gaussians were made of, of the real one Gaussians, as there is no other truth. "Gated":
what the depth contradicts is unknown (`gsseg_core/raster/depth_gating.py`, default tolerances, a scene unit being a
metre; `depth_gating` of the node). mIoU is over the classes of the scene, without refinement. The last columns: pixels
of the person, how many of these gating makes unknown, and how many of the others.

{table}
"""
