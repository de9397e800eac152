"""Finds how much memory this process can use: the free memory of the machine, limited by its control groups."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

GROUPS = {"": ("memory.max", "memory.current", "inactive_file"),
          "memory": ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file")}  # fmt: skip
"""By controller in /proc/self/cgroup ("" is version 2): files of limit and use, and key of the reclaimable use."""


def free_memory(proc: Path = Path("/proc"), groups: Path = Path("/sys/fs/cgroup")) -> int | None:
    """Return how many bytes can be allocated without evicting anything else; None if the system does not tell.

    Cached files count as free, since the system drops them when needed. The limits of all groups around the process
    count, of either version of cgroups. A container does not see the groups outside it; their limits appear at its
    root.
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
                    with suppress(OSError, ValueError):  # A group without a limit has "max", or no such files.
                        yield _left_in(groups / controller / folder, *GROUPS[controller])


def _left_in(folder: Path, limit: str, used: str, cached: str) -> int:
    given_up = dict(line.split() for line in (folder / "memory.stat").read_text().splitlines()).get(cached, 0)
    return int((folder / limit).read_text()) - int((folder / used).read_text()) + int(given_up)
