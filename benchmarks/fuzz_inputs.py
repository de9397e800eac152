"""A good input of every kind of file that gsseg reads, what can be broken about it, and the commands that read it."""

from __future__ import annotations

import json
import random
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import forked  # noqa: F401 - first: it says how numba runs, and where small scenes are
import fuzz_scenes
import mask_writers
import mutations
import numpy as np
from mutations import Mutation
from small_scenes import NAMES, balls_on_a_table, look_at, ring, write_dataset

from gsseg_core.data.dataset import Dataset
from gsseg_core.data.label_images import read_mask
from gsseg_core.live.session import LiveSession
from gsseg_core.scene.camera import Camera

WIDTH, HEIGHT = 16, 12
STATE, SEGMENTATION = "state.npz", "out/segmentation.npz"
JSON = (mutations.json_values, mutations.json_values, mutations.json_values, mutations.any_bytes)
NPZ = (mutations.npz_members, mutations.npz_members, mutations.npz_members, mutations.any_bytes)
PNG = (mutations.png_chunks, mutations.png_chunks, mutations.any_bytes)
PLY = (mutations.ply_header, mutations.ply_header, mutations.any_bytes)
TEXT = (mutations.words, mutations.words, mutations.any_bytes)
BINARY = (mutations.numbers, mutations.numbers, mutations.any_bytes)

SEGMENT = ("segment", "{scene}", "--data", "{data}", "--out", "{out}", "--quiet")
VOTES = (*SEGMENT, "--learner", "votes")
PER_VIEW = (*SEGMENT, "--ids", "per-view")
RENDER = ("render", "{scene}", "--data", "{data}", "--segmentation", "{npz}", "--out", "{new}", "--quiet")
_PICK = ("pick", "{scene}", "--data", "{data}", "--view", "view0", "--mask", "{data}/labels/view0.png")
MASK = (*_PICK, "--out", "{new}", "--quiet")
REMOVE = ("remove", "{scene}", "--segmentation", "{npz}", "--class", "red ball", "--out", "{new}/rest.ply")
EVAL = ("eval", "--pred", "{data}/labels", "--truth", "{data}/truth/labels")
LOAD_STATE = ("load_state",)
"""No command: what the node does with a state."""


@dataclass(frozen=True)
class Kind:
    """A kind of file.

    Attributes
    ----------
    name : str
        As `--what` knows it.
    make : callable
        Turns the plain dataset into one that has such a file.
    files : tuple of str
        One of these is broken.
    mutations : tuple of Mutation
        One of these breaks it.
    commands : tuple of tuple of str
        One of these reads it.
    """

    name: str
    make: Callable[[Path], None]
    files: tuple[str, ...]
    mutations: tuple[Mutation, ...]
    commands: tuple[tuple[str, ...], ...]


def plain(folder: Path) -> None:
    """Write the dataset that all others are made from, with a mask of one object beside it."""
    scene, truth = balls_on_a_table()
    cameras = [look_at(camera.name, camera.center, WIDTH, HEIGHT, 14.0) for camera in ring(3)]
    write_dataset(folder, scene, truth, cameras, NAMES)
    write_dataset(folder / "truth", scene, truth, cameras, NAMES)
    session = LiveSession(scene, NAMES)
    for view in Dataset(folder).views("train"):
        session.fuse(view)
    session.learn("votes")
    session.save(folder / STATE)


def _as_it_is(folder: Path) -> None:
    pass


def _cameras(folder: Path) -> list[Camera]:
    cameras = list(Dataset(folder).cameras)
    (folder / "cameras.json").unlink()
    return cameras


def _nerfstudio(folder: Path) -> None:
    frames = []
    for camera in _cameras(folder):
        pose = np.linalg.inv(camera.world_to_camera) @ np.diag([1.0, -1, -1, 1])
        frames.append({"file_path": f"images/{camera.name}.png", "transform_matrix": pose.tolist()})
    shared = {"w": WIDTH, "h": HEIGHT, "fl_x": 14.0, "fl_y": 14.0, "cx": WIDTH / 2, "cy": HEIGHT / 2}
    (folder / "transforms.json").write_text(json.dumps({**shared, "k1": 0.0, "frames": frames}))


def _colmap_poses(folder: Path) -> list[tuple[str, list[float]]]:
    from scipy.spatial.transform import Rotation

    found = []
    for camera in _cameras(folder):
        quat = Rotation.from_matrix(camera.world_to_camera[:3, :3]).as_quat()[[3, 0, 1, 2]]
        found.append((f"{camera.name}.png", [*quat.tolist(), *camera.world_to_camera[:3, 3].tolist()]))
    (folder / "sparse" / "0").mkdir(parents=True)
    return found


def _colmap_txt(folder: Path) -> None:
    poses, model = _colmap_poses(folder), folder / "sparse" / "0"
    (model / "cameras.txt").write_text(f"# cameras\n1 PINHOLE {WIDTH} {HEIGHT} 14.0 14.0 {WIDTH / 2} {HEIGHT / 2}\n")
    lines = [f"{i} {' '.join(map(repr, pose))} 1 {name}\n1.0 2.0 -1" for i, (name, pose) in enumerate(poses, 1)]
    (model / "images.txt").write_text("# images\n" + "\n".join(lines) + "\n")
    (model / "points3D.txt").write_text("")


def _colmap_bin(folder: Path) -> None:
    poses, model = _colmap_poses(folder), folder / "sparse" / "0"
    lens = struct.pack("<IiQQ4d", 1, 1, WIDTH, HEIGHT, 14.0, 14.0, WIDTH / 2, HEIGHT / 2)
    (model / "cameras.bin").write_bytes(struct.pack("<Q", 1) + lens)
    images = [
        struct.pack("<I7dI", i, *pose, 1) + name.encode() + b"\0" + struct.pack("<Qddq", 1, 1.0, 2.0, -1)
        for i, (name, pose) in enumerate(poses, 1)
    ]
    (model / "images.bin").write_bytes(struct.pack("<Q", len(images)) + b"".join(images))
    (model / "points3D.bin").write_bytes(bytes(8))


def _sixteen_bits(folder: Path) -> None:
    from gsseg_core.data.label_images import write_mask

    for path in (folder / "labels").iterdir():
        write_mask(path, read_mask(path).labels, 16)


def _soft(folder: Path) -> None:
    path = folder / "labels" / "view0.png"
    labels = np.maximum(read_mask(path).labels, 0)
    probabilities = np.eye(len(NAMES), dtype=np.float32)[labels].transpose(2, 0, 1) * np.float32(0.9)
    unknown = np.zeros(labels.shape, bool)
    classes = np.arange(len(NAMES))
    np.savez_compressed(path.with_suffix(".npz"), probabilities=probabilities, classes=classes, unknown=unknown)
    path.unlink()


def _detections(folder: Path) -> None:
    from PIL import Image

    path = folder / "labels" / "view0.png"
    labels = read_mask(path).labels
    path.with_suffix("").mkdir()
    for k in (1, 2):
        Image.fromarray(np.uint8(255 * (labels == k))).save(path.with_suffix("") / f"{k}.png")
    Image.fromarray(np.uint16(65535 * (labels == 3))).save(path.with_suffix("") / "3.png")
    path.unlink()


def _supervises(folder: Path) -> None:
    (folder / "labels" / "supervises.json").write_text(json.dumps({"*": [1, 2, 3], "view0": [0, 1, 2, 3]}))


def _masks_of(name: str) -> Callable[[Path], None]:
    """Make a dataset that has its masks once more, in `masks`, as another program writes them."""

    def write(folder: Path) -> None:
        (folder / "masks").mkdir()
        labels = {path.stem: np.maximum(read_mask(path).labels, 0) for path in sorted((folder / "labels").iterdir())}
        (mask_writers.WRITERS | mask_writers.PER_VIEW_WRITERS)[name](folder / "masks", labels, NAMES)

    return write


def _masks(name: str, file: str, mutations: tuple[Mutation, ...]) -> Kind:
    """Give the kind of a file of masks of another program, in `masks`."""
    place = "masks/labels" if name == "YOLO" else "masks"
    command = (*VOTES, "--labels", place)
    return Kind(name, _masks_of(name), (f"masks/{file}",), mutations, (command,))


def _label_map(folder: Path) -> None:
    (folder / "map.json").write_text(json.dumps({"1": "ball", "cup/mug": "ball", "box": None, "background": "ignore"}))


def _scene(name: str, file: str, write: fuzz_scenes.Write, mutations: tuple[Mutation, ...]) -> Kind:
    """Give the kind of a scene of another format."""
    place = f"{{data}}/{file}"
    commands = (("doctor", place), *((command[0], place, *command[2:]) for command in (VOTES, MASK)))
    return Kind(name, fuzz_scenes.written(file, write), (file,), mutations, commands)


def _lens(model: str, parameters: tuple[float, ...]) -> Callable[[Path], None]:
    """Make a dataset whose cameras in COLMAP's text have a lens that bends."""

    def make(folder: Path) -> None:
        _colmap_txt(folder)
        values = " ".join(map(str, (14.0, 14.0, WIDTH / 2, HEIGHT / 2, *parameters)))
        (folder / "sparse/0/cameras.txt").write_text(f"1 {model} {WIDTH} {HEIGHT} {values}\n")

    return make


def _bent_nerfstudio(folder: Path) -> None:
    _nerfstudio(folder)
    path = folder / "transforms.json"
    lens = {"camera_model": "OPENCV", "k1": -0.1, "k2": 0.01, "p1": 0.001, "p2": 0.001}
    more = {"applied_transform": np.eye(4)[:3].tolist(), "applied_scale": 1.0}
    path.write_text(json.dumps({**json.loads(path.read_text()), **lens, **more}))
    fuzz_scenes.dataparser(folder)


_LABELS = ("labels/view0.png",)
_LENSES, _BENT = ("sparse/0/cameras.txt",), (SEGMENT, MASK, RENDER)
_ALL_CAMERAS = (SEGMENT, VOTES, MASK, MASK, RENDER)
KINDS = (
    Kind("scene.ply", _as_it_is, ("scene.ply",), PLY, (SEGMENT, MASK, MASK, REMOVE, RENDER)),
    *(_scene(*row) for row in fuzz_scenes.FORMATS),
    Kind("cameras.json", _as_it_is, ("cameras.json",), JSON, _ALL_CAMERAS),
    Kind("transforms.json", _nerfstudio, ("transforms.json",), JSON, _ALL_CAMERAS),
    Kind("colmap bin", _colmap_bin, ("sparse/0/cameras.bin", "sparse/0/images.bin"), BINARY, _ALL_CAMERAS),
    Kind("colmap txt", _colmap_txt, ("sparse/0/cameras.txt", "sparse/0/images.txt"), TEXT, _ALL_CAMERAS),
    Kind("OPENCV", _lens("OPENCV", (-0.1, 0.01, 0.001, 0.001)), _LENSES, TEXT, _BENT),
    Kind("FULL_OPENCV", _lens("FULL_OPENCV", (-0.1, 0.01, 0, 0, 0, 0, 0, 0)), _LENSES, TEXT, _BENT),
    Kind("fisheye", _lens("OPENCV_FISHEYE", (0.01, 0, 0, 0)), _LENSES, TEXT, _BENT),
    Kind("bent transforms.json", _bent_nerfstudio, ("transforms.json",), JSON, _BENT),
    Kind("dataparser", _bent_nerfstudio, ("dataparser_transforms.json",), JSON, _BENT),
    Kind("labels 8 bit", _as_it_is, _LABELS, PNG, (SEGMENT, VOTES, PER_VIEW, MASK, EVAL)),
    Kind("labels 16 bit", _sixteen_bits, _LABELS, PNG, (SEGMENT, VOTES, PER_VIEW, MASK, EVAL)),
    Kind("soft npz", _soft, ("labels/view0.npz",), NPZ, (SEGMENT, VOTES)),
    Kind("mask folder", _detections, ("labels/view0/1.png", "labels/view0/3.png"), PNG, (SEGMENT, VOTES)),
    Kind("classes.json", _as_it_is, ("classes.json", "truth/classes.json"), JSON, (SEGMENT, VOTES, RENDER, EVAL)),
    Kind("split.json", _as_it_is, ("split.json",), JSON, (SEGMENT, VOTES, RENDER)),
    Kind("supervises.json", _supervises, ("labels/supervises.json",), JSON, (SEGMENT, VOTES)),
    _masks("COCO polygons", "annotations.json", JSON),
    _masks("COCO text", "annotations.json", JSON),
    _masks("SAM JSON", "view0.json", JSON),
    _masks("SAM folders", "view0/metadata.csv", TEXT),
    _masks("LabelMe polygons", "view0.json", JSON),
    _masks("LabelMe masks", "view0.json", JSON),
    _masks("ISAT", "view0.json", JSON),
    _masks("CVAT polygons", "annotations.xml", TEXT),
    _masks("CVAT masks", "annotations.xml", TEXT),
    _masks("YOLO", "labels/view0.txt", TEXT),
    _masks("EISeg images", "view0.png", PNG),
    _masks("EISeg polygons", "view0.json", JSON),
    _masks("SAM 2 video", "001/view0.png", PNG),
    _masks("Grounded SAM 2", "view0.json", JSON),
    Kind("label map", _label_map, ("map.json",), JSON, ((*VOTES, "--label-map", "{data}/map.json"),)),
    Kind("segmentation.npz", _as_it_is, (SEGMENTATION,), NPZ, (RENDER, REMOVE)),
    Kind("state", _as_it_is, (STATE,), NPZ, (LOAD_STATE,)),
)  # fmt: skip


def break_one(kind: Kind, data: Path, rng: random.Random) -> str:
    """Break one file of a dataset; returns what was done."""
    path = data / rng.choice(kind.files)
    if rng.random() < 0.01:
        return f"{path.name}: {mutations.not_a_file(path, rng)} in its place"
    mutation = rng.choice(kind.mutations)
    path.write_bytes(mutation(path.read_bytes(), rng))
    return f"{path.name}: {mutation.__name__}"


def filled(command: tuple[str, ...], data: Path) -> list[str]:
    """Fill in the places of a command on a dataset."""
    places = {"scene": "scene.ply", "data": "", "out": "out", "npz": SEGMENTATION, "new": "new"}
    return [word.format(**{name: data / place for name, place in places.items()}) for word in command]
