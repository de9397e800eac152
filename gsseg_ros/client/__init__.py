"""Client of the segmentation node: requests block, and return arrays."""

from gsseg_ros.client.results import (
    Exported,
    LearnResult,
    LoadedScene,
    LoadedState,
    PickedObject,
    RenderedView,
    SavedState,
    SegmentedObject,
    SegmentResult,
    Viewpoint,
)
from gsseg_ros.client.segmentation_client import SegmentationClient
from gsseg_ros.errors import NodeUnavailableError, SegmentationError

__all__ = [
    "Exported", "LearnResult", "LoadedScene", "LoadedState", "NodeUnavailableError", "PickedObject", "RenderedView",
    "SavedState", "SegmentResult", "SegmentationClient", "SegmentationError", "SegmentedObject", "Viewpoint",
]  # fmt: skip
