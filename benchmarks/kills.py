"""Kill gsseg with SIGKILL at random moments, and see what is left: nothing saved is lost, all is whole and of one run.

Kill number i of a kind is drawn from the seed, the kind and i alone, so that any of them can be had again:
`--what segment --first 17 --count 1`. `segment` and `state` run in forked children of this process, which has
everything loaded; `save`, `export` and `learn` ask a node in a process of its own, which takes a few seconds to start.

Usage: python benchmarks/kills.py [--what segment,state,save,export,learn] [--count 200] [--seed 0] [--json FILE]
Exit code 1 where a bar is missed.
"""

from __future__ import annotations

import argparse
import functools
import json
import random
import shutil
import statistics
import sys
import tempfile
import time
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from forked import in_child, run_command  # first: it says how numba runs
from report import markdown
from whole_outputs import Fault, faults_of, leftovers, listing, read_folder

KINDS = ("segment", "state", "save", "export", "learn")
AFTER = "then "
ATTEMPTS = 5
"""To hit a job before it ends, whose duration varies."""
THEN = tuple(AFTER + kind for kind in ("lost", "broken", "mixed", "refused"))
COLUMNS = ("lost", "broken", "mixed", "unmarked", *THEN, "leftover")
PATIENCE = 60.0  # s


class Victim(ABC):
    """A job that is killed."""

    @abstractmethod
    def seconds(self) -> float:
        """How long it takes if it is left alone."""

    @abstractmethod
    def kill(self, delay: float) -> bool:
        """Begin it anew, kill it after so many seconds; returns whether it still ran."""

    @abstractmethod
    def faults(self) -> list[Fault]:
        """Say what is wrong with the files as they are."""

    def faults_after(self) -> list[Fault]:
        """Say what is wrong once the next command, or node, has read them."""
        return self.faults()

    @abstractmethod
    def leftovers(self) -> list[Fault]:
        """Say what lies about once the job has been done again."""

    def close(self) -> None:  # noqa: B027 - some have nothing to take down
        """Take everything down."""


@dataclass
class Tally:
    """What came of killing one kind of job."""

    what: str
    seconds: float = 0.0
    kills: int = 0
    late: int = 0
    counts: Counter[str] = field(default_factory=Counter)
    examples: dict[str, str] = field(default_factory=dict)

    def add(self, number: int, delay: float, faults: list[Fault]) -> None:
        """Count the faults of one kill, each kind once; the first of a kind is kept as the example."""
        for kind, text in faults:
            self.examples.setdefault(kind, f"{self.what}, kill {number} at {delay:.3f} s, {kind}: {text}")
        self.counts.update({kind for kind, _ in faults})

    def row(self) -> list[str]:
        """Write it as a row of the table."""
        counts = [str(self.counts[column]) for column in COLUMNS]
        return [self.what, str(self.kills), str(self.late), f"{self.seconds:.3f}", *counts]


class Segmenting(Victim):
    """`gsseg segment` into a folder that holds an earlier run with other masks."""

    def __init__(self, folder: Path) -> None:
        from small_scenes import write_dataset

        from gsseg_core.warm_up import warm_up

        self._folder = folder
        self._data = write_dataset(folder / "data")
        _turn_labels(self._data)
        self._out = folder / "killed" / "out"
        warm_up()  # Children have what their parent has.
        (folder / "clean").mkdir()
        for name in ("first", "second", "first"):
            self._run(name, folder / "clean" / "out")
        self._clean = listing(folder / "clean")
        self._runs = {}
        for name in ("first", "second"):
            self._run(name, folder / name / "out")
            self._runs[name] = read_folder(folder / name / "out")
        self._out.parent.mkdir()
        self._run("first", self._out)

    def seconds(self) -> float:
        return statistics.median(self._run("first", self._out) for _ in range(3))

    def kill(self, delay: float) -> bool:
        ended = in_child(functools.partial(run_command, self._command("second", self._out)), self._folder, delay)
        return not ended.in_time

    def faults(self) -> list[Fault]:
        return faults_of(self._out, self._runs)

    def faults_after(self) -> list[Fault]:
        rest = self._folder / "rest.ply"
        arguments = ["--segmentation", self._out / "segmentation.npz", "--class", "1", "--out", rest]
        command = ["remove", str(self._data / "scene.ply"), *map(str, arguments)]
        ended = in_child(functools.partial(run_command, command), self._folder, PATIENCE)
        refused = [("refused", ended.errors.strip())] if ended.code else []
        return refused + faults_of(self._out, self._runs)

    def leftovers(self) -> list[Fault]:
        self._run("first", self._out)
        return leftovers(self._out.parent, self._clean)

    def _command(self, name: str, out: Path) -> list[str]:
        labels = {"first": "labels", "second": "turned"}[name]
        arguments = ["--data", self._data, "--out", out, "--labels", labels, "--quiet"]
        return ["segment", str(self._data / "scene.ply"), *map(str, arguments)]

    def _run(self, name: str, out: Path) -> float:
        ended = in_child(functools.partial(run_command, self._command(name, out)), self._folder, PATIENCE)
        if ended.code:
            raise RuntimeError(f"gsseg segment failed: {ended.errors}")
        return ended.seconds


class SavingState(Victim):
    """`LiveSession.save` over an earlier state."""

    def __init__(self, folder: Path) -> None:
        from ros_robot import core_session, renamed
        from small_scenes import balls_on_a_table, clean_views

        scene, _ = balls_on_a_table()
        self._views = {"first": 3, "second": 60}
        self._sessions = {
            name: core_session(scene, renamed(clean_views(12) * (count // 12 or 1))[:count])
            for name, count in self._views.items()
        }
        self._folder, self._path = folder, folder / "killed" / "state.npz"
        self._path.parent.mkdir(parents=True)
        self._save("first")
        self._clean = listing(self._path.parent)

    def seconds(self) -> float:
        return statistics.median(self._save("second") for _ in range(5))

    def kill(self, delay: float) -> bool:
        self._save("first")
        job = functools.partial(self._sessions["second"].save, self._path)
        return not in_child(lambda: job() and 0, self._folder, delay).in_time

    def faults(self) -> list[Fault]:
        return state_faults(self._path, self._sessions["first"].scene, set(self._views.values()))

    def leftovers(self) -> list[Fault]:
        self._save("first")
        return leftovers(self._path.parent, self._clean)

    def _save(self, name: str) -> float:
        ended = in_child(lambda: self._sessions[name].save(self._path) and 0, self._folder, PATIENCE)
        if ended.code:
            raise RuntimeError(f"save failed: {ended.errors}")
        return ended.seconds


def state_faults(path: Path, scene: object, views: set[int]) -> list[Fault]:
    """Load a state, which must be one of those that were saved: it goes by the number of views."""
    from ros_robot import CLASSES

    from gsseg_core.live.session import LiveSession

    if not path.is_file():
        return [("lost", f"{path.name} is not there")]
    session = LiveSession(scene, dict(enumerate(CLASSES)))  # type: ignore[arg-type]
    try:
        count = session.load(path)
    except Exception as error:  # Whatever is made of half a file.
        return [("broken", f"{path.name}: {error}")]
    return [] if count in views else [("mixed", f"{path.name} holds {count} views; expected one of {views}")]


def _turn_labels(data: Path) -> None:
    """Put the same masks with other ids beside those of a dataset, so that every output of theirs differs."""
    import numpy as np

    from gsseg_core.data.label_images import read_mask, write_mask

    turned = np.array([0, 2, 3, 1])
    for path in (data / "labels").iterdir():
        write_mask(data / "turned" / path.name, turned[read_mask(path)[0]], 8)


def victim(what: str, folder: Path) -> Victim:
    """Make a job that can be killed."""
    if what in ("segment", "state"):
        made: Callable[[Path], Victim] = {"segment": Segmenting, "state": SavingState}[what]
        return made(folder)
    from kills_node import NODE_VICTIMS  # It starts threads, after which nothing can be forked.

    return NODE_VICTIMS[what](folder)


def kill_often(what: str, folder: Path, first: int, count: int, seed: int) -> Tally:
    """Kill one kind of job so many times, over its whole duration."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    job, tally = victim(what, folder), Tally(what)
    try:
        tally.seconds = job.seconds()
        print(f"{what}: {tally.seconds:.3f} s if left alone; {count} kills, seed {seed}", flush=True)
        started = time.monotonic()
        for number in range(first, first + count):
            draws = random.Random(f"{seed} {what} {number}")
            for _ in range(ATTEMPTS):
                delay = draws.uniform(0, 1.05 * tally.seconds)
                if job.kill(delay):
                    break
                tally.late += 1
            tally.kills += 1
            faults = job.faults()
            faults += [(AFTER + kind, text) for kind, text in job.faults_after() if kind != "unmarked"]
            tally.add(number, delay, faults + job.leftovers())
            if tally.kills % 20 == 0:
                said = ", ".join(f"{n} {kind}" for kind, n in sorted(tally.counts.items())) or "nothing wrong"
                print(f"  {tally.kills} kills, {time.monotonic() - started:.0f} s: {said}", flush=True)
    finally:
        job.close()
    return tally


def main() -> int:
    """Kill what was asked for and print the table; returns 1 if anything was wrong."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--what", default=",".join(KINDS), help="kinds, separated by commas (default: all)")
    parser.add_argument("--count", type=int, default=200, help="kills of each kind (default: %(default)s)")
    parser.add_argument("--first", type=int, default=0, help="number of the first kill (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="default: %(default)s")
    parser.add_argument("--json", type=Path, help="write the counts there, too")
    options = parser.parse_args()
    wanted = [kind for kind in KINDS if kind in options.what.split(",")]
    if unknown := set(options.what.split(",")) - set(KINDS):
        parser.error(f"--what: {', '.join(sorted(unknown))} is none of {', '.join(KINDS)}")
    tallies = []
    with tempfile.TemporaryDirectory(prefix="kills-") as name:
        for what in wanted:
            tallies.append(kill_often(what, Path(name) / what, options.first, options.count, options.seed))
    print()
    print(markdown(["job", "kills", "late", "takes [s]", *COLUMNS], [tally.row() for tally in tallies]))
    print(f'"{AFTER}...": after the next command, or node, has read what was left. "late": ended before, killed anew.')
    examples = [text for tally in tallies for text in tally.examples.values()]
    print("\n".join(["", "First of each kind:", *examples] if examples else ["", "Nothing was wrong."]))
    if options.json:
        counts = {tally.what: {"kills": tally.kills, **tally.counts} for tally in tallies}
        options.json.write_text(json.dumps({"seed": options.seed, **counts}, indent=1) + "\n")
    return int(any(sum(tally.counts.values()) for tally in tallies))


if __name__ == "__main__":
    sys.exit(main())
