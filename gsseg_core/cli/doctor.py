"""The command `gsseg doctor`: what this machine has of what gsseg needs, and how to get the rest.

Nothing of ROS is imported here, only looked for.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import platform
import re
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from importlib import metadata
from itertools import groupby
from pathlib import Path

from gsseg_core.cli.shared import (
    LABELS,
    add_dataparser,
    add_device,
    add_quiet,
    hint_at_own_ids,
    labels_path,
    load_kernels,
    placed,
)
from gsseg_core.cli.terminal import note, tell
from gsseg_core.errors import CameraFileError, GssegError, SettingsError
from gsseg_core.kernels import kernel_cache

DESCRIPTION = """
Without PATH: prints the versions of gsseg, Python and its packages, the devices, whether the kernels run and where
they are cached, the formats that gsseg reads, the installed extras, and the parts of ROS 2, with the command that
installs each missing one. The exit code is 0 if gsseg works, with or without extras, and 2 if not.

With a scene: prints its format, and what this format keeps of a Gaussian. With a dataset: reads its cameras and masks,
and prints what it holds. With a dataset and --scene: prints whether the cameras fit the scene (exit code 0) or else
which axes, scale, rotation and translation make them fit (exit code 2), and whether the masks lie on what the photos
show.
"""
EXAMPLES = """
  gsseg doctor
  gsseg doctor scan.spz
  gsseg doctor DATASET
  gsseg doctor DATASET --scene scene.ply
"""

_REQUIREMENT = re.compile(r"(?P<name>[A-Za-z0-9._-]+)")
_EXTRA = re.compile(r"""extra\s*==\s*["'](?P<extra>[^"']+)["']""")
# The extras for users; those for developers are looked for by their own tools.
_EXTRAS_FOR = {
    "view": "gsseg view, the scene in the browser",
    "formats": "--format compressed-ply, spz; reading SPZ of version 4, YAML of masks",
    "usd": "--format usd, --collision surface, poisson",
    "ros": "the ROS 2 nodes, on a machine without ROS from apt",
    "distributed": "gsseg segment --scheduler, several machines",
    "cuda12": "--device cuda, on a machine with an NVIDIA GPU",
    "cuda13": "the same, with a driver of CUDA 13",
}
_ROS_MODULES = {
    "rclpy": "ROS 2 itself: source its setup file, or see the extra ros above",
    "gsseg_msgs": "the messages: pip install ./msg_defs, or in a workspace ln -s gsseg/msg_defs src/gsseg_msgs",
    "gsseg_ros": "the nodes: they come with gsseg",
    "tf2_ros": "only for poses from TF or in other frames than the map; apt install ros-jazzy-tf2-ros",
}
_ROS_VARIABLES = ("ROS_DISTRO", "RMW_IMPLEMENTATION", "ROS_DOMAIN_ID")


@dataclass(frozen=True)
class Finding:
    """One line of what `gsseg doctor` prints."""

    group: str
    name: str
    state: str
    mark: str = "ok"  # "-" for an option that is missing, "!!" for something without which gsseg does not work, or ""
    fix: str = ""  # what to do, if anything


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what the command takes."""
    what = "a scene, or a dataset (with --scene: do its cameras fit that scene?)"
    parser.add_argument("path", nargs="?", metavar="PATH", help=what)
    parser.add_argument("--scene", metavar="SCENE", help="trained scene that cameras of the dataset should fit")
    labels = "the masks, as for gsseg segment; --scene uses them where there are no photos (default: labels)"
    parser.add_argument("--labels", default=LABELS, metavar="PATH", help=labels)
    add_dataparser(parser)
    add_device(parser)
    add_quiet(parser)


def run(options: argparse.Namespace) -> int:
    """Look, and print what was found."""
    if options.scene and not options.path:
        raise SettingsError(
            "gsseg doctor: --scene is given alone; expected a dataset as well, whose cameras should fit it"
        )
    if not options.path:
        findings = examine(note)
        tell(describe(findings))
        return 0 if works(findings) else 2
    options.labels = labels_path(options.path, options.labels)
    try:
        if options.scene:
            return _examine_frame(options)
        with hint_at_own_ids():
            dataset = examine_dataset(options.path, options.labels)
    except CameraFileError as error:  # Hints are for commands that have --data.
        raise CameraFileError(str(error).replace("type --data ", "type gsseg doctor ")) from error
    tell(_listed(dataset or examine_scene(options.path)))
    return 0


def _examine_frame(options: argparse.Namespace) -> int:
    """Look whether the cameras of a dataset fit a scene, and print what makes them fit."""
    from gsseg_core.align.agreement import far_off
    from gsseg_core.data.dataset import Dataset
    from gsseg_core.scene.gaussian_scene import GaussianScene

    scene, dataset = GaussianScene.load(options.scene), Dataset(options.path, options.labels)
    load_kernels(options.quiet, options.device)
    found = placed(options, scene, dataset, align=True)
    tell(found.describe())
    if told := far_off(scene.rounding):
        note(told)
    return 0 if found.fits else 2


def examine(say: Callable[[str], object] = lambda text: None) -> list[Finding]:
    """Look at this machine, and segment a handful of Gaussians to see whether the core works.

    `say` is told if kernels have to be compiled, which takes half a minute or more.
    """
    return [*_versions(), *_devices(), *_kernels(say), *_formats(), *_extras(), *_ros()]


def examine_scene(path: str) -> list[Finding]:
    """Read a scene, and say its format, and what that keeps of it; raises what `GaussianScene.load` raises."""
    from gsseg_core.scene.gaussian_scene import GaussianScene
    from gsseg_core.scene.scene_formats import SCENE_FORMATS, find_format, read_scene
    from gsseg_core.text import clipped, counted

    read = read_scene(path)
    scene = GaussianScene.from_vertices(read.vertices, Path(path))
    known = find_format(Path(path)) or SCENE_FORMATS[0]
    version = f", version {read.version}" if read.version else ""
    name = clipped(path)
    remarks = [Finding(name, "here", remark, "") for remark in read.remarks]
    return [
        Finding(name, "format", f"{known.name}{version}"),
        Finding(name, "holds", f"{counted(len(scene), 'Gaussian')}, SH of degree {scene.sh_degree}"),
        Finding(name, "keeps", known.keeps, ""),
        *remarks,
        Finding(name, "order", "labels are in the order of this file", ""),
    ]


def examine_dataset(path: str, labels: str) -> list[Finding]:
    """Read the cameras and all masks of a dataset, and say what is there; nothing of a scene.

    Raises what `Dataset` and `View.read_labels` raise, with where a scene lies in a folder that has no cameras.
    """
    from gsseg_core.data.camera_files import find_cameras, read_cameras
    from gsseg_core.data.dataset import Dataset
    from gsseg_core.data.hints import mask_hint
    from gsseg_core.data.label_images import EXPECTED_IDS
    from gsseg_core.scene.scene_formats import find_format, scene_hint
    from gsseg_core.text import clipped, counted, masks_line

    found = find_cameras(Path(path)) if os.path.isdir(path) else None
    if found is None:
        if os.path.isdir(path) and find_format(Path(path)) is None:
            try:
                read_cameras(path)
            except CameraFileError as error:
                raise CameraFileError(f"{error}{scene_hint(Path(path))}") from error
        return []
    dataset, name = Dataset(path, labels), clipped(path)
    masked = [view for view in dataset.views() if view.has_mask]
    ids = {0}.union(*(view.class_ids() for view in masked))
    train, test = (len(dataset.views(split)) for split in ("train", "test"))
    rest = len(dataset.views()) - train - test
    unused = f", {rest} for neither: split.json names them nowhere, or not as train or test" if rest else ""
    told, mark, fix = f"of {counted(len(masked), 'view')}; all can be read", "ok", ""
    if not masked:
        hint = mask_hint(Path(path), labels, [view.camera.image for view in dataset.views()])
        told, mark, fix = f"none in {clipped(labels)}", "-", hint.removeprefix("; ")
    elif ids == {0}:
        told, mark, fix = f"of {counted(len(masked), 'view')}; none of them names an object", "-", EXPECTED_IDS
    described = dataset.describe_masks()
    return [
        Finding(name, "cameras", f"{found[0].name}: {train} to learn from, {test} to test{unused}"),
        Finding(name, "masks", told, mark, fix),
        *([Finding(name, "format", masks_line(described), "")] if described else []),
        Finding(name, "scene", "not looked at", "", f"gsseg doctor {name} --scene SCENE tells whether cameras fit"),
    ]


def works(findings: list[Finding]) -> bool:
    """Whether nothing is missing without which gsseg does not work."""
    return all(finding.mark != "!!" for finding in findings)


def describe(findings: list[Finding]) -> str:
    """Write findings as text for a terminal, group by group, and the verdict."""
    missing = sum(finding.mark == "-" for finding in findings)
    verdict = "gsseg works here" if works(findings) else "gsseg does not work here: see the lines marked !!"
    options = f"; what is marked - ({missing}) is optional" if missing else ""
    return "\n".join([_listed(findings), "", verdict + options])


def _listed(findings: list[Finding]) -> str:
    width = max(len(finding.name) for finding in findings)
    lines: list[str] = []
    for group, of_group in groupby(findings, lambda finding: finding.group):
        lines += ["", group] if lines else [group]
        for finding in of_group:
            lines.append(f"  {finding.mark:2}  {finding.name.ljust(width)}  {finding.state}".rstrip())
            if finding.fix:
                lines.append(f"      {' ' * width}  -> {finding.fix}")
    return "\n".join(lines)


def _versions() -> Iterator[Finding]:
    yield Finding("machine", "gsseg", metadata.version("gsseg"))
    supported = (3, 10) <= sys.version_info[:2] <= (3, 14)
    mark, fix = ("ok", "") if supported else ("!!", "use Python 3.10 to 3.14")
    yield Finding("machine", "Python", f"{platform.python_version()}, {sys.executable}", mark, fix)
    yield Finding("machine", "system", f"{platform.system()} {platform.release()}, {platform.machine()}")
    for name in _requirements(""):
        found = _version(name)
        fix = "" if found else f"pip install {name}"
        yield Finding("packages", name, found or "missing", "ok" if found else "!!", fix)


def _extras() -> Iterator[Finding]:
    for extra, purpose in _EXTRAS_FOR.items():
        names = _requirements(extra)
        missing = [name for name in names if not _version(name)]
        if missing:
            fix = f"pip install 'gsseg[{extra}]'"
            yield Finding("extras", extra, f"{purpose}: lacks {', '.join(missing)}", "-", fix)
        elif names:
            yield Finding("extras", extra, purpose)


def _devices() -> Iterator[Finding]:
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    try:
        import numba

        threads = f"{numba.get_num_threads()} threads on {cores} cores"
        fix = "NUMBA_NUM_THREADS is set; unset it to use all cores" if numba.get_num_threads() < cores else ""
        yield Finding("devices", "cpu", threads, "ok", fix)
    except ImportError:
        yield Finding("devices", "cpu", f"{cores} cores")
    try:
        os.getcwd()
    except FileNotFoundError:  # PyTorch would end this process as it loads.
        yield Finding("devices", "cuda", "not looked at: the current folder is gone", "-", "cd to one that is there")
        return
    try:
        import torch

        gpus = [torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count())]
    except (ImportError, OSError, RuntimeError) as error:
        fix = "pip install --force-reinstall torch"
        yield Finding("devices", "cuda", f"PyTorch does not load ({error})", "!!", fix)
        return
    if gpus:
        yield Finding("devices", "cuda", ", ".join(gpus))
    elif shutil.which("nvidia-smi"):
        fix = "install PyTorch's CUDA build, and look whether nvidia-smi shows a GPU"
        yield Finding("devices", "cuda", f"PyTorch {torch.__version__} sees no GPU", "-", fix)
    else:
        yield Finding("devices", "cuda", "no GPU; everything runs on the CPU")


def _kernels(say: Callable[[str], object]) -> Iterator[Finding]:
    start = time.perf_counter()
    try:
        from gsseg_core.raster.vote_total import add_pairs
        from gsseg_core.warm_up import SIDE, warm_up

        warm_up(say=say)
    except (ImportError, OSError, RuntimeError, GssegError) as error:
        fix = "install the packages marked !! above"
        yield Finding("kernels", "run", f"{type(error).__name__}: {error}", "!!", fix)
        return
    seconds = time.perf_counter() - start
    compiled = "from the cache" if add_pairs.stats.cache_hits else "compiled just now"
    yield Finding("kernels", "run", f"segmented {SIDE**2:,} Gaussians in {seconds:.1f} s, {compiled}")
    if kernel_cache.FOLDER and not kernel_cache.INCOMPLETE:
        yield Finding("kernels", "cache", add_pairs.stats.cache_path or kernel_cache.FOLDER)
    else:
        folders = [kernel_cache.FOLDER] if kernel_cache.FOLDER else kernel_cache.candidates()
        state = f"{'incomplete' if kernel_cache.FOLDER else 'none'}: cannot write to {' or '.join(folders)}"
        fix = f"{kernel_cache.REMEDY}; else every run compiles for about a minute on two cores"
        yield Finding("kernels", "cache", state, "-", fix)


def _formats() -> Iterator[Finding]:
    with suppress(ImportError):  # What is missing is said above.
        from gsseg_core.data.camera_formats.table import CAMERA_FORMATS
        from gsseg_core.data.mask_formats.table import LABEL_IMAGES, MASK_FORMATS
        from gsseg_core.scene.scene_formats import SCENE_FORMATS

        for group, formats in (("scene formats", SCENE_FORMATS), ("camera formats", CAMERA_FORMATS)):
            for known in formats:
                yield Finding(group, known.name, known.looked_for)
        yield Finding("mask formats", LABEL_IMAGES, "<stem>.png")
        for masks in MASK_FORMATS:
            yield Finding("mask formats", masks.name, masks.looked_for.replace("`", ""))


def _ros() -> Iterator[Finding]:
    for name, fix in _ROS_MODULES.items():
        found = importlib.util.find_spec(name) is not None
        yield Finding("ROS 2", name, "found" if found else "missing", "ok" if found else "-", "" if found else fix)
    programs = [name for name in ("segment_node", "replay_node") if shutil.which(name)]
    state = f"{' and '.join(programs)} can be started" if programs else "not on the PATH; in a workspace: ros2 run"
    yield Finding("ROS 2", "programs", state, "ok" if programs else "-")
    for name in _ROS_VARIABLES:
        yield Finding("ROS 2", name, os.environ.get(name, "not set"), "")


def _requirements(extra: str) -> list[str]:
    """List the packages that an extra of gsseg needs, or, for "", those that gsseg always needs."""
    names = []
    for line in metadata.requires("gsseg") or []:
        name, belongs = _REQUIREMENT.match(line), _EXTRA.search(line)
        if name and (belongs["extra"] if belongs else "") == extra:
            names.append(name["name"])
    return sorted(set(names))


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return ""
