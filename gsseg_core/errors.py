"""Every error that gsseg raises on purpose: one class per cause, all derived from `GssegError`.

A message is one line. It names the file (or topic), what was found there, and what was expected.
"""

from __future__ import annotations

from gsseg_core.text import one_line


class GssegError(Exception):
    """Base of all errors of gsseg; the command line prints it as one line and exits with code 2."""

    def __str__(self) -> str:
        """Give the message on one line, whatever names from files and messages it holds."""
        return one_line(super().__str__())


class SceneFileError(GssegError):
    """A scene file is missing, truncated, or of no format that is read."""


class ScenePropertyError(GssegError):
    """A PLY lacks the properties of a 3DGS scene, or has them in an unusable form."""


class SceneValueError(GssegError):
    """Values of a scene are NaN, infinite, out of range, or of the wrong shape."""


class EmptySceneError(GssegError):
    """A scene, or a selection from one, holds no Gaussian."""


class SceneDeltaError(GssegError):
    """A change of a scene is damaged or out of turn, or does not fit the Gaussians and groups that are there."""


class UnknownGroupError(GssegError):
    """A view belongs to a group that the scene does not have."""


class CameraFileError(GssegError):
    """A camera file is missing or broken, or a folder has no cameras."""


class PoseError(GssegError):
    """A camera pose is NaN, not invertible, or not a rigid motion."""


class AlignmentError(GssegError):
    """It cannot be found where the cameras of a dataset are in a scene."""


class IntrinsicsError(GssegError):
    """An intrinsic matrix or image size is unusable, or a lens of an unknown model or with impossible distortion."""


class MaskFormatError(GssegError):
    """A mask is missing, unreadable, or of a kind or with values that no mask has."""


class MaskSizeError(GssegError):
    """A mask has another size than its camera."""


class UnknownLabelError(GssegError):
    """A mask holds a label that the classes do not name."""


class ClassesFileError(GssegError):
    """`classes.json` is broken."""


class SupervisesFileError(GssegError):
    """`supervises.json` is broken, or names views or classes that do not exist."""


class LabelMapError(GssegError):
    """A label map is broken, or names a class that the masks do not have."""


class SplitFileError(GssegError):
    """`split.json` is broken, or names views that do not exist."""


class NoUsableViewsError(GssegError):
    """No view is left to learn from or to render."""


class WriteError(GssegError):
    """A file could not be written: disk full, folder not writable, path taken by a folder."""


class PathTakenError(WriteError):
    """What lies where something should be written is not ours to replace; nothing was written."""


class PathNotAllowedError(GssegError):
    """A path leads outside the folder below which it must lie."""


class StateFileError(GssegError):
    """A saved state or segmentation is missing or broken."""


class StateMismatchError(GssegError):
    """A saved state or segmentation belongs to another scene."""


class SettingsError(GssegError):
    """A setting has an impossible value."""


class SchedulerError(GssegError):
    """A Dask scheduler does not answer, or its workers are missing or cannot do the work."""


class NoCodesError(GssegError):
    """Nothing has been learnt or fused yet that could be shown or saved."""


def memory_ran_out(error: BaseException) -> bool:
    """Tell whether an error says that memory is not enough: for an array, a thread, a library, or on a GPU.

    PyTorch has its own error for the last one; it may not be loaded.
    """
    if isinstance(error, MemoryError) or type(error).__name__ == "OutOfMemoryError":
        return True
    no_thread = isinstance(error, RuntimeError) and "can't start new thread" in str(error)
    return no_thread or (isinstance(error, ImportError) and "failed to map segment" in str(error))


def explained(error: BaseException) -> str | None:
    """Say what one of our errors says, or that memory is not enough; None of an error that nobody foresaw."""
    if isinstance(error, GssegError):
        return str(error)
    if not memory_ran_out(error):
        return None
    said = f" ({error})" if str(error) else ""  # Python's own says nothing.
    return f"memory is not enough{said}"
