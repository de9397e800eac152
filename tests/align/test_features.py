"""Features: what finds them is missing on some machines."""

from __future__ import annotations

import sys

import pytest

from gsseg_core.align.features import Extractor
from gsseg_core.align.settings import AlignSettings
from gsseg_core.errors import AlignmentError


@pytest.mark.parametrize(
    ("machine", "how"), [("x86_64", "pip install pycolmap"), ("aarch64", "there is no wheel of it for ARM")]
)
def test_a_missing_pycolmap_is_one_error_that_says_what_to_do(
    monkeypatch: pytest.MonkeyPatch, machine: str, how: str
) -> None:
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    monkeypatch.setattr("platform.machine", lambda: machine)
    with pytest.raises(AlignmentError, match=f"needs pycolmap, which is missing: {how}"):
        Extractor(AlignSettings())
