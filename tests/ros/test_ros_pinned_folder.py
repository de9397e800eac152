"""Folders that the node writes into lie below its root, also when they are moved or swapped for links meanwhile."""

from __future__ import annotations

from pathlib import Path

import pytest

from gsseg_core.errors import PathNotAllowedError, WriteError
from gsseg_ros.node.pinned_folder import pinned_folder


def test_a_folder_that_is_swapped_while_it_is_written_to_does_not_lead_out(tmp_path: Path) -> None:
    root = tmp_path / "root"
    root.mkdir()
    folder, outside = root / "new" / "folder", tmp_path / "elsewhere"
    outside.mkdir()
    with pinned_folder(folder, root) as pinned:
        folder.rename(root / "moved")
        folder.symlink_to(outside)
        (pinned / "file").write_text("written")
    assert (root / "moved" / "file").read_text() == "written"
    assert not list(outside.iterdir())
    with pytest.raises(WriteError, match=f"{folder}: cannot be written"), pinned_folder(folder, root):
        pass


def test_errors_name_the_folder_as_it_was_asked_for(tmp_path: Path) -> None:
    root = tmp_path / "root"
    root.mkdir()
    with pytest.raises(WriteError) as caught, pinned_folder(root / "new", root) as pinned:
        raise WriteError(f"{pinned / 'file'}: cannot be written (No space left on device)")
    assert str(caught.value) == f"{root}/new/file: cannot be written (No space left on device)"
    with pytest.raises(PathNotAllowedError, match="does not lie below"), pinned_folder(tmp_path, root):
        pass
