"""Make masks from photos with a 2D segmenter, and write them in the layout of a dataset.

    pip install scikit-image
    python examples/masks_from_photos.py DATASET --out auto
    gsseg segment scene.ply --data DATASET --out out --labels auto --ids per-view

The segmenter here is Felzenszwalb and Huttenlocher's (2004), which needs no weights. It does not recognise objects: it
finds areas of one colour, and numbers them anew in every photo, as automatic mask generators do. To use another
segmenter, rewrite `segment_photo` only.

If DATASET has no images/, `--scene` renders the scene in place of the photos. The cameras must have no lens distortion.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
from PIL import Image
from skimage.segmentation import felzenszwalb

from gsseg_core import Dataset, GaussianScene, GssegError, View, make_operator
from gsseg_core.data.label_images import UNKNOWN, write_mask

SCALE = 300
"""How different two areas must be to stay separate; larger values give fewer areas."""

LEAST, MOST = 0.001, 0.25
"""Areas below the first share of the image count as noise, areas above the second as background."""


def segment_photo(
    photo: np.ndarray,  # (H, W, 3) uint8
) -> np.ndarray:
    """Find areas: (H, W) int32 with a number for each, 0 for background and -1 for unknown."""
    areas = felzenszwalb(photo, scale=SCALE, sigma=0.8, min_size=int(LEAST * photo[..., 0].size))
    share = np.bincount(areas.ravel()) / areas.size
    numbers = np.where(share > MOST, 0, np.where(share < LEAST, UNKNOWN, 1 + np.arange(len(share))))
    return numbers[areas].astype(np.int32)


def photo_of(view: View, scene: GaussianScene | None) -> np.ndarray:
    """Read the photo of a view, or render it: (H, W, 3) uint8."""
    if scene is not None:
        if view.camera.undistortion is not None:
            raise GssegError(f"view '{view.name}' was taken through a lens, as its mask has to be; expected its photo")
        image = make_operator(scene, view.camera).render(scene.colors(view.camera.center))
        return (255 * image.clip(0, 1)).astype(np.uint8)
    if view.image_path is None:
        raise GssegError(f"view '{view.name}' has no photo in images/; give --scene SCENE.ply to render it")
    return np.array(Image.open(view.image_path).convert("RGB"))


def main() -> None:
    """Write a mask for each train view."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", metavar="DATASET", help="folder with cameras, and photos in images/")
    parser.add_argument("--out", default="auto", metavar="NAME", help="folder in DATASET for masks (default: auto)")
    parser.add_argument("--scene", metavar="SCENE.ply", help="render photos from it")
    options = parser.parse_args()
    try:
        views = Dataset(options.dataset).views("train")
        scene = GaussianScene.load(options.scene) if options.scene else None
        for image, view in {view.camera.image: view for view in views}.items():  # A panorama is several views.
            labels = segment_photo(photo_of(view, scene))
            write_mask(Path(options.dataset) / options.out / f"{image}.png", labels, bits=16)
            print(f"{image}: {len(np.unique(labels[labels > 0]))} areas")
    except GssegError as error:
        sys.exit(f"masks_from_photos: {error}")


if __name__ == "__main__":
    main()
