"""Client of the segmentation node: requests block, and return arrays."""

from gsseg_ros.client.results import (
    Exported,
    LearnResult,
    LoadedScene,
    LoadedState,
    MergedStates,
    PickedObject,
    RenderedView,
    SavedState,
    SegmentedObject,
    SegmentResult,
    UpdatedScene,
    Viewpoint,
)
from gsseg_ros.client.segmentation_client import SegmentationClient
from gsseg_ros.errors import NodeUnavailableError, SegmentationError

__all__ = [
    "Exported", "LearnResult", "LoadedScene", "LoadedState", "MergedStates", "NodeUnavailableError", "PickedObject",
    "RenderedView", "SavedState", "SegmentResult", "SegmentationClient", "SegmentationError", "SegmentedObject",
    "UpdatedScene", "Viewpoint",
]  # fmt: skip
