"""The table of rasterisers: which devices are taken, what is refused, and how one more is added."""

from __future__ import annotations

import sys
from types import ModuleType, SimpleNamespace

import pytest
from operator_cases import random_view

from gsseg_core.cli import main as cli
from gsseg_core.errors import SettingsError
from gsseg_core.raster.backends import RASTERISERS, Rasteriser, devices, make_operator, rasteriser_of

EXPECTED = "expected cpu, cuda (the first GPU) or cuda:1 and so on"


@pytest.mark.parametrize("device", ["cpu", "cuda", "cuda:0", "cuda:12"])
def test_a_device_has_a_rasteriser(device: str) -> None:
    assert device.startswith(rasteriser_of(device).described[:3])


@pytest.mark.parametrize("device", ["", "gpu", "cuda:", "cuda:x", "CUDA", "cpu:0", "cuda:1\n"])
def test_anything_else_is_refused(device: str) -> None:
    with pytest.raises(SettingsError) as error:
        rasteriser_of(device)
    assert str(error.value).endswith(EXPECTED)


@pytest.mark.parametrize("command", [["segment", "no.ply", "--data", "no", "--out", "out"], ["view", "no.ply"]])
def test_the_command_line_refuses_it_before_any_work(command: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        cli.main([*command, "--device", "cuda:one"])
    assert ended.value.code == 2
    assert f"device is 'cuda:one'; {EXPECTED}" in capsys.readouterr().err


def test_a_rasteriser_is_added_by_one_line(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    scene, camera = random_view(0)
    toy = ModuleType("toy_rasteriser")
    toy.view_operator = lambda scene, camera, device: SimpleNamespace(seen=(device, len(scene), camera.name))  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, toy.__name__, toy)
    monkeypatch.setattr(
        "gsseg_core.raster.backends.RASTERISERS", [*RASTERISERS, Rasteriser("toy", "toy", toy.__name__, "")]
    )
    operator = make_operator(scene, camera, "toy")
    assert operator.seen == ("toy", len(scene), camera.name)  # type: ignore[attr-defined]
    assert operator.scene is scene
    assert devices().endswith(", toy")
    with pytest.raises(SettingsError, match=r"or cuda:1 and so on, toy$"):
        make_operator(scene, camera, "abacus")
    with pytest.raises(SystemExit):
        cli.main(["segment", "--help"])
    assert "toy (default: cpu)" in " ".join(capsys.readouterr().out.split())


def test_a_package_that_a_rasteriser_lacks_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    lacking = Rasteriser("toy", "toy", "package_of_nobody", "pip install it")
    monkeypatch.setattr("gsseg_core.raster.backends.RASTERISERS", [lacking])
    with pytest.raises(SettingsError, match="'package_of_nobody' is missing; expected pip install it"):
        make_operator(*random_view(0), device="toy")
