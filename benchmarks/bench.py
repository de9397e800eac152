"""Measure everything, and what a user could take instead, in one run: BENCHMARK.md and BENCHMARK.json.

    python benchmarks/bench.py            # what `make bench` runs: at most 25 minutes on two cores
    python benchmarks/bench.py --quick    # a small subset in about 3 minutes, into results_out/

Nothing else should run meanwhile. The real scenes are those of $GSSEG_DATA (default ../shared/data beside the
repository). The numbers are compared with those of the BENCHMARK.json that is there.
"""

from __future__ import annotations

import shutil
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from children import ChildError, finish, run_child, seconds_of
from growth import add_growth
from machine import REPOSITORY, describe, parser_of
from peers import LOOP, add_flashsplat, add_others, add_torch_loop
from report import Bar, Report
from workloads import MASKS, REAL, SIZES, Sizes

ROOM, LIFT, FIRST_USE = "workload (a), room", "lift rate, workload (a)", "first use"
IMPORT = "import gsseg_core"


def main() -> int:
    """Measure and write."""
    parser = parser_of(__doc__)
    parser.add_argument("--quick", action="store_true", help="the same as --sizes quick")
    parser.add_argument("--sizes", choices=SIZES, default="full", help="how much to measure; tiny only tries it out")
    parser.add_argument("--out", type=Path, help="gets both files [the repository if full, else results_out/]")
    options = parser.parse_args()
    sizes = SIZES["quick" if options.quick else options.sizes]
    out = options.out or (REPOSITORY if sizes.name == "full" else REPOSITORY / "results_out")
    report = Report(sizes.name, time.strftime("%Y-%m-%d"), describe())
    with tempfile.TemporaryDirectory() as work:
        complete = measure(report, sizes, options.data, Path(work))
    minutes = report.machine["minutes"]
    report.write(out, TEXT.format(arguments="" if sizes.name == "full" else f" --sizes {sizes.name}"), bars(sizes))
    print(f"{out / 'BENCHMARK.md'}: {len(report.rows)} numbers in {minutes} minutes")
    return 0 if complete else 1


def measure(report: Report, sizes: Sizes, data: Path, work: Path) -> bool:
    """Measure part after part; one that fails is said to have, and the others go on."""
    start, failed = time.perf_counter(), []

    def tell(text: str) -> None:
        print(f"{(time.perf_counter() - start) / 60:5.1f} min  {text}", flush=True)

    def part(section: str, job: Callable[[], None]) -> None:
        tell(section)
        try:
            job()
        except ChildError as error:
            failed.append(section)
            report.say(section, f"**Failed**: {error}.")
            tell(f"failed: {error}")

    room = work / "room"
    tell(f"write {sizes.room}")
    run_child("jobs.room", folder=str(room), size=asdict(sizes.room), wrong=True)
    report.say(ROOM, f"{sizes.room}. Stages of one view are means over {sizes.sampled} views.")
    part(FIRST_USE, lambda: add_first_use(report, sizes))
    part(ROOM, lambda: add_stages(report, ROOM, room, sizes))
    part(LIFT, lambda: add_lift(report, room, sizes))
    part(f"{ROOM}: whole command", lambda: add_command(report, ROOM, room, sizes, work))
    for name in REAL:
        if not (data / name).is_dir():
            tell(f"skipped: no {data / name}; set GSSEG_DATA or --data to the folder that holds {name}/")
            report.say(f"workload (b), {name}", "Skipped: the scene is not there.")
            continue
        part(f"workload (b), {name}", lambda: add_real(report, name, data, sizes, work))  # noqa: B023 - called at once
    part(LOOP, lambda: add_torch_loop(report, sizes, room))
    part("against FlashSplat's rule", lambda: add_flashsplat(report, room, "room"))
    if (data / REAL[0]).is_dir() and sizes.name == "full":
        part("against FlashSplat's rule, real", lambda: add_flashsplat(report, data / REAL[0], REAL[0]))
    part("rasterisers of others", lambda: add_others(report, sizes, work))
    shutil.rmtree(room)
    part("growth", lambda: add_growth(report, sizes, work, tell))
    report.say("on a GPU", (REPOSITORY / "benchmarks" / "gpu_figures.md").read_text(encoding="utf-8").strip())
    report.machine["minutes"] = round((time.perf_counter() - start) / 60, 1)
    return not failed


def add_first_use(report: Report, sizes: Sizes) -> None:
    """Measure what a process costs before it does anything, with compiled kernels and without."""
    bare = [seconds_of([sys.executable, "-c", "pass"]) for _ in range(sizes.runs)]
    empty = statistics.median(bare)
    for name, code in {
        IMPORT: "import gsseg_core",
        "import all that `gsseg segment` needs": "import gsseg_core.pipeline",
        "the same, and kernels from the cache": "from gsseg_core.warm_up import warm_up; warm_up()",
    }.items():
        finish([sys.executable, "-c", code])
        runs = [seconds_of([sys.executable, "-c", code]) - empty for _ in range(sizes.runs)]
        report.add(FIRST_USE, name, "s", runs)
    if sizes.cold:
        code = "from gsseg_core.warm_up import warm_up; warm_up()"
        with tempfile.TemporaryDirectory() as cache:
            seconds = seconds_of([sys.executable, "-c", code], NUMBA_CACHE_DIR=cache) - empty
        report.add(FIRST_USE, "the same, and all kernels compiled", "s", [seconds])
    report.say(FIRST_USE, "Less the start of the interpreter itself.")


def add_stages(report: Report, section: str, folder: Path, sizes: Sizes) -> None:
    """Time every stage apart, on the true masks."""
    times = run_child("jobs.stages", folder=str(folder), runs=sizes.runs, sampled=sizes.sampled)
    for name, values in times.items():
        report.add(section, name, "" if name == "EM steps" else "s", values)


def add_command(report: Report, section: str, folder: Path, sizes: Sizes, work: Path) -> None:
    """Run all that `gsseg segment` does, in processes of their own."""
    for labels, masks in MASKS.items():
        if not (folder / labels).is_dir():
            continue
        answers: list[dict[str, Any]] = [
            run_child("jobs.command", folder=str(folder), labels=labels, out=str(work / "out"))
            for _ in range(sizes.whole_runs)
        ]
        for stage in answers[0]["seconds"]:
            values = [answer["seconds"][stage] for answer in answers]
            report.add(section, f"whole command, {masks}: {stage}", "s", values)
        learning = [answer["seconds"]["observe"] + answer["seconds"]["learn"] for answer in answers]
        report.add(section, f"whole command, {masks}: observe and learn", "s", learning)
        totals = [sum(answer["seconds"].values()) for answer in answers]
        report.add(section, f"whole command, {masks}: all", "s", totals)
        report.add(section, f"whole command, {masks}: EM steps", "", [answer["steps"] for answer in answers])
        report.add(section, f"whole command, {masks}: peak memory", "GiB", [answer["peak"] for answer in answers])


def add_real(report: Report, name: str, data: Path, sizes: Sizes, work: Path) -> None:
    """Time stages and whole command on a real scene; without masks, only what needs none."""
    section = f"workload (b), {name}"
    report.say(section, f"Stages of one view are means over {sizes.sampled} views.")
    add_stages(report, section, data / name, sizes)
    add_command(report, section, data / name, sizes, work)


def add_lift(report: Report, room: Path, sizes: Sizes) -> None:
    """Tell the rate of the lift, of the first rasteriser, and how far the peak is."""
    answer = run_child("jobs.lift", folder=str(room), views=max(1, sizes.sampled // 3), runs=sizes.runs)
    views, peak = answer["views"], answer["fma_peak"]

    def rates(what: str, by: str) -> list[float]:
        """Count what was done per second of a job; each run goes over all views."""
        total = sum(view[what] for view in views)
        return [total / sum(seconds) for seconds in zip(*(view[by] for view in views), strict=True)]

    for name, by in {
        "lift": "lift",
        "lift, without the sums of each Gaussian": "sums",
        "observe": "observe",
        "projection to votes": "all",
        "first rasteriser, lift": "first",
    }.items():
        report.add(LIFT, f"{name}: useful pairs", "G/s", [rate / 1e9 for rate in rates("pairs", by)])
    ratios = [ours / first for ours, first in zip(rates("pairs", "lift"), rates("pairs", "first"), strict=True)]
    report.add(LIFT, "lift / first rasteriser", "x", ratios)
    report.add(LIFT, "useful pairs per view", "M", [sum(view["pairs"] for view in views) / len(views) / 1e6])
    used = sum(view["pairs"] for view in views) / sum(16 * view["evaluations"] for view in views)
    report.add(LIFT, "evaluated pixels that were useful pairs", "", [used])
    report.add(LIFT, "peak by fused multiply-adds", "GFLOP/s", [32 * peak / 1e9])
    flops, instructions = (statistics.median(rates(what, "lift")) for what in ("flops", "instructions"))
    report.add(LIFT, "lift: arithmetic", "GFLOP/s", [flops / 1e9])
    report.add(LIFT, "share of the peak, by operations", "", [flops / (32 * peak)])
    report.add(LIFT, "share of the peak, by vector instructions", "", [instructions / peak])
    differences = [view["difference"] for view in views]
    report.add(LIFT, "sums of the two that differ, share of all", "", [max(differences)])
    _add_dense_lift(report, sizes)
    report.say(
        LIFT,
        f"The lift does {flops / 1e9:.0f} GFLOP/s of arithmetic, {flops / (32 * peak):.0%} of the "
        f"{32 * peak / 1e9:.0f} GFLOP/s that a loop of nothing but fused multiply-adds reached on "
        f"{answer['threads']} threads in the same run. Only 6 of the 21 vector instructions of a block are such, and "
        f"counted by instructions it reaches {instructions / peak:.0%}; the count stands in `benchmarks/lift_rate.py`.",
    )


def _add_dense_lift(report: Report, sizes: Sizes) -> None:
    """Tell the same on a view like the one on which the bars were set."""
    room = sizes.room
    views, width, height = max(1, sizes.sampled // 4), room.width * 5 // 4, room.height * 5 // 4
    size = replace(room, views=views, tests=0, width=width, height=height)
    answer = run_child("jobs.dense_lift", size=asdict(size), runs=sizes.runs)
    views = answer["views"]
    pairs = sum(view["pairs"] for view in views)
    ours, first = (
        [pairs / sum(seconds) for seconds in zip(*(view[by] for view in views), strict=True)]
        for by in ("lift", "first")
    )
    report.add(LIFT, "dense view: pairs per pixel", "", [pairs / len(views) / answer["pixels"]])
    report.add(LIFT, "dense view, lift: useful pairs", "G/s", [rate / 1e9 for rate in ours])
    report.add(LIFT, "dense view, first rasteriser: useful pairs", "G/s", [rate / 1e9 for rate in first])
    ratios = [one / other for one, other in zip(ours, first, strict=True)]
    report.add(LIFT, "dense view, lift / first rasteriser", "x", ratios)
    report.say(
        LIFT,
        "The bars were set on an 800 x 600 view of a million Gaussians with 51 M pairs, 106 a pixel. Trained scenes "
        "have 40 a pixel, and so has workload (a): smaller Gaussians, which hit fewer pixels of a block of sixteen. "
        "The dense view is the same room with Gaussians larger and fainter. A lift ends with the votes of each "
        "Gaussian: ours adds them to those of all views, the first rasteriser writes them down. To observe is to lift, "
        "and to note what later steps of `em` need; runs without a row for that called it lift.",
    )


def bars(sizes: Sizes) -> list[Bar]:
    """List what is asked for on two cores, for the full sizes."""
    if sizes.name != "full":
        return []
    learn, peak = (f"whole command, true masks: {what}" for what in ("observe and learn", "peak memory"))
    return [
        Bar("lift rate on (a), G useful pairs/s", LIFT, "lift: useful pairs", 1.6, at_least=True),
        Bar("lift against the first rasteriser", LIFT, "lift / first rasteriser", 7, at_least=True),
        Bar("lift rate at the bar's own density", LIFT, "dense view, lift: useful pairs", 1.6, at_least=True),
        Bar("the same against the first rasteriser", LIFT, "dense view, lift / first rasteriser", 7, at_least=True),
        Bar("one mask fused into (a), s", ROOM, "fuse one mask", 0.05),
        Bar("em on (a), 60 views, to convergence, s", ROOM, learn, 20),
        Bar("the same, peak memory, GiB", ROOM, peak, 6e9 / 2**30),
        Bar("segment on (a), KNN and filter, first call, s", ROOM, "segment, first call", 1),
        Bar("the same, later calls, s", ROOM, "segment, later calls", 0.3),
        Bar("against the loop in PyTorch", LOOP, "PyTorch / em, time to learn", 50, at_least=True),
        Bar("mIoU there, em less PyTorch", LOOP, "em less PyTorch, mIoU", 0, at_least=True),
        Bar("exponent of time against views", "growth with views", "whole: exponent", 1.05),
        Bar("exponent of time against Gaussians", "growth with gaussians", "whole: exponent", 1.05),
        Bar("import gsseg_core, s", FIRST_USE, IMPORT, 0.5),
    ]


TEXT = """# Benchmark

Made by `make bench`, that is `python benchmarks/bench.py{arguments}`, which measures everything here again. All scenes
are seeded. Numbers are medians; the spread is from the least to the most of the runs. Ratios are of numbers from this
one run.

What to know before comparing:

- Processor names do not say everything: other programs on the machine, its clock and its memory count. `load_before`
  is the mean number of runnable processes in the minute before; well above 0 the machine was not quiet.
- Workload (a) is a made-up room with the statistics of trained scenes (`benchmarks/room.py` says how near). Its masks
  are true ones, but for those called wrong, which have 15 % of the objects missed, 10 % swapped, edges off by 3 px.
- Each part ran in a process of its own, its kernels compiled before except where it says otherwise. Peak memory is
  that of the process. Files were in memory, as after a first run, except for "load, from disk".
- The loop in PyTorch and the rasterisers of others cannot take the large scenes in reasonable time; both sides of those
  ratios are measured on the same smaller ones, and small scenes flatter whoever has the least overhead.
- The last section alone is not measured by `make bench`: it keeps what `benchmarks/bench_gpu.py` said on a machine with
  a GPU (`benchmarks/gpu_figures.md`).
"""

if __name__ == "__main__":
    sys.exit(main())
