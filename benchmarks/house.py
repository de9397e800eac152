"""Prints how the house stands: files, lines, circles, the way of a mask, the start of the command; bars beside them.

python benchmarks/house.py             # half a minute
python benchmarks/house.py --times     # and how long all tests take from nothing, in a fresh clone: half an hour
"""

from __future__ import annotations

import argparse
import ast
import functools
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np

REPOSITORY = Path(__file__).parents[1]
CORE = REPOSITORY / "gsseg_core"
PACKAGES = ("gsseg_core", "gsseg_ros")
MOST_LINES = 400
HEAVY = ("numba", "scipy", "torch")
STARTS = 5
SLOWER = 1.05
CI, TEST, CHECK = "`.ci/run` from nothing, minutes", "`make test`, minutes", "`make check`, seconds"
STAGES = f"stages of `make bench` more than {SLOWER - 1:.0%} slower"
BARS = {
    "Python files at the root of the core": "12",
    "Python lines of the core": "17,500",
    "import circles": "0",
    f"Python files over {MOST_LINES} lines": "0",
    "files that a mask passes through": "12",
    "of them climbed back to": "3",
    "`gsseg --help`, seconds": "0.15",
    "heavy modules that it loads": "0",
    STAGES: "0",
    CI: "12",
    TEST: "8",
    CHECK: "60",
}
EXPLAINED = """
A mask passes through the files of `gsseg_core` that one small run enters, from `Dataset` by `EMLearner` to a saved
`Segmentation`. A file is entered where a Python function of it is called, or a kernel of it from Python. One is climbed
back to where a call enters it from a room that lies below its own. The time of `gsseg --help` is the best of five,
without the start of Python itself; heavy are numba, scipy and torch.

Stages are those of the last committed BENCHMARK.json against the last before it on such a processor; the five worst are
named. Times mean two idle cores; what processors worked stands beside them, and two cores need half of that at least.
Labels of the demo cannot be those of before the rooms any more, since its scene, the learner and the refinement are
others; docs/results.md has what they score.
"""


def main() -> None:
    """Measure, and print a table in Markdown."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--times", action="store_true", help="run all tests in a fresh clone, too")
    found = measured() | times_of_tests(parser.parse_args().times)
    print("| what | found | bar: at most |\n| --- | --- | --- |")
    for what, bar in BARS.items():
        print(f"| {what} | {found[what]} | {bar} |")
    print(EXPLAINED)


def measured() -> dict[str, str]:
    """Value by name, as in `BARS`."""
    long = [f"{path} ({count})" for path, count in lines_of(tracked()).items() if count > MOST_LINES]
    files, climbed = way_of_a_mask()
    seconds, heavy = help_start()
    circles = import_circles()
    return dict(
        zip(
            list(BARS)[: -len((CI, TEST, CHECK))],
            (
                str(len(list(CORE.glob("*.py")))),
                f"{sum(lines_of(sorted(CORE.rglob('*.py'))).values()):,}",
                _listed([" = ".join(circle) for circle in circles]),
                _listed(long),
                _listed(files),
                _listed(climbed),
                f"{seconds:.2f}",
                _listed(heavy),
                _slower_stages(),
            ),
            strict=True,
        )
    )


def tracked() -> list[Path]:
    """Python files of the repository that are not ignored."""
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard", "*.py"]
    names = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=True).stdout.split("\n")
    return [REPOSITORY / name for name in sorted(set(names)) if (REPOSITORY / name).is_file()]


def lines_of(files: list[Path]) -> dict[str, int]:
    """Lines by path below the repository, docstrings and empty ones too."""
    return {str(path.relative_to(REPOSITORY)): len(path.read_text("utf-8").splitlines()) for path in files}


def import_circles() -> list[list[str]]:
    """List the groups of modules that import each other, be it for type checking or within a function."""
    import grimp
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    graph = grimp.build_graph(*PACKAGES, cache_dir=None)
    names = sorted(graph.modules)
    number = {name: i for i, name in enumerate(names)}
    edges = np.array([(number[a], number[b]) for a in names for b in graph.find_modules_directly_imported_by(a)]).T
    ones = coo_array((np.ones(edges.shape[1]), edges), shape=(len(names),) * 2)
    _, group = connected_components(ones, directed=True, connection="strong")
    return [[names[i] for i in np.flatnonzero(group == g)] for g in np.flatnonzero(np.bincount(group) > 1)]


def way_of_a_mask() -> tuple[list[str], list[str]]:
    """Files below `gsseg_core` that a mask passes through to become labels, and those that are climbed back to."""
    code = f"import sys; sys.path.insert(0, {str(Path(__file__).parent)!r}); import house; house.follow_a_mask()"
    # A process of its own, in which no kernel has been called before.
    out = subprocess.run(
        [sys.executable, "-c", code], cwd=REPOSITORY, capture_output=True, text=True, check=True
    ).stdout
    files, climbed = (sorted(line.split()) for line in out.split("\n")[:2])
    return files, climbed


def follow_a_mask() -> None:
    """Segment a small scene, and print the files that are entered, and those that are climbed back to."""
    sys.path.insert(0, str(REPOSITORY / "tests/helpers"))
    from small_scenes import write_dataset

    from gsseg_core.data.dataset import Dataset
    from gsseg_core.learn.em.em_learner import EMLearner
    from gsseg_core.scene.gaussian_scene import GaussianScene
    from gsseg_core.segmentation import Segmentation

    entered: set[str] = set()
    climbed: set[str] = set()
    floor = floors()

    def follow(frame: FrameType, event: str, argument: Any) -> None:
        file = _below_core(frame)
        if event != "call" or file is None:
            return
        entered.add(file)
        caller = _below_core(frame.f_back)
        if caller and floor[_room(caller)] > floor[_room(file)]:
            climbed.add(file)

    with tempfile.TemporaryDirectory() as folder:
        data = write_dataset(Path(folder) / "data")
        scene = GaussianScene.load(data / "scene.ply")
        sys.setprofile(follow)
        dataset = Dataset(data)
        learner = EMLearner(scene, dataset.num_classes)
        for view in dataset.views("train"):
            learner.observe(view)
        codes = learner.fit().codes_
        result = Segmentation.from_codes(scene, codes, dataset.class_names, evidence=learner.evidence())
        result.save(Path(folder) / "segmentation.npz")
        sys.setprofile(None)
    print(*(entered | set(kernel_files())))
    print(*climbed)


def kernel_files() -> Iterator[str]:
    """Files of the kernels that Python has called so far in this process."""
    from numba.core.dispatcher import Dispatcher

    for name, module in list(sys.modules.items()):
        if name.startswith("gsseg_core."):
            for value in vars(module).values():
                if isinstance(value, Dispatcher) and value.overloads and value.py_func.__module__ == name:
                    yield str(Path(value.py_func.__code__.co_filename).relative_to(CORE))


def floors() -> dict[str, int]:
    """Return the number of the layer by room, 0 at the top, from the contract in pyproject.toml."""
    text = (REPOSITORY / "pyproject.toml").read_text("utf-8")
    contract = text[text.index('containers = ["gsseg_core"]') :]
    layers: list[str] = ast.literal_eval(contract[contract.index("layers = ") + 9 : contract.index("]\n", 60) + 1])
    return {room.strip(): i for i, layer in enumerate(layers) for room in layer.split("|")}


def help_start() -> tuple[float, list[str]]:
    """Seconds that `gsseg --help` takes besides the start of Python, and the heavy modules that it loads."""
    told = [sys.executable, "-m", "gsseg_core.cli", "--help"]
    asked = (
        "import contextlib, io, sys; from gsseg_core.cli.main import main\n"
        "with contextlib.suppress(SystemExit), contextlib.redirect_stdout(io.StringIO()): main(['--help'])\n"
        f"print(*(name for name in {HEAVY} if name in sys.modules))"
    )
    seconds = _seconds(told) - _seconds([sys.executable, "-c", "pass"])
    loaded = subprocess.run([sys.executable, "-c", asked], cwd=REPOSITORY, capture_output=True, text=True, check=True)
    return seconds, loaded.stdout.split()


def _slower_stages() -> str:
    """Tell what took longer in the last committed BENCHMARK.json than before on such a processor, the worst first."""

    def git(*command: str) -> str:
        return subprocess.run(["git", *command], cwd=REPOSITORY, capture_output=True, text=True, check=True).stdout

    commits = git("log", "--format=%H", "--", "BENCHMARK.json").split()
    runs = (json.loads(git("show", f"{commit}:BENCHMARK.json")) for commit in commits)
    last = next(runs)
    earlier = next((run for run in runs if run["machine"]["processor"] == last["machine"]["processor"]), None)
    if earlier is None:
        return f"no earlier run on {last['machine']['processor']}"
    now, before = (
        {(row["section"], row["name"]): row["value"] for row in run["rows"] if row["unit"] == "s"}
        for run in (last, earlier)
    )
    ratios = sorted(((now[key] / before[key], key) for key in now.keys() & before.keys() if before[key]), reverse=True)
    return _listed([f"{name} ({section}) {ratio:.2f}" for ratio, (section, name) in ratios if ratio > SLOWER], 5)


def times_of_tests(run: bool) -> dict[str, str]:
    """Time all tests from nothing, once more with what that made, and those that start no process; or say how to."""
    if not run:
        return dict.fromkeys((CI, TEST, CHECK), "not measured: `--times`")
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run(["git", "clone", "--quiet", str(REPOSITORY), folder], check=True)
        steps = {CI: ([".ci/run"], 60), TEST: (["make", "test"], 60), CHECK: (["make", "check"], 1)}
        return {what: _time(command, folder, unit) for what, (command, unit) in steps.items()}


def _time(command: list[str], folder: str, unit: float) -> str:
    """Run a command that may fail; says how long it took, and how long processors worked."""
    data = os.environ.get("GSSEG_DATA") or str(REPOSITORY.parent / "shared" / "data")
    begun, before = time.perf_counter(), os.times()
    code = subprocess.run(command, cwd=folder, env={**os.environ, "GSSEG_DATA": data}, stdout=sys.stderr).returncode
    taken, after = time.perf_counter() - begun, os.times()
    worked = after.children_user + after.children_system - before.children_user - before.children_system
    failed = "" if code == 0 else f", and failed with code {code}"
    return f"{taken / unit:.1f} ({worked / unit:.1f} of processors){failed}"


def _seconds(command: list[str]) -> float:
    taken = []
    for _ in range(STARTS):
        begun = time.perf_counter()
        subprocess.run(command, cwd=REPOSITORY, stdout=subprocess.DEVNULL, check=True)
        taken.append(time.perf_counter() - begun)
    return min(taken)


def _below_core(frame: FrameType | None) -> str | None:
    return _name_below_core(frame.f_code.co_filename) if frame else None


@functools.cache
def _name_below_core(file: str) -> str | None:
    return str(Path(file).relative_to(CORE)) if CORE in Path(file).parents else None


def _room(file: str) -> str:
    return Path(file).parts[0].removesuffix(".py")


def _listed(names: list[str], most: int | None = None) -> str:
    return f"{len(names)}: {', '.join(names[:most])}" if names else "0"


if __name__ == "__main__":
    main()
