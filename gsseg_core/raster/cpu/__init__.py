"""Numba kernels over tiles of 16 x 16 pixels."""
