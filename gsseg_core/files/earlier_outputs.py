"""Which files of a folder are results of gsseg, where it wrote no manifest: versions before it did, and bare copies.

Each function is an `earlier` for `gsseg_core.files.run_folder.staged_run`: it takes a folder, and gives relative paths.
A file counts only by what it holds, or because a report of gsseg names it.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from gsseg_core.errors import GssegError
from gsseg_core.files.json_files import read_json
from gsseg_core.files.npz_files import npz_format
from gsseg_core.files.run_manifest import is_inside

_HEADER = 1 << 14  # bytes of a PLY in which its header ends


def earlier_segment(out: Path) -> Iterator[str]:
    """Results of `gsseg segment`, or of the node's export: what report.json names, and what is known by its content."""
    report: Any = _report(out / "report.json")
    ours = bool(report)
    if ours:
        named = [report.get("page"), *report.get("pictures", []), *(entry.get("ply") for entry in report["classes"])]
        yield from (place for place in named if is_inside(place))
        yield "report.json"
    if npz_format(out / "segmentation.npz").startswith("gsseg-segmentation-"):
        yield "segmentation.npz"
        yield from (f"pictures/{name}.png" for name in ("contact_sheet", "legend", "worst_views"))
    yield from (f"classes/{name}" for name in earlier_classes(out / "classes"))


def earlier_classes(folder: Path) -> Iterator[str]:
    """PLYs of an `export_classes`: `<id>_<name>.ply` with the property `label`, which no scene has."""
    if not folder.is_dir() or folder.is_symlink():
        return
    for path in folder.iterdir():
        if re.fullmatch(r"[0-9]+_.+\.ply", path.name) and path.is_file():
            with open(path, "rb") as file:
                header = file.read(_HEADER).partition(b"end_header")[0]
            if header.startswith(b"ply") and b"\nproperty int label\n" in header:
                yield path.name


def earlier_render(out: Path) -> Iterator[str]:
    """Results of `gsseg render`: label maps that each have an overlay, beside a contact sheet and a legend of these."""
    overview = ["overlays/contact_sheet.png", "overlays/legend.png"]
    if all((out / place).is_file() for place in overview):
        yield from overview
        for path in out.glob("*.png"):
            if (out / "overlays" / path.name).is_file():
                yield from (path.name, f"overlays/{path.name}")


def earlier_pick(out: Path) -> Iterator[str]:
    """Results of `gsseg pick`."""
    if npz_format(out / "pick.npz").startswith("gsseg-pick-"):
        yield from ("object.ply", "pick.npz", "pick.png")


def _report(path: Path) -> dict[str, Any]:
    """Read a report of gsseg; empty if it is missing or something else."""
    try:
        content = read_json(path, GssegError)
    except GssegError:
        return {}
    if not isinstance(content, dict) or not {"scene", "gaussians", "classes", "versions"} <= content.keys():
        return {}
    lists = content["classes"], content.get("pictures", [])
    whole = all(isinstance(entries, list) for entries in lists) and all(isinstance(e, dict) for e in lists[0])
    return content if whole and "gsseg" in content["versions"] else {}
