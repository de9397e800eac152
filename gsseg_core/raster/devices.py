"""Names of the devices that views are rendered on."""

from __future__ import annotations

import re

from gsseg_core.errors import SettingsError

DEVICES = "cpu, cuda (the first GPU) or cuda:1 and so on"
"""What may be written, for help texts."""


def checked_device(device: str) -> str:
    """Return the name of a device as it is, if it can be one; whether there is such a device shows when it is used.

    Raises
    ------
    SettingsError
        It is neither 'cpu' nor 'cuda' nor 'cuda:' and a number.
    """
    if not re.fullmatch(r"cpu|cuda(:[0-9]+)?", device):
        raise SettingsError(f"device is {device!r}; expected 'cpu', 'cuda' or 'cuda:' and the number of a GPU")
    return device
