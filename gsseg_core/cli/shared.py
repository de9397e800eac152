"""Arguments and steps that several commands of `gsseg` share."""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from gsseg_core.cli.terminal import note
from gsseg_core.errors import GssegError, PathTakenError, SettingsError, UnknownLabelError
from gsseg_core.progress import progress_bars
from gsseg_core.raster.backends import devices, rasteriser_of
from gsseg_core.scene.scene_writers import SCENE_WRITERS

if TYPE_CHECKING:
    from gsseg_core.align.placing import Placed
    from gsseg_core.data.dataset import Dataset
    from gsseg_core.scene.gaussian_scene import GaussianScene

LABELS = "labels"  # folder of the masks in a dataset, unless `--labels` names another
OWN_IDS = "where an id holds in its own view only, as SAM's do, it takes --ids per-view"


def add_scene(parser: argparse.ArgumentParser) -> None:
    """Add the scene, the dataset, the device and `--quiet`."""
    parser.add_argument("scene", metavar="SCENE", help="trained 3DGS scene, of any format that gsseg reads")
    data = "folder with cameras, labels/<stem>.png, classes.json, split.json"
    parser.add_argument("--data", required=True, metavar="DATASET", help=data)
    add_frame(parser)
    add_device(parser)
    add_quiet(parser)


def add_frame(parser: argparse.ArgumentParser) -> None:
    """Add `--align` and `--dataparser`."""
    find = "find the cameras' place in the scene and move them there; see gsseg doctor"
    parser.add_argument("--align", action="store_true", help=find)
    add_dataparser(parser)


def add_dataparser(parser: argparse.ArgumentParser) -> None:
    """Add `--dataparser`."""
    file = "nerfstudio's dataparser_transforms.json, if it lies neither beside the scene nor in DATASET"
    parser.add_argument("--dataparser", metavar="FILE", help=file)


def add_device(parser: argparse.ArgumentParser) -> None:
    """Add `--device`."""
    parser.add_argument("--device", type=_device, default="cpu", help=f"{devices()} (default: cpu)")


def add_quiet(parser: argparse.ArgumentParser) -> None:
    """Add `--quiet`."""
    parser.add_argument("--quiet", action="store_true", help="no progress bars")


def add_format(add: Callable[..., object], default: str | None, otherwise: str = "%(default)s") -> None:
    """Add `--format` by the `add_argument` of a parser or group; `otherwise` says what counts where it is left out."""
    add("--format", choices=tuple(SCENE_WRITERS), default=default, help=f"format to write (default: {otherwise})")


def add_collision(add: Callable[..., object], what: str) -> None:
    """Add `--collision` by the `add_argument` of a parser or group; `what` says of what, and where they are written."""
    mesh = f"collision mesh of {what}: convex hull, watertight, or Poisson surface (default: none, or hull)"
    add("--collision", nargs="?", choices=("hull", "surface", "poisson"), const="hull", help=mesh)


def labels_path(data: str, labels: str) -> str:
    """Return the place of the masks: in the dataset, or else, where that lacks it, as a shell completes it."""
    is_elsewhere = not os.path.exists(os.path.join(data, labels)) and os.path.exists(labels)
    # The default is a folder of the dataset only: masks that lie here by chance were not asked for.
    if not is_elsewhere or labels == LABELS:
        return labels
    place, root = Path(os.path.abspath(labels)), os.path.abspath(data)
    # What lies in the dataset moves with it, and reports are read after that, too.
    return str(place.relative_to(root) if place.is_relative_to(root) else place)


@contextmanager
def hint_at_own_ids() -> Iterator[None]:
    """Add to the error of an id that is no class how ids of a view's own are learnt: by `gsseg segment` alone."""
    try:
        yield
    except UnknownLabelError as error:
        raise UnknownLabelError(f"{error}; {OWN_IDS}") from error


def placed(options: argparse.Namespace, scene: GaussianScene, dataset: Dataset, *, align: bool) -> Placed:
    """Put the cameras of a dataset where they are in a scene, by the options of `add_frame`, and show progress."""
    from gsseg_core.align.placing import place

    with progress_bars(options.quiet) as progress:
        return place(
            scene, dataset, align=align, dataparser=options.dataparser, device=options.device, progress=progress
        )


def note_frame(options: argparse.Namespace) -> None:
    """Warn if the run that made a segmentation moved the cameras, by a file or `--align`, and this one does not."""
    from gsseg_core.files.json_files import read_object

    report = Path(options.segmentation).parent / "report.json"
    with suppress(GssegError, KeyError, TypeError):  # There may be no report, or one of a run that moved none.
        frame = read_object(report, GssegError, "a report")["frame"]
        file = frame["dataparser"] and Path(frame["dataparser"])
        if file and not (options.dataparser or _is_found(file, options)):
            note(f"{report}: that run moved the cameras by {file}, and here they are not; try --dataparser {file}")
        found = "; ".join(frame["alignment"]["found"])
        if found and not options.align:
            note(f"{report}: that run moved the cameras by --align ({found}), and here they are not; try --align")


def _is_found(file: Path, options: argparse.Namespace) -> bool:
    """Whether the file of nerfstudio that a run took is the one that is found here; it may be named from elsewhere."""
    from gsseg_core.data.camera_formats.dataparser import DATAPARSER

    beside = (os.path.join(folder, DATAPARSER) for folder in (Path(options.scene).parent, options.data))
    found = next(filter(os.path.exists, beside), None)
    return found is not None and (os.path.samefile(file, found) if os.path.exists(file) else file.name == DATAPARSER)


def load_kernels(quiet: bool, device: str = "cpu") -> None:
    """Compile the kernels or load them, and say so if it takes long."""
    from gsseg_core.warm_up import warm_up

    warm_up(device, (lambda text: None) if quiet else note)


def _device(text: str) -> str:
    try:
        rasteriser_of(text)
    except SettingsError as error:
        raise argparse.ArgumentTypeError(str(error)) from error
    return text


def check_not_read(out: str, what: str, path: str) -> None:
    """Raise `PathTakenError` if a file to write is, links followed, a file that is read, which messages call `what`."""
    if os.path.exists(out) and os.path.exists(path) and os.path.samefile(out, path):
        raise PathTakenError(f"{out}: is the {what} that is read, and would be lost; expected another file")
