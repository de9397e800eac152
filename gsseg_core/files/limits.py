"""How large what files claim may be: claims are checked from headers, before memory is taken for them."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Limits:
    """Largest sizes that are accepted: no real capture comes near, a damaged or malicious file may claim more.

    Attributes
    ----------
    max_value : float
        Of the position of a Gaussian or a camera, in scene units, and of a coefficient of spherical harmonics: float32
        cannot hold the square of much larger ones.
    max_pixels : int
        Of a mask, a photo, or the picture of a camera: 134 million, as many as 11,585 x 11,585.
    max_npz_bytes : int
        Of the arrays of one npz, inflated: 16 GiB. Where the scene or the camera tells the shape of an array, that is
        its limit.
    max_json_bytes : int
        Of a JSON file, or of the header of an npz: 64 MiB. In memory, JSON takes up to 20 times as much.
    """

    max_value: float = 1e12
    max_pixels: int = 2**27
    max_npz_bytes: int = 2**34
    max_json_bytes: int = 2**26


LIMITS = Limits()

MAX_LABEL = 65534
"""The largest label that a 16-bit mask can hold."""
