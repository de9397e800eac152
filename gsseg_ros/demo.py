"""The demo: a table-top scene with known truth, segmented as robots do it, by nodes that talk over DDS.

One process is the segmentation node, one plays the robot and publishes posed masks that are wrong as real ones are,
and this one asks for learning, objects and pictures.
"""

from __future__ import annotations

import argparse
import os
import signal
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from gsseg_core.data.dataset import Dataset
from gsseg_core.data.label_images import write_mask
from gsseg_core.data.view import View, spread
from gsseg_core.demo.run import gaussian_ious
from gsseg_core.demo.table_scene import DemoScene, build_demo
from gsseg_core.errors import GssegError
from gsseg_core.export.pictures import contact_sheet, palette, save_png
from gsseg_core.export.view_pictures import write_overview
from gsseg_core.files.run_folder import StagedRun, staged_run
from gsseg_core.freed_memory import search_no_imports_at_the_end
from gsseg_core.learn.learner import Progress, silent
from gsseg_core.metrics import evaluate_folders
from gsseg_core.progress import Stopwatch, progress_bars
from gsseg_core.segmentation import Segmentation
from gsseg_core.text import percent, seconds_table, table
from gsseg_ros.child_nodes import ChildNodes
from gsseg_ros.client import Exported, NodeUnavailableError, RenderedView, SegmentationClient, Viewpoint

T = TypeVar("T")

START_SECONDS = 240.0
"""How long the node may take to start: the first time, kernels are compiled."""

SLICE_SECONDS = 2.0
COMPARED_VIEWS = 3


def run_demo(out: Path, nodes: ChildNodes, *, seed: int = 0, rate: float = 10.0, progress: Progress = silent) -> str:
    """Build the scene, replay its masks to a node, learn, segment, look, export; return how well that went, as tables.

    Raises `GssegError`: a node could not be started or asked; its log says more.
    """
    watch = Stopwatch()
    with watch.stage("build the scene"):
        demo = build_demo(out / "scene", seed)
    with SegmentationClient(domain_id=nodes.domain_id) as client:
        with watch.stage("start the node"):
            _start(client, nodes, demo, progress)
        with watch.stage(f"fuse masks as they come, {rate:g} per second"):
            _replay(client, nodes, demo, rate, progress)
        with watch.stage("learn"):
            learnt = client.learn(on_feedback=lambda stage, done, total, loss: progress(stage, done, total))
        with watch.stage("segment: from request to last cloud"):
            result = client.segment()
        test = Dataset(demo.root, "labels_true").views("test")
        with watch.stage("segment again, with a viewpoint"):
            client.segment(viewpoint=Viewpoint.of(test[0].camera))
        train = spread(Dataset(demo.root).views("train"), COMPARED_VIEWS)
        with watch.stage(f"render {len(test) + len(train)} views"):
            rendered = [client.render_view(Viewpoint.of(view.camera), with_overlay=True) for view in test]
            seen = [client.render_view(Viewpoint.of(view.camera)).labels for view in train]
        with watch.stage("export"):
            exported = client.export("segmented")
    with watch.stage("pictures and scores"):
        segmentation = Segmentation.load(exported.folder / "segmentation.npz", demo.scene)
        # As `gsseg render` writes it, so that either demo may go where the other has been.
        with staged_run(out / "rendered", "render") as run:
            overlays = [_write(one, view, run) for one, view in zip(rendered, test, strict=True)]
            names, save = [view.name for view in test], partial(save_png, run=run.id)
            write_overview(segmentation, overlays, names, run.folder / "overlays", save)
        _compare(demo, train, seen, out / "masks_and_result.png")
        scores = evaluate_folders(out / "rendered", demo.root / "labels_true").as_dict(demo.class_names)
        overlap = gaussian_ious(demo, exported.folder / "segmentation.npz")
    inside = ", ".join(f"{stage} {seconds:.2f}" for stage, seconds in result.seconds.items())
    return "\n\n".join(
        [
            seconds_table(watch.seconds) + f"\nsegment, in the node: {inside} s",
            _classes(exported, overlap, scores),
            f"{learnt.report.num_views} views with missed, swapped and frayed masks came over DDS; {learnt.num_steps} "
            f"steps of EM.\nScored on {scores['views']} others against the truth, rendered by the node: mIoU "
            f"{percent(scores['mean_iou'])}, mAcc {percent(scores['mean_accuracy'])}, boundary IoU "
            f"{percent(scores['mean_boundary_iou'])}",
            f"Look at: {out}/masks_and_result.png and {out}/rendered/overlays/contact_sheet.png\n"
            f"Objects: {out}/segmented/classes, PLYs for 3DGS viewers\n"
            f"Logs of the nodes: {out}/logs",
        ]
    )


def _start(client: SegmentationClient, nodes: ChildNodes, demo: DemoScene, progress: Progress) -> None:
    stage = "start the node (the first time, kernels compile for half a minute or more)"
    progress(stage, 0, 1)
    nodes.start(
        "segment_node",
        {
            "scene_path": str(demo.root.resolve() / "scene.ply"),
            "data_root": str(demo.root.resolve().parent),
            "class_names": list(demo.class_names.values()),
        },
    )
    _in_slices(nodes, client.wait_until_active, START_SECONDS)
    progress(stage, 1, 1)


def _replay(client: SegmentationClient, nodes: ChildNodes, demo: DemoScene, rate: float, progress: Progress) -> None:
    count = len(demo.train)
    nodes.start("replay_node", {"data": str(demo.root.resolve()), "rate": rate})
    _in_slices(
        nodes,
        lambda timeout: client.wait_for_views(count, timeout, lambda views: progress("fuse", views, count)),
        count / rate + 60,
    )


def _in_slices(nodes: ChildNodes, wait: Callable[[float], T], seconds: float) -> T:
    """Wait a little at a time, and look at the nodes in between: one that has failed is not waited for."""
    deadline = time.monotonic() + seconds
    while True:
        try:
            return wait(SLICE_SECONDS)
        except NodeUnavailableError:
            nodes.check()
            if time.monotonic() > deadline:
                raise


def _write(seen: RenderedView, view: View, run: StagedRun) -> np.ndarray:  # (H, W, 3)
    """Write the labels that the node saw in a view, and their overlay, which is returned."""
    assert seen.overlay is not None
    write_mask(run.folder / f"{view.name}.png", seen.labels, 8, run.id)
    save_png(run.folder / "overlays" / f"{view.name}.png", seen.overlay, run.id)
    return seen.overlay


def _compare(demo: DemoScene, views: Sequence[View], seen: Sequence[np.ndarray], path: Path) -> None:
    """Draw the masks that the node was given above what it makes of them."""
    colors = palette(len(demo.class_names))
    images = [view.read_labels() for view in views] + list(seen)
    captions = [f"mask {view.name}, as it came" for view in views] + [
        f"{view.name}, as the node sees it" for view in views
    ]
    save_png(path, contact_sheet([colors[np.maximum(labels, 0)] for labels in images], captions, len(views)))


def _classes(exported: Exported, overlap: Sequence[float], scores: dict[str, Any]) -> str:
    images = {entry["id"]: entry["iou"] for entry in scores["classes"]}
    rows = [
        [
            summary.name,
            f"{summary.num_gaussians:,}",
            percent(summary.mean_confidence),
            percent(overlap[summary.class_id]),
            percent(images.get(summary.class_id)),
        ]
        for summary in exported.report.classes
    ]
    return table(["class", "Gaussians", "confidence", "IoU of Gaussians", "IoU in test views"], rows)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the demo; returns the exit code: 0, 2 on an error, 130 when interrupted."""
    parser = argparse.ArgumentParser(prog="python -m gsseg_ros.demo", description=__doc__.split("\n")[0])
    parser.add_argument("--out", default="demo_out", metavar="DIR", help="folder to write to (default: %(default)s)")
    parser.add_argument("--rate", type=float, default=10.0, help="masks per second (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="of the scene's defects and the masks' errors")
    parser.add_argument("--quiet", action="store_true", help="no progress bars")
    options = parser.parse_args(arguments)
    if not 0 < options.rate <= 1000:
        parser.error(f"--rate is {options.rate:g}; expected more than 0 and at most 1000 masks per second")

    search_no_imports_at_the_end()
    out = Path(options.out)
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, lambda number, _: sys.exit(128 + number))  # As Ctrl-C, through all that cleans up.
    nodes = None
    try:
        nodes = ChildNodes(out / "logs")
        os.environ.update(nodes.environment)
        with nodes, progress_bars(options.quiet) as progress:
            summary = run_demo(out, nodes, seed=options.seed, rate=options.rate, progress=progress)
    except (GssegError, OSError) as error:
        logs = f" (logs: {', '.join(map(str, nodes.logs))})" if nodes is not None and nodes.logs else ""
        print(f"demo: error: {error}{logs}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("\ndemo: interrupted", file=sys.stderr)
        return 130
    print(summary)
    return 0


if __name__ == "__main__":
    sys.exit(main())
