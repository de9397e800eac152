"""How time and memory grow with Gaussians, views and classes, one at a time."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
from children import run_child
from report import Report
from workloads import RoomSize, Sizes

TOLD = ("observe", "EM steps", "segment", "whole", "memory")


def exponent(
    sizes: Sequence[float],
    values: Sequence[float],
) -> float:
    """Slope of the line through log(value) over log(size), by least squares: b of value = a size^b."""
    x, y = np.log(np.asarray(sizes, float)), np.log(np.maximum(np.asarray(values, float), 1e-9))
    return float(np.polyfit(x, y, 1)[0])


def add_growth(report: Report, sizes: Sizes, work: Path, tell: Callable[[str], None]) -> None:
    """Measure the three curves, which meet in one point."""
    base, points = sizes.growth, {}

    def measure(scene: RoomSize, views: Iterable[int]) -> None:
        tell(f"growth: {scene}")
        folder = work / "growth"
        run_child("jobs.room", folder=str(folder), size=asdict(scene))
        for count in sorted(set(views)):
            point = replace(scene, views=count)
            points[point] = run_child("jobs.grow", folder=str(folder), views=count, steps=sizes.steps)
        shutil.rmtree(folder)

    measure(replace(base, views=max(*sizes.views, base.views)), [*sizes.views, base.views])
    for count in sizes.gaussians:
        if count != base.gaussians:
            measure(replace(base, gaussians=count), [base.views])
    for count in sizes.classes:
        if count != base.classes:
            measure(replace(base, classes=count), [base.views])

    curves = {"gaussians": sizes.gaussians, "views": sizes.views, "classes": sizes.classes}
    for what, counts in curves.items():
        section = f"growth with {what}"
        report.say(
            section,
            f"Otherwise {base}. Observing all views, {sizes.steps} steps of EM, and segmenting with KNN and filter; "
            "memory is the peak of the process less what it had before the scene.",
        )
        curve = {count: points[replace(base, **{what: count})] for count in counts}
        for name in TOLD:
            slope = exponent(list(curve), [values[name] for values in curve.values()])
            report.add(section, f"{name}: exponent", "", [slope])
        for name in TOLD:
            for count, values in curve.items():
                report.add(section, f"{name}, {count:,} {what}", "GiB" if name == "memory" else "s", [values[name]])
