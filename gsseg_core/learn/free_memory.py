"""How much memory is free for this process: what the machine has left, and what its control groups let it take."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

GROUPS = {"": ("memory.max", "memory.current", "inactive_file"),
          "memory": ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file")}  # fmt: skip
"""By controller in /proc/self/cgroup, "" being version 2: files with limit and use, and what of the use is given up."""


def free_memory(proc: Path = Path("/proc"), groups: Path = Path("/sys/fs/cgroup")) -> int | None:
    """Tell how many bytes can be taken without anything else being pushed out; None where the system does not say.

    Cached files count as free: the system gives them up. A limit of any group around the process counts, of either
    version of cgroups; inside a container the groups outside of it are not seen, and their limits stand at its root.
    """
    left = list(_left_in_groups(proc, groups))
    with suppress(OSError, ValueError, IndexError):
        left.append(1024 * int((proc / "meminfo").read_text().split("MemAvailable:")[1].split()[0]))
    return max(min(left), 0) if left else None


def _left_in_groups(proc: Path, groups: Path) -> Iterator[int]:
    with suppress(OSError):
        for line in (proc / "self" / "cgroup").read_text().splitlines():
            _, controllers, path = line.split(":", 2)
            for controller in GROUPS.keys() & controllers.split(","):
                group = Path(path.lstrip("/"))
                for folder in (group, *group.parents):
                    with suppress(OSError, ValueError):  # One without a limit says "max", or has no such files.
                        yield _left_in(groups / controller / folder, *GROUPS[controller])


def _left_in(folder: Path, limit: str, used: str, cached: str) -> int:
    given_up = dict(line.split() for line in (folder / "memory.stat").read_text().splitlines()).get(cached, 0)
    return int((folder / limit).read_text()) - int((folder / used).read_text()) + int(given_up)
