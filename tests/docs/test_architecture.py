"""The page of the architecture shows the rooms of the import contract."""

from __future__ import annotations

import sys

import pytest
from doc_blocks import REPOSITORY

sys.path.insert(0, str(REPOSITORY / "docs/gen"))
rooms = pytest.importorskip("rooms", reason="import-linter is not installed", exc_type=ImportError)

AGAIN = "made from something else than the contract and the docstrings of today; run python docs/gen/rooms.py"


def test_the_figure_of_the_rooms_is_that_of_the_contract() -> None:
    assert rooms.FIGURE.read_text(encoding="utf-8") == rooms.figure(), f"docs/pictures/rooms.svg: {AGAIN}"


def test_the_table_of_the_rooms_is_that_of_the_contract_and_the_docstrings() -> None:
    assert rooms.PAGE.read_text(encoding="utf-8") == rooms.page(), f"docs/architecture.md: {AGAIN}"
    for folder in (REPOSITORY / "gsseg_core").iterdir():
        assert not (folder / "__init__.py").is_file() or f"| `{folder.name}/` |" in rooms.table(), folder.name
