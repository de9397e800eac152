"""What measurements are made with: where things lie, what machine this is, how long and how much."""

from __future__ import annotations

import argparse
import importlib.metadata
import itertools
import os
import platform
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from gsseg_core.raster.observation import Observation, VoteShares

REPOSITORY = Path(__file__).resolve().parents[1]
DATA = Path(os.environ.get("GSSEG_DATA") or REPOSITORY.parent / "shared" / "data")
LIBRARIES = ("numpy", "numba", "llvmlite", "scipy", "torch", "pillow")


def parser_of(description: str | None) -> argparse.ArgumentParser:
    """Make the parser of a program that its docstring describes, with the option that says where real scenes lie."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=DATA, help="folder of the real scenes")
    return parser


def timed(job: Callable[[], object], runs: int) -> list[float]:
    """Seconds of each run of a job, after one that does not count."""
    job()
    return [once(job) for _ in range(runs)]


def asked_anew(
    observation: Observation,
    said: np.ndarray,  # (P,)
    rest: np.ndarray,  # (L,)
) -> Callable[[], VoteShares]:
    """Ask for shares, each time a little differently: an observation remembers what it was asked last."""
    times = itertools.count(1)
    return lambda: observation.shares(said * np.float32(1 + 1e-3 * next(times)), rest)


def once(job: Callable[[], object]) -> float:
    """Seconds of a single run."""
    start = time.perf_counter()
    job()
    return time.perf_counter() - start


def peak_memory() -> float:
    """Most memory that this process has had in use, in GiB."""
    # Not getrusage: a child's count starts with what its parent held when it was forked.
    return memory_of("VmHWM") / 2**30


def memory_of(field: str, process: int | str = "self") -> int:
    """Bytes that Linux tells of a process: VmHWM, the most in use so far, VmRSS, that in use now, or VmSize."""
    return int(Path(f"/proc/{process}/status").read_text().split(f"{field}:")[1].split()[0]) << 10


def describe() -> dict[str, Any]:
    """Name the machine and the versions."""
    return {
        "processor": processor(),
        "cores": os.cpu_count(),
        "memory_gib": round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30, 1),
        "system": platform.platform(),
        "python": platform.python_version(),
        "load_before": round(os.getloadavg()[0], 2),
        **{name: version(name) for name in LIBRARIES},
    }


def version(name: str) -> str:
    """Version of an installed package."""
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"


def processor() -> str:
    """Name of the processor."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.is_file() else []
    fields = [line.split(":", 1) for line in lines if ":" in line]
    known = {key.strip(): value.strip() for key, value in reversed(fields)}
    name = known.get("model name", platform.processor() or platform.machine())
    family = f" (family {known['cpu family']}, model {known['model']})" if "cpu family" in known else ""
    wide = " with AVX-512" if "avx512f" in known.get("flags", "").split() else ""
    return f"{name}{family}{wide}"


def drop_from_page_cache(path: Path) -> None:
    """Have the next reader of a file fetch it from the disk."""
    with open(path, "rb") as file:
        os.fsync(file.fileno())
        os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
