"""Small copies of the layouts in which NVOS, SPIn-NeRF and LERF-Mask are published, of balls on a table."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import small_scenes
from PIL import Image
from protocols import resized

from gsseg_core.segmentation import Segmentation

CAMERAS = small_scenes.ring(6)
SCENE, TRUTH = small_scenes.balls_on_a_table()
BALL = 1


def save(path: Path, mask: np.ndarray, mode: str = "L") -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray((255 * mask).astype(np.uint8)).convert(mode).save(path)


def ball(index: int, scale: int = 1) -> np.ndarray:
    camera = CAMERAS[index]
    camera = resized(camera, scale * camera.width, scale * camera.height)
    return small_scenes.true_labels(SCENE, TRUTH, camera) == BALL


def write_nvos(root: Path) -> Path:
    """As published: one folder a kind, one in it a scene; masks larger than the images that were trained on."""
    inside, spots = ball(0), np.arange(ball(0).size).reshape(ball(0).shape) % 5 == 0
    save(root / "reference_image/fern/view0.png", inside)
    save(root / "scribbles/fern/pos_0.png", inside & spots, "RGB")
    save(root / "scribbles/fern/neg_0.png", ~inside & spots, "RGB")
    save(root / "masks/fern/view2_mask.png", ball(2, 2))
    Image.fromarray(np.zeros((8, 8, 3), np.uint8)).save(root / "masks/fern/view2.JPG")
    return root


def write_spin(folder: Path, names: list[str]) -> Path:
    for index, name in enumerate(names):
        save(folder / f"{name}.png", ball(index))
        save(folder / f"{name}_cutout.png", ball(index), "RGB")
        save(folder / f"{name}_pseudo.png", ball(index))
    return folder


def write_lerf(folder: Path, numbered: bool = True) -> Path:
    """Beside the cameras: views 2 and 5 were not trained on, and show the ball; `numbered` as published."""
    for i in (0, 1, 3, 4):
        save(folder / f"images_train/view{i}.jpg", ball(i))
    for number, index in enumerate((2, 5)):
        save(folder / f"test_mask/{number if numbered else f'view{index}'}/red ball.png", ball(index))
    return folder


def true_segmentation() -> Segmentation:
    codes = np.eye(small_scenes.NUM_CLASSES, dtype=np.float32)[TRUTH]
    return Segmentation.from_codes(SCENE, codes, small_scenes.NAMES)
