"""Names of devices: what is taken, and what is refused with a message that says what can be written."""

from __future__ import annotations

import pytest

from gsseg_core.cli import main as cli
from gsseg_core.errors import SettingsError
from gsseg_core.raster.devices import checked_device


@pytest.mark.parametrize("device", ["cpu", "cuda", "cuda:0", "cuda:12"])
def test_a_device_is_taken_as_it_is(device: str) -> None:
    assert checked_device(device) == device


@pytest.mark.parametrize("device", ["", "gpu", "cuda:", "cuda:x", "CUDA", "cpu:0", "cuda:1\n"])
def test_anything_else_is_refused(device: str) -> None:
    with pytest.raises(SettingsError, match="expected 'cpu', 'cuda' or 'cuda:' and the number of a GPU"):
        checked_device(device)


def test_the_command_line_refuses_it_before_any_work(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        cli.main(["segment", "no.ply", "--data", "nowhere", "--out", "out", "--device", "cuda:one"])
    assert ended.value.code == 2
    assert "device is 'cuda:one'; expected 'cpu', 'cuda' or 'cuda:' and the number of a GPU" in capsys.readouterr().err
