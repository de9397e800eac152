"""The command `gsseg segment`."""

from __future__ import annotations

import argparse
from contextlib import nullcontext
from statistics import median
from typing import Any

from gsseg_core.cli.shared import (
    LABELS,
    OWN_IDS,
    add_collision,
    add_format,
    add_scene,
    hint_at_own_ids,
    labels_path,
    load_kernels,
)
from gsseg_core.cli.terminal import note, tell
from gsseg_core.learn.registry import DEFAULT, LEARNERS, distributed_learners
from gsseg_core.progress import progress_bars
from gsseg_core.refine.settings import RefineSettings
from gsseg_core.scene.scene_writers import DEFAULT as DEFAULT_FORMAT

DESCRIPTION = """
Learns from the masks of the train views which Gaussian belongs to which class, refines the result in space, and writes
OUT/segmentation.npz, one PLY (or another file) per class, a report and pictures.
"""
EXAMPLES = """
  gsseg segment scene.ply --data DATASET --out out
  gsseg segment scene.ply --data DATASET --out out --labels sam --ids per-view
  gsseg segment scene.ply --data DATASET --out out --labels annotations.json
  gsseg segment scene.ply --data DATASET --out out --learner votes --views 20
  gsseg segment scene.ply --data DATASET --out out --format usd --collision
"""
_HALF = 0.5  # share of its pixels in which half of the masks agree less with the others, whatever their errors


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what the command takes."""
    add_scene(parser)
    parser.add_argument("--out", required=True, metavar="OUT", help="folder to write to")
    labels = "the masks: a folder in DATASET, or a file or folder of another program, such as COCO (default: labels)"
    parser.add_argument("--labels", default=LABELS, metavar="PATH", help=labels)
    renames = "JSON file that renames, merges or ignores classes of the masks; see docs/formats.md"
    parser.add_argument("--label-map", metavar="FILE", help=renames)
    ids = "whether an id names the same object in every view, or in its own view only (default: by the masks' format)"
    parser.add_argument("--ids", choices=("global", "per-view"), help=ids)
    level = "per-view ids: the level to write, from 0 (groups of objects) to 1 (all parts) (default: the objects)"
    parser.add_argument("--granularity", type=float, metavar="G", help=level)
    add = parser.add_argument_group("learning").add_argument
    add("--learner", choices=tuple(LEARNERS), default=DEFAULT, help="default: %(default)s")
    add("--views", type=int, metavar="N", help="learn from N train views, spread evenly (default: all)")
    pixels = "learn from all pixels, or from every second or fourth of each row and column, for speed (default: full)"
    add("--quality", choices=("full", "half", "quarter"), default="full", help=pixels)
    add("--seed", type=int, default=0, help="for learners that use random numbers (default: %(default)s)")
    budget = "memory for prepared views; the rest goes to a temporary file (default: an eighth of the free memory)"
    add("--memory-budget", type=int, metavar="MIB", help=budget)
    learners = " and ".join(distributed_learners())
    add("--scheduler", metavar="ADDRESS", help=f"learn on the workers of this Dask scheduler ({learners})")
    add = parser.add_argument_group("files of the classes").add_argument
    add_format(add, DEFAULT_FORMAT)
    add_collision(add, "each object, as .obj and in USD")
    add = parser.add_argument_group("refinement").add_argument
    k, beta = RefineSettings.k, RefineSettings.beta
    add("--k", type=int, default=k, help="neighbours in KNN and filter (default: %(default)s)")
    add("--beta", type=float, default=beta, help="confidence below which KNN decides (default: %(default)s)")
    ways = "after KNN: cut objects to their silhouettes in the views, or filter outliers (default: %(default)s)"
    add("--refine", choices=("carve", "paper"), default="carve", help=ways)
    for name, effect in {
        "--no-graph": "with few views: no label propagation to Gaussians that they hardly saw; KNN decides",
        "--no-knn": "no KNN: leave uncertain and unobserved Gaussians as they are",
        "--no-filter": "neither cut objects to silhouettes nor filter outliers",
    }.items():
        add(name, action="store_true", help=effect)
    # The default today, which once had to be asked for.
    add("--carve", dest="refine", action="store_const", const="carve", help=argparse.SUPPRESS)


def run(options: argparse.Namespace) -> int:
    """Segment, and print a summary."""
    # The rasteriser's kernels load with the pipeline; `gsseg --help` need not wait for them.
    from gsseg_core import pipeline

    outer = None if options.no_filter else options.refine
    refine = RefineSettings(
        k=options.k, beta=options.beta, weigh=options.refine != "paper", cluster=not options.no_knn,
        filter=outer == "paper", carve=outer == "carve",
    )  # fmt: skip
    load_kernels(options.quiet, options.device)
    hint = nullcontext() if options.ids else hint_at_own_ids()
    with hint, progress_bars(options.quiet) as progress:
        report = pipeline.segment(
            options.scene, options.data, options.out, labels=labels_path(options.data, options.labels),
            learner=options.learner, views=options.views, refine=refine, graph=not options.no_graph,
            device=options.device, memory_budget=None if options.memory_budget is None else options.memory_budget << 20,
            seed=options.seed, scheduler=options.scheduler, ids=options.ids, granularity=options.granularity,
            label_map=options.label_map,
            scene_format=options.format, collision=options.collision, align=options.align,
            dataparser=options.dataparser, quality=options.quality, progress=progress,
        )  # fmt: skip
    from gsseg_core.text import segment_summary

    _note_doubts(options, report)
    tell(segment_summary(report, options.out))
    return 0


def _note_doubts(options: argparse.Namespace, report: dict[str, Any]) -> None:
    """Warn of what makes a whole run worthless."""
    from gsseg_core.report.findings import NO_OBJECTS, frame_of, grey_ids_of, has_objects, renamed_ids_of

    known = [view["reliability"] for view in report["views"].get("reliability", ()) if view["reliability"] is not None]
    if known and median(known) < _HALF and report["settings"]["ids"] == "global":
        note(f"most masks contradict the others: {OWN_IDS}")
    elif of_ids := grey_ids_of(report) or renamed_ids_of(report):
        note(of_ids)
    for told in frame_of(report, f"{options.data} --scene {options.scene}"):
        note(told)
    if not has_objects(report):
        note(f"no Gaussian is part of an object: {NO_OBJECTS}")
