"""What trained scenes are like, in numbers: the real ones, and the room that stands in for them.

    python benchmarks/scene_statistics.py [--gaussians 1000000]

The real scenes are those of $GSSEG_DATA (default ../shared/data beside the repository); without them, only the room.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from lift_rate import count_work
from machine import parser_of
from room import build_room
from scipy.spatial import cKDTree

from gsseg_core.data.dataset import Dataset
from gsseg_core.raster.constants import T_MIN
from gsseg_core.raster.cpu.projection import project
from gsseg_core.raster.cpu.tiling import assign
from gsseg_core.scene.camera import Camera
from gsseg_core.scene.gaussian_scene import GaussianScene

QUANTILES = (5, 50, 95)
CAMERAS = 20


def main() -> None:
    """Print a table of each scene."""
    parser = parser_of(__doc__)
    parser.add_argument("--gaussians", type=int, default=1_000_000, help="of the room")
    options = parser.parse_args()
    for name in ("replica_apartment", "fern"):
        folder = options.data / name
        if not folder.is_dir():
            print(f"skipped: no {folder}; set GSSEG_DATA or --data to the folder that holds {name}/\n")
            continue
        show(name, scene_statistics(GaussianScene.load(folder / "scene.ply"), Dataset(folder).cameras))
    room = build_room(options.gaussians)
    show("room", scene_statistics(room.scene, room.cameras))


def scene_statistics(scene: GaussianScene, cameras: Sequence[Camera]) -> dict[str, list[float]]:
    """Measure a scene; the keys say what."""
    rows = []
    for camera in cameras[:: max(1, len(cameras) // CAMERAS)]:
        projected = project(scene, camera)
        tiles = assign(projected, camera.width, camera.height)
        pairs = count_work(projected, tiles, camera.width, camera.height, least=T_MIN).pairs
        seen = len(projected.ids)
        rows.append([pairs / (camera.width * camera.height), seen / len(scene), len(tiles.entries) / max(seen, 1)])
    pairs, seen, tiles_each = np.median(rows, axis=0).tolist()
    distances = cKDTree(scene.means).query(scene.means, 4, workers=-1)[0][:, 1:]
    nearest, spacing = distances[:, 0].mean(), distances.mean(axis=1)
    smallest, middle, largest = np.log(np.sort(scene.scales.astype(np.float64), axis=1)).T
    return {
        "Gaussians": [len(scene)],
        "pairs per pixel": [pairs],
        "share of Gaussians seen by a view": [seen],
        "tiles per Gaussian seen": [tiles_each],
        f"opacity, {QUANTILES} %": np.percentile(scene.opacities, QUANTILES).tolist(),
        f"middle scale / mean nearest distance, {QUANTILES} %": np.percentile(
            np.exp(middle) / nearest, QUANTILES
        ).tolist(),
        "log (middle scale / spacing), mean and sd": moments(middle - np.log(spacing)),
        "log (largest / middle scale), mean and sd": moments(largest - middle),
        "log (smallest / middle scale), mean and sd": moments(smallest - middle),
    }


def moments(values: np.ndarray) -> list[float]:
    """Mean and standard deviation."""
    return [float(values.mean()), float(values.std())]


def show(name: str, statistics: dict[str, list[float]]) -> None:
    """Print one scene."""
    print(name)
    for key, values in statistics.items():
        print(f"  {key:52} " + ", ".join(f"{value:.4g}" for value in values))
    print()


if __name__ == "__main__":
    main()
