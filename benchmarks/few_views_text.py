"""The words of docs/few_views.md; few_views.py puts the figures in."""

from __future__ import annotations

HEADER = """# Few views, few labels

How many views must be labelled, and how well one object is found from one mask. In the demo scene 8 labelled views come
within 2 points of all 30, in the apartment 32 within 3 points of all 105. Nothing has to be set: from few views,
`gsseg segment` lets neighbours decide what no labelled view shows (the *graph*). For one object, `gsseg pick` takes a
mask or two; give two.

Made by `python benchmarks/few_views.py`, which measures everything here again, in {minutes} minutes.
Machine: {machine}.
"""

CURVES = """## How many views must be labelled

{draws} draws of views at random, the same for all; true masks; mIoU of label maps of {scored}, mean and range of
the draws. Classes that no labelled view shows count as 0, so that with one view the figure is bounded by what it
shows. All have KNN clustering; "+ graph" is `gsseg_core.refine.label_propagation` before it.

![mIoU by number of views](pictures/few_views.svg)

{tables}

"+ graph" is measured at every number of views. `gsseg segment` uses it by itself where all other views
leave more than a hundredth of a view's labelled pixels unknown (`--no-graph`: never). Where they leave less unknown,
the graph changed mIoU by -0.1 to 0.3 points on held-out train views, with true and wrong masks (`python
benchmarks/graph_term.py`). [method.md](method.md#the-graph) has its formula, and who does without it.
"""

ONE_VIEW = """## One object from one view

`gsseg pick SCENE.ply --data DATASET --view STEM --mask FILE --out DIR`, with more pairs of `--view` and `--mask` for
more masks, and `--label` where the object is one label of several; in Python `pick_mask`, `pick_masks` and
`pick_clicks` of `gsseg_core.objects.pick`.

Each object is shown in the train view in which it is
largest (at least {least} px), once by its true mask and once by a click on the pixel farthest from its outline, and
scored in {scored}: where its blended membership is at least one half, against its true pixels, summed over these
views. In the apartment, whose ids are shared by objects that are far apart, these are told apart as in
[ids.md](ids.md).

{tables}

Of more than 40 objects, 40 are taken evenly. "What its view sees" has no graph (`GraphSettings(strength=0)`). Like the
rows below it, it has evidence against what is far for the object's size ([method.md](method.md#the-graph)); without,
masks flood the rooms behind what they show. Its amount was chosen on held-out train views of the demo and the
apartment.

The **next view** is the one that sees the most of what is in doubt: the standard deviation of each Gaussian's
membership, as far as neighbours guessed it (`Pick.next_view`). The command names it, and writes the scene as seen from
there to `next.png`, for any segmenter; give its mask by another `--view` and `--mask`. On the mean over the scenes it
tells as much as the random view, which is drawn among those that show the object, by the truth. It was chosen among six
such sums, on held-out train views of four of these scenes, not the apartment.

A **click** becomes a mask in its view: regions of one colour and direction merge until all is one, and the
longest-lived around the click is taken (`gsseg_core.objects.clicks`). It knows nothing of what people call an object: a
drawer may last longer than the cupboard, or a wall and its picture be one. So the command takes no clicks. Click in
[the viewer](viewer.md#corrections), where a wrong one is corrected at once; or put the click through a 2D segmenter,
and give its mask.

What a mask's view does not show, as the other end of a corner sofa, is guessed from what is near and looks alike.
"""
