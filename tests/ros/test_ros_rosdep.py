"""rosdep itself on both packages, in a workspace as docs/tutorial_robot.md has it, with an index in a folder."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest

pytest.importorskip("rosdep2", reason="rosdep is not installed")

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = {"gsseg_ros": ROOT / "package.xml", "gsseg_msgs": ROOT / "msg_defs" / "package.xml"}
# Of the names below these, rosdep's list (rosdep/python.yaml of ros/rosdistro) has the first from apt, under their own
# names; the others from pip.
FROM_APT = [f"python3-{name}" for name in ("jinja2", "numpy", "pil", "pytest", "scipy", "tqdm", "venv", "yaml")]
FROM_PIP = {"python3-plyfile-pip": "plyfile", "python3-rosbags-pip": "rosbags"}


def _wanted(file: Path) -> set[str]:
    """All that a package.xml names, under whichever condition."""
    return {str(entry.text) for entry in ElementTree.parse(file).getroot() if entry.tag.endswith("depend")}


@pytest.fixture(name="workspace", scope="module")
def workspace_fixture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A workspace with both packages, and beside it what rosdep looks names up in."""
    folder = tmp_path_factory.mktemp("rosdep")
    ros = set().union(*map(_wanted, PACKAGES.values())) - {*PACKAGES, *FROM_APT, *FROM_PIP}
    rules = {key: {"ubuntu": [key]} for key in FROM_APT}
    rules |= {key: {"ubuntu": {"pip": {"packages": [name]}}} for key, name in FROM_PIP.items()}  # type: ignore[dict-item]
    release = {"tags": {"release": "release/jazzy/{package}/{version}"}, "url": "file:///x.git", "version": "1.0.0-1"}
    repositories = {name: {"release": release, "status": "maintained"} for name in sorted(ros)}
    platforms = {"ubuntu": ["noble"]}
    distribution = {"release_platforms": platforms, "repositories": repositories, "type": "distribution", "version": 2}
    cache = {"name": "jazzy", "type": "cache", "version": 2, "distribution_file": [distribution],
             "release_package_xmls": {}, "source_repo_package_xmls": {}}  # fmt: skip
    listed = {"distribution": ["jazzy.yaml"], "distribution_cache": (folder / "cache.yaml").as_uri(),
              "distribution_status": "active", "distribution_type": "ros2", "python_version": 3}  # fmt: skip
    index = {"type": "index", "version": 4, "distributions": {"jazzy": listed}}
    files = {"rules": rules, "jazzy": distribution, "cache": cache, "index": index}
    for name, content in files.items():  # JSON is YAML.
        (folder / f"{name}.yaml").write_text(json.dumps(content))
    (folder / "sources").mkdir()
    (folder / "sources" / "10.list").write_text(f"yaml {(folder / 'rules.yaml').as_uri()}\n")
    _rosdep(folder, "update")
    (folder / "src").mkdir()
    (folder / "src" / "gsseg").symlink_to(ROOT)
    (folder / "src" / "gsseg_msgs").symlink_to("gsseg/msg_defs")
    return folder


def _rosdep(workspace: Path, *arguments: str, expected: int = 0, **environment: str) -> str:
    # Its own user, so that nothing of the one who runs tests is looked at.
    home, sources, index = str(workspace), str(workspace / "sources"), (workspace / "index.yaml").as_uri()
    environment |= {"HOME": home, "ROS_HOME": home, "ROSDEP_SOURCE_PATH": sources, "ROSDISTRO_INDEX_URL": index,
                    "ROS_DISTRO": "jazzy", "ROS_VERSION": "2", "ROS_PYTHON_VERSION": "3",
                    "PATH": os.environ["PATH"]}  # fmt: skip
    program = [sys.executable, "-c", "from rosdep2.main import rosdep_main; rosdep_main()", *arguments]
    done = subprocess.run(program, cwd=workspace, env=environment, capture_output=True, text=True)
    assert done.returncode == expected, done.stdout + done.stderr
    return done.stdout + done.stderr


def _installed(workspace: Path, expected: int = 0, **environment: str) -> str:
    # As the tutorial has it, for Ubuntu 24.04 and as if nothing was there yet.
    arguments = ("install", "--from-paths", "src", "--ignore-src", "-y", "--simulate", "--reinstall")
    return _rosdep(workspace, *arguments, "--os=ubuntu:noble", expected=expected, **environment)


def test_rosdep_installs_from_apt_all_that_both_packages_name(workspace: Path) -> None:
    said = _installed(workspace)
    wanted = set().union(*map(_wanted, PACKAGES.values())) - {*PACKAGES, *FROM_PIP}
    from_ros = {f"ros-jazzy-{key.replace('_', '-')}" for key in wanted - set(FROM_APT)}
    lines = {line.strip() for line in said.splitlines() if line.startswith("  ")}
    assert {line.split()[-1] for line in lines} == from_ros | set(FROM_APT)
    assert all(line.startswith("apt-get install ") for line in lines), "pip would bring NumPy 2 over that of apt"


def test_where_pip_may_write_beside_the_system_rosdep_takes_the_two_that_apt_lacks(workspace: Path) -> None:
    said = _installed(workspace, PIP_BREAK_SYSTEM_PACKAGES="1")
    from_pip = {line.split()[-1] for line in said.splitlines() if " pip3 install " in f" {line}"}
    assert from_pip == set(FROM_PIP.values())


def test_without_the_link_rosdep_says_that_the_messages_are_missing(workspace: Path) -> None:
    link = workspace / "src" / "gsseg_msgs"
    link.unlink()
    try:
        assert "gsseg_ros: Cannot locate rosdep definition for [gsseg_msgs]" in _installed(workspace, expected=1)
    finally:
        link.symlink_to("gsseg/msg_defs")
