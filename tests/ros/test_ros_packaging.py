"""What ROS tools read besides Python: every file is valid, is installed, and agrees with the code and the others."""

from __future__ import annotations

import ast
import importlib.util
import json
import os
import re
import runpy
import stat
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import pytest
import yaml

from gsseg_ros.child_nodes import NODES

ROOT = Path(__file__).resolve().parents[2]
LAUNCH_FILES = sorted((ROOT / "launch").glob("*.launch.py"))

# Where the ROS package's name is not that of the module.
ROS_PACKAGES = {"tf2_ros": "tf2_ros_py"}
# From PyPI, in setup.py.
NOT_ROS = {"PIL", "numba", "numpy", "plyfile", "pycolmap", "rosbags", "scipy", "torch", "tqdm", "yaml"}

ALLOWED = {
    "topics": {"publish", "subscribe"},
    "services": {"reply", "request"},
    "actions": {"call", "execute"},
}


def _set_up(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Return what setup.py hands to setuptools."""
    handed: dict[str, Any] = {}
    monkeypatch.chdir(ROOT)
    monkeypatch.setattr("setuptools.setup", lambda **keywords: handed.update(keywords))
    exec(compile(Path("setup.py").read_text(), "setup.py", "exec"), {"__name__": "setup"})
    return handed


def _imports(file: Path) -> set[str]:
    names = set()
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names.add(node.module.split(".")[0])
    return names


def _flat(tree: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, value in tree.items():
        flat.update(_flat(value, f"{prefix}{name}.") if isinstance(value, dict) else {prefix + name: value})
    return flat


def _package(folder: Path) -> ElementTree.Element:
    return ElementTree.parse(folder / "package.xml").getroot()


def test_every_file_that_setup_py_installs_is_there(monkeypatch: pytest.MonkeyPatch) -> None:
    files = dict(_set_up(monkeypatch)["data_files"])
    assert [file for names in files.values() for file in names if not (ROOT / file).is_file()] == []
    assert files["share/ament_index/resource_index/packages"] == ["resource/gsseg_ros"]
    assert files["share/gsseg_ros"] == ["package.xml"]


def test_no_launch_or_configuration_file_is_forgotten_by_setup_py(monkeypatch: pytest.MonkeyPatch) -> None:
    installed = {file for _, names in _set_up(monkeypatch)["data_files"] for file in names}
    folders = ("config", "foxglove", "launch", "resource", "rviz", "scripts", "sros2")
    present = {file.relative_to(ROOT).as_posix() for name in folders for file in (ROOT / name).glob("*.*")}
    assert present - installed == set()


def test_setup_py_installs_every_package_and_names_both_nodes(monkeypatch: pytest.MonkeyPatch) -> None:
    handed = _set_up(monkeypatch)
    folders = {file.parent.relative_to(ROOT) for file in ROOT.glob("gsseg_*/**/*.py")}
    assert sorted(handed["packages"]) == sorted(folder.as_posix().replace("/", ".") for folder in folders)
    assert {f"{name} = {module}:main" for name, module in NODES.items()} < set(
        handed["entry_points"]["console_scripts"]
    )


def test_versions_are_the_same_everywhere(monkeypatch: pytest.MonkeyPatch) -> None:
    versions = {_set_up(monkeypatch)["version"], _package(ROOT).findtext("version")}
    assert versions == {_package(ROOT / "msg_defs").findtext("version")}


def test_the_wheels_that_the_messages_are_compiled_against_are_those_of_the_extra(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    wheels = {name for name in _set_up(monkeypatch)["extras_require"]["ros"] if name.startswith("ros-jazzy-")}
    quoted = {line.strip().strip('",') for line in (ROOT / "msg_defs" / "pyproject.toml").read_text().splitlines()}
    assert wheels - quoted == set()
    assert wheels - set((ROOT / "constraints.txt").read_text().splitlines()) == set()


@pytest.mark.parametrize("name", NODES)
def test_node_script_is_executable_and_runs_the_node_of_its_name(name: str) -> None:
    script = ROOT / "scripts" / name
    assert script.stat().st_mode & stat.S_IXUSR
    assert script.read_text().startswith("#!/bin/sh\n")
    assert _imports(script) == {"sys", "gsseg_ros"}
    assert f"from {NODES[name]} import main" in script.read_text()


@pytest.mark.parametrize("activated", [True, False])
def test_node_script_takes_the_interpreter_of_the_environment_it_lies_in(tmp_path: Path, activated: bool) -> None:
    (tmp_path / "lib" / "gsseg_ros").mkdir(parents=True)
    script = tmp_path / "lib" / "gsseg_ros" / "segment_node"
    script.write_bytes((ROOT / "scripts" / "segment_node").read_bytes())
    script.chmod(0o755)
    # Both interpreters only say who they are. The environment's own comes first, activated or not.
    search = tmp_path / "elsewhere"
    for folder in (tmp_path / "bin", search):
        folder.mkdir()
        (folder / "python3").write_text(f'#!/bin/sh\necho {folder.name} "$@"\n')
        (folder / "python3").chmod(0o755)
    path = f"{tmp_path / 'bin' if activated else search}{os.pathsep}{os.environ['PATH']}"

    def said() -> str:
        asked = subprocess.run([script, "--ros-args"], env={"PATH": path}, capture_output=True, text=True, check=True)
        return asked.stdout.strip()

    assert said() == f"bin {script} --ros-args"
    if not activated:  # As in a colcon workspace, whose prefix has no interpreter.
        (tmp_path / "bin" / "python3").unlink()
        assert said() == f"elsewhere {script} --ros-args"


@pytest.mark.parametrize("module", [*NODES.values(), "gsseg_ros.client"])
def test_nodes_and_clients_start_without_the_parts_of_scipy_which_take_longer_to_load_than_they_do(module: str) -> None:
    loaded = "{'scipy.' + part for part in ('linalg', 'ndimage', 'optimize', 'sparse', 'spatial')} & sys.modules.keys()"
    subprocess.run([sys.executable, "-c", f"import sys, {module}; sys.exit(bool({loaded}))"], check=True)


def test_launch_files_are_found() -> None:
    assert [file.name for file in LAUNCH_FILES] == ["replay.launch.py", "segment.launch.py"]


@pytest.mark.parametrize("file", LAUNCH_FILES, ids=lambda file: file.name)
def test_launch_file_compiles_and_defines_what_ros2_launch_calls(file: Path) -> None:
    tree = ast.parse(file.read_text())
    compile(tree, file, "exec")
    assert "generate_launch_description" in {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}
    # For those who have launch_ros; the wheels do not.
    if importlib.util.find_spec("launch_ros"):
        spec = importlib.util.spec_from_file_location("launch_file", file)
        assert spec and spec.loader
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        module.generate_launch_description()


def test_replay_launch_file_has_the_parameters_of_the_node_with_their_defaults() -> None:
    from gsseg_ros.replay.replay_node import _PARAMETERS

    assignment = next(node for node in ast.parse(LAUNCH_FILES[0].read_text()).body if isinstance(node, ast.Assign))
    arguments = {ast.literal_eval(row.elts[0]): ast.literal_eval(row.elts[2]) for row in assignment.value.elts}
    assert arguments == {name: str(default) for name, default, *_ in _PARAMETERS}


def test_parameters_file_has_every_parameter_at_its_default() -> None:
    from gsseg_ros.node.declarations import DECLARATIONS

    file = yaml.safe_load((ROOT / "config" / "segment_node.yaml").read_text())
    assert list(file) == ["/**"]
    assert list(file["/**"]) == ["ros__parameters"]
    in_file = _flat(file["/**"]["ros__parameters"])
    declared = {declaration.name: declaration.default for declaration in DECLARATIONS}
    assert in_file == declared
    # 1 and 1.0 are equal to Python but not to ROS.
    assert {name: type(value) for name, value in in_file.items()} == {n: type(v) for n, v in declared.items()}


def test_parameters_file_says_which_parameters_can_be_set_when() -> None:
    from gsseg_ros.node.declarations import AT_ONCE, DECLARATIONS

    text = (ROOT / "config" / "segment_node.yaml").read_text().split("/**:")[0].replace("\n#", "")
    at_any_time, others = text.split("segment_node.yaml", 1)[1].split(" can be set at any time, ")
    assert set(re.findall(r"\w+", at_any_time)) - {"and"} == {name.partition(".")[0] for name in AT_ONCE}
    at_start = {declaration.name for declaration in DECLARATIONS if declaration.at_start}
    assert set(re.findall(r"\w+", others.split(" here only")[0])) - {"and"} == at_start


@pytest.mark.parametrize(("name", "namespace"), [("gsseg", ""), ("front", "/robot")])
def test_a_node_accepts_the_parameters_file_as_it_stands(name: str, namespace: str) -> None:
    from ros_helpers import Node, private_context

    from gsseg_ros.node import declarations, parameters

    with private_context("--ros-args", "--params-file", str(ROOT / "config" / "segment_node.yaml")) as context:
        node = Node(name, namespace=namespace, context=context)
        declarations.declare(node)
        settings = parameters.Settings.read(node)
        node.destroy_node()
    assert (settings.pose_source, settings.max_views, settings.class_names) == ("topic", 200, ())


def test_package_xml_lists_every_ros_package_that_gsseg_ros_imports() -> None:
    used = set().union(*(_imports(file) for file in (ROOT / "gsseg_ros").rglob("*.py")))
    used -= {*sys.stdlib_module_names, "gsseg_core", "gsseg_ros", *NOT_ROS}
    package = _package(ROOT)
    listed = {element.text for element in package if element.tag in ("depend", "exec_depend")}
    assert {ROS_PACKAGES.get(name, name) for name in used} - listed == set()


@pytest.mark.parametrize("folder", [ROOT, ROOT / "msg_defs"], ids=["gsseg_ros", "gsseg_msgs"])
def test_package_xml_is_of_format_3_and_names_the_same_maintainer(folder: Path) -> None:
    package = _package(folder)
    assert (package.tag, package.get("format"), package.findtext("license")) == ("package", "3", "Apache-2.0")
    maintainers = [ElementTree.tostring(element).strip() for element in package.findall("maintainer")]
    assert maintainers == [ElementTree.tostring(element).strip() for element in _package(ROOT).findall("maintainer")]
    depends = [(element.tag, element.text) for element in package if element.tag.endswith("depend")]
    assert len(set(depends)) == len(depends)


def test_without_the_messages_the_import_says_which_link_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gsseg_msgs", None)
    with pytest.raises(ModuleNotFoundError, match="run `ln -s gsseg/msg_defs src/gsseg_msgs`, and `colcon") as it:
        runpy.run_path(str(ROOT / "gsseg_ros" / "__init__.py"))
    assert it.value.name == "gsseg_msgs"


def test_colcon_finds_both_packages_in_the_repository_itself() -> None:
    defaults = yaml.safe_load((ROOT / "colcon_defaults.yaml").read_text())
    assert defaults == {verb: {"base-paths": [".", "msg_defs"]} for verb in ("build", "list", "test")}
    assert all((ROOT / path / "package.xml").is_file() for path in defaults["build"]["base-paths"])


def test_security_policy_keeps_to_the_schema() -> None:
    policy = ElementTree.parse(ROOT / "sros2" / "policy.xml").getroot()
    assert (policy.tag, policy.get("version")) == ("policy", "0.2.0")
    enclaves = {"/gsseg": "gsseg", "/gsseg_replay": "replay", "/gsseg_client": "gsseg_client"}
    enclaves["/gsseg_viewer"] = "gsseg_view"
    assert [enclave.attrib for enclave in policy.findall("enclaves/enclave")] == [{"path": path} for path in enclaves]
    for enclave in policy.findall("enclaves/enclave"):
        (profile,) = enclave.findall("profiles/profile")
        assert profile.attrib == {"ns": "/", "node": enclaves[enclave.attrib["path"]]}
        assert_rules_are_clean(profile)


def assert_rules_are_clean(profile: ElementTree.Element) -> None:
    for group in profile:
        assert set(group.attrib) <= ALLOWED[group.tag]
        assert set(group.attrib.values()) == {"ALLOW"}
        assert {element.tag for element in group} == {group.tag.removesuffix("s")}
        assert all(element.text and element.text == element.text.strip() for element in group)
    rules = [(group.tag, *group.attrib, element.text) for group in profile for element in group]
    assert len(set(rules)) == len(rules)


def test_security_policy_has_every_service_and_action_of_gsseg_msgs() -> None:
    def snake(name: str) -> str:
        return "".join(f"_{letter.lower()}" if letter.isupper() else letter for letter in name).lstrip("_")

    profile = ElementTree.parse(ROOT / "sros2" / "policy.xml").find("enclaves/enclave/profiles/profile")
    assert profile is not None
    rules = {element.text for element in profile.iter() if element.tag in ("service", "action")}
    files = [*(ROOT / "msg_defs").glob("srv/*.srv"), *(ROOT / "msg_defs").glob("action/*.action")]
    assert {f"~/{snake(file.stem)}" for file in files} - rules == set()


def test_rviz_shows_latched_topics_of_the_node_in_the_map_frame() -> None:
    manager = yaml.safe_load((ROOT / "rviz" / "gsseg.rviz").read_text())["Visualization Manager"]
    assert manager["Global Options"]["Fixed Frame"] == "map"
    displays = {display["Name"]: display for display in manager["Displays"]}
    assert list(displays) == ["Grid", "TF", "Objects", "Objects by label", "Object boxes", "Overlay"]
    shown = {name for name, display in displays.items() if display["Enabled"]}
    assert shown == set(displays) - {"Objects by label"}, "at the first start; that one hides the other's colours"
    topics = {"Objects": "cloud", "Objects by label": "cloud", "Object boxes": "object_markers", "Overlay": "overlay"}
    for name, topic in topics.items():
        asked = displays[name]["Topic"]
        assert asked["Value"] == f"gsseg/{topic}", "relative: in the namespace that RViz is started in"
        assert (asked["Durability Policy"], asked["Reliability Policy"]) == ("Transient Local", "Reliable")
    assert displays["Objects"]["Color Transformer"] == "RGB8"
    assert (displays["Objects by label"]["Color Transformer"], displays["Objects by label"]["Channel Name"]) == (
        "Intensity",
        "label",
    )


def test_foxglove_shows_topics_that_the_node_publishes_in_the_map_frame() -> None:
    layout = json.loads((ROOT / "foxglove" / "gsseg.json").read_text())
    panels = layout["configById"]

    def ids(part: str | dict[str, Any]) -> list[str]:
        return [part] if isinstance(part, str) else [*ids(part["first"]), *ids(part["second"])]

    assert sorted(ids(layout["layout"])) == sorted(panels), "every panel has its place, and every place its panel"
    scene = next(panel for name, panel in panels.items() if name.startswith("3D!"))
    assert scene["followTf"] == "map"
    paths = [panel[key] for panel in panels.values() for key in ("topicPath", "topicToRender") if key in panel]
    images = [panel["imageMode"]["imageTopic"] for panel in panels.values() if panel.get("imageMode")]
    profile = ElementTree.parse(ROOT / "sros2" / "policy.xml").find("enclaves/enclave/profiles/profile")
    assert profile is not None
    published = {
        (element.text or "").replace("~/", "/gsseg/")
        for group in profile.findall("topics[@publish='ALLOW']")
        for element in group
    }
    assert {*scene["topics"], *paths, *images} <= published
    assert {"/gsseg/cloud", "/gsseg/object_markers"} <= {name for name, of in scene["topics"].items() if of["visible"]}
    assert images == ["/gsseg/overlay"] and "/gsseg/objects" in paths and "/diagnostics" in paths
