"""What fields of requests ask for: classes, a confidence, and how to refine."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from gsseg_msgs.srv import Export, Segment

from gsseg_core.data.class_names import class_ids
from gsseg_core.data.label_images import PER_VIEW
from gsseg_core.errors import SettingsError
from gsseg_core.refine.settings import RefineSettings
from gsseg_ros.errors import InvalidRequestError, UnknownClassError
from gsseg_ros.node.parameters import Settings

PAPER, CARVE = "paper", "carve"
"""What a request may ask for after KNN clustering."""


def chosen_classes(request: Any, class_names: Mapping[int, str]) -> list[int]:
    """Ids of the classes that a request asks for, ascending; all if it names none.

    Raises `UnknownClassError`: a name or number does not exist, or several classes have the name.
    """
    try:
        return sorted(class_ids(request.classes, class_names) or class_names)
    except SettingsError as error:
        raise UnknownClassError(str(error)) from error


def checked_confidence(request: Any) -> float:
    """Threshold of a request. Raises `InvalidRequestError`: it is not in [0, 1]."""
    if not 0 <= request.min_confidence <= 1:
        raise InvalidRequestError(f"min_confidence is {request.min_confidence}; expected 0 to 1")
    return float(request.min_confidence)


def level_of(request: Any, settings: Settings) -> float:
    """Level of parts and wholes that a request asks for, as the parameter granularity has it.

    Raises `InvalidRequestError`: it is above 1 or no number, or there are no parts.
    """
    if not isinstance(request, Segment.Request) or not len(request.granularity):
        return settings.granularity
    wanted = float(request.granularity[0])
    if not wanted <= 1:
        raise InvalidRequestError(f"granularity is {wanted:g}; expected 0 to 1, or below 0 for the objects")
    if wanted >= 0 and settings.ids != PER_VIEW:
        raise InvalidRequestError(
            f"granularity is {wanted:g}, but with the parameter ids '{settings.ids}' objects have no parts; expected "
            "none, or a node with ids per-view"
        )
    return wanted


def refinement(request: Any, settings: Settings) -> RefineSettings:
    """Refinement as a request asks for it, with the node's k and beta.

    Files are made to be kept, and worth the seconds that carving takes; what is asked for while the robot moves is not,
    unless the request says so. Raises `InvalidRequestError`: there is no such refinement.
    """
    default = CARVE if isinstance(request, Export.Request) else PAPER
    if request.refine not in ("", PAPER, CARVE):
        raise InvalidRequestError(f"refine is '{request.refine[:60]}'; expected {PAPER}, {CARVE}, or nothing")
    outer = None if request.skip_refinement or request.skip_filter else request.refine or default
    return RefineSettings(
        k=settings.k,
        beta=settings.beta,
        weigh=PAPER not in (request.refine, outer),
        cluster=not request.skip_refinement,
        filter=outer == PAPER,
        carve=outer == CARVE,
    )
