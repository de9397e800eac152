"""The documentation as a site: built without a warning, asking nobody for anything, with a whole reference."""

from __future__ import annotations

import importlib.util
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from doc_blocks import REPOSITORY


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The documentation as a site, built as `make docs` does: a link or anchor that leads nowhere is an error."""
    if importlib.util.find_spec("mkdocs") is None:
        pytest.skip("mkdocs is not installed (pip install '.[docs]')")
    out = tmp_path_factory.mktemp("site")
    run = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(out)],
        cwd=REPOSITORY, capture_output=True, text=True, env={**os.environ, "NO_MKDOCS_2_WARNING": "1"}, check=False,
    )  # fmt: skip
    assert run.returncode == 0, run.stderr
    yield out


def test_the_site_asks_nobody_for_anything(site: Path) -> None:
    fetched = re.compile(r"""<(?:script|img|iframe|source|video)[^>]+src=["'](?:https?:)?//|<link[^>]+rel=["']?"""
                         r"""(?:stylesheet|preconnect|icon)["']?[^>]+href=["'](?:https?:)?//""")  # fmt: skip
    for path in site.rglob("*.html"):
        assert not fetched.search(path.read_text(encoding="utf-8")), path
    assert "fonts.googleapis" not in (site / "index.html").read_text(encoding="utf-8")


def test_the_reference_names_every_command_class_and_interface(site: Path) -> None:
    import gsseg_core
    from gsseg_core.cli.arguments import COMMANDS

    text = {name: (site / f"{name}.html").read_text(encoding="utf-8") for name in ("cli", "api", "ros")}
    assert all(f"gsseg {name}</h2>" in re.sub(r"<a class=\"headerlink.*?</a>", "", text["cli"]) for name in COMMANDS)
    assert all(f'id="{getattr(gsseg_core, name).__module__}.{name}"' in text["api"] for name in gsseg_core.__all__)
    for path in REPOSITORY.glob("msg_defs/*/*.*"):
        assert f"{path.parent.name}/{path.stem}" in text["ros"]
