"""Packaging of gsseg.

The metadata is here and not in pyproject.toml because a ROS 2 workspace builds the package by running this file with
the system's setuptools, and that of Ubuntu 24.04 (68) refuses the form in which newer ones want a licence stated there.
"""

from setuptools import setup

setup(
    name="gsseg",
    version="0.1.0",
    description="Segments trained 3D Gaussian Splatting scenes into objects from posed 2D masks",
    author="gsseg developers",
    license="Apache-2.0",
    packages=["gsseg_core"],
    python_requires=">=3.10,<3.14",
    install_requires=[
        "numba>=0.61",
        "numpy>=2.0",
        "pillow>=10.1",
        "plyfile>=1.0",
        "pycolmap>=3.11",
        "scipy>=1.13",
        "torch>=2.3",
        "tqdm>=4.64",
    ],
    extras_require={
        "dev": ["hypothesis>=6.100", "mypy>=1.15", "pytest>=8", "ruff>=0.9", "scikit-learn>=1.5"],
        "test": ["pytest"],  # colcon test runs pytest only where an extra of this name asks for it.
    },
    entry_points={"console_scripts": ["gsseg = gsseg_core.cli:main"]},
)
