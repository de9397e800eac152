"""The result: a label, a probability per class and a confidence for every Gaussian."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

from gsseg_core.csr_rows import CSRRows, largest
from gsseg_core.data.class_names import check_class_names, class_name
from gsseg_core.data.object_tree import ObjectTree
from gsseg_core.data.segmentation_file import FORMAT, read_segmentation
from gsseg_core.data.segmentation_file import REMOVED as REMOVED
from gsseg_core.data.segmentation_file import UNOBSERVED as UNOBSERVED
from gsseg_core.data.view import spread
from gsseg_core.errors import SettingsError, StateMismatchError
from gsseg_core.files.limits import MAX_LABEL
from gsseg_core.files.npz_files import arrays_of_rows, check_evidence, check_shares, check_temperature, write_npz
from gsseg_core.files.run_folder import settle
from gsseg_core.learn.temperature import tempered, tempered_rows
from gsseg_core.raster.view_operator import ViewOperator
from gsseg_core.raster.view_renderer import Blended
from gsseg_core.refine.knn_filter import before_clustering, cluster, statistical_filter
from gsseg_core.refine.settings import RefineSettings
from gsseg_core.refine.silhouette_carving import Silhouette, kept_shares, sticking_out
from gsseg_core.scene.camera import Camera
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.spatial.neighbourhood import neighbours_of
from gsseg_core.spatial.row_order import inverse
from gsseg_core.text import clipped

T = TypeVar("T")
_BLEND_LOCK = threading.Lock()  # lets only one of several threads compute the codes to blend


class RenderedLabels(NamedTuple):
    """Class and confidence of every pixel of a rendered view."""

    labels: np.ndarray  # (H, W) int32: class ids
    confidence: np.ndarray  # (H, W) float32: class probability; if calibrated, the share of such pixels that are right


@dataclass(frozen=True, eq=False)
class Segmentation:
    """Label and class probabilities of every Gaussian of one scene.

    Attributes
    ----------
    labels : (N,) int32
        Class id, or `UNOBSERVED` (-1), or `REMOVED` (-2).
    shares : CSRRows
        Class probabilities (N, K) float32; `probabilities` is the dense array. A Gaussian has entries for only a few of
        hundreds of classes. Rows sum to 1; rows of unobserved Gaussians are empty. Removed Gaussians keep their rows.
        Columns are in the order of `class_names`: column k is class k, unless ids have gaps.
    class_names : dict of int to str
        Names by class id, ascending, one for each of the K columns.
    scene_digest : str
        Digest of the scene to which the segmentation belongs.
    clustered : (N,) bool
        Gaussians whose probabilities came from their neighbours.
    learnt : CSRRows
        Probabilities that the `clustered` Gaussians had before, (C, K) float32, in scene order; never calibrated.
    temperature : float
        Temperature that calibrates the probabilities, see `calibrated`; 1 if they are as they were learnt.
    ids : (N,) int64 or None
        Gaussian ids that persist while the scene changes, if it has any; see docs/living_map.md.
    tree : ObjectTree or None
        Parts and wholes of the classes, if the classes are objects that were found from per-view ids.
    """

    labels: np.ndarray
    shares: CSRRows
    class_names: dict[int, str]
    scene_digest: str
    clustered: np.ndarray
    learnt: CSRRows
    temperature: float = 1.0
    ids: np.ndarray | None = None
    tree: ObjectTree | None = None

    @classmethod
    def from_codes(
        cls,
        scene: GaussianScene,
        codes: np.ndarray,
        class_names: Mapping[int, str],
        settings: RefineSettings | None = None,
        evidence: np.ndarray | None = None,
    ) -> Segmentation:
        """Refine learnt codes by their neighbours, and label every Gaussian by its largest entry.

        Parameters
        ----------
        scene : GaussianScene
            N Gaussians.
        codes : (N, K) float32
            Class probabilities; each row sums to 1, or is zero if nothing is known. Other values raise `SettingsError`,
            another N raises `StateMismatchError`.
        class_names : mapping from id to name
            Classes without a name get one like "class_07". Ids outside 0 to K - 1 and names that are not one line of
            text raise `SettingsError`.
        settings : RefineSettings, optional
            By default without the filter. Carving needs views: call `carved` for it.
        evidence : (N,) float32, optional
            Weight of the pixels that each code was learnt from, in px, finite and at least 0: `Learner.evidence`. It
            weights the neighbours; without it, all have equal weight. Raises the same errors as `codes`.
        """
        settings = settings or RefineSettings()
        codes, n = np.asarray(codes, np.float32), len(scene)
        px = np.asarray(np.zeros(n) if evidence is None else evidence, np.float32)
        if codes.ndim != 2 or len(codes) != n or px.shape != (n,):
            raise StateMismatchError(f"codes are {codes.shape}, evidence {px.shape}; expected ({n}, K) and ({n},)")
        if not (columns := range(codes.shape[1])) or not class_names.keys() <= {*columns}:
            raise SettingsError(f"class names have ids {clipped([*class_names])}; expected some of {columns}")
        check_class_names(class_names, SettingsError)
        rows, names = CSRRows.from_dense(codes), {k: class_name(class_names, k) for k in columns}
        check_shares("codes", rows, SettingsError)
        check_evidence(px, SettingsError)
        result = cls.unfiltered(scene, rows, names, settings, None if evidence is None else px)
        return result.filtered(scene, settings)

    @classmethod
    def unfiltered(
        cls, scene: GaussianScene, codes: CSRRows, class_names: Mapping[int, str], settings: RefineSettings,
        evidence: np.ndarray | None = None,
    ) -> Segmentation:  # fmt: skip
        """Do what `from_codes` does, but without the filter, from a learner's codes and the names of all K classes."""
        refined, clustered = codes, np.zeros(len(scene), bool)
        if settings.cluster:
            px, neighbours = evidence if settings.weigh else None, neighbours_of(scene, settings.k)
            refined, clustered = cluster(neighbours, codes, len(class_names), settings.beta, px)
        _, labels = largest(refined)  # -1, which is UNOBSERVED, for empty rows
        learnt = codes.take(np.flatnonzero(clustered))
        return cls(labels, refined, dict(class_names), scene.digest, clustered, learnt, ids=scene.ids)

    def require(self, scene: GaussianScene) -> None:
        """Raise `StateMismatchError` if this segmentation belongs to another scene."""
        if self.scene_digest != scene.digest:
            found, given = self.scene_digest[:12], scene.digest[:12]
            raise StateMismatchError(f"segmentation: belongs to the scene {found}; expected {given}, the one given")

    def filtered(self, scene: GaussianScene, settings: RefineSettings) -> Segmentation:
        """Remove outliers of each object by the paper's statistical filter if `settings.filter`; raises as `carved`."""
        self.require(scene)
        if not settings.filter:
            return self
        return self._without(statistical_filter(neighbours_of(scene, settings.k), self.labels, settings.filter_sigmas))

    def calibrated(self, temperature: float) -> Segmentation:
        """Apply a temperature from `gsseg_core.learn.calibrate` to all probabilities; labels and pictures don't change.

        Views always blend the shares as they were learnt, and apply the temperature to the blended pixel. Raises
        `SettingsError` for a temperature outside 0.001 to 1000, the range that files can hold.
        """
        temperature = check_temperature(temperature, SettingsError)
        change = temperature / self.temperature
        return replace(self, shares=tempered_rows(self.shares, change), temperature=temperature)

    def at(self, granularity: float | None) -> Segmentation:
        """Cut the tree at a granularity: return a segmentation whose classes are the nodes there; None: the objects.

        Nodes that are objects keep their ids and names. A Gaussian's share of its own object goes to its own part; its
        share of another object goes to the largest part of that object.

        Raises
        ------
        SettingsError
            There is no tree, or the granularity is not in [0, 1].
        """
        if granularity is None:
            return self
        if (tree := self.tree) is None:
            raise SettingsError("granularity needs objects that were found from ids of each view's own; found no tree")
        names = tree.names(self.class_names)
        # A whole blends as the sum of its objects, so sum the probabilities as they were learnt, at temperature 1.
        shares, nodes = tree.shares_at(granularity, self.calibrated(1.0).shares, tree.leaves)
        return replace(
            self, labels=tree.labels_at(granularity, self.labels), shares=shares,
            class_names={node: names[node] for node in nodes}, temperature=1.0, tree=None,
            learnt=tree.shares_at(granularity, self.learnt, tree.leaves[self.clustered])[0],
        ).calibrated(self.temperature)  # fmt: skip

    @property
    def node_names(self) -> dict[int, str]:
        """Names by id of the classes, and of the parts and wholes of the tree if there is one."""
        return self.class_names if self.tree is None else self.tree.names(self.class_names)

    def members(self, node: int) -> np.ndarray:
        """Mark the Gaussians of a class, or of a part or whole by its id in the tree, (N,) bool."""
        if self.tree is None or node < self.tree.num_classes:
            return np.asarray(self.labels == node)
        return np.isin(self.tree.labels_at(1.0, self.labels), [node, *self.tree.inside(node)])

    def selected(self, classes: Collection[int], min_confidence: float = 0.0) -> Segmentation:
        """Keep the labels of some classes for Gaussians of at least `min_confidence`; other labels become `REMOVED`."""
        kept = np.isin(self.labels, list(classes)) & (self.confidence >= min_confidence)
        return self._without(~kept & (self.labels >= 0))

    @property
    def class_ids(self) -> np.ndarray:
        """Class id of each column, (K,) int32 ascending; the first is 0, the background."""
        return np.fromiter(self.class_names, np.int32)

    @property
    def num_classes(self) -> int:
        """Largest id + 1; K, unless ids have gaps."""
        return max(self.class_names) + 1

    def _without(self, out: np.ndarray) -> Segmentation:  # (N,) bool
        return replace(self, labels=np.where(out, np.int32(REMOVED), self.labels))

    def numbered(self) -> Segmentation:
        """Renumber the classes without gaps, in the order of their ids, so that column k is class k."""
        if self.num_classes == len(ids := self.class_ids):
            return self
        labels = np.where(self.labels >= 0, np.searchsorted(ids, self.labels).astype(np.int32), self.labels)
        return replace(self, labels=labels, class_names=dict(enumerate(self.class_names.values())))

    def with_ids(self, ids: Sequence[int]) -> Segmentation:
        """Replace gapless class ids by K different ones, 0 first; `SettingsError` for other ids, gaps or a tree."""
        names, order = list(self.class_names.values()), np.argsort(ids).tolist()
        fits = all(isinstance(k, int | np.integer) and k <= MAX_LABEL for k in ids)
        if self.tree or not fits or not len(names) == self.num_classes == len(ids) == len({*ids}) or order[0] or ids[0]:
            expected = f"{len(names)} different ones, 0 first, for classes that have neither gaps nor a tree"
            raise SettingsError(f"ids are {clipped(list(ids))}; expected {expected}")
        labels = np.where(self.labels >= 0, np.array(ids, np.int32)[np.maximum(self.labels, 0)], self.labels)
        result = replace(self, labels=labels, class_names={int(ids[k]): names[k] for k in order})
        if order == sorted(order):
            return result
        places = inverse(np.array(order))
        shares, learnt = (rows.in_columns(places[rows.indices]) for rows in (self.shares, self.learnt))
        return replace(result, shares=shares, learnt=learnt)

    def in_order_of(self, digest: str, places: np.ndarray) -> Segmentation:
        """Reorder the segmentation for the scene with `digest`; `places`, (N,): index here of each of its Gaussians."""
        learnt = np.cumsum(self.clustered)[places] - 1  # row in `learnt` of each clustered Gaussian
        clustered = self.clustered[places]
        tree = self.tree and replace(self.tree, leaves=self.tree.leaves[places])
        return replace(
            self, labels=self.labels[places], shares=self.shares.take(places), clustered=clustered,
            learnt=self.learnt.take(learnt[clustered]), scene_digest=digest, tree=tree,
            ids=None if self.ids is None else self.ids[places],
        )  # fmt: skip

    @cached_property
    def probabilities(self) -> np.ndarray:
        """Class probabilities as a dense array, (N, K) float32; only this property needs the 4 N K bytes."""
        return self.shares.dense(len(self.class_names))

    @cached_property
    def confidence(self) -> np.ndarray:
        """Largest class probability of each Gaussian, (N,) float32; 0 where unobserved."""
        return np.asarray(largest(self.shares)[0])

    def counts(self) -> np.ndarray:
        """Count the Gaussians of each class by id, (num_classes,) int64."""
        return np.bincount(self.labels[self.labels >= 0], minlength=self.num_classes)

    def render(self, operator: ViewOperator) -> RenderedLabels:
        """Render the label map of a view: the class of the largest blended probability in each pixel.

        Blends the probabilities from before refinement. A Gaussian across an edge is rightly a mixture: its neighbours
        decide to which object it goes, but the picture is sharper with its own probabilities. A removed Gaussian still
        covers what is behind it. The remaining transmittance of a ray counts as background if any code has a share of
        the background, else as nothing.

        Raises `StateMismatchError` if the operator is of another scene, as do all methods that take an operator.
        """
        image = self.blend(operator)
        return RenderedLabels(self.class_ids[image.argmax(axis=2)], tempered(image, self.temperature).max(axis=2))

    def carved(
        self, scene: GaussianScene, cameras: Sequence[Camera], device: str = "cpu",
        num_views: int = RefineSettings.carve_views,
    ) -> Segmentation:  # fmt: skip
        """Remove from each object the Gaussians that stick out of its silhouettes in some views; they become `REMOVED`.

        The silhouettes come from label maps that the segmentation renders, not from masks. The label maps are learnt
        from all masks together, so errors of single masks remove nothing. `num_views` views are used, spread evenly.
        Raises `StateMismatchError` for another scene.
        """
        look = partial(Silhouette.rendered, scene, self.label_map, device)
        return self.carved_by(scene, spread(cameras, num_views), look, device)

    def carved_by(
        self, scene: GaussianScene, views: Iterable[T], look: Callable[[T], Silhouette], device: str = "cpu"
    ) -> Segmentation:
        """Remove Gaussians that stick out of silhouettes, as `carved` does; `look` returns the silhouette of a view."""
        self.require(scene)
        return self._without(sticking_out(kept_shares(scene, self.labels, views, look, device=device), self.labels))

    def label_map(self, operator: ViewOperator) -> np.ndarray:
        """Return the class of every pixel of a view, (H, W) int32: the labels of `render`, without the confidence."""
        codes, shows_background = self._codes_to_blend(operator)
        return np.asarray(self.class_ids[operator.strongest(codes, len(self.class_names), shows_background).classes])

    def label_map_beside(self, operator: ViewOperator, others: np.ndarray) -> tuple[np.ndarray, Blended]:
        """Return the class of every pixel, as `label_map` does, and blend further values of Gaussians in the same pass.

        `others`, (M, C), are values of the Gaussians in the operator's `ids`, such as their colours.
        """
        codes, shows_background = self._codes_to_blend(operator)
        found = operator.strongest(codes, len(self.class_names), shows_background, beside=others)
        assert found.beside is not None
        return self.class_ids[found.classes], found.beside

    def blend(self, operator: ViewOperator) -> np.ndarray:
        """Blend the learnt, uncalibrated probabilities into a view, (H, W, K) float32.

        The K values of a pixel sum to the share of it that is known. `gsseg_core.learn.temperature.tempered` at
        `temperature` calibrates them.
        """
        codes, shows_background = self._codes_to_blend(operator)
        return operator.blend_probabilities(codes, len(self.class_names), shows_background)

    def _codes_to_blend(self, operator: ViewOperator) -> tuple[CSRRows, bool]:
        """Return the codes as they were learnt, and whether any has a share of the background.

        If so, the remaining transmittance of each ray counts as background.
        """
        self.require(operator.scene)
        with _BLEND_LOCK:
            return self._blended

    @cached_property
    def _blended(self) -> tuple[CSRRows, bool]:
        codes = before_clustering(tempered_rows(self.shares, 1 / self.temperature), self.clustered, self.learnt)
        return codes, codes.has_column(0)

    def save(self, path: str | os.PathLike[str], run: str | None = None) -> None:
        """Write labels, probabilities, confidence, class ids and names, ids and tree (if any) to one npz, atomically.

        `run` is the id of the run to which the file belongs; it is written to the header.

        Raises
        ------
        WriteError
            The file cannot be written; an existing file is unchanged.
        """
        known = {int(k): name for k, name in self.class_names.items()}  # JSON keys must not be NumPy integers.
        header = {"format": FORMAT, "scene": self.scene_digest, "class_names": known,
                  "temperature": self.temperature, **({} if run is None else {"run": run})}  # fmt: skip
        names, k = ("labels", "class_ids", "confidence", "clustered"), len(self.class_names)
        arrays: dict[str, Any] = {name: getattr(self, name) for name in names}
        arrays |= arrays_of_rows("probabilities", self.shares, k) | arrays_of_rows("learnt", self.learnt, k)
        if self.tree is not None:
            header["granularity"] = self.tree.level
            arrays |= self.tree.arrays()
        write_npz(path, header, **arrays, **({} if self.ids is None else {"ids": self.ids}))

    @classmethod
    def load(cls, path: str | os.PathLike[str], scene: GaussianScene) -> Segmentation:
        """Read a segmentation of `scene` and check all of its content.

        Raises
        ------
        StateFileError
            The file is missing, damaged or invalid, for example with probabilities that do not sum to 1 or labels
            without a class.
        StateMismatchError
            It belongs to another scene.
        WriteError
            The run that wrote it was interrupted just before its end, and the remaining steps fail now
            (`gsseg_core.files.run_folder`).
        """
        path = Path(path)
        settle(path.parent)
        return cls(**read_segmentation(path, scene.digest, len(scene)), scene_digest=scene.digest, ids=scene.ids)
