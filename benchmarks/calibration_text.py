"""The words around the tables of docs/calibration.md."""

HEADER = """# Calibration: what confidence means

`python benchmarks/calibration.py` measures everything on this page again and writes it.
Machine: {machine}.

Of all pixels (or Gaussians) with a confidence of 0.8, eight in ten should be right, that is, belong to their true class
even if masks were wrong. Learners and blending compute shares, which are underconfident. A pixel with a share of 0.7 of
one object belongs to it in far more than seven cases of ten. If a quarter of the masks are wrong, votes hardly ever
exceed 0.75, however many views agree.

## How it is done

One number per scene, the temperature T, turns shares O into probabilities

    P[k] = O[k]^(1/T) / sum_j O[j]^(1/T)

For a Gaussian, O are the learnt class probabilities; for a pixel, O are these probabilities blended. (Blending always
uses the learnt probabilities, never those at T.) The order of the classes does not change, so labels, label maps and
mIoU do not change either. Raising shares to a power weighs the evidence: n pixels that saw a Gaussian are not n
independent observations, since the pixels of one view err together. T expresses how many they are worth.

T needs no ground truth. gsseg takes at most 16 views, spread evenly, predicts the mask of each from the other views,
and chooses the T that maximises the likelihood of these masks:

- `em` predicts by probabilities without the view's own term. The stage "check views" has them, so nothing is rendered
  twice. `votes` predicts by exactly the votes of the other views. `gradient` cannot leave a view out: it predicts by
  probabilities that were also fitted to the mask, one view among many.
- T should give the probability of the true class, not of a wrong label. So each mask has its own confusion matrix,
  estimated again for every T that is tried.
- 2,048 pixels of a view are enough, and the result is the same in every run.

| where | what is calibrated |
|---|---|
| `segmentation.npz` | `probabilities`, `confidence`; the temperature is in the header |
| class PLYs | the property `confidence`, beside `label` |
| `report.json` | mean confidences; `calibration`: temperature, its views and pixels, the share left `unknown` |
| `Segmentation` | `probabilities`, `confidence`, `render(...).confidence`; `blend` gives the shares |
| ROS, after `~/learn` | clouds, reports, `~/render_view`, `min_confidence`: by the temperature of what was learnt |
| ROS, votes alone, before `~/learn` | not calibrated: shares, which are underconfident |
| KNN's `beta` | acts on shares, before calibration, as in the paper |

With soft or partial masks, T is fitted to the pixels for which the mask names a class.
"""

SCORES = """## On the test views

Everything is learnt from all train views and scored on the test views against their true masks, with the pixels of all
views together.

- **ECE**: 15 bins of equal width over the confidence of the predicted class; sum of share times |accuracy -
  confidence|.
- **AURC**: mean share of wrong pixels over all coverages, the most confident pixels first.
- **ECE of Gaussians**: the same, each Gaussian weighted by the pixels that see it. A Gaussian counts as right if its
  most probable class is the one that EM without error models learns from the true masks of all views, test views too.
- **As blended**: T = 1, before calibration.
- **Wrong masks**: every view misses 15 % of the objects, has 10 % under another id, and has edges off by up to 3 px
  (the apartment's); those of the demo are those of `make demo`.

{table}

![Share of right pixels by confidence](pictures/calibration.svg)

![Share of wrong pixels by coverage](pictures/risk_coverage.svg)
"""

ROADS = """## Ways to choose the temperature

The table has ECE, and T, against the true masks of one train view in seven, held out from learning. *Masks taken as
true* treats every label of a held-out mask as the true class. *Through confusion* is what gsseg does. *Best possible*
is fitted to the true masks of the held-out views themselves, which nobody has at run time.

{table}

With true masks, taking them as true is as good as the confusion matrices. With wrong masks, it calibrates to the wrong
labels. The confusion matrices correct most of this; they take shifted edges for uncertain predictions, so T is somewhat
too high.
"""
