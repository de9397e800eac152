"""The page of the formats has the tables of the code."""

from __future__ import annotations

import sys

from doc_blocks import REPOSITORY

sys.path.insert(0, str(REPOSITORY / "docs/gen"))
import formats


def test_the_tables_of_the_formats_are_those_of_the_code() -> None:
    text = formats.PAGE.read_text(encoding="utf-8")
    assert all(f"<!-- {name} -->" in text for name in formats.TABLES)
    assert text == formats.page(), "docs/formats.md: the code has other formats today; run python docs/gen/formats.py"
