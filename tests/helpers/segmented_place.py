"""Command lines for a folder with a dataset in data/ and its segmentation in out/, and what tests ask of it."""

from __future__ import annotations

from pathlib import Path


def segment(place: Path, *more: str, scene: str = "data/scene.ply") -> list[str]:
    return ["segment", f"{place / scene}", "--data", f"{place}/data", "--out", f"{place}/out", "--quiet", *more]


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def assert_one_line(stderr: str, names: str) -> None:
    assert "Traceback" not in stderr
    lines = stderr.splitlines()
    assert len(lines) == 1 and lines[0].startswith("gsseg: error: "), stderr
    assert names in lines[0], stderr
