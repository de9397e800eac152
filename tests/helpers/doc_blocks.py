"""The fenced blocks of the documentation, and what a page's reader has before the first of them."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import mask_writers
import protocol_layouts
import small_scenes

from gsseg_core.data.class_names import read_classes
from gsseg_core.data.label_images import read_mask
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.scene.scene_writers import write_scene
from gsseg_core.segmentation import Segmentation

REPOSITORY = Path(__file__).parents[2]
PAGES = [
    "README.md",
    "CONTRIBUTING.md",
    "examples/README.md",
    *sorted(f"docs/{path.name}" for path in REPOSITORY.glob("docs/*.md")),
]
FENCE = re.compile(r"^```(?P<info>[^\n`]*)\n(?P<code>.*?)^```$", re.MULTILINE | re.DOTALL)
NEEDS = "needs "


@dataclass(frozen=True)
class Block:
    """A fenced block of a page."""

    page: str
    language: str
    title: str
    code: str

    @property
    def is_program(self) -> bool:
        return self.language in ("bash", "python")

    @property
    def runs(self) -> bool:
        return self.is_program and not self.title.startswith(NEEDS)

    @property
    def lines(self) -> list[str]:
        """Commands, each on a line of its own."""
        return [line for line in self.code.replace("\\\n", " ").splitlines() if line.split("#")[0].strip()]


def blocks_of(page: str) -> list[Block]:
    text = (REPOSITORY / page).read_text(encoding="utf-8")
    found = []
    for match in FENCE.finditer(text):
        title = re.search(r'title="([^"]*)"', match["info"])
        found.append(Block(page, (match["info"].split() or [""])[0], title[1] if title else "", match["code"]))
    return found


def needs_ros(page: str) -> bool:
    return any(
        re.search(r"segment_node|gsseg_ros|publish_masks|--ros", block.code) for block in blocks_of(page) if block.runs
    )


def segmented(desk: Path) -> None:
    """What `gsseg segment scene.ply --data DATASET --out out` left; and one object is a chair."""
    (desk / "out").mkdir()
    shutil.copy(desk / "demo_out/segmented/report.json", desk / "out")
    result = Segmentation.load(desk / "demo_out/segmented/segmentation.npz", GaussianScene.load(desk / "scene.ply"))
    names = {label: "chair" if name == "box" else name for label, name in result.class_names.items()}
    replace(result, class_names=names).save(desk / "out/segmentation.npz")


def on_a_robot(desk: Path) -> None:
    """A map in the robot's home folder."""
    (desk / "maps").mkdir()
    shutil.copy(desk / "scene.ply", desk / "maps/flat.ply")


def apartment(desk: Path) -> None:
    """The measured scene's place, with a scene that is faster."""
    (desk / "replica_apartment").symlink_to(desk / "DATASET")


def protocols(desk: Path) -> None:
    """A small scene with the files of three benchmarks, in the folders that the page names."""
    shutil.rmtree(desk / "DATASET")
    small_scenes.write_dataset(desk / "DATASET")
    shutil.copy(desk / "DATASET/scene.ply", desk / "SCENE.ply")
    protocol_layouts.write_nvos(desk / "ROOT")
    small_scenes.write_dataset(desk / "FOLDER")
    protocol_layouts.write_lerf(desk / "FOLDER")
    protocol_layouts.write_spin(desk / "FOLDER", [camera.name for camera in protocol_layouts.CAMERAS])
    protocol_layouts.true_segmentation().save(desk / "OUT/segmentation.npz")


def annotated(desk: Path) -> None:
    """What was segmented, and the masks once more as COCO."""
    segmented(desk)
    names = read_classes(desk / "DATASET/classes.json")
    masks = {path.stem: read_mask(path).labels for path in sorted((desk / "DATASET/labels").iterdir())[::6]}
    mask_writers.coco_text(desk, masks, names)
    (desk / "names.json").write_text('{"*": "thing", "background": "background"}')


def phone(desk: Path) -> None:
    """A splat from a phone, without cameras."""
    write_scene(GaussianScene.load(desk / "scene.ply"), desk / "capture.spz")


FIRST: dict[str, Callable[[Path], None]] = {
    "docs/clean_objects.md": segmented,
    "docs/evaluation.md": protocols,
    "docs/formats.md": annotated,
    "docs/results.md": apartment,
    "docs/ids.md": on_a_robot,
    "docs/tutorial_phone.md": phone,
    "docs/tutorial_robot.md": on_a_robot,
    "docs/viewer.md": segmented,
}
"""What readers of a page have besides scene.ply, DATASET, the examples and the demo's output."""
