"""The command `gsseg`."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path

from gsseg_core.errors import GssegError
from gsseg_core.export import write_json
from gsseg_core.progress import progress_bars
from gsseg_core.refine_settings import RefineSettings

_INTERRUPTED = 130


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code: 0, 2 on an error of the input, 130 when interrupted."""
    options = _parser().parse_args(arguments)
    try:
        code: int = options.run(options)
    except GssegError as error:
        print(f"gsseg: error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("\ngsseg: interrupted; nothing that was saved before has changed", file=sys.stderr)
        return _INTERRUPTED
    except BrokenPipeError:
        # The reader of our output has left, as `head` does; there is nobody to tell.
        sys.stderr.close()
        return 0
    return code


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="gsseg",
        description="Segment a trained 3D Gaussian Splatting scene, all objects at once, from posed 2D masks.",
    )
    parser.add_argument("--version", action="version", version=f"gsseg {version('gsseg')}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    command = commands.add_parser("segment", help="learn from masks, refine, write labels and one PLY per object")
    _add_scene(command)
    command.add_argument("--out", required=True, metavar="OUT", help="folder to write to")
    command.add_argument(
        "--labels", default="labels", metavar="DIR", help="folder of the masks in DATASET (default: labels)"
    )
    command.add_argument("--learner", choices=("em", "gradient", "votes"), default="em", help="default: em")
    command.add_argument(
        "--views", type=int, metavar="N", help="learn from N train views, spread evenly (default: all)"
    )
    command.add_argument(
        "--k", type=int, default=RefineSettings.k, help="neighbours in KNN and filter (default: %(default)s)"
    )
    command.add_argument(
        "--beta",
        type=float,
        default=RefineSettings.beta,
        help="confidence below which KNN decides (default: %(default)s)",
    )
    command.add_argument("--no-knn", action="store_true", help="leave uncertain and unobserved Gaussians as they are")
    command.add_argument(
        "--no-filter", action="store_true", help="keep Gaussians that lie far from the rest of their object"
    )
    command.add_argument("--seed", type=int, default=0, help="for learners that draw at random (default: %(default)s)")
    command.add_argument(
        "--ids",
        choices=("global", "per-view"),
        default="global",
        help="whether an id means the same in every view, or holds in its own view only (default: %(default)s)",
    )
    command.add_argument(
        "--memory-budget",
        type=int,
        default=2048,
        metavar="MIB",
        help="for prepared views; those beyond it are prepared anew in each step (default: %(default)s)",
    )
    command.add_argument(
        "--scheduler", metavar="ADDRESS", help="learn on the workers of this Dask scheduler (em and votes)"
    )
    command.set_defaults(run=_segment)

    command = commands.add_parser("render", help="render label maps and overlays of a segmentation")
    _add_scene(command)
    command.add_argument("--segmentation", required=True, metavar="FILE", help="segmentation.npz of this scene")
    command.add_argument("--split", choices=("train", "test", "all"), default="test", help="default: test")
    command.add_argument("--out", required=True, metavar="DIR", help="folder to write to")
    command.set_defaults(run=_render)

    command = commands.add_parser("eval", help="score label maps: mIoU, mAcc, boundary IoU")
    command.add_argument("--pred", required=True, metavar="DIR", help="folder of predicted label maps <stem>.png")
    command.add_argument("--truth", required=True, metavar="DIR", help="folder of true label maps <stem>.png")
    command.add_argument("--json", metavar="FILE", help="write the scores there, too")
    command.set_defaults(run=_eval)

    command = commands.add_parser("demo", help="make a small scene with known truth and segment it")
    command.add_argument("--out", default="demo_out", metavar="DIR", help="folder to write to (default: %(default)s)")
    command.add_argument(
        "--seed", type=int, default=0, help="of the scene and its masks' errors (default: %(default)s)"
    )
    command.add_argument("--quiet", action="store_true", help="no progress bars")
    command.set_defaults(run=_demo)
    return parser


def _add_scene(command: argparse.ArgumentParser) -> None:
    command.add_argument("scene", metavar="SCENE.ply", help="trained 3DGS scene")
    command.add_argument(
        "--data",
        required=True,
        metavar="DATASET",
        help="folder with cameras, labels/<stem>.png, classes.json, split.json",
    )
    command.add_argument("--device", choices=("cpu", "cuda"), default="cpu", help="default: cpu")
    command.add_argument("--quiet", action="store_true", help="no progress bars")


def _segment(options: argparse.Namespace) -> int:
    # The rasteriser's kernels load with the pipeline; `gsseg --help` need not wait for them.
    from gsseg_core import pipeline

    refine = RefineSettings(k=options.k, beta=options.beta, cluster=not options.no_knn, filter=not options.no_filter)
    _load_kernels(options.quiet, options.device)
    with progress_bars(options.quiet) as progress:
        report = pipeline.segment(
            options.scene,
            options.data,
            options.out,
            labels=options.labels,
            learner=options.learner,
            views=options.views,
            refine=refine,
            device=options.device,
            memory_budget=options.memory_budget << 20,
            seed=options.seed,
            scheduler=options.scheduler,
            ids=options.ids,
            progress=progress,
        )
    from gsseg_core.tables import segment_summary

    print(segment_summary(report, options.out))
    return 0


def _load_kernels(quiet: bool, device: str = "cpu") -> None:
    from gsseg_core.warm_up import warm_up

    warm_up(device, lambda text: None if quiet else print(f"gsseg: {text}", file=sys.stderr))


def _render(options: argparse.Namespace) -> int:
    from gsseg_core import pipeline

    _load_kernels(options.quiet, options.device)
    with progress_bars(options.quiet) as progress:
        paths = pipeline.render(
            options.scene,
            options.data,
            options.segmentation,
            options.out,
            split=options.split,
            device=options.device,
            progress=progress,
        )
    print(f"{len(paths)} label maps in {options.out}, overlays in {options.out}/overlays")
    return 0


def _eval(options: argparse.Namespace) -> int:
    from gsseg_core.masks import read_classes
    from gsseg_core.metrics import evaluate_folders
    from gsseg_core.tables import evaluation_summary

    classes = Path(options.truth).parent / "classes.json"
    names = read_classes(classes) if classes.is_file() else None
    scores = evaluate_folders(options.pred, options.truth).as_dict(names)
    if options.json:
        write_json(options.json, scores)
    print(evaluation_summary(scores))
    return 0


def _demo(options: argparse.Namespace) -> int:
    from gsseg_core.demo import run_demo

    _load_kernels(options.quiet)
    with progress_bars(options.quiet) as progress:
        summary = run_demo(options.out, seed=options.seed, progress=progress)
    print(summary)
    return 0


if __name__ == "__main__":
    sys.exit(main())
