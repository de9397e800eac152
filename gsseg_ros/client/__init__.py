"""Programs that ask the node: requests block, arrays come back."""

from gsseg_ros.client.results import (
    Exported,
    LearnResult,
    LoadedScene,
    LoadedState,
    RenderedView,
    SavedState,
    SegmentedObject,
    SegmentResult,
    Viewpoint,
)
from gsseg_ros.client.segmentation_client import SegmentationClient
from gsseg_ros.errors import NodeUnavailableError, SegmentationError

__all__ = [
    "Exported", "LearnResult", "LoadedScene", "LoadedState", "NodeUnavailableError", "RenderedView", "SavedState",
    "SegmentResult", "SegmentationClient", "SegmentationError", "SegmentedObject", "Viewpoint",
]  # fmt: skip
