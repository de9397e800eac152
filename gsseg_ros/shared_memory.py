"""Room in shared memory for large messages, where the middleware is Fast DDS."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

PROFILE = Path(__file__).with_name("fastdds.xml")
"""What Fast DDS is told; also for other publishers of large masks."""

SEGMENT = 8 << 20
"""Bytes of it, in the profile."""

_FILES = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")
_TOLD = (*_FILES, "FASTDDS_BUILTIN_TRANSPORTS")
_FOUND = ("DEFAULT_FASTRTPS_PROFILES.xml", "DEFAULT_FASTDDS_PROFILES.xml")  # in the folder that a program runs in
_SHARED = Path("/dev/shm")


def make_room() -> bool:
    """Have this process's messages pass through 8 MiB of shared memory in place of half a MiB; before `rclpy.init`.

    A publisher of larger messages than there is room for loses parts of them, though the subscriber is on the same
    machine: they are lost for good where best effort, and sent again seconds later where reliable.

    Returns whether Fast DDS was told so: not where the user has told it something, nor where memory is short, as in a
    container. Other middleware does not listen.
    """
    told = any(name in os.environ for name in _TOLD) or any(map(os.path.exists, _FOUND))
    if told or not _SHARED.is_dir() or shutil.disk_usage(_SHARED).free < 4 * SEGMENT:
        return False
    os.environ.update(dict.fromkeys(_FILES, str(PROFILE)))
    return True
