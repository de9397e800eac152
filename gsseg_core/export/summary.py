"""What `report.json` says of a run."""

from __future__ import annotations

import platform
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import version
from typing import Any

import numpy as np

from gsseg_core.data.label_images import IDS, PER_VIEW
from gsseg_core.data.object_tree import check_granularity
from gsseg_core.data.view import QUALITIES, View
from gsseg_core.errors import SettingsError
from gsseg_core.export.class_files import class_places
from gsseg_core.export.collision import check_collision
from gsseg_core.export.view_pictures import view_file_name
from gsseg_core.learn.registry import check_learner, check_seed
from gsseg_core.objects.oriented_boxes import object_boxes
from gsseg_core.refine.label_propagation import GraphSettings
from gsseg_core.refine.settings import RefineSettings
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.scene.scene_writers import DEFAULT, check_format, format_of
from gsseg_core.segmentation import REMOVED, UNOBSERVED, Segmentation

PACKAGES = ("gsseg", "numpy", "scipy", "numba")  # those whose versions a report names


@dataclass(frozen=True)
class RunSettings:
    """All that determines a run, as `gsseg_core.pipeline.segment` takes it; `settings` in `report.json`."""

    learner: str
    labels: str
    views: int | None
    device: str
    memory_budget: int
    seed: int
    scheduler: str | None
    ids: str | None  # None before the masks are opened, where they decide
    refine: RefineSettings
    graph: GraphSettings | None  # None where probabilities do not spread along one
    granularity: float | None = None
    scene_format: str = DEFAULT
    collision: str | None = None
    label_map: str | None = None
    quality: str = "full"
    learner_settings: Any = None  # those of the learner, if it has any

    def places(self, class_names: Mapping[int, str], views: Iterable[View]) -> list[str]:
        """Files that `gsseg segment` writes, as far as they are known before it learns; relative to its folder."""
        pictures = ["contact_sheet.png", "legend.png", "worst_views.png"]
        pictures += [view_file_name(view.name, "overlay_") for view in views]
        classes = class_places(class_names, self.scene_format, self.collision)
        return [
            "segmentation.npz", "report.json", "report.html",
            *(f"classes/{name}" for name in classes), *(f"pictures/{name}" for name in pictures),
        ]  # fmt: skip

    def check(self) -> None:
        """Raise `SettingsError` where one is unusable, or two contradict each other."""
        check_learner(self.learner, self.scheduler)
        check_seed(self.seed)
        if self.ids not in (*IDS, None):
            raise SettingsError(f"ids is {self.ids!r}; expected one of {', '.join(IDS)}")
        if self.granularity is not None:
            check_granularity(self.granularity)
            if self.ids not in (PER_VIEW, None):
                raise SettingsError("granularity needs masks with ids of each view's own; expected ids per-view")
        if self.quality not in QUALITIES:
            raise SettingsError(f"quality is {self.quality!r}; expected one of {', '.join(QUALITIES)}")
        check_format(self.scene_format)
        check_collision(self.collision)
        if self.label_map is not None and self.ids == PER_VIEW:
            raise SettingsError("a label map is for ids that mean the same in every view; expected ids global")

    def as_dict(self) -> dict[str, Any]:
        """Give them as `report.json` does."""
        settings = asdict(self)
        for name in ("learner_settings", "label_map"):
            if settings[name] is None:
                del settings[name]
        return settings


@dataclass(frozen=True, eq=False, kw_only=True)
class RunReport:
    """What a run found, from what, with which settings, and how long it took; its fields are those of `report.json`."""

    scene: Mapping[str, Any]  # path, size, digest and `rounding` of what was segmented
    views: Mapping[str, Any]  # how many were used, and why others were not
    settings: Mapping[str, Any]  # all that determined the result
    objective: Sequence[float] = ()  # the learner's objective after each step
    gaussians: Mapping[str, int]  # how many, by what became of them
    classes: Sequence[Mapping[str, Any]]  # id, name, size, mean confidence, file and box of each
    pictures: Sequence[str] = ()  # files
    seconds: Mapping[str, float]  # of each stage
    versions: Mapping[str, str]  # of each package that it ran on
    run: str | None = None  # id of the run
    calibration: Mapping[str, Any] | None = None  # the temperature and what it was fitted to
    ids: Mapping[str, Any] | None = None  # how objects were found, where ids hold in their own view only
    prepared_views: Mapping[str, int] | None = None  # bytes in memory and in a temporary file, and the budget
    masks: Mapping[str, Any] | None = None  # those that another program wrote, or that were scaled
    page: str | None = None  # file of the report page
    frame: Mapping[str, Any] | None = None  # how well the cameras fit the scene, and how they were moved

    @classmethod
    def of(
        cls,
        scene: GaussianScene,
        result: Segmentation,
        *,
        files: Mapping[int, str],
        meshes: Mapping[int, str] | None = None,
        digest: str | None = None,
        **others: Any,
    ) -> RunReport:
        """Report a segmentation of a scene: `files` and `meshes` are those of each class, `others` all other fields.

        `digest` is that of the scene's file, where Gaussians have another order there.
        """
        return cls(
            scene={
                "path": str(scene.path),
                "gaussians": len(scene),
                "digest": digest or scene.digest,
                "rounding": scene.rounding,
            },
            gaussians=gaussian_counts(result),
            classes=class_table(scene, result, files, meshes),
            versions={"python": platform.python_version(), **{name: version(name) for name in PACKAGES}},
            **others,
        )

    def as_dict(self) -> dict[str, Any]:
        """Give the content of `report.json`, without fields that are None."""
        seconds = {name: round(value, 3) for name, value in self.seconds.items()}
        return {name: value for name, value in {**vars(self), "seconds": seconds}.items() if value is not None}


def gaussian_counts(result: Segmentation) -> dict[str, int]:
    """Count the Gaussians by what became of them."""
    return {
        "labelled": int((result.labels >= 0).sum()),
        "unobserved": int((result.labels == UNOBSERVED).sum()),
        "removed": int((result.labels == REMOVED).sum()),
        "from_neighbours": int((result.clustered & (result.labels >= 0)).sum()),  # of those that are labelled
    }


def class_table(
    scene: GaussianScene,
    result: Segmentation,
    files: Mapping[int, str] | None = None,
    meshes: Mapping[int, str] | None = None,
) -> list[dict[str, Any]]:
    """List the classes, with the file of each, and of the mesh to collide with it, where there is one."""
    files, meshes = files or {}, meshes or {}
    counts, boxes, labelled = result.counts(), object_boxes(scene, result), result.labels >= 0
    total = np.bincount(result.labels[labelled], result.confidence[labelled], result.num_classes)
    return [
        {
            "id": k,
            "name": name,
            "gaussians": int(counts[k]),
            "mean_confidence": round(float(total[k] / counts[k]), 4) if counts[k] else None,
            "ply": files[k] if k in files and format_of(files[k]) == DEFAULT else None,
            "box": boxes[k].as_dict() if k in boxes else None,
            **({"file": files[k]} if k in files and format_of(files[k]) != DEFAULT else {}),
            **({"collision": meshes[k]} if k in meshes else {}),
        }
        for k, name in result.class_names.items()
    ]
