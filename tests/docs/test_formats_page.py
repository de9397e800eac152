"""docs/formats.md: its table of what gsseg opens is that of the code."""

from __future__ import annotations

import importlib.util
import sys
from unittest import mock

from doc_blocks import REPOSITORY


def test_the_table_of_scenes_that_are_opened_is_that_of_the_code() -> None:
    source = importlib.util.spec_from_file_location("pages", REPOSITORY / "docs/gen/pages.py")
    assert source is not None and source.loader is not None
    pages = importlib.util.module_from_spec(source)
    with mock.patch.object(sys, "path", [str(REPOSITORY / "docs/gen"), *sys.path]):
        source.loader.exec_module(pages)
    page = (REPOSITORY / "docs/formats.md").read_text(encoding="utf-8")
    assert f"\n{pages.scenes_read()}\n" in page, "copy it from pages.scenes_read() of docs/gen/pages.py"
