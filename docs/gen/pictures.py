"""Draws the pictures of docs/pictures from the demo scene: python docs/gen/pictures.py [DEMO_OUT]."""

from __future__ import annotations

import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from gsseg_core import Camera, Dataset, GaussianScene, Segmentation, make_operator
from gsseg_core.data.label_images import read_mask
from gsseg_core.demo.run import run_demo
from gsseg_core.export.pictures import overlay, palette

PICTURES = Path(__file__).parents[1] / "pictures"
VIEW = "0003"  # for testing: nothing was learnt from it
TRAIN_VIEW = "0013"
LEAD_VIEW = "0030"
WRONG_VIEWS = ("0013", "0004", "0020", "0030")
GAP = 8
PANEL = (480, 360)
ARROW, CAPTION = 52, 40
INK = (39, 52, 79)


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
    wrong = [overlay(photograph(scene, views[v].camera), views[v].read_labels(), colors) for v in WRONG_VIEWS]
    camera = views[LEAD_VIEW].camera
    cut = [close_up(scene.subset(result.labels == k), camera) for k in result.class_names if k]
    lead(photograph(scene, camera), wrong, cut)


def photograph(scene: GaussianScene, camera: Camera) -> np.ndarray:
    """Render the scene's own colours, (H, W, 3) uint8, on white."""
    operator = make_operator(scene, camera)
    image = operator.render(scene.colors(camera.center))
    alpha = operator.render(np.ones((len(scene), 1), np.float32))
    return np.clip(255 * (image + 1 - alpha), 0, 255).round().astype(np.uint8)


def close_up(thing: GaussianScene, camera: Camera) -> np.ndarray:
    """Render an object alone, as large as the picture has room for."""
    shown = make_operator(thing, camera).render(np.ones((len(thing), 1), np.float32))[..., 0] > 0.5
    rows, columns = np.flatnonzero(shown.any(axis=1)), np.flatnonzero(shown.any(axis=0))
    zoom = 0.9 * min(camera.height / (np.ptp(rows) + 1), camera.width / (np.ptp(columns) + 1))
    K = camera.K * zoom
    K[:2, 2] += np.array([camera.width, camera.height]) / 2 - zoom * np.array([columns.mean(), rows.mean()])
    K[2, 2] = 1
    return photograph(thing, replace(camera, K=K))


def lead(photo: np.ndarray, wrong: list[np.ndarray], objects: list[np.ndarray]) -> None:
    """Put the picture that the README begins with together: a scene, wrong masks of it, and its objects."""
    panels = [[photo], wrong, objects]
    captions = ["a trained scene", "masks of its views, wrong as real ones are", "its objects, each by itself"]
    width, height = PANEL
    picture = Image.new("RGB", (3 * width + 2 * ARROW, height + CAPTION), "white")
    draw, font = ImageDraw.Draw(picture), ImageFont.load_default(size=20)
    for i, (images, caption) in enumerate(zip(panels, captions, strict=True)):
        left, side = i * (width + ARROW), round(len(images) ** 0.5)
        for j, image in enumerate(images):
            size = (width // side - 4 * (side > 1), height // side - 4 * (side > 1))
            small = Image.fromarray(image).resize(size, Image.Resampling.LANCZOS)
            picture.paste(small, (left + j % side * width // side + 2, j // side * height // side + 2))
        draw.text((left + width // 2, height + CAPTION // 2), caption, INK, font, anchor="mm")
        if i:
            middle = left - ARROW // 2, height // 2
            if i == 1:
                draw.text(middle, "+", INK, ImageFont.load_default(size=40), anchor="mm")
            else:
                x, y = middle
                draw.line([(x - 15, y), (x + 10, y)], INK, 4)
                draw.polygon([(x + 17, y), (x + 5, y - 9), (x + 5, y + 9)], INK)
    picture.save(PICTURES / "lead.jpg", quality=85, optimize=True)


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
