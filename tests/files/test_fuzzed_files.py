"""Every kind of file with bytes changed anywhere: read, or refused with one clear error; never anything else."""

from __future__ import annotations

import json
import shutil
import struct
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from small_scenes import NAMES, NUM_CLASSES, balls_on_a_table, clean_views, ring, taught, write_dataset

from gsseg_core.data.camera_files import read_cameras
from gsseg_core.data.class_names import read_classes
from gsseg_core.data.dataset import Dataset
from gsseg_core.data.label_images import read_mask
from gsseg_core.data.mask_files import read_soft_mask
from gsseg_core.errors import GssegError
from gsseg_core.learn.learner_state import State
from gsseg_core.learn.vote_learner import VoteLearner
from gsseg_core.live.living_session import LivingSession
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.scene.living_scene import LivingScene
from gsseg_core.scene.scene_delta import GroupMove, SceneDelta
from gsseg_core.scene.similarity import Similarity
from gsseg_core.segmentation import Segmentation
from gsseg_core.text import printable

SCENE, TRUTH = balls_on_a_table()
SMALL = SCENE.subset(np.arange(0, len(SCENE), 40))

READERS: dict[str, Callable[[Path], Any]] = {
    "scene.ply": GaussianScene.load,
    "ascii.ply": GaussianScene.load,
    "segmentation.npz": lambda path: Segmentation.load(path, SCENE),
    "state.npz": lambda path: State.load(path, SCENE.digest, len(SCENE)),
    "living.npz": lambda path: State.load(path, SCENE.digest, len(SCENE), first=LivingScene.of(SCENE)),
    "delta.npz": SceneDelta.load,
    "mask.png": read_mask,
    "soft.npz": lambda path: read_soft_mask(path, NAMES, ring(1)[0]),
    "detections/1.tif": lambda path: read_soft_mask(path.parent, NAMES, ring(1)[0]),
    "classes.json": read_classes,
    "data/cameras.json": lambda path: read_cameras(path.parent),
    "data/split.json": lambda path: Dataset(path.parent),
    "data/labels/supervises.json": lambda path: Dataset(path.parents[1]),
    "nerf/transforms.json": lambda path: read_cameras(path.parent),
    "colmap/sparse/0/cameras.bin": lambda path: read_cameras(path.parents[2]),
    "colmap/sparse/0/images.bin": lambda path: read_cameras(path.parents[2]),
}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with one good file of each kind."""
    folder = tmp_path_factory.mktemp("whole")
    write_dataset(folder / "data", cameras=ring(3))
    (folder / "data/labels/supervises.json").write_text('{"*": [1, 2, 3]}')
    shutil.copy(folder / "data/labels/view0.png", folder / "mask.png")
    shutil.copy(folder / "data/classes.json", folder / "classes.json")
    SMALL.save(folder / "scene.ply")
    write_ascii(folder / "ascii.ply")
    Segmentation.from_codes(SCENE, np.eye(NUM_CLASSES, dtype=np.float32)[TRUTH], NAMES).save(
        folder / "segmentation.npz"
    )
    taught(VoteLearner(SCENE, NUM_CLASSES), clean_views(2)).state().save(folder / "state.npz", SCENE.digest)
    delta = SceneDelta(1, np.arange(5), SMALL, np.arange(len(SMALL)) + 999, np.full(len(SMALL), 2, np.int64))
    replace(delta, moves=(GroupMove(2, Similarity(2.0), ("view0",)),)).save(folder / "delta.npz")
    session = LivingSession(SCENE, NAMES)
    session.fuse(clean_views(1)[0])
    session.update(delta)
    session.save(folder / "living.npz")
    np.savez_compressed(folder / "soft.npz", probabilities=np.full((4, 48, 64), 0.25, np.float32))
    (folder / "detections").mkdir()
    Image.fromarray(np.full((48, 64), 0.5, np.float32)).save(folder / "detections/1.tif")
    frame = {"file_path": "a.png", "transform_matrix": np.eye(4).tolist(), "w": 64, "h": 48, "fl_x": 55.0}
    (folder / "nerf").mkdir()
    (folder / "nerf/transforms.json").write_text(json.dumps({"frames": [frame, {**frame, "file_path": "b.png"}]}))
    write_colmap(folder / "colmap/sparse/0")
    return folder


def write_ascii(path: Path) -> None:
    names = SMALL.vertices.dtype.names or ()
    lines = ["ply", "format ascii 1.0", f"element vertex {len(SMALL)}", *(f"property float {n}" for n in names)]
    rows = [" ".join(f"{value:.4g}" for value in row) for row in SMALL.vertices.tolist()]
    path.write_text("\n".join([*lines, "end_header", *rows, ""]))


def write_colmap(folder: Path) -> None:
    folder.mkdir(parents=True)
    camera = struct.pack("<IiQQ4d", 1, 1, 64, 48, 55.0, 55.0, 32.0, 24.0)  # of kind 1, PINHOLE
    (folder / "cameras.bin").write_bytes(struct.pack("<Q", 1) + camera)
    points = struct.pack("<QddQ", 1, 2.0, 3.0, 2**64 - 1)
    images = [struct.pack("<I7dI", i, 1, 0, 0, 0, 0, 0, i, 1) + b"view%d.png\0" % i + points for i in (1, 2)]
    (folder / "images.bin").write_bytes(struct.pack("<Q", 2) + b"".join(images))


@pytest.mark.parametrize("name", READERS)
def test_the_good_files_are_read(whole: Path, name: str) -> None:
    READERS[name](whole / name)


@pytest.mark.parametrize("name", READERS)
@settings(derandomize=True)
@given(data=st.data())
def test_changed_bytes_are_read_or_refused_with_one_clear_error(whole: Path, name: str, data: st.DataObject) -> None:
    content = bytearray((whole / name).read_bytes())
    broken = bytes(mutated(content, data))
    try:
        (whole / name).write_bytes(broken)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # Pillow's, of what it makes of a tag
            READERS[name](whole / name)
    except GssegError as error:
        message = str(error)
        assert "\n" not in message and len(message) < 900 and message == printable(message)
        assert "/tmp" not in message.replace(str(whole), ""), message
    finally:
        (whole / name).write_bytes(content)


def mutated(content: bytearray, data: st.DataObject) -> bytearray:
    places = st.integers(0, len(content) - 1)
    kind = data.draw(st.sampled_from(["bytes", "early", "number", "cut", "double"]))
    if kind == "cut":
        return content[: data.draw(places)]
    if kind == "double":
        place = data.draw(places)
        return content[:place] + content[place // 2 :]
    if kind == "number":  # what a length or a count may be replaced by
        place, value = data.draw(places), data.draw(st.sampled_from([0, 2**31 - 1, 2**32 - 1, 2**63, 2**64 - 1]))
        return content[:place] + value.to_bytes(8, "little") + content[place + 8 :]
    limit = len(content) if kind == "bytes" else min(len(content), 200)
    out = bytearray(content)
    for place in data.draw(st.lists(st.integers(0, limit - 1), min_size=1, max_size=4)):
        out[place] = data.draw(st.integers(0, 255))
    return out
