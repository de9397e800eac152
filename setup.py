"""Packaging of gsseg.

The metadata is here and not in pyproject.toml because a ROS 2 workspace builds the package by running this file with
the system's setuptools, and that of Ubuntu 24.04 (68) refuses the form in which newer ones want a licence stated there.
"""

from setuptools import Distribution, find_packages, setup

SHARE = "share/gsseg_ros"


class DistributionWithData(Distribution):
    """Installs data_files in an editable install too."""

    def has_data(self) -> bool:
        """Answer the question that setuptools asks before it does so, and that its own class leaves unanswered."""
        return self.has_data_files()


setup(
    distclass=DistributionWithData,
    name="gsseg",
    version="0.1.0",
    description="Segments trained 3D Gaussian Splatting scenes into objects from posed 2D masks",
    author="gsseg developers",
    license="Apache-2.0",
    packages=find_packages(include=["gsseg_core*", "gsseg_ros*"]),
    package_data={
        "gsseg_core": ["__init__.pyi"],
        "gsseg_ros": ["fastdds.xml"],
        "gsseg_core.report": ["charts.html.j2", "page.css", "page.html.j2", "page.js", "sections.html.j2"],
    },
    # What ROS looks for, at the places where it looks: the same after pip, colcon and colcon --symlink-install.
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/gsseg_ros"]),
        (SHARE, ["package.xml"]),
        (f"{SHARE}/config", ["config/nav2_obstacles.yaml", "config/segment_node.yaml"]),
        (f"{SHARE}/foxglove", ["foxglove/gsseg.json"]),
        (f"{SHARE}/launch", ["launch/replay.launch.py", "launch/segment.launch.py"]),
        (f"{SHARE}/rviz", ["rviz/gsseg.rviz"]),
        (f"{SHARE}/sros2", ["sros2/policy.xml"]),
        ("lib/gsseg_ros", ["scripts/replay_node", "scripts/segment_node"]),  # For `ros2 run` and `ros2 launch`.
    ],
    python_requires=">=3.10,<3.15",
    install_requires=[
        "jinja2>=3.1",
        "lazy_loader>=0.4",
        "numba>=0.61",
        "numpy>=1.26",
        "pillow>=10.1",
        "plyfile>=1.0",
        'pycolmap>=4.2; platform_machine != "aarch64"',  # which it has no wheel for; only `--align` by photos needs it
        "scipy>=1.11",
        "shtab>=1.8",
        "torch>=2.3",
        "tqdm>=4.64",
    ],
    extras_require={
        "distributed": ["dask>=2024.8", "distributed>=2024.8"],
        "dev": [
            "distributed>=2024.8",
            "gaussforge>=0.6",
            "greenlet>=3.0",
            'gsply>=0.4.6; platform_machine != "aarch64"',  # where it is compiled, by tools that are not pinned
            "hypothesis>=6.100",
            "import-linter>=2.5",
            "mkdocs-material>=9.6",
            "mkdocstrings-python>=1.16",
            "mypy>=1.15",
            "playwright>=1.45",
            "pycocotools>=2.0.8",
            "pygltflib>=1.16",
            "pytest>=8",
            "pytest-xdist>=3.6",
            "pyyaml>=6.0",
            "ruff>=0.9",
            "rosbags>=0.10",
            "rosdep>=0.26",
            "scikit-image>=0.25",
            "scikit-learn>=1.5",
            "threadpoolctl>=3.1",
            "trimesh>=4.0",
            "usd-core>=26.3",
            "viser>=1.0",
            "zstandard>=0.22",
        ],
        "docs": ["mkdocs-material>=9.6", "mkdocstrings-python>=1.16"],
        # Writing compressed PLY and SPZ, and reading SPZ of version 4 and YAML of masks.
        "formats": ["gsply>=0.4.6", "pyyaml>=6.0", "zstandard>=0.22"],
        "examples": ["rosbags>=0.10", "scikit-image>=0.25"],
        # Views on a GPU, with a driver of CUDA 12 or later, or of CUDA 13. numba-cuda 0.30 needs NumPy below 2.5.
        "cuda12": ["numba-cuda[cu12]>=0.30", "numpy<2.5"],
        "cuda13": ["numba-cuda[cu13]>=0.30", "numpy<2.5"],
        # ROS 2 Jazzy as wheels, for a machine without one from apt. Exact, because gsseg_msgs is compiled against them.
        "ros": [
            "ros-jazzy-common-interfaces==5.3.6",
            "ros-jazzy-rclpy==7.1.6",
            "ros-jazzy-rmw-fastrtps-cpp==8.4.3",
            "rosbags>=0.10",
        ],
        # 26.3 is the first with a schema for Gaussians.
        "usd": ["scikit-image>=0.25", "usd-core>=26.3"],
        "view": ["viser>=1.0"],
        "test": ["pytest"],  # colcon test runs pytest only where an extra of this name asks for it.
    },
    entry_points={
        "console_scripts": [
            "gsseg = gsseg_core.cli.main:main",
            "replay_node = gsseg_ros.replay.replay_node:main",
            "segment_node = gsseg_ros.node.segment_node:main",
        ],
        # Sources of class probabilities that change while `gsseg view` runs; see gsseg_core/viewer/live_source.py.
        "gsseg.live_sources": ["ros = gsseg_ros.client.view_source:RosSource"],
    },
)
