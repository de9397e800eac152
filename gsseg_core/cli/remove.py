"""The command `gsseg remove`."""

from __future__ import annotations

import argparse

from gsseg_core.cli.shared import add_collision, add_format, add_quiet, check_not_read
from gsseg_core.cli.terminal import tell
from gsseg_core.progress import progress_bars

DESCRIPTION = """
Writes all Gaussians except those of the given classes as a valid 3DGS PLY, or a file of another format. No camera saw
what the removed object hid: there may be holes where it stood, and gsseg does not fill them.
"""
EXAMPLES = """
  gsseg remove scene.ply --segmentation out/segmentation.npz --class chair \\
               --out without_chair.ply
  gsseg remove scene.ply --segmentation out/segmentation.npz --class chair \\
               --class 7 --out rest.spz
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what the command takes."""
    parser.add_argument("scene", metavar="SCENE", help="trained 3DGS scene, of any format that gsseg reads")
    parser.add_argument("--segmentation", required=True, metavar="FILE", help="segmentation.npz of this scene")
    classes = "id or name of a class, part or whole to remove (a number is an id); may be given several times"
    parser.add_argument("--class", dest="classes", action="append", required=True, metavar="NAME", help=classes)
    parser.add_argument("--out", required=True, metavar="FILE", help="file to write")
    add_format(parser.add_argument, None, "by the suffix of FILE, else ply")
    add_collision(parser.add_argument, "each remaining object, as .obj beside FILE, or in a USD")
    add_quiet(parser)


def run(options: argparse.Namespace) -> int:
    """Remove, and say what is left."""
    from pathlib import Path

    from gsseg_core.data.class_names import class_ids, listed
    from gsseg_core.export.class_files import write_selection
    from gsseg_core.export.collision import check_collision
    from gsseg_core.files.atomic import check_replaceable, check_writable
    from gsseg_core.objects.removal import left_without
    from gsseg_core.scene.gaussian_scene import GaussianScene
    from gsseg_core.scene.scene_formats import find_format
    from gsseg_core.scene.scene_writers import SCENE_WRITERS, check_format, format_of
    from gsseg_core.segmentation import Segmentation
    from gsseg_core.text import clipped, counted

    check_writable(options.out)
    check_not_read(options.out, "scene", options.scene)
    check_not_read(options.out, "segmentation", options.segmentation)
    scene_format = format_of(options.out, options.format)
    path, suffixes = Path(options.out), SCENE_WRITERS[scene_format].suffixes
    is_scene = path.name.lower().endswith(suffixes) or find_format(path) is not None
    check_replaceable(path, "scene", is_scene or not (path.exists() and path.stat().st_size))
    check_format(scene_format)
    check_collision(options.collision)
    scene = GaussianScene.load(options.scene)
    segmentation = Segmentation.load(options.segmentation, scene)
    names = segmentation.node_names
    chosen = class_ids(options.classes, names, options.segmentation)
    rest = left_without(scene, segmentation, chosen)
    with progress_bars(options.quiet) as progress:
        write_selection(
            scene, rest, segmentation.labels, segmentation.confidence, segmentation.class_names, options.out,
            scene_format, options.collision, progress,
        )  # fmt: skip
    removed = listed(f"{k} ({clipped(names[k])})" for k in chosen)
    tell(f"without {removed}: {int(rest.sum()):,} of {counted(len(scene), 'Gaussian')} in {options.out}")
    return 0
