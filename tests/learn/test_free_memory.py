"""Free memory is what the machine has left, and no more than the control groups of the process let it take."""

from __future__ import annotations

from pathlib import Path

import pytest

from gsseg_core.learn.free_memory import free_memory

GIB = 1 << 30


def machine(folder: Path, group: str, free: int = 10 * GIB) -> tuple[Path, Path]:
    proc, groups = folder / "proc", folder / "cgroup"
    (proc / "self").mkdir(parents=True)
    (proc / "meminfo").write_text(f"MemTotal: 99 kB\nMemFree: 1 kB\nMemAvailable:  {free // 1024} kB\n")
    (proc / "self" / "cgroup").write_text(group)
    groups.mkdir()
    return proc, groups


def group(folder: Path, limit: object, used: int, cached: int = 0, version: int = 2) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    names = ("memory.max", "memory.current") if version == 2 else ("memory.limit_in_bytes", "memory.usage_in_bytes")
    for name, value in zip(names, (limit, used), strict=True):
        (folder / name).write_text(f"{value}\n")
    (folder / "memory.stat").write_text(f"anon 3\n{'' if version == 2 else 'total_'}inactive_file {cached}\n")


def test_without_a_limit_all_that_the_machine_has_left_is_free(tmp_path: Path) -> None:
    proc, groups = machine(tmp_path, "0::/user/shell\n")
    group(groups / "user" / "shell", "max", 5 * GIB)
    assert free_memory(proc, groups) == 10 * GIB


def test_a_limit_of_any_group_around_the_process_counts_less_what_it_uses(tmp_path: Path) -> None:
    proc, groups = machine(tmp_path, "0::/user/shell\n")
    group(groups / "user" / "shell", 8 * GIB, GIB)
    assert free_memory(proc, groups) == 7 * GIB
    group(groups / "user", 6 * GIB, 4 * GIB, cached=GIB)
    assert free_memory(proc, groups) == 3 * GIB


def test_limits_of_version_1_count_at_the_root_where_a_container_sees_no_more(tmp_path: Path) -> None:
    proc, groups = machine(tmp_path, "5:cpu,cpuacct:/docker/abc\n4:memory:/docker/abc\n")
    group(groups / "memory", 4 * GIB, GIB, version=1)
    assert free_memory(proc, groups) == 3 * GIB


def test_what_is_used_up_leaves_nothing(tmp_path: Path) -> None:
    proc, groups = machine(tmp_path, "0::/\n")
    group(groups, GIB, 2 * GIB)
    assert free_memory(proc, groups) == 0


@pytest.mark.parametrize("text", ["", "MemAvailable:", "MemAvailable: many kB"])
def test_a_system_that_says_nothing_leaves_it_open(tmp_path: Path, text: str) -> None:
    assert free_memory(tmp_path / "none", tmp_path) is None
    proc, groups = machine(tmp_path, "0::/\n")
    (proc / "meminfo").write_text(text)
    assert free_memory(proc, groups) is None
