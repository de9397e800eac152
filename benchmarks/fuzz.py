"""Give gsseg thousands of broken inputs: each must work, or be refused with one clear line.

Files go through the commands that read them, in forked children that have 60 s and 2 GiB; messages and requests go to
a node over DDS. Input i of a kind is drawn from the seed, the kind and i alone. Whatever is neither done nor refused
is a finding; its files are kept in `--out`, and `--what "soft npz" --replay 17` shows input 17 again.

Usage: python benchmarks/fuzz.py [--what KIND,...] [--count 2000] [--seed 0] [--out fuzz-findings]
Exit code 1 where there are findings.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import random
import re
import shutil
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

from forked import MOST_MEMORY, Ended, in_child, run_command  # first: it says how numba runs
from fuzz_inputs import KINDS, NAMES, SEGMENT, STATE, Kind, break_one, filled, plain
from report import markdown

from gsseg_core.errors import GssegError
from gsseg_core.live.session import LiveSession
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.text import printable

FILE_KINDS = tuple(kind.name for kind in KINDS)
NODE_KINDS = (
    "mask", "camera_info", "pose", "odometry", "image", "segment", "render_view", "load_scene", "save_state",
    "load_state", "export", "learn",
)  # fmt: skip
LONGEST_LINE = 1000
COLUMNS = ("done", "refused")
_NO_MEMORY = re.compile(r"MemoryError|[Uu]nable to allocate|[Cc]annot allocate memory|bad_alloc")
_FRAME = re.compile(r'File "[^"]*/(gsseg_\w+/(?:\w+/)*\w+\.py)", line (\d+)')


@dataclass
class Tally:
    """What came of the inputs of one kind; `causes` has the first input of each cause of a finding."""

    what: str
    inputs: int = 0
    counts: Counter[str] = field(default_factory=Counter)
    causes: dict[str, list[int]] = field(default_factory=dict)
    most_memory: int = 0
    longest: float = 0.0

    def add(self, number: int, outcome: str) -> None:
        """Count one input."""
        self.inputs += 1
        self.counts[outcome if outcome in COLUMNS else "finding"] += 1
        if outcome not in COLUMNS:
            self.causes.setdefault(outcome, []).append(number)

    def row(self) -> list[str]:
        """Write it as a row of the table."""
        counts = [str(self.counts[column]) for column in (*COLUMNS, "finding")]
        return [self.what, str(self.inputs), *counts, f"{self.longest:.1f}", f"{self.most_memory / 2**20:.0f}"]


class Files:
    """Good datasets, of which one file is broken at a time."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._base = folder, folder / "plain"
        plain(self._base)
        with contextlib.redirect_stdout(io.StringIO()):  # In this process: children then have all that it loads.
            assert run_command(filled(SEGMENT, self._base)) == 0

    def dataset(self, kind: Kind) -> Path:
        """Make a good dataset with such a file, once, and see that its commands work on it."""
        folder = self._folder / kind.name.replace(" ", "_")
        if not folder.exists():
            shutil.copytree(self._base, folder)
            kind.make(folder)
            for command in kind.commands:
                data = self._copied(folder)
                ended = self._run(data, filled(command, data), 600.0)
                if judge(ended) != "done":
                    raise RuntimeError(f"{kind.name}: {command[0]} fails before anything is broken: {ended.errors}")
        return folder

    def broken(self, kind: Kind, name: str, patience: float) -> tuple[str, Ended, str, Path]:
        """Break one file and read it: what came of it, how the child ended, what was done, and the dataset."""
        data, rng = self._copied(self.dataset(kind)), random.Random(name)
        done = break_one(kind, data, rng)
        command = filled(rng.choice(kind.commands), data)
        before = _written(data / "out")
        ended = self._run(data, command, patience)
        outcome = judge(ended)
        if outcome == "refused" and _written(data / "out") != before:
            outcome = "refused, but results were changed"
        return outcome, ended, f"{done}; gsseg {' '.join(command)}".replace(str(data), "."), data

    def _copied(self, folder: Path) -> Path:
        data = self._folder / "broken"
        shutil.rmtree(data, ignore_errors=True)
        shutil.copytree(folder, data)
        return data

    def _run(self, data: Path, command: list[str], patience: float) -> Ended:
        loads = command == ["load_state"]
        return in_child(lambda: load_state(data) if loads else run_command(command), self._folder, patience)


def load_state(data: Path) -> int:
    """Load a state as the node does, and use it; answers as the command line does."""
    session = LiveSession(GaussianScene.load(data / "scene.ply"), NAMES)
    try:
        session.load(data / STATE)
    except GssegError as error:
        print(f"gsseg: error: {error}", file=sys.stderr)
        return 2
    session.segmentation()
    session.learn("votes")
    session.save(data / "again.npz")
    return 0


def judge(ended: Ended) -> str:
    """Say what came of an input: "done", "refused" with one clear line, or a finding in words to count by."""
    lines = ended.errors.splitlines()
    if not ended.in_time:
        return "hang"
    if "Traceback (most recent call last)" in ended.errors:
        frames = _FRAME.findall(ended.errors)
        raised = next(
            (line for line in reversed(lines) if re.match(r"[\w.]+(Error|Exception|Warning|Interrupt)", line)), ""
        )
        return f"traceback: {raised.split(':')[0]} at {':'.join(frames[-1]) if frames else 'no line of gsseg'}"
    if ended.code < 0:
        return f"ended by signal {-ended.code}"
    short = len(lines) == 1 and "memory is not enough" in lines[0]
    if ended.peak > MOST_MEMORY or (_NO_MEMORY.search(ended.errors) and not short):
        return "memory: more than 2 GiB"
    if ended.code == 0:
        unexpected = [line for line in lines if not line.startswith("gsseg: ")]  # What gsseg notes is meant so.
        return f"warning: {_without_paths(unexpected[0])[:90]}" if unexpected else "done"
    if ended.code != 2:
        return f"exit code {ended.code}"
    if len(lines) != 1 or not lines[0].startswith("gsseg: error: "):
        return "refused with more than one line"
    if len(lines[0]) > LONGEST_LINE:
        return "refused with a line of more than 1000 characters"
    return "refused" if lines[0] == printable(lines[0]) else "refused with control characters"


def _without_paths(line: str) -> str:
    return re.sub(r"(?:/[\w.+-]+)+/([\w.+-]+)", r"\1", line)


def _written(out: Path) -> dict[str, int]:
    return {str(path): path.lstat().st_mtime_ns for path in sorted(out.rglob("*")) if not path.is_dir()}


def fuzz_files(what: str, files: Files, options: argparse.Namespace) -> Tally:
    """Break files of one kind."""
    kind, tally, started = next(kind for kind in KINDS if kind.name == what), Tally(what), time.monotonic()
    files.dataset(kind)
    for number in range(options.first, options.first + options.count):
        outcome, ended, done, data = files.broken(kind, f"{options.seed} {what} {number}", options.patience)
        tally.most_memory, tally.longest = max(tally.most_memory, ended.peak), max(tally.longest, ended.seconds)
        if outcome not in COLUMNS and len(tally.causes.get(outcome, [])) < 3:
            _keep(options.out / what.replace(" ", "_") / str(number), outcome, done, ended, data)
        tally.add(number, outcome)
        if tally.inputs % 200 == 0:
            print(
                f"{what}: {tally.inputs} inputs, {time.monotonic() - started:.0f} s, {dict(tally.counts)}", flush=True
            )
    return tally


def _keep(folder: Path, outcome: str, done: str, ended: Ended, data: Path) -> None:
    """Keep the files of a finding, and what was done and said."""
    shutil.rmtree(folder, ignore_errors=True)
    kept = shutil.ignore_patterns("out", "new", "truth")
    with contextlib.suppress(shutil.Error):  # A FIFO cannot be copied.
        shutil.copytree(data, folder, symlinks=True, ignore=kept)
    said = {"outcome": outcome, "done": done, "code": ended.code, "errors": ended.errors[-5000:]}
    (folder / "finding.json").write_text(json.dumps(said, indent=1) + "\n")


def replay(what: str, files: Files, options: argparse.Namespace) -> int:
    """Show one input of one kind again."""
    kind = next(kind for kind in KINDS if kind.name == what)
    name = f"{options.seed} {what} {options.replay}"
    outcome, ended, done, data = files.broken(kind, name, options.patience)
    _keep(options.out / what.replace(" ", "_") / str(options.replay), outcome, done, ended, data)
    print(f"{done}\n{outcome} (code {ended.code}, {ended.seconds:.2f} s, {ended.peak >> 20} MiB)\n{ended.errors}")
    return int(outcome not in COLUMNS)


def main() -> int:
    """Fuzz what was asked for and print the table; returns 1 if there are findings."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    every = (*FILE_KINDS, *NODE_KINDS)
    parser.add_argument(
        "--what", default=",".join(every), help=f"files, node, or kinds: {', '.join(every)} (default: all)"
    )
    parser.add_argument("--count", type=int, default=2000, help="inputs of each kind (default: %(default)s)")
    parser.add_argument("--first", type=int, default=0, help="number of the first input (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="default: %(default)s")
    parser.add_argument("--patience", type=float, default=60.0, help="seconds for one input (default: %(default)s)")
    parser.add_argument("--out", type=Path, default=Path("fuzz-findings"), help="folder for findings (%(default)s)")
    parser.add_argument("--replay", type=int, metavar="NUMBER", help="show this input of one kind of file")
    options = parser.parse_args()
    groups = {"files": FILE_KINDS, "node": NODE_KINDS}
    wanted = [kind for word in options.what.split(",") for kind in groups.get(word, (word,))]
    if unknown := set(wanted) - set(every):
        parser.error(f"--what: {', '.join(sorted(unknown))}; expected some of {', '.join(every)}")
    tallies: list[Tally] = []
    with tempfile.TemporaryDirectory(prefix="fuzz-") as name:
        of_files = [kind for kind in wanted if kind in FILE_KINDS]
        files = Files(Path(name)) if of_files else None
        if options.replay is not None:
            if files is None or len(wanted) != 1:
                parser.error("--replay goes with one kind of file: --what KIND")
            return replay(wanted[0], files, options)
        for what in of_files:
            assert files is not None
            tallies.append(fuzz_files(what, files, options))
        of_node = [kind for kind in wanted if kind in NODE_KINDS]
        if of_node:
            from fuzz_node import fuzz_node  # It starts threads, after which nothing can be forked.

            tallies += fuzz_node(of_node, Path(name) / "node", options)
    print_summary(tallies)
    return int(any(tally.causes for tally in tallies))


def print_summary(tallies: list[Tally]) -> None:
    """Print the table, and each cause of findings with its first input."""
    header = ["inputs of", "inputs", "done", "refused", "findings", "longest [s]", "peak memory [MiB]"]
    print("\n" + markdown(header, [tally.row() for tally in tallies]) + "\n")
    for tally in tallies:
        for cause, numbers in sorted(tally.causes.items(), key=lambda found: -len(found[1])):
            print(f"{tally.what}: {len(numbers)} x {cause}; first: {', '.join(map(str, numbers[:3]))}")


if __name__ == "__main__":
    sys.exit(main())
