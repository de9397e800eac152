"""The command `gsseg pick`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from gsseg_core.cli.shared import add_collision, add_format, add_scene, load_kernels, placed
from gsseg_core.cli.terminal import tell
from gsseg_core.errors import SettingsError
from gsseg_core.scene.scene_writers import DEFAULT, SCENE_WRITERS
from gsseg_core.text import quoted

if TYPE_CHECKING:
    import numpy as np

    from gsseg_core.data.dataset import Dataset
    from gsseg_core.objects.pick import Pick
    from gsseg_core.scene.camera import Camera
    from gsseg_core.scene.gaussian_scene import GaussianScene

CANDIDATES = 24  # cameras of which the next view is chosen, spread over all, as neighbours see much the same

DESCRIPTION = """
Finds the Gaussians of one object from its mask in one view, or in a few, and writes it as DIR/object.ply, or another
file, with the indices in DIR/pick.npz and a picture of the first view. Needs no other masks. Prints which further
view's mask would help most, and draws the scene from there as DIR/next.png, for any segmenter. To correct an object by
clicks, use `gsseg view`.
"""
EXAMPLES = """
  gsseg pick scene.ply --data DATASET --view 0001 --mask chair.png --out chair
  gsseg pick scene.ply --data DATASET --view 0001 --mask a.png \\
             --view 0042 --mask b.png --out chair
  gsseg pick scene.ply --data DATASET --view 0001 --mask coco.json \\
             --label chair --out chair
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what the command takes."""
    add_scene(parser)
    view = "a view that shows the object; may be given several times, each with its --mask"
    parser.add_argument("--view", required=True, action="append", metavar="STEM", dest="views", help=view)
    mask = "label image of the view, or masks of another program, such as COCO: every pixel that is not 0 is the object"
    parser.add_argument("--mask", required=True, action="append", metavar="PATH", dest="masks", help=mask)
    label = "only this label is the object: an id, or the name of a class"
    parser.add_argument("--label", help=label)
    parser.add_argument(
        "--out", required=True, metavar="DIR", help="folder for object.ply, pick.npz, pick.png, next.png"
    )
    add_format(parser.add_argument, DEFAULT)
    add_collision(parser.add_argument, "the object, as object.obj and in USD")


def run(options: argparse.Namespace) -> int:
    """Pick, and say what was written."""
    from gsseg_core.data.dataset import Dataset, folders_of
    from gsseg_core.data.view import spread
    from gsseg_core.export.collision import check_collision
    from gsseg_core.export.pictures import save_png
    from gsseg_core.files.run_folder import staged_run
    from gsseg_core.scene.gaussian_scene import GaussianScene
    from gsseg_core.scene.scene_writers import check_format

    dataset = Dataset(options.data)
    options.views = _names_of_views(options, dataset)
    check_format(options.format)
    check_collision(options.collision)
    file = f"object{SCENE_WRITERS[options.format].suffixes[0]}"
    out, scene = Path(options.out), GaussianScene.load(options.scene)
    load_kernels(options.quiet, options.device)
    posed = placed(options, scene, dataset, align=options.align).dataset
    cameras = {camera.name: camera for camera in posed.cameras}
    places = file, "object.obj", "pick.npz", "pick.png", "next.png"
    with staged_run(out, "pick", places=places, inputs=(options.scene, *folders_of(dataset.root))) as run:
        picked = _picked(options, scene, cameras, dataset)
        _write(options, scene, picked, cameras[options.views[0]], run.folder / file, run.id)
        unseen = spread([camera for name, camera in cameras.items() if name not in options.views], CANDIDATES)
        if unseen:
            following = unseen[picked.next_view(scene, unseen, device=options.device)]
            save_png(run.folder / "next.png", _picture(options, scene, following), run.id)
    tell(f"{len(picked.ids):,} of {len(scene):,} Gaussians: {out}/{file}, pick.npz, and pick.png to look at")
    if unseen:
        lens = "" if following.undistortion is None else ", without its lens: masks are of the photo"
        tell(f"a mask of view {quoted(following.name)} would help most: {out}/next.png is the scene from there{lens}")
    return 0


def _names_of_views(options: argparse.Namespace, dataset: Dataset) -> list[str]:
    """Find the views that are asked for; `SettingsError` unless they exist, are different, and each has its mask."""
    from gsseg_core.data.mask_formats.place import view_of

    names = [camera.name for camera in dataset.cameras]
    views = [view_of(view, names) or view for view in options.views]
    for view in views:
        if view not in names:
            raise SettingsError(f"{options.data}: has no view {view!r}; expected a stem such as {min(names)!r}")
    if len(views) != len(options.masks) or len({*views}) != len(views):
        raise SettingsError(
            f"found --view {len(views)} times, of {len({*views})} views, and --mask {len(options.masks)} times; "
            "expected one mask for each view"
        )
    return views


def _picked(options: argparse.Namespace, scene: GaussianScene, cameras: dict[str, Camera], dataset: Dataset) -> Pick:
    """Pick the object that the masks show."""
    from gsseg_core.data.view import View
    from gsseg_core.errors import NoUsableViewsError
    from gsseg_core.objects.pick import pick_masks, read_object_mask

    known = dataset.class_names if options.label and not options.label.isdecimal() else None
    views = [
        View.from_arrays(cameras[name], read_object_mask(mask, cameras[name], options.label, known))
        for name, mask in zip(options.views, options.masks, strict=True)
    ]
    picked = pick_masks(scene, views, device=options.device)
    if not len(picked.ids):
        raise NoUsableViewsError(
            f"{', '.join(options.masks)}: no Gaussian lies more in the object than beside it; expected a mask of "
            "what the scene shows there as Gaussians of its own"
        )
    return picked


def _write(
    options: argparse.Namespace, scene: GaussianScene, picked: Pick, camera: Camera, path: Path, run: str
) -> None:
    """Write the object, as a scene and maybe as a mesh, its indices, and how it is seen by a camera."""
    from gsseg_core.export.collision import collision_mesh
    from gsseg_core.export.pictures import overlay, palette, save_png
    from gsseg_core.scene.scene_writers import SceneObject, write_objects, write_scene

    kind, part, folder = options.collision, scene.subset(picked.ids), path.parent
    mesh = collision_mesh(scene, picked.ids, picked.membership, kind) if kind else None
    if mesh is not None:
        mesh.save(folder / "object.obj", run)
    if SCENE_WRITERS[options.format].together:
        write_objects([SceneObject(part, collision=mesh)], path, options.format, run)
    else:
        write_scene(part, path, options.format, run)
    picked.save(folder / "pick.npz", run)
    shown = picked.silhouette(scene, camera, device=options.device)
    image = _picture(options, scene, camera)
    save_png(folder / "pick.png", overlay(image, shown.astype(int), palette(2)), run)


def _picture(options: argparse.Namespace, scene: GaussianScene, camera: Camera) -> np.ndarray:
    from gsseg_core.export.view_pictures import background_image
    from gsseg_core.raster.backends import make_operator

    return background_image(scene, make_operator(scene, camera, options.device))
