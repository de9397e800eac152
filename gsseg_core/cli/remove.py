"""The command `gsseg remove`."""

from __future__ import annotations

import argparse
from pathlib import Path

from gsseg_core.cli.terminal import tell

DESCRIPTION = """
Writes a valid 3DGS PLY of all Gaussians but those of the given classes. What an object hid, no camera has seen: where
it stood there may be holes, and nothing is made up to fill them.
"""
EXAMPLES = """
  gsseg remove scene.ply --segmentation out/segmentation.npz --class chair \\
               --out without_chair.ply
  gsseg remove scene.ply --segmentation out/segmentation.npz --class chair \\
               --class 7 --out rest.ply
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what the command takes."""
    parser.add_argument("scene", metavar="SCENE.ply", help="trained 3DGS scene")
    parser.add_argument("--segmentation", required=True, metavar="FILE", help="segmentation.npz of this scene")
    classes = "id or name of a class to leave out, a number being an id; may be given several times"
    parser.add_argument("--class", dest="classes", action="append", required=True, metavar="NAME", help=classes)
    parser.add_argument("--out", required=True, metavar="PLY", help="file to write")


def run(options: argparse.Namespace) -> int:
    """Remove, and say what is left."""
    from gsseg_core.data.class_names import class_ids, listed
    from gsseg_core.files.atomic import check_writable
    from gsseg_core.objects.removal import without_objects
    from gsseg_core.scene.gaussian_scene import GaussianScene
    from gsseg_core.segmentation import Segmentation
    from gsseg_core.text import clipped, counted

    check_writable(options.out)
    scene = GaussianScene.load(options.scene)
    segmentation = Segmentation.load(options.segmentation, scene)
    chosen = class_ids(options.classes, segmentation.class_names)
    rest = without_objects(scene, segmentation, chosen)
    rest.save(Path(options.out))
    removed = listed(f"{k} ({clipped(segmentation.class_names[k])})" for k in chosen)
    tell(f"without {removed}: {len(rest):,} of {counted(len(scene), 'Gaussian')} in {options.out}")
    return 0
