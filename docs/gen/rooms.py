"""Draws the rooms of the code from the import contract, and tables what lives in them: python docs/gen/rooms.py.

The contract is `[tool.importlinter]` in pyproject.toml. What is made of it is docs/pictures/rooms.svg, and the table of
docs/architecture.md between its two comments; a test says when they are no longer the contract's.
"""

from __future__ import annotations

import ast
import html
import re
from pathlib import Path

from importlinter.api import read_configuration

REPOSITORY = Path(__file__).parents[2]
FIGURE = REPOSITORY / "docs/pictures/rooms.svg"
PAGE = REPOSITORY / "docs/architecture.md"
CORE, ROS = "gsseg_core", "gsseg_ros"
BEGIN = {
    "align": "placing.py", "cli": "arguments.py", "data": "dataset.py", "demo": "run.py", "export": "class_files.py",
    "files": "atomic.py", "kernels": "compiler.py",
    "learn": "learner.py", "live": "session.py", "objects": "object_table.py", "raster": "view_operator.py",
    "refine": "settings.py", "report": "page.py", "scene": "gaussian_scene.py", "spatial": "neighbourhood.py",
    "viewer": "viewer.py",
}  # fmt: skip
"""The file of each room to read first."""

FLOOR, GAP, TOP, LEFT = 26, 4, 44, 46
CORE_WIDTH, ROS_LEFT, ROS_WIDTH = 600, 676, 240
STYLE = (
    ".h{font-size:15px;font-weight:bold;fill:#14213d}.r{font-size:13px;font-weight:bold;fill:#14213d}"
    ".m{font-size:12px;text-anchor:middle;fill:#14213d}.f{font-size:10.5px;text-anchor:middle;fill:#14213d}"
    ".n{font-size:12px;fill:#394867}"
    ".b{stroke:#394867;fill:#dff3ea}.o{stroke:#394867;fill:#fff1d0}.c{stroke:#394867;fill:#e8eefc}"
    ".a{stroke:#394867;stroke-width:1.8;fill:none}"
)


def contracts() -> list[dict[str, list[str]]]:
    """Read the import contracts of the repository."""
    found: list[dict[str, list[str]]] = read_configuration(str(REPOSITORY / "pyproject.toml"))["contracts_options"]
    return found


def floors(package: str) -> list[list[str]]:
    """Rooms of a package, the topmost floor first; a room imports from the floors below its own."""
    (layers,) = [each["layers"] for each in contracts() if each.get("containers") == [package]]
    return [[room.strip("() ") for room in layer.split("|")] for layer in layers]


def not_in_a_node() -> set[str]:
    """Rooms of the core that a robot's node must not load."""
    (rooms,) = [each["forbidden_modules"] for each in contracts() if each.get("source_modules") == [f"{ROS}.node"]]
    return {room.removeprefix(f"{CORE}.") for room in rooms}


def figure() -> str:
    """Draw both packages as houses, floor upon floor, as SVG."""
    core, ros, apart = floors(CORE), floors(ROS), not_in_a_node()
    height = TOP + len(core) * (FLOOR + GAP)
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {ROS_LEFT + ROS_WIDTH + 14} {height + 40}" role="img" '
        'font-family="sans-serif">',
        "<title>Rooms of the code: each imports only from the floors below it</title>",
        f"<style>{STYLE}</style>",
        '<defs><marker id="m" markerWidth="9" markerHeight="8" refX="7" refY="4" orient="auto">'
        '<path d="M0 0 L8 4 L0 8 z" fill="#394867"/></marker></defs>',
        '<rect width="100%" height="100%" fill="#ffffff"/>',
        f'<text x="{LEFT}" y="28" class="h">{CORE}</text>',
        f'<path d="M24 {TOP + 8} L24 {height - 12}" class="a" marker-end="url(#m)"/>',
        f'<text x="14" y="{(TOP + height) // 2}" class="n" text-anchor="middle" '
        f'transform="rotate(-90 14 {(TOP + height) // 2})">imports</text>',
    ]
    for i, rooms in enumerate(core):
        kinds = ["o" if room in apart else "b" for room in rooms]
        parts += _floor(rooms, kinds, LEFT, TOP + i * (FLOOR + GAP), CORE_WIDTH, captions=True)
    ground = height - len(ros) * (FLOOR + GAP)
    parts.append(f'<text x="{ROS_LEFT}" y="{ground - 16}" class="h">{ROS}</text>')
    for i, rooms in enumerate(ros):
        parts += _floor(rooms, ["c"] * len(rooms), ROS_LEFT, ground + i * (FLOOR + GAP), ROS_WIDTH)
    middle = ground + len(ros) * (FLOOR + GAP) // 2
    parts.append(
        f'<path d="M{ROS_LEFT - 4} {middle} L{LEFT + CORE_WIDTH + 4} {middle}" class="a" marker-end="url(#m)"/>'
    )
    legend = [("b", "a robot's node may load it", LEFT), ("o", "for people: a node must not load it", LEFT + 210)]
    for kind, text, x in [*legend, ("c", "around it: ROS 2", ROS_LEFT)]:
        parts.append(f'<rect x="{x}" y="{height + 12}" width="16" height="16" rx="3" class="{kind}"/>')
        parts.append(f'<text x="{x + 23}" y="{height + 25}" class="n">{text}</text>')
    return "\n".join([*parts, "</svg>\n"])


def _floor(rooms: list[str], kinds: list[str], left: int, top: int, width: int, captions: bool = False) -> list[str]:
    each, parts = (width - GAP * (len(rooms) - 1)) / len(rooms), []
    for i, (room, kind) in enumerate(zip(rooms, kinds, strict=True)):
        x = left + i * (each + GAP)
        parts.append(f'<rect x="{x:.1f}" y="{top}" width="{each:.1f}" height="{FLOOR}" rx="4" class="{kind}"/>')
        if captions and len(rooms) == 1:
            parts.append(f'<text x="{left + 12}" y="{top + 18}" class="r">{room}</text>')
            parts.append(f'<text x="{left + 118}" y="{top + 18}" class="n">{_caption(room)}</text>')
        else:
            size = "m" if len(rooms) < 4 else "f"
            parts.append(f'<text x="{x + each / 2:.1f}" y="{top + 18}" class="{size}">{room}</text>')
    return parts


def _caption(room: str) -> str:
    text = _first_paragraph(_source(room))
    short = text.split(": ")[0]
    return html.escape((short if len(short) > 12 else text).rstrip(".").replace("`", ""))


def table() -> str:
    """Table the rooms of the core, the lowest first: what lives in each, by its docstring, and where to begin."""
    rows = ["| room | what lives there | begin with |", "|---|---|---|"]
    for rooms in reversed(floors(CORE)):
        for room in rooms:
            source, folder = _source(room), (REPOSITORY / CORE / room).is_dir()
            begin = f"[{BEGIN[room]}](../{CORE}/{room}/{BEGIN[room]})" if folder else ""
            name = f"`{room}/`" if folder else f"[`{room}`](../{CORE}/{room}.py)"
            rows.append(f"| {name} | {_first_paragraph(source)} | {begin} |")
    return "\n".join(rows)


def _source(room: str) -> Path:
    folder = REPOSITORY / CORE / room
    return folder / "__init__.py" if folder.is_dir() else folder.with_suffix(".py")


def _first_paragraph(source: Path) -> str:
    text = ast.get_docstring(ast.parse(source.read_text(encoding="utf-8"))) or ""
    return " ".join(text.split("\n\n")[0].split()).replace("|", "\\|")


def page() -> str:
    """Put the table into docs/architecture.md, between its two comments."""
    text = PAGE.read_text(encoding="utf-8")
    return re.sub(r"(?<=<!-- rooms -->\n).*?(?=<!-- end -->)", lambda _: table() + "\n", text, flags=re.DOTALL)


if __name__ == "__main__":
    FIGURE.write_text(figure(), encoding="utf-8")
    PAGE.write_text(page(), encoding="utf-8")
