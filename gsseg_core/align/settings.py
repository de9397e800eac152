"""Settings of checking and finding the frame of cameras."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class AlignSettings:
    """How frames are checked and found; the defaults are what `benchmarks/bench_alignment.py` measures.

    Attributes
    ----------
    views : int
        Views that are compared with the scene, spread evenly over the dataset.
    picture_px : int
        Longer side of the pictures that are compared, in px.
    gaussians : int
        Gaussians of which they are rendered, at most; see `gsseg_core.align.thinning`.
    photo_margins, mask_margins : (float, float)
        By how much the score of views, 0 to 1, is above that of pictures that do not belong together: below the first,
        cameras and scene have nothing to do with each other; from the second on they agree; between, nobody can tell.
    survivors : float
        Share of the conventions that go on to the next view, after each view.
    photos : int
        Photos that are registered, spread evenly over the dataset.
    photo_px : int
        Longer side at which they are, in px.
    features : int
        Features in each of them, at most.
    virtual_views : int
        Views of the scene in which photos are looked for, at most.
    ratio : float
        Largest distance of a match of features, as a share of that of the second best.
    reprojection_px : float
        Error of a match that counts as right while a photo is being located, in px of the photo as registered.
    matches : int
        Right matches that locate a photo, at least.
    refinements : int
        Steps of the last fit, in each of which the scene is rendered anew.
    """

    views: int = 6
    picture_px: int = 96
    gaussians: int = 1 << 17
    photo_margins: tuple[float, float] = (0.1, 0.35)
    mask_margins: tuple[float, float] = (0.03, 0.1)
    survivors: float = 0.25
    photos: int = 16
    photo_px: int = 480
    features: int = 800
    virtual_views: int = 360
    ratio: float = 0.8
    reprojection_px: float = 4.0
    matches: int = 12
    refinements: int = 2
