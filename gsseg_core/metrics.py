"""Measures how well predicted label maps agree with the truth: IoU, accuracy and boundary IoU over all views.

All figures are ratios of pixel counts that are summed over all views, never means of per-view figures. So a class that
is small in one view and fills another has the weight of its pixels in each.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from gsseg_core.data.class_names import class_name
from gsseg_core.data.label_images import UNKNOWN, read_mask
from gsseg_core.data.mask_formats.masks import MaskSet
from gsseg_core.errors import MaskFormatError, MaskSizeError, NoUsableViewsError
from gsseg_core.files.input_files import list_folder
from gsseg_core.files.limits import MAX_LABEL
from gsseg_core.files.run_folder import settle
from gsseg_core.scene.camera import Camera

_SOME_VIEWS = "; to score a few views, name them as test in split.json, and render these"
BOUNDARY_SHARE = 0.02  # width of the boundary band / image diagonal (Cheng et al., Boundary IoU, CVPR 2021)


class Evaluation:
    """Agreement of predicted label maps with the truth, accumulated view by view.

    Labels are integers from 0; K is the largest label so far plus one, and grows when needed. Pixels whose truth is
    `UNKNOWN` are ignored. If only the prediction is `UNKNOWN`, the pixel is a false negative of the true class, and a
    false positive of no class.

    Examples
    --------
    >>> import numpy as np
    >>> evaluation = Evaluation()
    >>> evaluation.add(truth=np.array([[0, 0, 1, 1]]), prediction=np.array([[0, 1, 1, 1]]))
    >>> evaluation.iou.round(3).tolist()
    [0.5, 0.667]
    >>> round(evaluation.mean_iou, 3)
    0.583
    """

    def __init__(self) -> None:
        self.num_views = 0
        self._pairs: Counter[tuple[int, int]] = Counter()
        self._area = np.zeros((3, 0), np.int64)  # pixels per class: in both, in the truth, in the prediction
        self._band = np.zeros((3, 0), np.int64)  # the same, of boundary bands

    def add(self, truth: np.ndarray, prediction: np.ndarray, name: str = "view") -> None:  # both (H, W)
        """Add the label maps of one view: integers, `UNKNOWN` where a pixel has no label.

        Raises
        ------
        MaskFormatError, MaskSizeError
            A map has invalid labels, or the two differ in size; the message calls the view `name`.
        """
        if truth.shape != prediction.shape or truth.ndim != 2:
            raise MaskSizeError(
                f"{name}: found a prediction of shape {prediction.shape} for a truth of shape {truth.shape}; "
                "expected two label maps (height, width) of the same size"
            )
        for labels in (truth, prediction):
            ends = [int(end(initial=0)) for end in (labels.min, labels.max)] if labels.dtype.kind in "iub" else []
            if not ends or ends[0] < UNKNOWN or ends[1] > MAX_LABEL:
                found = f"{labels.dtype} {ends[0]} to {ends[1]}" if ends else labels.dtype
                raise MaskFormatError(f"{name}: found {found}; expected integers {UNKNOWN} to {MAX_LABEL}")
        known = truth != UNKNOWN
        # Fill unknown truth with the prediction, so that the truth has no boundary along unknown pixels.
        truth, prediction = np.where(known, truth, prediction).astype(np.int32), prediction.astype(np.int32)
        answered = known & (prediction != UNKNOWN)
        size = max(self.num_classes, int(truth.max(initial=-1)) + 1, int(prediction.max(initial=-1)) + 1)

        # As int64: NumPy 1 multiplies int32 as int32, which overflows for the square of the largest label.
        pairs, counts = np.unique(truth[answered].astype(np.int64) * size + prediction[answered], return_counts=True)
        for pair, count in zip(pairs.tolist(), counts.tolist(), strict=True):
            self._pairs[divmod(pair, size)] += count

        width = max(1, round(BOUNDARY_SHARE * float(math.hypot(*truth.shape))))
        near_truth, near_prediction = known & boundary_band(truth, width), answered & boundary_band(prediction, width)
        self._area = _grow(self._area, size) + _count(truth, prediction, known, answered, size)
        self._band = _grow(self._band, size) + _count(truth, prediction, near_truth, near_prediction, size)
        self.num_views += 1

    @property
    def num_classes(self) -> int:
        """K, the largest label seen in truth or prediction plus one; 0 before the first view."""
        return self._area.shape[1]

    @property
    def confusion(self) -> np.ndarray:
        """Confusion matrix, (K, K) int64: pixels by true label (row) and predicted label (column)."""
        matrix = np.zeros((self.num_classes, self.num_classes), np.int64)
        for pair, count in self._pairs.items():
            matrix[pair] = count
        return matrix

    @property
    def iou(self) -> np.ndarray:
        """Intersection over union of each class, (K,) float64; NaN for a class in neither truth nor prediction."""
        return iou(*self._area)

    @property
    def accuracy(self) -> np.ndarray:
        """Share of each true class's pixels that are predicted correctly, (K,) float64; NaN if the truth has none."""
        return _ratio(self._area[0], self._area[1])

    @property
    def boundary_iou(self) -> np.ndarray:
        """IoU of each class's boundary band, (K,) float64: its pixels nearer to its edge than 2 % of the diagonal."""
        return iou(*self._band)

    @property
    def mean_iou(self) -> float:
        """Mean of `iou` over the classes that occur in the truth or in the prediction."""
        return _mean(self.iou)

    @property
    def mean_accuracy(self) -> float:
        """Mean of `accuracy` over the classes that occur in the truth."""
        return _mean(self.accuracy)

    @property
    def mean_boundary_iou(self) -> float:
        """Mean of `boundary_iou` over the classes that occur in the truth or in the prediction."""
        return _mean(self.boundary_iou)

    @property
    def other_ids(self) -> dict[int, int]:
        """Map true objects to the different object id that most of their pixels get; empty if most objects agree."""
        most: dict[int, tuple[int, int]] = {}
        for (truth, found), count in self._pairs.items():
            if truth:
                most[truth] = max(most.get(truth, (0, 0)), (count, found))
        others = {k: found for k, (_, found) in sorted(most.items()) if found not in (0, k)}
        return others if 2 * len(others) > len(most) else {}

    def as_dict(self, class_names: Mapping[int, str] | None = None) -> dict[str, Any]:
        """Return all figures as plain numbers for JSON; undefined ones are None.

        Parameters
        ----------
        class_names : mapping from label to name, optional
            A class without a name is called "class_07" or the like.

        Returns
        -------
        dict
            `views`, `mean_iou`, `mean_accuracy`, `mean_boundary_iou`, and `classes`: for each class that occurs its
            `id`, `name`, `iou`, `accuracy`, `boundary_iou` and `pixels` in the truth.
        """
        scores = {"iou": self.iou, "accuracy": self.accuracy, "boundary_iou": self.boundary_iou}
        classes = [
            {
                "id": k,
                "name": class_name(class_names or {}, k),
                **{name: _plain(values[k]) for name, values in scores.items()},
                "pixels": int(self._area[1, k]),
            }
            for k in np.flatnonzero(self._area.any(axis=0)).tolist()
        ]
        means = {f"mean_{name}": _plain(_mean(values)) for name, values in scores.items()}
        return {"views": self.num_views, **means, "classes": classes}


def iou(both: np.ndarray, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Compute intersection over union from counts in both, in the first and in the second; NaN where both are empty."""
    return _ratio(both, first + second - both)


def boundary_band(labels: np.ndarray, width: int) -> np.ndarray:  # (H, W) of a signed type; pixels
    """Mark the pixels on the inner boundary of their own class, for all classes at once: (H, W) bool.

    A pixel of class c is in the band of c unless all pixels up to `width` rows and columns away are c; pixels outside
    the image have no class. For each class this is the mask minus its erosion by `width` steps of a 3x3 square, as
    boundary IoU defines it. The code uses that a square has only one label exactly if its smallest and largest label
    are equal.
    """
    from scipy import ndimage  # Imported here because a ROS node, which measures nothing, does not need it.

    size = 2 * width + 1
    lowest = ndimage.minimum_filter(labels, size, mode="constant", cval=UNKNOWN - 1)
    highest = ndimage.maximum_filter(labels, size, mode="constant", cval=UNKNOWN - 1)
    return np.asarray(lowest != highest)


def evaluate_folders(pred_dir: str | Path, truth_dir: str | Path, cameras: Iterable[Camera] = ()) -> Evaluation:
    """Compare every `<stem>.png` in one folder of label images with the mask of the same view in another.

    True masks without a prediction are ignored, since their folder also has those of the train views. With `cameras`, a
    true mask is undistorted if its camera has lens distortion, and scaled if its size is not that of the prediction, as
    masks for learning are.

    Raises `NoUsableViewsError` if `pred_dir` has no PNG, `MaskFormatError` if a prediction has no truth or a file is no
    label image, and `MaskSizeError` if a prediction and its truth differ in size.
    """
    pred_dir, truth_dir, predictions = Path(pred_dir), Path(truth_dir), predicted_maps(pred_dir)
    from gsseg_core.data.mask_files import masks_below  # These imports load numba, which the rest does not need.
    from gsseg_core.data.mask_formats.place import Place
    from gsseg_core.data.view import View

    known = {camera.name: camera for camera in cameras}
    images = [known[path.stem].image if path.stem in known else path.stem for path in predictions]
    truths = masks_below(Place(truth_dir, frozenset(images)))
    missing = [f"{image}.png" for image in images if image not in truths]
    if missing:
        raise MaskFormatError(
            f"{truth_dir}: found no {missing[0]} ({len(missing)} of {len(predictions)} are missing); "
            f"expected a true mask for every prediction in {pred_dir}{_SOME_VIEWS}"
        )
    evaluation = Evaluation()
    for path, image in zip(predictions, images, strict=True):
        prediction, camera, truth = read_mask(path).labels, known.get(path.stem), truths[image]
        view = None if camera is None else View(camera, truth)
        if view is None or (view.camera.undistortion is None and view.mask_size == prediction.shape[::-1]):
            labels = read_mask(truth).labels
        else:
            labels = view.read_labels()
        evaluation.add(labels, prediction, name=str(path))
    return evaluation


def evaluate_masks(pred_dir: str | Path, masks: MaskSet, cameras: Iterable[Camera] = ()) -> Evaluation:
    """Compare every `<stem>.png` in a folder of label images with the mask of the same view from another program.

    A view without a camera in `cameras` is taken to have an image of the size of its prediction. Raises as
    `evaluate_folders` does, and `MaskFormatError` if a mask cannot be read.
    """
    from gsseg_core.data.view import View

    known, evaluation = {camera.name: camera for camera in cameras}, Evaluation()
    for path in predicted_maps(pred_dir):
        labels = read_mask(path).labels
        height, width = labels.shape
        camera = known.get(path.stem) or Camera(path.stem, width, height, np.eye(3), np.eye(4))
        if camera.image not in masks.views:
            raise MaskFormatError(
                f"{path}: has no true mask among those of {masks.format}; expected one for each view{_SOME_VIEWS}"
            )
        evaluation.add(View(camera, foreign_mask=masks.views[camera.image]).read_labels(), labels, name=str(path))
    return evaluation


def predicted_maps(folder: str | Path) -> list[Path]:
    """List the label maps `<stem>.png` in a folder, as `gsseg render` writes them; `NoUsableViewsError` if none."""
    settle(Path(folder))
    predictions = [path for path in list_folder(Path(folder), NoUsableViewsError, None) if path.suffix == ".png"]
    if not predictions:
        raise NoUsableViewsError(f"{folder}: found no predictions; expected label images <stem>.png")
    return predictions


def _count(
    truth: np.ndarray, prediction: np.ndarray, in_truth: np.ndarray, in_prediction: np.ndarray, size: int
) -> np.ndarray:  # of (H, W)
    """Count the pixels per class in both, in the truth and in the prediction, (3, size)."""
    in_both = in_truth & in_prediction & (truth == prediction)
    chosen = truth[in_both], truth[in_truth], prediction[in_prediction]
    return np.stack([np.bincount(labels, minlength=size) for labels in chosen])


def _grow(counts: np.ndarray, size: int) -> np.ndarray:
    return np.pad(counts, ((0, 0), (0, size - counts.shape[1])))


def _ratio(part: np.ndarray, whole: np.ndarray) -> np.ndarray:
    return np.asarray(np.divide(part, whole, out=np.full(part.shape, np.nan), where=whole > 0))


def _mean(values: np.ndarray) -> float:
    defined = values[~np.isnan(values)]
    return float(defined.mean()) if defined.size else float("nan")


def _plain(value: float) -> float | None:
    return None if np.isnan(value) else float(value)
