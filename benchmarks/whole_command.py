"""Time every stage of `gsseg segment` on a workload, of one checkout or of several in turn, and compare them.

    python benchmarks/whole_command.py                            # workload (a), this checkout
    python benchmarks/whole_command.py --trees ../before . --runs 3
    python benchmarks/whole_command.py --workload e               # 3 M Gaussians indoors, 60 views: 1 GiB of disk
    python benchmarks/whole_command.py --workload c               # 3 M Gaussians, 200 views: 8 GiB of disk
    python benchmarks/whole_command.py --workload c --share 0.1   # a tenth of its Gaussians, views and pixels
    python benchmarks/whole_command.py --labels labels_automatic  # hundreds of things, ids of each view's own

Seconds are medians over the runs, of the wall clock and of all cores; ratios are of this one run of the program. The
bar is the whole command over what it learns in (observe and learn). Wrong masks are used unless `--labels labels`.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

REPOSITORY = Path(__file__).resolve().parents[1]
LEARNING = ("observe", "learn")
AUTOMATIC = "labels_automatic"


def main() -> int:
    """Write the workload, run the trees in turn, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--workload", choices=("a", "c", "d", "e"), default="a", help="of benchmarks/workloads.py")
    parser.add_argument("--share", type=float, default=1.0, help="of its Gaussians, views and pixels")
    parser.add_argument("--data", type=Path, help="a dataset folder with its scene.ply, in place of a workload")
    parser.add_argument("--labels", default="labels_noisy", help="folder of the masks")
    parser.add_argument("--trees", type=Path, nargs="+", default=[REPOSITORY], help="checkouts to compare")
    parser.add_argument("--runs", type=int, default=1, help="of each")
    parser.add_argument("--device", default="cpu", help="that renders the views")
    parser.add_argument("--child", metavar="OUT", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.child:
        print(json.dumps(run_here(options.data, options.labels, options.device, options.child)))
        return 0
    with tempfile.TemporaryDirectory() as work:
        folder = options.data or write_workload(
            Path(work) / "data", options.workload, options.share, options.labels == AUTOMATIC
        )
        answers: list[list[dict[str, Any]]] = [[] for _ in options.trees]
        for _ in range(options.runs):
            for tree, answer in zip(options.trees, answers, strict=True):
                answer.append(run_in(tree.resolve(), folder, options.labels, options.device, Path(work) / "out"))
                print(f"{tree}: {sum(answer[-1]['wall'].values()):.1f} s", file=sys.stderr, flush=True)
    print_table([str(tree) for tree in options.trees], answers)
    return 0


def write_workload(folder: Path, name: str, share: float, automatic: bool) -> Path:
    """Write a workload, or a part of it, as a dataset."""
    from workloads import WHOLE, write_room

    size = WHOLE[name]
    part = replace(
        size, gaussians=round(share * size.gaussians), views=max(3, round(share * size.views)),
        width=round(share**0.5 * size.width), height=round(share**0.5 * size.height), tests=min(size.tests, 1),
    )  # fmt: skip
    print(part if share < 1 else size, file=sys.stderr, flush=True)
    return write_room(folder, part if share < 1 else size, wrong=not automatic, automatic=automatic)


def run_in(tree: Path, folder: Path, labels: str, device: str, out: Path) -> dict[str, Any]:
    """Run the command of a checkout in a process of its own."""
    command = [sys.executable, str(Path(__file__).resolve()), "--data", str(folder), "--labels", labels]
    command += ["--device", device]
    path = os.pathsep.join([str(tree), *filter(None, [os.environ.get("PYTHONPATH")])])
    environment = {**os.environ, "PYTHONPATH": path}
    done = subprocess.run([*command, "--child", str(out)], env=environment, check=True, capture_output=True, text=True)
    answer: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return answer


def run_here(folder: Path, labels: str, device: str, out: str) -> dict[str, Any]:
    """Do what `gsseg segment` does: seconds of each stage, by the clock and of all cores, and peak memory in GiB."""
    from machine import peak_memory

    from gsseg_core import progress
    from gsseg_core.freed_memory import keep_freed_memory

    wall: dict[str, float] = {}
    cores: dict[str, float] = {}

    @contextmanager
    def stage(watch: progress.Stopwatch, name: str) -> Iterator[None]:
        start, worked = time.perf_counter(), time.process_time()
        yield
        wall[name] = wall.get(name, 0.0) + time.perf_counter() - start
        cores[name] = cores.get(name, 0.0) + time.process_time() - worked
        watch.seconds[name] = wall[name]

    progress.Stopwatch.stage = stage  # type: ignore[method-assign, assignment]
    from gsseg_core import pipeline
    from gsseg_core.warm_up import warm_up

    keep_freed_memory()
    warm_up(device)
    ids = "per-view" if labels == AUTOMATIC else None
    report = pipeline.segment(folder / "scene.ply", folder, out, labels=labels, device=device, ids=ids)
    return {"wall": wall, "cores": cores, "peak": peak_memory(), "steps": len(report["objective"])}


def print_table(names: list[str], answers: list[list[dict[str, Any]]]) -> None:
    """Print medians by stage; of several trees, also as a share of the first one's."""

    def median(answer: list[dict[str, Any]], kind: str, stages: list[str]) -> float:
        return statistics.median(sum(run[kind].get(name, 0.0) for name in stages) for run in answer)

    every = list(dict.fromkeys(name for answer in answers for run in answer for name in run["wall"]))
    rows = [(name, [name]) for name in every]
    rows += [("observe and learn", [name for name in every if name in LEARNING]), ("all", every)]
    for tree, answer in zip(names, answers, strict=True):
        print(f"\n{tree}\n{'stage':20s} {'clock, s':>10s} {'cores, s':>10s} {'/ first':>8s} {'cores / first':>14s}")
        for name, stages in rows:
            now = [median(answer, kind, stages) for kind in ("wall", "cores")]
            first = [median(answers[0], kind, stages) for kind in ("wall", "cores")]
            shares = [f"{a / b:.2f}" if b else "-" for a, b in zip(now, first, strict=True)]
            print(f"{name:20s} {now[0]:10.2f} {now[1]:10.2f} {shares[0]:>8s} {shares[1]:>14s}")
        for kind, what in (("wall", "by the clock"), ("cores", "of all cores")):
            ratio = median(answer, kind, every) / median(answer, kind, rows[-2][1])
            print(f"all / observe and learn, {what}: {ratio:.2f}")
        peak = max(run["peak"] for run in answer)
        print(f"peak memory: {peak:.2f} GiB; steps of EM: {answer[0]['steps']}")


if __name__ == "__main__":
    sys.exit(main())
