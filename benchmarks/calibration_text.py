"""The words around the tables of docs/calibration.md."""

HEADER = """# Calibration: what confidence means

Made by `python benchmarks/calibration.py`, which measures everything here again.
Machine: {machine}.

Of all pixels (or Gaussians) with a confidence of 0.8, eight in ten should be right: belong to the true class, whatever
the masks said that were learnt from. What learners and blending give are shares, which are not sure enough: a pixel
that is made to 0.7 of one object belongs to it far more often than in seven cases of ten, and where the masks are wrong
in a quarter of the cases, votes hardly ever exceed 0.75, however many views agree.

## How it is done

One number per scene, the temperature T. Shares O become probabilities

    P[k] = O[k]^(1/T) / sum_j O[j]^(1/T)

For a Gaussian, O are the class probabilities as learnt; for a pixel, what these blend to. (What is blended is always
what was learnt, never probabilities at T.) The order of the classes stays, so labels, label maps and mIoU stay too.
Raising shares to a power is what it means to weigh evidence: n pixels that saw a Gaussian are not n independent
observations, since those of one view err together; T says how much they are worth all the same.

T is found without any truth. Of at most 16 views, spread evenly, the mask is predicted from the other views: for `em`
by probabilities without the view's own summand (those of "check views", so nothing is rendered twice), for `votes` by
the votes of the others, exactly. T maximises the likelihood of these masks. What is wanted is the probability of the
true class and not that of a wrong label, so each mask is seen through a confusion matrix of its own, learnt anew at
every T that is tried. `gradient` has no such step; there the masks are predicted by probabilities that were fitted to
them, one view among many. In all cases 2,048 pixels of a view are enough, and the result is the same in every run.

| where | what is calibrated |
|---|---|
| `segmentation.npz` | `probabilities`, `confidence`; the temperature is in the header |
| class PLYs | the property `confidence`, beside `label` |
| `report.json` | mean confidences; `calibration`: temperature, its views and pixels, the share left `unknown` |
| `Segmentation` | `probabilities`, `confidence`, `render(...).confidence`; `blend` gives the shares |
| ROS, after `~/learn` | clouds, reports, `~/render_view`, `min_confidence`: by the temperature of what was learnt |
| ROS, votes alone, before `~/learn` | not calibrated: shares, less sure than they might be |
| KNN's `beta` | acts on shares, before calibration, as in the paper |

With soft or partial masks, T is fitted to the pixels for which the mask names a class.
"""

SCORES = """## On the test views

Learnt from all train views, scored on the test views against their true masks, all pixels of all views together. ECE:
15 bins of equal width over the confidence of the class predicted, sum of share times |accuracy - confidence|. AURC:
mean share of wrong pixels over all coverages, the surest pixels first. Of Gaussians: the same ECE, each Gaussian
weighted by the pixels that see it; right is one whose most probable class is that of probabilities that EM without
error models learnt from the true masks of all views, test views too. "As blended" is T = 1, before calibration. Wrong
masks: 15 % of the objects missed, 10 % under another id in every view, edges off by up to 3 px (the apartment's), and
those of `make demo`.

{table}

![Share of right pixels by confidence](pictures/calibration.svg)

![Share of wrong pixels by coverage](pictures/risk_coverage.svg)
"""

ROADS = """## Ways to choose the temperature

On one train view in seven, held out from learning, against their true masks: ECE, and T. *Masks taken as true* takes
every label of a held-out mask for the true class. *Through confusion* is what is built in. *Best possible* is fitted to
the true masks of the held-out views themselves, which nobody has at run time.

{table}

With true masks, taking them as true is as good as the confusion matrices. With wrong ones it makes confidences those of
the wrong label; the confusion matrices repair it, for the most part: edges that are off look to them like unsure
predictions, so T comes out somewhat too high.
"""
