"""What belongs to the operator on gsplat alone: how it is chosen, what it keeps, and how it differs from the CPU's."""

from __future__ import annotations

import gc
import importlib
import inspect
import subprocess
import sys
import weakref
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import plain_gsplat
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from naive_rasteriser import naive_gsplat_view, naive_view
from operator_backends import PLAIN, why_missing
from operator_cases import dense, make_scene, random_mask, random_view
from small_scenes import NUM_CLASSES, balls_on_a_table, ring, taught, true_labels

from gsseg_core.data.view import View
from gsseg_core.errors import SettingsError
from gsseg_core.learn.em.em_learner import EMLearner, EMSettings
from gsseg_core.learn.gradient_learner import GradientLearner, GradientSettings
from gsseg_core.learn.vote_learner import VoteLearner
from gsseg_core.raster.backends import make_operator
from gsseg_core.raster.gsplat_backend import GsplatOperator, _tensors_of, chunks, load_gsplat
from gsseg_core.scene.camera import Camera
from gsseg_core.scene.gaussian_scene import GaussianScene

FUNCTIONS = ("fully_fused_projection", "isect_tiles", "isect_offset_encode", "rasterize_to_pixels")
TORN = 0.02
"""Share of a ray that gsplat's rules move at most; docs/gpu.md derives it."""


def names_and_defaults(function):
    return [(name, p.default) for name, p in inspect.signature(inspect.unwrap(function)).parameters.items()]


@pytest.mark.parametrize("name", FUNCTIONS)
def test_the_stand_in_takes_the_arguments_that_gsplat_takes(name):
    gsplat = pytest.importorskip("gsplat", reason="gsplat is not installed, so its arguments cannot be compared")
    assert names_and_defaults(getattr(plain_gsplat, name)) == names_and_defaults(getattr(gsplat, name))


# Labels and rules


def solid_and_thin():
    """The table with balls, its Gaussians of any opacity; a third of them opaque."""
    scene, truth = balls_on_a_table()
    rng = np.random.default_rng(1)
    opacities = np.where(rng.random(len(scene)) < 0.3, rng.uniform(0.98, 0.9999, len(scene)), rng.uniform(0.2, 1))
    return GaussianScene.from_arrays(scene.means, scene.quats, scene.scales, opacities, scene.sh), truth


@pytest.mark.parametrize("backend", ["plain", "cuda"], indirect=True)
@pytest.mark.parametrize("which", ["em", "votes", "gradient"])
def test_labels_are_those_of_the_cpu(backend, monkeypatch, which):
    scene, truth = solid_and_thin()
    views = [View.from_arrays(camera, true_labels(scene, truth, camera)) for camera in ring(4)]
    learners = {
        "em": lambda device: EMLearner(scene, NUM_CLASSES, EMSettings(max_steps=6), device=device),
        "votes": lambda device: VoteLearner(scene, NUM_CLASSES, device=device),
        "gradient": lambda device: GradientLearner(scene, NUM_CLASSES, GradientSettings(epochs=1), device=device),
    }
    expected = taught(learners[which]("cpu"), views).fit()
    monkeypatch.setattr(
        "gsseg_core.learn.learner.make_operator", lambda scene, camera, device: backend.make(scene, camera)
    )
    got = taught(learners[which](backend.name), views).fit()
    both = expected.observed_ & got.observed_
    assert both.sum() >= 0.999 * expected.observed_.sum() > 300
    same = expected.codes_.argmax(axis=1) == got.codes_.argmax(axis=1)
    # A tie may fall to either side: a lead of less than the two learners differ by, a thousandth each.
    second, first = np.sort(expected.codes_, axis=1)[:, -2:].T
    tied = (first - second < 0.002) & (which == "em")
    assert (same | tied)[both].mean() >= 0.999
    assert same[both].mean() >= 0.998
    np.testing.assert_allclose(got.codes_[both], expected.codes_[both], atol=0.05)


@given(st.integers(0, 2**32 - 1), st.integers(1, 200))
def test_the_rules_of_gsplat_move_at_most_a_fiftieth_of_a_ray(seed, n):
    scene, camera = random_view(seed, n, 20, 12)
    ours, theirs = naive_view(scene, camera), naive_gsplat_view(scene, camera, rounding=0.011)
    weights = np.abs(ours.weights - theirs.weights).sum(axis=1)
    moved = 0.5 * (weights + np.abs(ours.transmittance - theirs.transmittance))
    # Where some alpha is within a hundredth of 1/255, that Gaussian may be missing besides.
    assert (moved[theirs.slack == 0] <= TORN + 1e-9).all()


# What it keeps


def test_a_scene_is_copied_to_a_device_once_and_forgotten_with_the_scene():
    scene, camera = random_view(0)
    operator = PLAIN.make(scene, camera)
    first = _tensors_of(scene, "cpu")
    PLAIN.make(scene, camera)
    assert _tensors_of(scene, "cpu") is first
    assert first.opacities.max() <= np.float32(0.99) < scene.opacities.max()
    gone = weakref.ref(scene)
    del scene
    gc.collect()
    assert gone() is None
    assert operator.transmittance().shape == (21, 37)


def test_memory_grows_with_what_is_visible_and_with_the_image():
    scene, camera = random_view(0)
    operator = PLAIN.make(scene, camera)
    seen = operator.observe(random_mask(0))
    assert operator.nbytes >= 28 * len(operator.ids)
    assert seen.nbytes > operator.nbytes + 4 * 37 * 21


def test_no_gradient_is_kept_or_handed_out():
    scene, camera = random_view(0)
    operator = PLAIN.make(scene, camera)
    held = [value for value in vars(operator).values() if isinstance(value, torch.Tensor)]
    assert len(held) == 5
    assert not any(tensor.requires_grad for tensor in held)
    with torch.no_grad():
        assert operator.visibility().any()


@pytest.mark.parametrize(("channels", "sizes"), [(0, []), (1, [1]), (32, [32]), (33, [32, 1]), (70, [32, 32, 6])])
def test_channels_go_through_gsplat_in_chunks_of_32_at_most(channels, sizes):
    cut = list(chunks(channels))
    assert [part.stop - part.start for part in cut] == sizes
    assert [i for part in cut for i in range(channels)[part]] == list(range(channels))


def test_a_view_is_projected_once_and_rasterised_once_for_each_chunk():
    calls = []

    def counting(name):
        function = getattr(plain_gsplat, name)
        return lambda *values, **named: (calls.append(name), function(*values, **named))[1]

    scene, camera = random_view(0)
    operator = GsplatOperator(scene, camera, "cpu", SimpleNamespace(**{name: counting(name) for name in FUNCTIONS}))
    assert calls == list(FUNCTIONS[:3])
    calls.clear()
    operator.render(np.zeros((len(scene), 70)))
    seen = operator.observe(random_mask(0))
    seen.votes()
    seen.shares(np.ones(len(seen.labels)), np.ones(5))
    assert calls == ["rasterize_to_pixels"] * (3 + 1 + 1)


def test_a_scene_far_from_the_origin_loses_nothing():
    scene, camera = random_view(3)
    # Steps of 1/256 are exact in float32 at either place.
    near = make_scene(np.round(scene.means * 256) / 256, scene.quats, scene.scales, scene.opacities)
    offset = np.array([8192.0, -4096, 1024])
    far = make_scene(near.means + offset, near.quats, near.scales, near.opacities)
    there = camera.world_to_camera.copy()
    there[:3, 3] -= there[:3, :3] @ offset
    moved = Camera("far", camera.width, camera.height, camera.K, there)
    slack = naive_gsplat_view(near, camera).slack[:, None]
    difference = np.abs(dense(PLAIN.make(near, camera)) - dense(PLAIN.make(far, moved)))
    assert (difference <= 10 * PLAIN.weight + slack).all()


def test_a_gaussian_whose_extent_overflows_is_left_out_and_spoils_no_pixel():
    scene = make_scene([[0, 0, 2], [0.5, 0.5, 1]], [[1, 0.1, 0.2, 0.3]] * 2, [[0.5] * 3, [1e25, 1, 1e25]], [0.5, 0.5])
    camera = Camera("view", 20, 20, [[16, 0, 10], [0, 16, 10], [0, 0, 1]], np.eye(4))
    operator = PLAIN.make(scene, camera)
    assert operator.ids.tolist() == [0]
    assert np.isfinite(operator.transmittance()).all()


# Where it cannot run


@pytest.fixture
def one_gpu(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    load_gsplat.cache_clear()
    yield
    load_gsplat.cache_clear()


def refused(device):
    with pytest.raises(SettingsError) as error:
        make_operator(*random_view(0), device=device)
    assert "\n" not in str(error.value)
    assert str(error.value).startswith(f"device is '{device}'")
    return str(error.value)


@pytest.mark.parametrize("device", ["cuda:", "cuda:x", "cuda:-1", "cudas", "CUDA", "cuda:0 ", ""])
def test_a_device_that_is_misspelt_is_refused(device):
    assert refused(device).endswith("expected cpu, cuda (the first GPU) or cuda:1 and so on")


@pytest.mark.parametrize("device", ["cuda", "cuda:3"])
def test_without_a_gpu_the_error_says_so(monkeypatch, device):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    load_gsplat.cache_clear()
    assert "sees no GPU; expected an NVIDIA GPU" in refused(device)


@pytest.mark.usefixtures("one_gpu")
@pytest.mark.parametrize("device", ["cuda:1", "cuda:300"])
def test_a_gpu_that_is_not_there_is_refused(device):
    assert refused(device).endswith("PyTorch sees 1 GPUs; expected 'cuda:0' to 'cuda:0'")


@pytest.mark.usefixtures("one_gpu")
def test_without_gsplat_the_error_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "gsplat", None)
    assert refused("cuda").endswith("the package 'gsplat' is missing; expected gsplat: pip install 'gsseg[gsplat]'")


def test_without_torch_the_error_names_the_extra(monkeypatch):
    monkeypatch.delitem(sys.modules, "gsseg_core.raster.gsplat_backend")
    monkeypatch.setitem(sys.modules, "torch", None)
    assert refused("cuda").endswith(
        "'torch' is missing; expected a CUDA build of PyTorch, and gsplat: pip install 'gsseg[gsplat]'"
    )


def install_fake(monkeypatch, kernels):
    fake, backend = ModuleType("gsplat"), ModuleType("gsplat.cuda._backend")
    backend._C = kernels
    for name, module in {"gsplat": fake, "gsplat.cuda": ModuleType("gsplat.cuda"), backend.__name__: backend}.items():
        monkeypatch.setitem(sys.modules, name, module)
    return fake


@pytest.mark.usefixtures("one_gpu")
def test_gsplat_without_compiled_kernels_is_refused(monkeypatch):
    install_fake(monkeypatch, None)
    assert "gsplat is not compiled and finds no CUDA toolkit; expected nvcc" in refused("cuda")


@pytest.mark.usefixtures("one_gpu")
def test_kernels_that_do_not_compile_are_one_clear_error(monkeypatch):
    def fail(name):
        if name.startswith("gsseg_core"):
            return sys.modules[name]
        raise RuntimeError("Error building extension 'gsplat_cuda': [1/3] nvcc\nmany\nlines")

    monkeypatch.setattr(importlib, "import_module", fail)
    assert refused("cuda").endswith("do not compile or load: Error building extension 'gsplat_cuda': [1/3] nvcc")


@pytest.mark.usefixtures("one_gpu")
def test_gsplat_that_is_compiled_is_used(monkeypatch):
    fake = install_fake(monkeypatch, object())
    assert load_gsplat("cuda") is load_gsplat("cuda:0") is fake


def test_the_benchmark_says_in_one_line_that_there_is_no_gpu():
    if not why_missing("cuda"):
        pytest.skip("there is a GPU")
    program = Path(__file__).parents[2] / "benchmarks" / "bench_gpu.py"
    ended = subprocess.run([sys.executable, program], capture_output=True, text=True, check=False)
    assert ended.returncode == 2
    assert ended.stdout == ""
    assert ended.stderr.startswith("bench_gpu: device is 'cuda'")
    assert ended.stderr.count("\n") == 1
