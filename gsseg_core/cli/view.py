"""The command `gsseg view`."""

from __future__ import annotations

import argparse
import os
import threading
import webbrowser
from contextlib import closing, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from gsseg_core.cli.shared import add_device, add_frame, add_quiet, load_kernels, note_frame, placed
from gsseg_core.cli.terminal import note, tell
from gsseg_core.errors import SettingsError
from gsseg_core.text import counted

if TYPE_CHECKING:
    from gsseg_core.data.dataset import Dataset
    from gsseg_core.data.view import View
    from gsseg_core.segmentation import Segmentation
    from gsseg_core.viewer.access import Listener
    from gsseg_core.viewer.learnt_views import LearntFrom
    from gsseg_core.viewer.viewer import Viewer

DESCRIPTION = """
Serves a page that draws the scene in true colours, by class or by confidence. There you can show single classes,
correct them and export them. With --ros the page follows a ROS 2 node while it learns.
"""
EXAMPLES = """
  gsseg view scene.ply --segmentation out/segmentation.npz --data DATASET
  gsseg view scene.ply --ros
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what the command takes."""
    parser.add_argument("scene", metavar="SCENE", help="trained 3DGS scene, of any format that gsseg reads")
    parser.add_argument("--segmentation", metavar="FILE", help="segmentation.npz of this scene")
    data = "dataset that the segmentation was learnt from, to jump to its views"
    parser.add_argument("--data", metavar="DATASET", help=data)
    parser.add_argument("--ros", action="store_true", help="follow the ROS 2 node `gsseg` while it learns")
    host = "0.0.0.0 admits other machines that have the address with its token (default: %(default)s)"
    parser.add_argument("--host", default="127.0.0.1", help=host)
    parser.add_argument("--port", type=int, default=8080, help="default: %(default)s, or the next one that is free")
    draw = "where to draw: in the browser; on the server, which sends images; or (default) in the browser if it is fast"
    parser.add_argument("--draw", choices=("auto", "browser", "server"), default="auto", help=draw)
    parser.add_argument("--open", action="store_true", help="open the page in a browser")
    add_frame(parser)
    add_device(parser)
    add_quiet(parser)


def run(options: argparse.Namespace) -> int:
    """Show the scene until interrupted."""
    try:
        from gsseg_core.viewer.viewer import Viewer
    except ModuleNotFoundError as missing:
        if missing.name != "viser":
            raise
        raise SettingsError("`gsseg view` needs viser, which is missing: pip install 'gsseg[view]'") from missing
    from gsseg_core.viewer.access import listen

    if options.ros and options.segmentation:
        raise SettingsError("both --ros and --segmentation are given; expected one: the node has codes of its own")
    with closing(listen(options.host, options.port)) as listener:
        return _show(options, listener, Viewer)


def _show(options: argparse.Namespace, listener: Listener, make: type[Viewer]) -> int:
    from gsseg_core.scene.gaussian_scene import GaussianScene
    from gsseg_core.segmentation import Segmentation
    from gsseg_core.viewer.learnt_views import LearntFrom
    from gsseg_core.viewer.live_source import open_source
    from gsseg_core.viewer.model import BY_CLASS, TRUE_COLOURS, Labelling, ViewModel

    load_kernels(options.quiet, options.device)
    scene = GaussianScene.load(options.scene)
    segmentation = Segmentation.load(options.segmentation, scene) if options.segmentation else None
    class_ids = segmentation.class_ids.tolist() if segmentation else []
    learnt = LearntFrom.read(Path(options.segmentation).parent / "report.json") if segmentation else LearntFrom()
    dataset = learnt.dataset(options.data) if options.data else None
    if dataset:
        if segmentation:
            note_frame(options)
        dataset = placed(options, scene, dataset, align=options.align).dataset
    if dataset and not options.ros:  # The node's ids are as they are.
        class_ids = class_ids or list(dataset.class_ids)
        dataset = dataset.numbered(class_ids)
    views = _views(options, learnt, dataset, segmentation) if dataset else []
    read = segmentation.numbered() if segmentation else None
    labelling = Labelling.of(read) if read else Labelling.unknown(len(scene), dataset.class_names if dataset else None)
    source = open_source("ros", scene) if options.ros else None
    mode = BY_CLASS if options.segmentation or options.ros else TRUE_COLOURS
    tree = read.tree if read else None  # A node tells labels alone.
    model = ViewModel(scene, labelling, mode=mode, class_ids=tuple(class_ids), tree=tree, read=read)
    viewer = make(model, views, learnt.reliability, source, listener=listener, draw=options.draw, device=options.device)
    with closing(viewer), suppress(KeyboardInterrupt):  # How it is meant to end.
        tell(f"gsseg: {counted(len(scene), 'Gaussian')} at {viewer.url} (Ctrl-C ends it)")
        if listener.everywhere:
            tell("gsseg: from elsewhere, put a name or address of this machine in place of localhost")
        # Without a screen, that would start a browser of text in this very terminal.
        if options.open and any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY")):
            webbrowser.open(viewer.url)
        threading.Event().wait()
    return 0


def _views(
    options: argparse.Namespace, learnt: LearntFrom, dataset: Dataset, segmentation: Segmentation | None
) -> list[View]:
    """List the views to jump to; where there are none, say why."""
    from gsseg_core.objects.object_table import object_name

    views = learnt.views(dataset)
    found = segmentation and any(name == object_name(k) for k, name in segmentation.class_names.items() if k)
    if not views:
        why = f"found no mask of a train view in {Path(options.data) / learnt.labels}"
    elif found and learnt.report is None:
        # As of one that was saved from the viewer. Its masks would be shown as objects that they are not.
        why = f"no report.json beside {options.segmentation} says what ids of masks are"
    else:
        return views
    note(f"there are no views to jump to: {why}")
    return []
