"""Tests of what a user may not do, in a process of their own: root may do anything."""

from __future__ import annotations

import os
from pathlib import Path

NOBODY = 65534


def become_nobody(folder: Path) -> None:
    """Go on in a folder, by relative paths, as a user whom permissions hold; all that is needed is imported."""
    os.chdir(folder)  # Folders above it may be closed to him.
    if os.geteuid() == 0:
        folder.chmod(0o777)
        os.setgroups([])
        os.setgid(NOBODY)
        os.setuid(NOBODY)
