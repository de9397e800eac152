"""Settings of checking and finding the frame of cameras."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class AlignSettings:
    """How frames are checked and found; the defaults are what `benchmarks/bench_alignment.py` measures.

    Margins are by how much views score better than pictures that do not belong together: below the first, cameras and
    scene do not agree; from the second on they do; between, it is undecided.
    """

    views: int = 6  # compared with the scene, spread evenly over the dataset
    picture_px: int = 96  # longer side of the pictures that are compared, in px
    gaussians: int = 1 << 17  # rendered at most; see `gsseg_core.align.agreement.thinned`
    photo_margins: tuple[float, float] = (0.1, 0.35)  # where photos are compared; scores are 0 to 1
    mask_margins: tuple[float, float] = (0.03, 0.1)  # where masks are
    survivors: float = 0.25  # share of the conventions that go on to the next view, after each view
    photos: int = 16  # registered, spread evenly over the dataset
    photo_px: int = 480  # longer side at which they are matched, in px
    features: int = 800  # in each of them, at most
    virtual_views: int = 360  # views of the scene in which photos are looked for, at most
    ratio: float = 0.8  # largest distance of a match of features, as a share of that of the second best
    reprojection_px: float = 4.0  # error of a match that is right while a photo is being located, in its px
    matches: int = 12  # inliers that locate a photo, at least
    refinements: int = 2  # steps of the last fit, each with renderings of its own
