"""Errors of requests, the error code that each error gets in an answer, and what a client makes of it."""

from __future__ import annotations

from typing import Any

from gsseg_core.errors import (
    GssegError,
    NoCodesError,
    NoUsableViewsError,
    PathNotAllowedError,
    PathTakenError,
    SettingsError,
    StateMismatchError,
    WriteError,
)


class SegmentationError(GssegError):
    """The node answered that a request failed.

    `code` is the error code of the answer, see msg_defs/README.md; `name` that of its constant, such as "NO_SCENE",
    which is the same for every request.
    """

    def __init__(self, code: int, name: str, message: str) -> None:
        super().__init__(f"{name} ({code}): {message}")
        self.code, self.name = code, name


class NodeUnavailableError(GssegError, TimeoutError):
    """The node, or what a client waited for, was not there in time."""


class NotActiveError(GssegError):
    """The node's lifecycle state is not active."""


class BusyError(GssegError):
    """Another job is running that cannot run beside this one, or too many requests are."""


class CanceledError(GssegError):
    """A job was canceled."""


class InvalidRequestError(GssegError):
    """A field of a request has a value that is not allowed."""


class NoSceneError(GssegError):
    """No scene is loaded."""


class UnknownClassError(GssegError):
    """A class that was asked for does not exist."""


class ViewpointError(GssegError):
    """The pose or the camera of a viewpoint cannot be used."""


class NoTransformError(GssegError):
    """A pose is in a frame that cannot be transformed to the map frame."""


class TooManyPixelsError(GssegError):
    """An image or a camera is larger than the parameter max_pixels allows."""


class DepthImageError(GssegError):
    """A depth image does not belong to its mask, or is broken."""


class LabelInfoError(GssegError):
    """A message that names the labels of masks cannot be used."""


class MissingFileError(GssegError):
    """A file or folder of a request does not exist."""


# The first that fits counts. Every other error of the core is about a file.
NAMES: tuple[tuple[type[GssegError], str], ...] = (
    (NotActiveError, "NOT_ACTIVE"),
    (BusyError, "BUSY"),
    (CanceledError, "CANCELED"),
    (InvalidRequestError, "INVALID_REQUEST"),
    (SettingsError, "INVALID_REQUEST"),
    (NoSceneError, "NO_SCENE"),
    (NoCodesError, "NO_CODES"),
    (NoUsableViewsError, "NO_VIEWS"),
    (UnknownClassError, "UNKNOWN_CLASS"),
    (ViewpointError, "INVALID_VIEWPOINT"),
    (NoTransformError, "NO_TRANSFORM"),
    (PathNotAllowedError, "PATH_NOT_ALLOWED"),
    (MissingFileError, "FILE_NOT_FOUND"),
    (PathTakenError, "PATH_TAKEN"),
    (WriteError, "WRITE_FAILED"),
    (StateMismatchError, "SCENE_MISMATCH"),
    (GssegError, "INVALID_FILE"),
)


def kind_of(error: Exception) -> str:
    """Return the name of the constant of answers for an error; UNKNOWN for one that was not foreseen."""
    return next((name for kind, name in NAMES if isinstance(error, kind)), "UNKNOWN")


def error_code(error: Exception, interface: Any) -> int:
    """Return the constant of an answer (a Response or Result class) for an error; its UNKNOWN where none fits."""
    return int(getattr(interface, kind_of(error), interface.UNKNOWN))


def error_name(code: int, interface: Any) -> str:
    """Return the name of an answer's error code (a Response or Result class); "UNKNOWN" for one that has none."""
    return next((name for _, name in NAMES if getattr(interface, name, None) == code), "UNKNOWN")
