"""The page of the architecture shows the rooms of the contract, imports go in no circle, what pages name is there."""

from __future__ import annotations

import re
import sys

import pytest
from doc_blocks import PAGES, REPOSITORY
from house import import_circles

sys.path.insert(0, str(REPOSITORY / "docs/gen"))
rooms = pytest.importorskip("rooms", reason="import-linter is not installed", exc_type=ImportError)

AGAIN = "made from something else than the contract and the docstrings of today; run python docs/gen/rooms.py"

ADDED = {
    "gsseg_core/data/camera_formats/poses.py", "gsseg_core/learn/sharp_learner.py", "gsseg_core/learn/sharp_learner",
    "gsseg_core/raster/vulkan_backend",
}  # fmt: skip
"""What CONTRIBUTING.md adds."""


def test_the_figure_of_the_rooms_is_that_of_the_contract() -> None:
    assert rooms.FIGURE.read_text(encoding="utf-8") == rooms.figure(), f"docs/pictures/rooms.svg: {AGAIN}"


def test_the_table_of_the_rooms_is_that_of_the_contract_and_the_docstrings() -> None:
    assert rooms.PAGE.read_text(encoding="utf-8") == rooms.page(), f"docs/architecture.md: {AGAIN}"
    for folder in (REPOSITORY / "gsseg_core").iterdir():
        assert not (folder / "__init__.py").is_file() or f"| `{folder.name}/` |" in rooms.table(), folder.name


def test_no_imports_go_in_a_circle_not_even_for_types_or_within_a_function_or_a_room() -> None:
    assert import_circles() == []  # The contract orders rooms, and sees nothing of what goes on within one.


@pytest.mark.parametrize("page", PAGES)
def test_modules_that_a_page_names_are_there(page: str) -> None:
    text = (REPOSITORY / page).read_text(encoding="utf-8")
    named = re.findall(r"(?<!tests/)\b(?:gsseg_core|gsseg_ros|benchmarks)/[\w/]+\.\w+", text)
    named += [path.replace(".", "/") for path in re.findall(r"\bgsseg_(?:core|ros)(?:\.[a-z_]+)+", text)]
    for name in set(named) - ADDED:
        path = (REPOSITORY / name).with_suffix("")
        there = (REPOSITORY / name).is_file() or path.is_dir() or path.with_suffix(".py").is_file()
        assert there or path.parent.with_suffix(".py").is_file(), f"{page}: {name} is not there"
