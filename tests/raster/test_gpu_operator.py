"""The operator on a GPU: labels, how it is chosen, and what is said where it cannot run.

Its laws are those of all operators, in `test_operator` and `test_operator_laws`, which run on a GPU where there is one.
Where there is none, numba interprets its kernels.
"""

from __future__ import annotations

import gc
import os
import subprocess
import sys
import weakref
from pathlib import Path

import numpy as np
import pytest
import torch
from operator_backends import CPU, why_missing
from operator_cases import random_view
from small_scenes import NUM_CLASSES, balls_on_a_table, ring, taught, true_labels

from gsseg_core.csr_rows import CSRRows
from gsseg_core.data.view import View
from gsseg_core.errors import SettingsError
from gsseg_core.learn import prepared_views
from gsseg_core.learn.em.em_learner import EMLearner, EMSettings
from gsseg_core.learn.gradient_learner import GradientLearner, GradientSettings
from gsseg_core.learn.vote_learner import VoteLearner
from gsseg_core.raster.backends import make_operator
from gsseg_core.raster.gpu import device
from gsseg_core.raster.gpu.projection import tensors_of


def test_kernels_of_the_gpu_give_what_those_of_the_cpu_give() -> None:
    tests, root = Path(__file__).with_name("on_simulated_gpu.py"), Path(__file__).parents[2]
    command = [sys.executable, "-m", "pytest", "-q", "-W", "error", "-p", "no:cacheprovider", str(tests)]
    simulated = {**os.environ, "NUMBA_ENABLE_CUDASIM": "1"}
    done = subprocess.run(command, cwd=root, env=simulated, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.parametrize("which", ["em", "votes", "gradient"])
def test_labels_are_those_of_the_cpu(backend, which):
    if backend is CPU:
        pytest.skip("the CPU is what it is compared with")
    scene, truth = balls_on_a_table()
    views = [View.from_arrays(camera, true_labels(scene, truth, camera)) for camera in ring(4)]
    learners = {
        "em": lambda device: EMLearner(scene, NUM_CLASSES, EMSettings(max_steps=6), device=device),
        "votes": lambda device: VoteLearner(scene, NUM_CLASSES, device=device),
        "gradient": lambda device: GradientLearner(scene, NUM_CLASSES, GradientSettings(epochs=1), device=device),
    }
    expected, got = (taught(learners[which](name), views).fit() for name in ("cpu", backend.name))
    np.testing.assert_array_equal(got.observed_, expected.observed_)
    np.testing.assert_allclose(got.codes_, expected.codes_, atol=1e-3)
    for view in views[:2] if which == "em" else []:
        np.testing.assert_allclose(got.predict_without(view), expected.predict_without(view), atol=1e-3)


def test_votes_against_classes_are_counted_on_the_cpu() -> None:
    learner = EMLearner(balls_on_a_table()[0], NUM_CLASSES, device="cuda", memory_budget=1)
    votes = np.array([[3, 0, 2]])
    assert learner._device_of(CSRRows.from_dense(votes)) == "cuda"
    assert learner._device_of(CSRRows.from_dense(votes - 1)) == "cpu"


def test_a_scene_is_copied_to_a_device_once_and_forgotten_with_the_scene() -> None:
    scene, _ = random_view(0)
    first = tensors_of(scene, torch.device("cpu"))
    assert tensors_of(scene, torch.device("cpu")) is first
    gone = weakref.ref(scene)
    del scene
    gc.collect()
    assert gone() is None


def test_half_of_the_free_memory_of_a_gpu_is_for_prepared_views(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(prepared_views, "free_memory_on", lambda name: {"cuda:1": 10 << 30, "cuda:2": 0}[name])
    assert prepared_views.default_budget("cuda:1") == 5 << 30
    assert prepared_views.default_budget("cuda:2") == 0, "what is full has no room, rather than the usual"


# Where it cannot run


@pytest.fixture
def one_gpu(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    monkeypatch.setattr(device.importlib.util, "find_spec", lambda name: object())
    device.find_gpu.cache_clear()
    yield
    device.find_gpu.cache_clear()


def refused(name):
    with pytest.raises(SettingsError) as error:
        make_operator(*random_view(0), device=name)
    assert "\n" not in str(error.value)
    assert str(error.value).startswith(f"device is '{name}'")
    return str(error.value)


@pytest.mark.parametrize("name", ["cuda:", "cuda:x", "cuda:-1", "cudas", "CUDA", "cuda:0 ", ""])
def test_a_device_that_is_misspelt_is_refused(name):
    assert refused(name).endswith("expected cpu, cuda (the first GPU) or cuda:1 and so on")


@pytest.mark.parametrize("name", ["cuda", "cuda:3"])
def test_without_a_gpu_the_error_says_so(monkeypatch, name):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    device.find_gpu.cache_clear()
    assert "sees no GPU; expected an NVIDIA GPU" in refused(name)


@pytest.mark.usefixtures("one_gpu")
@pytest.mark.parametrize("name", ["cuda:1", "cuda:300"])
def test_a_gpu_that_is_not_there_is_refused(name):
    assert refused(name).endswith("PyTorch sees 1 GPUs; expected 'cuda:0' to 'cuda:0'")


@pytest.mark.usefixtures("one_gpu")
def test_without_numba_cuda_the_error_names_the_extra(monkeypatch):
    monkeypatch.setattr(device.importlib.util, "find_spec", lambda name: None)
    assert "the package 'numba_cuda' is missing; expected numba-cuda: pip install 'gsseg[cuda12]'" in refused("cuda")


def test_without_torch_the_error_says_what_to_install(monkeypatch):
    for name in list(sys.modules):
        if name.startswith("gsseg_core.raster.gpu"):
            monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "torch", None)
    assert refused("cuda").endswith(
        "'torch' is missing; expected a CUDA build of PyTorch, and numba-cuda: pip install 'gsseg[cuda12]'"
    )


@pytest.mark.usefixtures("one_gpu")
def test_kernels_that_do_not_compile_are_one_clear_error(monkeypatch):
    def fail(*arguments):
        raise RuntimeError("libNVVM cannot be found\nmany\nlines")

    monkeypatch.setattr(device, "launch", fail)
    monkeypatch.setattr(device.torch, "zeros", lambda *size, device: None)
    assert "numba compiles nothing for it: libNVVM cannot be found; expected numba-cuda" in refused("cuda")


def test_the_benchmark_says_in_one_line_that_there_is_no_gpu():
    if not why_missing("cuda"):
        pytest.skip("there is a GPU")
    program = Path(__file__).parents[2] / "benchmarks" / "bench_gpu.py"
    ended = subprocess.run([sys.executable, program], capture_output=True, text=True, check=False)
    assert ended.returncode == 2
    assert ended.stdout == ""
    assert ended.stderr.startswith("bench_gpu: device is 'cuda'")
    assert ended.stderr.count("\n") == 1
