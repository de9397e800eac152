"""The words of docs/few_views.md; few_views.py puts the figures in."""

from __future__ import annotations

HEADER = """# Few views, few labels

Made by `python benchmarks/few_views.py`, which measures everything here again, in {minutes} minutes.
Machine: {machine}.
"""

CURVES = """## How many views must be labelled

{draws} draws of views at random, the same for all; true masks; mIoU of label maps of {scored}, mean and range of
the draws. Classes that no labelled view shows count as 0, so that with one view the figure is bounded by what it
shows. All have KNN clustering; "+ graph" is `gsseg_core.refine.label_propagation` before it.

![mIoU by number of views](pictures/few_views.svg)

{tables}

"+ graph" is measured at every number of views. `gsseg segment` uses it by a rule from the data, where all other views
leave more than a hundredth of a view's labelled pixels unknown (`--no-graph`: never);
[method.md](method.md#the-graph) has its formula.
`python benchmarks/graph_term.py` measures what the rule stands on, true and wrong masks, mIoU and calibration, on train
views that are held out. Where views leave each other less unknown, the graph changed mIoU there by -0.1 to 0.3 points.

The live session and the ROS node do without the graph: from so few views their labels differ from the command's.
"""

ONE_VIEW = """## One object from one view

`gsseg pick SCENE.ply --data DATASET --view STEM --mask FILE --out DIR`, with more pairs of `--view` and `--mask` for
more masks; in Python `pick_mask`, `pick_masks` and `pick_clicks`. Each object is shown in the train view in which it is
largest (at least {least} px), once by its true mask and once by a click on the pixel farthest from its outline, and
scored in {scored}: where its blended membership is at least one half, against its true pixels, summed over these
views. In the apartment, whose ids are shared by objects that are far apart, these are told apart as in
[ids.md](ids.md).

{tables}

Of more than 40 objects, 40 are taken evenly. "What its view sees" has no graph (`GraphSettings(strength=0)`), but like
the rows below it the evidence against what is far for the object's size ([method.md](method.md#the-graph)). Without,
masks flood rooms behind what they show, whose Gaussians a ray reaches with a thousandth of its light, and which no
pixel contradicts. Its amount was chosen on held-out train views of the demo and the apartment.

The **next view** is the one that sees the most of what is in doubt: the standard deviation of each Gaussian's
membership, as far as neighbours guessed it (`Pick.next_view`). The command names it, and writes the scene as seen from
there to `next.png`, for any segmenter; give its mask by another `--view` and `--mask`. Chosen on held-out
train views of four of these scenes, not the apartment, among six such sums. It knows no truth, as the random view does
that is drawn among those that show the object; on the mean over the scenes both tell as much.

A click becomes a mask in its view, by regions of one colour and direction that merge until all is one; the
longest-lived around the click is taken (`gsseg_core.objects.clicks`). It knows nothing of what people call an object: a
drawer may last longer than the cupboard, or a wall and its picture be one. So the command takes no clicks: in
[the viewer](viewer.md#corrections) a click that went wrong is seen and corrected at once. Where there is a 2D
segmenter, put the click through it, and give its mask.

What a mask's view does not show, as the other end of a corner sofa, is guessed from what is near and looks alike.
"""
