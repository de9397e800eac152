"""The rasteriser on a GPU: kernels that numba compiles for CUDA, with PyTorch's tensors as their arrays."""
