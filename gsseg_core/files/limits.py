"""How large what files claim may be: claims are checked from headers, before memory is taken for them."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Limits:
    """Largest sizes that are accepted: no real capture comes near, a damaged or malicious file may claim more."""

    # Of a coordinate of a Gaussian or a camera, in scene units, and of a coefficient of spherical harmonics: float32
    # cannot hold the square of much larger numbers.
    max_value: float = 1e12
    max_gaussians: int = 2**26  # of a scene whose file is compressed, and may claim more than it has bytes for
    max_pixels: int = 2**27  # of a mask, a photo, or the picture of a camera: as many as 11,585 x 11,585
    max_npz_bytes: int = 2**34  # of all arrays of an npz together, inflated
    max_json_bytes: int = 2**26  # of a JSON file, or the header of an npz; in memory, it takes up to 20 times as much


LIMITS = Limits()

MAX_LABEL = 65534
"""The largest label that a 16-bit mask can hold."""
