"""Segment trained 3D Gaussian Splatting scenes: from posed 2D masks to a class for every Gaussian.

>>> from gsseg_core import Dataset, EMLearner, GaussianScene, Segmentation, export_classes
>>> scene, data = GaussianScene.load("scene.ply"), Dataset("dataset")  # doctest: +SKIP
>>> learner = EMLearner(scene, data.num_classes)  # doctest: +SKIP
>>> for view in data.views("train"):  # doctest: +SKIP
...     learner.observe(view)
>>> result = Segmentation.from_codes(scene, learner.fit().codes_, data.class_names)  # doctest: +SKIP
>>> export_classes(scene, result, "classes")  # doctest: +SKIP
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

# Before any kernel is defined.
from gsseg_core import kernel_cache as _kernel_cache  # noqa: F401

if TYPE_CHECKING:
    from gsseg_core.data.dataset import Dataset, View
    from gsseg_core.errors import GssegError
    from gsseg_core.export.class_plys import export_classes
    from gsseg_core.learn.em.em_learner import EMLearner, EMSettings
    from gsseg_core.learn.gradient_learner import GradientLearner, GradientSettings
    from gsseg_core.learn.vote_learner import VoteLearner
    from gsseg_core.metrics import Evaluation
    from gsseg_core.objects.oriented_boxes import OrientedBox, object_boxes
    from gsseg_core.raster.view_operator import ViewOperator, make_operator
    from gsseg_core.refine.settings import RefineSettings
    from gsseg_core.scene.camera import Camera
    from gsseg_core.scene.gaussian_scene import GaussianScene
    from gsseg_core.segmentation import Segmentation

_HOMES = {
    "Camera": "scene.camera",
    "Dataset": "data.dataset",
    "EMLearner": "learn.em.em_learner",
    "EMSettings": "learn.em.em_learner",
    "Evaluation": "metrics",
    "GaussianScene": "scene.gaussian_scene",
    "GradientLearner": "learn.gradient_learner",
    "GradientSettings": "learn.gradient_learner",
    "GssegError": "errors",
    "OrientedBox": "objects.oriented_boxes",
    "RefineSettings": "refine.settings",
    "Segmentation": "segmentation",
    "View": "data.dataset",
    "ViewOperator": "raster.view_operator",
    "VoteLearner": "learn.vote_learner",
    "export_classes": "export.class_plys",
    "make_operator": "raster.view_operator",
    "object_boxes": "objects.oriented_boxes",
}

__all__ = [
    "Camera",
    "Dataset",
    "EMLearner",
    "EMSettings",
    "Evaluation",
    "GaussianScene",
    "GradientLearner",
    "GradientSettings",
    "GssegError",
    "OrientedBox",
    "RefineSettings",
    "Segmentation",
    "View",
    "ViewOperator",
    "VoteLearner",
    "export_classes",
    "make_operator",
    "object_boxes",
]


def __getattr__(name: str) -> Any:
    # Loaded on first use: compiled kernels and PyTorch take longer to import than all the rest.
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
