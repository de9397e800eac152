"""Draws the pictures of docs/pictures from the demo scene: python docs/gen/pictures.py [DEMO_OUT]."""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image

from gsseg_core import Camera, Dataset, GaussianScene, Segmentation, make_operator
from gsseg_core.data.label_images import read_mask
from gsseg_core.demo.run import run_demo
from gsseg_core.export.pictures import overlay, palette

PICTURES = Path(__file__).parents[1] / "pictures"
VIEW = "0003"  # for testing: nothing was learnt from it
TRAIN_VIEW = "0013"
GAP = 8


def main(demo: Path) -> None:
    """Draw them all."""
    scene = GaussianScene.load(demo / "scene/scene.ply")
    views = {view.name: view for view in Dataset(demo / "scene").views()}
    result = Segmentation.load(demo / "segmented/segmentation.npz", scene)
    colors = palette(result.num_classes)

    photo, train_photo = photograph(scene, views[VIEW].camera), photograph(scene, views[TRAIN_VIEW].camera)
    save(
        "given.jpg",
        train_photo,
        overlay(train_photo, views[TRAIN_VIEW].read_labels(), colors),
        overlay(train_photo, read_mask(demo / f"scene/labels_true/{TRAIN_VIEW}.png").labels, colors),
    )
    save("result.jpg", photo, overlay(photo, read_mask(demo / f"rendered/{VIEW}.png").labels, colors))
    objects = [k for k in result.class_names if k and result.class_names[k] != "table"]
    alone = [photograph(scene.subset(result.labels == k), views[VIEW].camera) for k in objects[:8]]
    rows = [np.concatenate(alone[i : i + 4], axis=1) for i in (0, 4)]
    save("objects.jpg", np.concatenate(rows))


def photograph(scene: GaussianScene, camera: Camera) -> np.ndarray:
    """Render the scene's own colours, (H, W, 3) uint8, on white."""
    operator = make_operator(scene, camera)
    image = operator.render(scene.colors(camera.center))
    alpha = operator.render(np.ones((len(scene), 1), np.float32))
    return np.clip(255 * (image + 1 - alpha), 0, 255).round().astype(np.uint8)


def save(name: str, *images: np.ndarray) -> None:
    """Put images side by side, 900 px across."""
    gap = np.full((images[0].shape[0], GAP, 3), 255, np.uint8)
    parts = [part for image in images for part in (gap, image)][1:]
    picture = Image.fromarray(np.concatenate(parts, axis=1))
    picture.resize((900, round(900 * picture.height / picture.width)), Image.Resampling.LANCZOS).save(
        PICTURES / name, quality=82, optimize=True
    )


if __name__ == "__main__":
    if len(sys.argv) > 1:
        main(Path(sys.argv[1]))
    else:
        with tempfile.TemporaryDirectory() as folder:
            run_demo(folder)
            main(Path(folder))
