"""Reference pages from what the program says of itself: its parser, its public names, its ROS interfaces."""

from __future__ import annotations

import argparse
import re
from pathlib import Path

import gsseg_core
from gsseg_core.cli.arguments import build_parser, command_module
from gsseg_core.cli.completion import subparsers
from gsseg_core.data.camera_formats.table import CAMERA_FORMATS
from gsseg_core.data.mask_formats.table import MASK_FORMATS
from gsseg_core.scene.scene_formats import SCENE_FORMATS

REPOSITORY = Path(__file__).parents[2]

API = {
    "Files in, files out": ["GaussianScene", "Dataset", "View", "Camera", "export_classes", "write_scene"],
    "Operator": ["make_operator", "ViewOperator"],
    "Learners": ["EMLearner", "EMSettings", "VoteLearner", "GradientLearner", "GradientSettings"],
    "Results": ["Segmentation", "RefineSettings", "Evaluation"],
    "Errors": ["GssegError"],
}
"""Public names of the library by subject; what is missing here comes last, under "More"."""

GROWING = (
    "live.living_session.LivingSession", "live.living_session.Changed", "scene.scene_delta.SceneDelta",
    "scene.scene_delta.GroupMove", "scene.similarity.Similarity", "scene.living_scene.LivingScene",
)  # fmt: skip


def command_line() -> str:
    """Make the page of the command line from its parser."""
    parts = [
        "# Command line\n",
        "Made from `gsseg --help`. Errors are one line on standard error, with exit code 2; an interrupt ends with "
        "130.\n",
    ]
    for name, parser in subparsers(build_parser()).items():
        module = command_module(name)
        parts += [f"## gsseg {name}\n", " ".join(module.DESCRIPTION.split()) + "\n"]
        parts.append(f"```text\n{parser.format_usage().removeprefix('usage: ').rstrip()}\n```\n")
        rows = [_argument(parser, action) for action in parser._actions if action.dest != "help"]
        if rows:
            parts += ["| argument | meaning | default |", "|---|---|---|", *rows, ""]
        parts.append("```text\n" + "\n".join(line[2:] for line in module.EXAMPLES.strip("\n").split("\n")) + "\n```\n")
    return "\n".join(parts)


def _argument(parser: argparse.ArgumentParser, action: argparse.Action) -> str:
    choices = "{" + ",".join(map(str, action.choices)) + "}" if action.choices else action.dest.upper()
    value = " ".join(action.metavar) if isinstance(action.metavar, tuple) else action.metavar or choices
    if not action.option_strings:
        name = str(value)
    else:
        name = " ".join([action.option_strings[-1], *([] if action.nargs == 0 else [str(value)])])
    shown = action.default not in (None, False, argparse.SUPPRESS)
    default = f"`{action.default}`" if shown else ("required" if action.required else "")
    text = str(action.help) % {**vars(action), "prog": parser.prog}
    return f"| `{_cell(name)}` | {_cell(text)} | {default} |"


def python() -> str:
    """Make the page of the library: one entry for each public name, filled by mkdocstrings."""
    parts = [
        "# Python\n",
        "`from gsseg_core import ...`; shapes, dtypes and units are in the descriptions. Arrays are NumPy's.\n",
    ]
    listed = {name for names in API.values() for name in names}
    more = [name for name in gsseg_core.__all__ if name not in listed]
    for title, names in {**API, **({"More": more} if more else {})}.items():
        parts.append(f"## {title}\n")
        parts += [f"::: {getattr(gsseg_core, name).__module__}.{name}\n" for name in names]
    parts += ["## Files that are read\n", _formats()]
    parts += ["## A robot without ROS\n", "::: gsseg_core.live.session.LiveSession\n"]
    parts += ["## A map that grows\n", *(f"::: gsseg_core.{name}\n" for name in GROWING)]
    parts += ["## The client of the ROS node\n", "::: gsseg_ros.client.SegmentationClient\n"]
    return "\n".join(parts)


def _formats() -> str:
    scenes = [f"| scene | {known.name} | `{known.looked_for}` |" for known in SCENE_FORMATS]
    cameras = [f"| cameras | {known.name} | `{known.looked_for}` |" for known in CAMERA_FORMATS]
    masks = [f"| masks | {known.name} | {known.looked_for} |" for known in MASK_FORMATS]
    return "\n".join(["| what | format | recognised by |", "|---|---|---|", *scenes, *cameras, *masks, ""])


def ros_interfaces() -> str:
    """Make the page of the ROS interfaces from the comments of the .msg, .srv and .action files."""
    folder = REPOSITORY / "msg_defs"
    readme = (folder / "README.md").read_text(encoding="utf-8")
    parts = [re.sub(r"^# .*", "# ROS 2 interfaces", _below_build(readme)), "\n## Definitions\n"]
    titles = {"msg": ["message"], "srv": ["request", "answer"], "action": ["goal", "result", "feedback"]}
    for kind, sections in titles.items():
        for path in sorted((folder / kind).glob(f"*.{kind}")):
            parts.append(f"### {kind}/{path.stem}\n")
            for title, text in zip(sections, path.read_text(encoding="utf-8").split("\n---\n"), strict=True):
                intro, rows = read_definition(text.removeprefix("---\n"))
                if len(sections) > 1:
                    parts.append(f"**{title.capitalize()}**\n")
                if intro:
                    parts.append(intro + "\n")
                if rows:
                    parts += [f"| {title} | type | |", "|---|---|---|"]
                    parts += [f"| `{name}` | {type_} | {_cell(comment)} |" for name, type_, comment in rows]
                    parts.append("")
                else:
                    parts.append("nothing\n")
    return "\n".join(parts)


def read_definition(text: str) -> tuple[str, list[tuple[str, str, str]]]:
    """Read one section of an interface.

    Returns
    -------
    intro : str
        The comment that stands alone at its top.
    rows : list of (name, type, comment)
        A comment is beside its field, or on the lines above it.
    """
    intro, above, rows = "", [], []
    last: list[str] = []
    for line in text.splitlines():
        code, _, comment = (part.strip() for part in line.partition("#"))
        if code:
            type_, _, name = code.partition(" ")
            rows.append([name.strip(), type_, " ".join([*above, comment]).strip()])
            above, last = [], rows[-1]
        elif comment and line.startswith(" ") and last:
            last[2] += f" {comment}"  # The comment beside a field goes on below.
        elif comment:
            above.append(comment)
        elif above and not rows and not intro:
            intro, above = " ".join(above), []
    return intro or (" ".join(above) if not rows else ""), [(name, type_, comment) for name, type_, comment in rows]


def _below_build(readme: str) -> str:
    """Leave out how the messages are built, which the tutorials tell."""
    return readme.split("\n## Build", 1)[0].strip() + "\n"


def _cell(text: str) -> str:
    return text.replace("|", "\\|")
