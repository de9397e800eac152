"""The words of docs/few_views.md; few_views.py puts the figures in."""

from __future__ import annotations

HEADER = """# Few views, few labels

Made by `python benchmarks/few_views.py`, which measures everything here again, in {minutes} minutes on a busy machine.
Machine: {machine}.
"""

CURVES = """## How many views must be labelled

{draws} draws of views at random, the same for all; true masks; mIoU of label maps of {scored}, mean and range of
the draws. Classes that no labelled view shows count as 0, so that with one view the figure is bounded by what it
shows. All have KNN clustering; "+ graph" is `gsseg_core.graph` before it.

![mIoU by number of views](pictures/few_views.svg)

{tables}

The graph is on by default (`gsseg segment`, `--no-graph`); [method.md](method.md#the-graph) has its formula.
Its settings (12 neighbours, a strength of 1 px, colour) were chosen on 15 of the train views of the apartment, held out
(`--held-out`): colour gained 0.3 to 0.5 points from 4 to 16 views, and counting twice as much 0.1 to 0.3 less; a
strength of 4 px was as good there and 0.1 worse from 90 views; nearness by the Gaussians' own extents in place of the
local spacing, and the direction of their shortest axes, made no difference. What it gives is the part of the scene that
few or no pixels saw; where everything was seen often, it leaves the codes as they are.
"""

ONE_VIEW = """## One object from one view

`gsseg pick SCENE.ply --data DATASET --view STEM --mask FILE --out DIR`, or `--click COLUMN ROW`; in Python `pick_mask`
and `pick_click`. Each object is shown in the train view in which it is largest (at least {least} px), once by its true
mask and once by a click on the pixel farthest from its outline, and scored in {scored}: where its blended
membership is at least one half, against its true pixels, summed over these views. In the apartment, whose ids are
shared by objects that are far apart, these are told apart as in [ids.md](ids.md).

{tables}

Of more than 40 objects, 40 are taken evenly. Strength, neighbours and reach of `gsseg pick` were chosen on held-out
train views of the demo scene: 24 neighbours were better than 12 there, and a strength of 4 px as good as 16; what a
click reaches grew better up to a reach of 192 on its plain colours, and 48 is a guess for what is less plain.

In the apartment the graph makes picks worse, and a click gives nothing usable: the settings come from the small demo
scene, where one view shows nearly all, and in a flat most of the scene is unseen. That it is codes that wander off into
unseen rooms is likely and not yet looked into; `pick_mask(..., GraphSettings(strength=0))` goes without the graph.

What a mask's view does not show, as the other end of a corner sofa, is guessed from what is near and looks alike. A
click alone knows neither size nor edges of what is meant: it finds things of one colour that stand apart. Where there
is a 2D segmenter, put the click through it, and give its mask.
"""
