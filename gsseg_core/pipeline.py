"""From files to files: what the command line and the demo do, one function per sub-command."""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from gsseg_core.dataset import Dataset, View
from gsseg_core.em import EMLearner
from gsseg_core.errors import NoUsableViewsError, SettingsError
from gsseg_core.export import background_image, export_classes, write_json, write_pictures
from gsseg_core.learner import Learner, Progress, silent
from gsseg_core.masks import write_mask
from gsseg_core.operator import make_operator
from gsseg_core.pictures import contact_sheet, legend, overlay, palette, save_png
from gsseg_core.refine import RefineSettings
from gsseg_core.scene import GaussianScene
from gsseg_core.segmentation import REMOVED, UNOBSERVED, Segmentation
from gsseg_core.votes import VoteLearner

LEARNERS = ("em", "votes", "gradient")

PICTURED_VIEWS = 12
"""Views that `segment` draws, spread evenly over the dataset."""


class Stopwatch:
    """Seconds per stage of a run, in the order in which the stages ran."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time what happens inside."""
        start = time.perf_counter()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start


def make_learner(name: str, scene: GaussianScene, num_classes: int, *, seed: int = 0, device: str = "cpu") -> Learner:
    """Make a learner by its name, with its default settings.

    Raises
    ------
    SettingsError
        There is no such learner.
    """
    if name == "em":
        return EMLearner(scene, num_classes, device=device)
    if name == "votes":
        return VoteLearner(scene, num_classes, device=device)
    if name == "gradient":
        # PyTorch takes seconds to import, and the other learners do without.
        from gsseg_core.gradient import GradientLearner, GradientSettings

        return GradientLearner(scene, num_classes, GradientSettings(seed=seed), device=device)
    raise SettingsError(f"learner is {name!r}; expected one of {', '.join(LEARNERS)}")


def segment(
    scene_path: str | os.PathLike[str],
    data: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    labels: str = "labels",
    learner: str = "em",
    views: int | None = None,
    refine: RefineSettings | None = None,
    device: str = "cpu",
    seed: int = 0,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Learn from the train views of a dataset, refine, and write everything into `out`.

    Parameters
    ----------
    scene_path : path
        A 3DGS PLY.
    data : path
        Dataset folder.
    out : path
        Gets `segmentation.npz`, `classes/`, `pictures/`, and at last `report.json`.
    labels : str
        Sub-folder of the dataset with the masks.
    learner : str
        One of `LEARNERS`.
    views : int, optional
        Learn from this many train views, spread evenly; from all by default.
    refine : RefineSettings, optional
        The paper's by default.

    Returns
    -------
    dict
        What `report.json` holds.

    Raises
    ------
    GssegError
        Whatever is wrong with the input; see `gsseg_core.errors`.
    """
    refine = refine or RefineSettings()
    watch = Stopwatch()
    with watch.stage("load"):
        scene = GaussianScene.load(scene_path)
        dataset = Dataset(data, labels)
        train = _spread(dataset.views("train"), views)
        teacher = make_learner(learner, scene, dataset.num_classes, seed=seed, device=device)
    with watch.stage("observe"):
        for done, view in enumerate(train):
            progress("observe", done, len(train))
            teacher.observe(view)
        progress("observe", len(train), len(train))
    with watch.stage("learn"):
        try:
            teacher.fit(progress)
        except NoUsableViewsError as error:
            raise NoUsableViewsError(f"{data}: {error}") from error
    with watch.stage("refine"):
        result = Segmentation.from_codes(scene, teacher.codes_, dataset.class_names, refine)
    out = Path(out)
    with watch.stage("export"):
        result.save(out / "segmentation.npz")
        plys = export_classes(scene, result, out / "classes")
    with watch.stage("pictures"):
        chosen = _spread(dataset.views("all"), PICTURED_VIEWS)
        pictures = write_pictures(scene, result, chosen, out / "pictures", device=device)
    settings = {"learner": learner, "labels": labels, "views": views, "device": device, "seed": seed}
    report = {
        "scene": {"path": str(scene_path), "gaussians": len(scene), "digest": scene.digest},
        "views": {"used": len(teacher.views), "rejected": teacher.reject_summary(), "names": teacher.rejected},
        "settings": {**settings, "refine": asdict(refine), **_settings_of(teacher)},
        "objective": teacher.history_,
        "gaussians": _gaussian_counts(result),
        "classes": _class_table(result, plys, out),
        "pictures": [str(path.relative_to(out)) for path in pictures],
        "seconds": {name: round(seconds, 3) for name, seconds in watch.seconds.items()},
        "versions": _versions(),
    }
    write_json(out / "report.json", report)
    return report


def render(
    scene_path: str | os.PathLike[str],
    data: str | os.PathLike[str],
    segmentation_path: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    split: str = "test",
    device: str = "cpu",
    progress: Progress = silent,
) -> list[Path]:
    """Render label maps of a split as `<stem>.png`, in the masks' own encoding, and overlays in `overlays/`.

    Returns
    -------
    list of pathlib.Path
        The label maps.
    """
    scene = GaussianScene.load(scene_path)
    dataset = Dataset(data)
    result = Segmentation.load(segmentation_path, scene)
    views = dataset.views(split)
    if not views:
        raise NoUsableViewsError(f"{data}: split {split!r} has no views; expected at least one to render")
    out = Path(out)
    colors = palette(result.num_classes)
    bits = 16 if result.num_classes > 255 else max((view.mask_bits or 8 for view in views), default=8)
    paths, overlays = [], []
    for done, view in enumerate(views):
        progress("render", done, len(views))
        operator = make_operator(scene, view.camera, device)
        labels = result.render_labels(operator)
        paths.append(out / f"{view.name}.png")
        write_mask(paths[-1], labels, bits)
        overlays.append(overlay(background_image(scene, operator), labels, colors))
        save_png(out / "overlays" / f"{view.name}.png", overlays[-1])
    progress("render", len(views), len(views))
    save_png(out / "overlays" / "contact_sheet.png", contact_sheet(overlays, [view.name for view in views], 4))
    save_png(out / "overlays" / "legend.png", legend(result.class_names, colors, result.counts()))
    return paths


def _spread(views: Sequence[View], count: int | None) -> list[View]:
    if count is None or count >= len(views):
        return list(views)
    if count < 1:
        raise SettingsError(f"views is {count}; expected at least 1")
    return [views[i] for i in np.linspace(0, len(views) - 1, count).round().astype(int)]


def _settings_of(learner: Learner) -> Mapping[str, Any]:
    settings = getattr(learner, "settings", None)
    return {} if settings is None else {"learner_settings": asdict(settings)}


def _gaussian_counts(result: Segmentation) -> dict[str, int]:
    return {
        "labelled": int((result.labels >= 0).sum()),
        "unobserved": int((result.labels == UNOBSERVED).sum()),
        "removed": int((result.labels == REMOVED).sum()),
        "from_neighbours": int(result.clustered.sum()),
    }


def _class_table(result: Segmentation, plys: Mapping[int, Path], out: Path) -> list[dict[str, Any]]:
    counts, confidence = result.counts(), result.confidence
    total = np.bincount(
        result.labels[result.labels >= 0], weights=confidence[result.labels >= 0], minlength=result.num_classes
    )
    return [
        {
            "id": k,
            "name": name,
            "gaussians": int(counts[k]),
            "mean_confidence": round(float(total[k] / counts[k]), 4) if counts[k] else None,
            "ply": str(plys[k].relative_to(out)) if k in plys else None,
        }
        for k, name in result.class_names.items()
    ]


def _versions() -> dict[str, str]:
    packages = {name: version(name) for name in ("gsseg", "numpy", "scipy", "numba")}
    return {"python": platform.python_version(), **packages}
