"""The words of docs/few_views.md; few_views.py puts the figures in."""

from __future__ import annotations

HEADER = """# Few views, few labels

This page shows how many views you must label, and how well gsseg finds one object from one mask. In the demo scene, 8
labelled views come within 2 points of all 30; in the apartment, 32 within 3 points of all 105. You need no setting:
with few views, `gsseg segment` lets neighbours decide what no labelled view shows (the *graph*). For one object,
`gsseg pick` takes one or two masks; give it two.

`python benchmarks/few_views.py` measures everything on this page again and writes it, in {minutes} minutes.
Machine: {machine}.
"""

CURVES = """## How many views must be labelled

The views are drawn at random {draws} times, the same for all rows, with true masks. The tables have the mIoU of label
maps of {scored}: mean and range of the draws. Classes that no labelled view shows count as 0, which limits the figure
for one view. All rows have KNN clustering; "+ graph" has `gsseg_core.refine.label_propagation` before it.

![mIoU by number of views](pictures/few_views.svg)

{tables}

"+ graph" is measured at every number of views. `gsseg segment` uses the graph if the other views leave more than a
hundredth of a view's labelled pixels unknown (`--no-graph` prevents it). If they leave less unknown, the graph changed
mIoU by -0.1 to 0.3 points on held-out train views, with true and wrong masks (`python benchmarks/graph_term.py`).
[method.md](method.md#the-graph) has its formula, and says who does not use it.
"""

ONE_VIEW = """## One object from one view

The command is `gsseg pick SCENE.ply --data DATASET --view STEM --mask FILE --out DIR`. Add pairs of `--view` and
`--mask` for more masks, and `--label` if the object is one of several labels. In Python, use `pick_mask`, `pick_masks`
and `pick_clicks` of `gsseg_core.objects.pick`.

Each object is given in the train view in which it is largest (at least {least} px), once by its true mask and once by a
click on the pixel farthest from its outline. It is scored in {scored}: the pixels where its blended membership is
at least one half are compared with its true pixels, summed over these views. In the apartment, where objects that are
far apart share ids, these are separated as in [ids.md](ids.md).

{tables}

If there are more than 40 objects, 40 are used, spread evenly. "What its view sees" has no graph
(`GraphSettings(strength=0)`). Like the rows below it, it has evidence against Gaussians that are far away for the
object's size ([method.md](method.md#the-graph)); without this, masks flood the rooms behind what they show. The amount
was chosen on held-out train views of the demo and the apartment.

The **next view** is the view that sees most of the uncertainty: the standard deviation of each Gaussian's membership,
as far as its neighbours determined it (`Pick.next_view`). The command names this view, and writes the scene as seen
from there to `next.png`, for any segmenter; pass its mask by another `--view` and `--mask`. Averaged over the scenes,
it helps as much as a random view; but the random view is drawn from those that, by the truth, show the object. The
measure was chosen among six such sums, on held-out train views of four of these scenes, not the apartment.

A **click** becomes a mask in its view: regions of one colour and direction merge until one is left, and gsseg takes the
region around the click that lasts longest (`gsseg_core.objects.clicks`). This does not know what people call an object:
a drawer may last longer than the cupboard, or a wall and its picture may be one region. So the command takes no clicks.
Click in [the viewer](viewer.md#corrections), where you can correct a wrong result at once; or pass the click to a 2D
segmenter, and give its mask to `gsseg pick`.

Parts that no mask's view shows, such as the other end of a corner sofa, are inferred from nearby Gaussians of similar
colour.
"""
