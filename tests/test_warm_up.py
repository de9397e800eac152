from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from numba.core import event
from patience import PATIENCE
from small_scenes import write_dataset

from gsseg_core import warm_up as warming
from gsseg_core.errors import SettingsError
from gsseg_core.warm_up import telling, warm_up

COUNTED = """
import gc
import json
import sys
import traceback
from numba.core.dispatcher import Dispatcher
from gsseg_core.warm_up import warm_up

def taken():
    found = [one for one in gc.get_objects() if isinstance(one, Dispatcher) and one._cache.cache_path]
    return {f"{one.py_func.__module__}.{one.py_func.__name__}{types}" for one in found for types in one.signatures}

warm_up()
found = {}
for what, work in json.load(sys.stdin).items():
    error, before = "", taken()
    try:
        exec(work, {})
    except BaseException:
        error = traceback.format_exc()
    found[what] = [*sorted(taken() - before), *filter(None, [error])]
with open(sys.argv[1], "w") as file:
    json.dump(found, file)
"""

WORK = {
    "segment": """
from gsseg_core.cli.main import main
assert main(["segment", {scene!r}, "--data", {data!r}, "--out", {out!r}, "--quiet"]) == 0""",
    "find objects": """
from gsseg_core.cli.main import main
run = ["segment", {scene!r}, "--data", {data!r}, "--out", {out!r}, "--ids", "per-view", "--quiet"]
assert main(run) == 0""",
    "fuse": """
from gsseg_core.data.dataset import Dataset
from gsseg_core.live.session import LiveSession
from gsseg_core.scene.gaussian_scene import GaussianScene
session, data = LiveSession(GaussianScene.load({scene!r})), Dataset({data!r})
assert not any(map(session.fuse, data.views("train")))
session.segmentation()""",
    "click": """
from gsseg_core.data.dataset import Dataset
from gsseg_core.objects.pick import pick_clicks
from gsseg_core.scene.gaussian_scene import GaussianScene
camera = Dataset({data!r}).views("train")[0].camera
pick_clicks(GaussianScene.load({scene!r}), camera, [(camera.height // 2, camera.width // 2)], [])""",
    "soft and partial masks": """
import numpy as np
from gsseg_core.data.dataset import Dataset
from gsseg_core.data.soft_masks import quantise, restrict
from gsseg_core.data.view import View
from gsseg_core.learn.em.em_learner import EMLearner
from gsseg_core.scene.gaussian_scene import GaussianScene
learner = EMLearner(GaussianScene.load({scene!r}), 4)
for number, view in enumerate(Dataset({data!r}).views("train")):
    labels = view.read_labels()
    soft = quantise(0.9 * np.stack([labels == k for k in range(4)])), restrict((labels == 1).astype(int), [1])
    learner.observe(View.from_seen(view.camera, soft[number % 2]))
learner.fit()""",
    "change the map": """
import numpy as np
from gsseg_core.data.dataset import Dataset
from gsseg_core.live.living_session import LivingSession
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.scene.scene_delta import SceneDelta
session, data = LivingSession(GaussianScene.load({scene!r})), Dataset({data!r})
assert not any(map(session.fuse, data.views("train")))
session.update(SceneDelta(removed=np.arange(5)))
session.segmentation()""",
    "weights and depth": """
import numpy as np
from gsseg_core.data.dataset import Dataset
from gsseg_core.raster.backends import make_operator
from gsseg_core.raster.depth import surface
from gsseg_core.raster.view_renderer import PixelGrid
from gsseg_core.scene.gaussian_scene import GaussianScene
camera = Dataset({data!r}).views("train")[0].camera
scene = GaussianScene.load({scene!r})
operator = make_operator(scene, camera)
operator.weights()
surface(scene, operator, PixelGrid(0, 4))
operator.adjoint(np.ones((camera.height, camera.width, 2)))""",
    "view and correct": """
import numpy as np
from gsseg_core.csr_rows import CSRRows
from gsseg_core.data.dataset import Dataset
from gsseg_core.data.object_tree import ObjectTree
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.segmentation import Segmentation
from gsseg_core.viewer.corrections import disc, looks_alike, region
from gsseg_core.viewer.model import Labelling, ViewModel
from gsseg_core.viewer.picking import pick
from gsseg_core.viewer.state import ViewerState
scene, view = GaussianScene.load({scene!r}), Dataset({data!r}).views("train")[0]
halves = np.arange(len(scene), dtype=np.int32) % 2
tree = ObjectTree(np.int32([-1, -1, 1, 1]), np.float32([1, 0.7, 1, 1]), np.where(halves, 2, 0).astype(np.int32), 2, 0.5)
read = Segmentation.from_codes(scene, np.eye(2, dtype=np.float32)[halves], dict(enumerate(["table", "ball"])))
state = ViewerState(ViewModel(scene, Labelling.of(read), class_ids=(0, 1), tree=tree, read=read), [view], dict(), "cpu")
camera, state.added_names[2] = view.camera, "spoon"
middle = camera.width / 2, camera.height / 2
for drawn in (region(camera, state.label_map(camera), *middle, 1), looks_alike(scene, camera, *middle, 0),
              disc(camera, *middle, 3, 2)):
    state.correct(drawn)
state.set_level(0.85)
state.change(lambda model: setattr(model, "min_probability", 0.5))
state.seen()[0].nodes
assert pick(scene, camera, camera.center, scene.means[0] - camera.center, state.model.shown())
state.view_votes()
state.segmentation_npz()
state.selection("ply")""",
    "a camera whose matrices lie by columns": """
from dataclasses import replace
import numpy as np
from gsseg_core.data.dataset import Dataset
from gsseg_core.raster.backends import make_operator
from gsseg_core.scene.gaussian_scene import GaussianScene
camera = Dataset({data!r}).views("train")[0].camera
turned = replace(camera, world_to_camera=np.asfortranarray(camera.world_to_camera), K=np.asfortranarray(camera.K))
assert turned.world_to_camera.flags.f_contiguous
colors = (scene := GaussianScene.load({scene!r})).colors(camera.center)
there, here = (make_operator(scene, one).render(colors) for one in (turned, camera))
assert all(np.array_equal(*pair) for pair in zip(there, here))""",
    "move outlines": """
import numpy as np
from gsseg_core.learn.em.boundary_alignment import align_boundaries
labels, edges = np.zeros((64, 64), np.int32), np.zeros((64, 64), np.float32)
labels[20:42, 20:42] = 1
for line in (edges[22, 22:40], edges[39, 22:40], edges[22:40, 22], edges[22:40, 39]):
    line[:] = 3
assert (align_boundaries(labels, edges, 3) != labels).any()""",
}


def test_a_device_that_is_not_there_is_refused() -> None:
    with pytest.raises(SettingsError, match="device is 'toaster'"):
        warm_up("toaster")


def test_the_first_compilation_is_said_and_only_once() -> None:
    said: list[str] = []
    with telling(said.append):
        assert not said
        for _ in range(2):
            with event.trigger_event("numba:compile"):
                pass
    assert len(said) == 1 and said[0].startswith("compiling kernels")


def test_the_first_compilation_is_shared_with_a_second_process_and_no_third(monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[list[str]] = []

    class Helper:
        def __init__(self, command: list[str], **_: object) -> None:
            started.append(command)

        def wait(self) -> None: ...
        def kill(self) -> None: ...
        def __enter__(self) -> None: ...
        def __exit__(self, *_: object) -> None: ...

    def learn(device: str) -> None:
        for _ in range(2):
            with event.trigger_event("numba:compile"):
                pass

    monkeypatch.setattr(warming.subprocess, "Popen", Helper)
    monkeypatch.setattr(warming, "_warm", set())
    monkeypatch.setattr(warming, "_learn_something", learn)
    warm_up()
    assert len(started) == 1 and "refine_beside" in started[0][-1]
    warm_up()
    assert len(started) == 1  # Whoever is warm need not begin.
    started.clear()
    monkeypatch.setattr(warming, "_warm", set())
    monkeypatch.setattr(warming.kernel_cache, "FOLDER", None)  # Nothing that it compiles would be found.
    warm_up()
    assert not started


@pytest.mark.processes
def test_the_second_process_does_not_outlive_the_first(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))  # Where it has more than a minute's work to do.
    (process,) = warming._start_beside()
    assert process.stdin is not None
    process.stdin.close()  # As the end of this process would.
    assert process.wait(PATIENCE) == 1


def test_warm_up_says_nothing_where_the_kernels_are_there() -> None:
    warm_up()
    program = "from gsseg_core.warm_up import warm_up; warm_up(say=print)"
    told = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout
    assert told == ""


def test_warm_up_loads_no_scipy() -> None:
    program = "import sys; from gsseg_core.warm_up import warm_up; warm_up(); sys.exit('scipy.sparse' in sys.modules)"
    subprocess.run([sys.executable, "-c", program], check=True)


@pytest.fixture(scope="module")
def compiled(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[str]]:
    """Which kernels each work took that warming up had not, one after the other, or the error that it ended in.

    Not only those that it compiled: what another test has left in the cache must not hide what is missing.
    """
    top = tmp_path_factory.mktemp("warm_up")
    data = str(write_dataset(top / "data"))
    shutil.copy(f"{data}/labels/view1.png", f"{data}/labels/view0.png")  # It is wrong there.
    works = {
        what: work.format(data=data, scene=f"{data}/scene.ply", out=str(top / f"out{number}"))
        for number, (what, work) in enumerate(WORK.items())
    }
    command = [sys.executable, "-c", COUNTED, str(top / "found.json")]
    subprocess.run(command, input=json.dumps(works), text=True, check=True)
    found: dict[str, list[str]] = json.loads((top / "found.json").read_text())
    return found


@pytest.mark.parametrize("what", WORK)
def test_warm_up_has_taken_all_kernels_that_work_takes(compiled: dict[str, list[str]], what: str) -> None:
    assert compiled[what] == []
