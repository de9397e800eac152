"""Room in shared memory for large messages: there where it may be, and nowhere else."""

from __future__ import annotations

import os
import re
from pathlib import Path
from types import SimpleNamespace
from xml.etree import ElementTree

import pytest
from ros_fixtures import root_fixture  # noqa: F401
from ros_helpers import Ros, ros_fixture  # noqa: F401

from gsseg_ros import shared_memory
from gsseg_ros.shared_memory import PROFILE, SEGMENT, make_room


@pytest.fixture(autouse=True)
def nothing_told(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    environment = {name: value for name, value in os.environ.items() if name not in shared_memory._TOLD}
    monkeypatch.setattr(os, "environ", environment)
    monkeypatch.chdir(tmp_path)


def test_fast_dds_is_told_of_the_profile_whose_segment_is_as_large_as_is_said() -> None:
    assert make_room()
    assert os.environ["FASTRTPS_DEFAULT_PROFILES_FILE"] == str(PROFILE)
    sizes = [element.text for element in ElementTree.parse(PROFILE).iter() if element.tag.endswith("segment_size")]
    assert sizes == [str(SEGMENT)]


@pytest.mark.parametrize("name", shared_memory._TOLD)
def test_what_the_user_has_told_fast_dds_holds(name: str) -> None:
    os.environ[name] = "theirs"
    assert not make_room()
    assert os.environ[name] == "theirs" and sum(name in os.environ for name in shared_memory._TOLD) == 1


def test_a_profile_in_the_folder_of_the_program_holds(tmp_path: Path) -> None:
    (tmp_path / "DEFAULT_FASTRTPS_PROFILES.xml").write_text("<dds/>")
    assert not make_room()


def test_where_shared_memory_is_short_it_is_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shared_memory.shutil, "disk_usage", lambda _: SimpleNamespace(free=3 * SEGMENT))
    assert not make_room()


@pytest.mark.parametrize("program", ["segment_node", "replay_node"])
def test_the_programs_have_the_room(ros: Ros, program: str, root: Path) -> None:
    if "fastrtps" not in os.environ.get("RMW_IMPLEMENTATION", "rmw_fastrtps_cpp"):
        pytest.skip("another middleware")
    replayed = {"data": root / "data", "wait_for_subscribers": 600.0}
    process = ros.start(program, replayed if program == "replay_node" else {"autostart": False})

    def largest() -> int:
        maps = Path(f"/proc/{process.pid}/maps").read_text()
        found = re.findall(r"^(\w+)-(\w+) .*/dev/shm/fast(?:rtps|dds)_[0-9a-f]{16}$", maps, re.MULTILINE)
        return max((int(end, 16) - int(begin, 16) for begin, end in found), default=0)

    ros.wait_until(lambda: not process.running or largest() > SEGMENT, "8 MiB of shared memory")
    assert process.running, process.output
