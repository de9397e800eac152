"""What all rasterisers share: the rules of blending, as docs/conventions.md has them, and how work is cut up."""

from __future__ import annotations

NEAR = 0.01  # centres nearer than this to the camera plane are not drawn, in scene units
DILATION = 0.3  # added to both variances on the image, in px^2 (the low-pass filter of 3DGS trainers)
ALPHA_MAX = 0.99  # largest alpha
T_MIN = 1e-4  # a ray ends when its transmittance falls below this

T_LIFTED = 0.1
"""A ray that lifts a mask ends at the Gaussian that leaves less than this of it, and that one takes what is left.

What shines through a surface by less is nothing that a mask speaks of: a floor that is only ever seen through a table's
soft edges would be learnt to be the table.
"""
TINY = 1e-30  # floor of a pixel's likelihood

CHANNELS = 32  # that one pass of an adjoint sums at once, which bounds its memory
BLOCK = 4  # px, side of the square blocks into which tiles are cut: sixteen pixels are one vector
CHUNKS = 16  # parts of the Gaussians that are worked on beside each other; fixed, so that threads change nothing
