"""The command `gsseg pick`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from gsseg_core.cli.shared import add_collision, add_format, add_scene, load_kernels
from gsseg_core.cli.terminal import tell
from gsseg_core.errors import SettingsError
from gsseg_core.progress import progress_bars
from gsseg_core.scene.scene_writers import DEFAULT

DESCRIPTION = """
Finds the Gaussians of one object that is shown in one view, by a mask (best) or by clicks, and writes it as
DIR/object.ply, or another file, with the indices in DIR/pick.npz and a picture of the view. Needs no other masks.
"""
EXAMPLES = """
  gsseg pick scene.ply --data DATASET --view 0001 --mask chair.png --out chair
  gsseg pick scene.ply --data DATASET --view 0001 --mask coco.json \\
             --label chair --out chair
  gsseg pick scene.ply --data DATASET --view 0001 --click 160 120 --out cup
  gsseg pick scene.ply --data D --view 0001 --click 16 12 --not 20 12 --out cup
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what the command takes."""
    add_scene(parser)
    parser.add_argument("--view", required=True, metavar="STEM", help="the view in which it is shown")
    how = parser.add_mutually_exclusive_group(required=True)
    mask = "label image of the view, or masks of another program, as COCO: all that is not 0 is the object"
    how.add_argument("--mask", metavar="PATH", help=mask)
    pixel: dict[str, Any] = {"nargs": 2, "type": int, "action": "append", "metavar": ("COLUMN", "ROW")}
    how.add_argument("--click", **pixel, help="a pixel of the object; several add up")
    parser.add_argument("--not", **pixel, dest="outside", default=[], help="with --click: a pixel that is not of it")
    label = "with --mask: the object is this label alone, an id or the name that another program's masks have"
    parser.add_argument("--label", help=label)
    parser.add_argument("--out", required=True, metavar="DIR", help="gets object.ply, pick.npz and pick.png")
    add_format(parser.add_argument, DEFAULT)
    add_collision(parser.add_argument, "the object, as object.obj and in USD")


def run(options: argparse.Namespace) -> int:
    """Pick, and say what was written."""
    from gsseg_core.align.placing import place
    from gsseg_core.data.dataset import Dataset
    from gsseg_core.data.view import View
    from gsseg_core.export.collision import check_collision, collision_mesh
    from gsseg_core.export.pictures import overlay, palette, save_png
    from gsseg_core.export.view_pictures import background_image
    from gsseg_core.files.run_folder import staged_run
    from gsseg_core.objects.pick import pick_clicks, pick_mask, read_object_mask
    from gsseg_core.raster.backends import make_operator
    from gsseg_core.scene.gaussian_scene import GaussianScene
    from gsseg_core.scene.scene_writers import SCENE_WRITERS, SceneObject, check_format, write_objects, write_scene

    dataset = Dataset(options.data)
    names = [camera.name for camera in dataset.cameras]
    if options.view not in names:
        raise SettingsError(f"{options.data}: has no view {options.view!r}; expected a stem such as {min(names)!r}")
    if options.mask and options.outside:
        raise SettingsError("--not goes with --click; found it with --mask, which says itself what is not the object")
    check_format(options.format)
    check_collision(options.collision)
    writer = SCENE_WRITERS[options.format]
    file = f"object{writer.suffixes[0]}"
    out, scene = Path(options.out), GaussianScene.load(options.scene)
    load_kernels(options.quiet, options.device)
    with progress_bars(options.quiet) as progress:
        placed = place(
            scene, dataset, align=options.align, dataparser=options.dataparser, device=options.device, progress=progress
        )
    camera = placed.dataset.cameras[names.index(options.view)]
    with staged_run(out, "pick", places=(file, "object.obj", "pick.npz", "pick.png")) as run:
        if options.mask:
            view = View.from_arrays(camera, read_object_mask(options.mask, camera, options.label))
            picked = pick_mask(scene, view, device=options.device)
        else:
            inside, outside = ([(row, column) for column, row in clicks] for clicks in (options.click, options.outside))
            picked = pick_clicks(scene, camera, inside, outside, device=options.device)
        shown = picked.silhouette(scene, camera, device=options.device)
        image = background_image(scene, make_operator(scene, camera, options.device))
        kind, part = options.collision, scene.subset(picked.ids)
        mesh = collision_mesh(scene, picked.ids, picked.membership, kind) if kind else None
        if mesh is not None:
            mesh.save(run.folder / "object.obj", run.id)
        if writer.together:
            write_objects([SceneObject(part, collision=mesh)], run.folder / file, options.format, run.id)
        else:
            write_scene(part, run.folder / file, options.format, run.id)
        picked.save(run.folder / "pick.npz", run.id)
        save_png(run.folder / "pick.png", overlay(image, shown.astype(int), palette(2)), run.id)
    tell(f"{len(picked.ids):,} of {len(scene):,} Gaussians: {out}/{file}, pick.npz, and pick.png to look at")
    return 0
