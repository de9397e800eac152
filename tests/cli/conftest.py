"""A dataset and what `gsseg segment` makes of it, for all tests of the command."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from small_scenes import write_dataset

from gsseg_core.cli.main import main


@pytest.fixture(scope="session")
def pristine(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset, and what `segment` makes of it."""
    data = write_dataset(tmp_path_factory.mktemp("pristine") / "data")
    assert main(["segment", f"{data}/scene.ply", "--data", str(data), "--out", f"{data.parent}/out", "--quiet"]) == 0
    return data.parent


@pytest.fixture
def place(pristine: Path, tmp_path: Path) -> Path:
    """A copy of it, to be damaged."""
    shutil.copytree(pristine, tmp_path / "place")
    return tmp_path / "place"
