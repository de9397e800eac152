"""Views whose ids hold only inside their own frame, and the objects that they show: ids for all views come out."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from gsseg_core.csr_rows import CSRRows, largest
from gsseg_core.data.class_names import BACKGROUND_NAME
from gsseg_core.data.label_images import UNKNOWN
from gsseg_core.data.view import View
from gsseg_core.errors import SceneValueError, SettingsError, UnknownLabelError
from gsseg_core.files.limits import MAX_LABEL
from gsseg_core.learn.all_or_nothing import Undo, all_or_nothing, checkpoint
from gsseg_core.objects.association import UNSEEN, AssociationSettings, associate
from gsseg_core.objects.lifted_segments import Lifted, Profiles
from gsseg_core.objects.sight import FULL_SIGHT_PX
from gsseg_core.objects.sparse_products import sums
from gsseg_core.objects.tree_growing import grow_tree
from gsseg_core.progress import Progress, silent
from gsseg_core.raster.backends import make_operator
from gsseg_core.raster.observation import Observation
from gsseg_core.raster.view_operator import ViewOperator
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.segmentation import REMOVED, Segmentation
from gsseg_core.several_at_once import each_with_made

_EARLY_GRANULARITY = 0.5  # of the objects before all views were looked at together


@dataclass(frozen=True)
class ViewObjects:
    """Objects that the ids of one view stand for, and ids that fit none."""

    objects: dict[int, int]  # by id; 0 is the background in both
    merged: int  # ids that cover two objects or more, so that they can be right for one only
    split: int  # ids beyond the first of an object that this view has cut up


@dataclass(frozen=True, eq=False)
class Repair:
    """Views and objects that `ObjectTable.solve` gave another number."""

    changed: list[str]  # views whose ids now mean something else than before
    successors: np.ndarray  # (K,) int64: of each earlier object, the number that most of its weight has now


class ObjectTable:
    """Objects, found from views whose ids are their own.

    Views come one at a time: `match` gives the ids of a new one the numbers of the objects that are known so far, at
    once. `solve` looks at all views together and repairs what one view could not know: it merges objects that were one,
    and parts others. What it finds does not depend on the order in which the views came.
    """

    def __init__(
        self, scene: GaussianScene, settings: AssociationSettings | None = None, *, device: str = "cpu"
    ) -> None:
        self.scene, self.settings, self.device = scene, settings or AssociationSettings(), device
        self.views: dict[str, View] = {}  # as they came, by name
        self._lifted: dict[str, Lifted] = {}
        self._objects: dict[str, np.ndarray] = {}
        self._largest, self._agreement = 0, self.settings.agreement
        self._forgotten = Profiles.empty(len(scene))
        self._profiles = Profiles.empty(len(scene))

    @property
    def num_objects(self) -> int:
        """Objects that the views show, the background not counted."""
        return len({k for objects in self._objects.values() for k in objects.tolist()} - {0})

    @property
    def class_names(self) -> dict[int, str]:
        """Names by number, up to the largest that was given: "object_001" and so on."""
        return {k: object_name(k) for k in range(self._largest + 1)}

    def add(self, view: View, operator: ViewOperator | None = None) -> bool:
        """Add a view for `solve`; one of a name that is there already replaces it.

        The view's `operator` is made here unless it is at hand. Tells whether the view has a mask and sees any
        Gaussian; if not, nothing has changed. Raises `MaskFormatError`, `MaskSizeError` or `UnknownLabelError` where
        the mask is broken, of another size than the camera, or has ids beyond `MAX_LABEL`.
        """
        return self._add(view, self._lift(view, operator))

    def add_all(self, views: Sequence[View], progress: Progress = silent) -> None:
        """Add views, as `add` does; the error that one of them raises ends it."""
        for view, lifted in each_with_made(self._lift, views, self.device, progress, "lift"):
            self._add(view, lifted)

    def match(self, view: View, operator: ViewOperator | None = None) -> View:
        """Add a view, and give its ids the numbers of the objects so far; what nobody has seen yet is a new object.

        Returns what `relabelled` does. Takes and raises what `add` does, and raises where there are too many objects;
        then nothing has changed.
        """
        with all_or_nothing(self.checkpoint()):
            if not self.add(view, operator):
                return _without_labels(view)
            lifted = self._lifted[view.name]
            best, seen = self._profiles.explain(lifted)
            new = (lifted.ids > 0) & (seen < UNSEEN)
            best[lifted.ids == 0] = 0
            best[new] = self._largest + 1 + np.arange(np.count_nonzero(new))
            if best.max(initial=0) > MAX_LABEL:
                raise UnknownLabelError(f"view '{view.name}': shows object {best.max()}; expected at most {MAX_LABEL}")
            self._give(view.name, best)
            return self.relabelled(view)

    def checkpoint(self) -> Undo:
        """Return what goes back to the present state, after `add`, `match`, `remove` or `solve`; not after `forget`."""
        copies = {name: dict(getattr(self, name)) for name in ("views", "_lifted", "_objects")}
        return checkpoint(self, **copies, _profiles=copy(self._profiles))

    def adopt(self, view: View) -> Observation | None:
        """Add a view whose ids are the numbers of objects already; returns it lifted, None where `add` tells False."""
        opened = self._open(view)
        if opened is None:
            return None
        operator, labels, _ = opened
        observation = operator.observe(labels)
        if not observation.num_pairs:
            return None
        self._add(view, Lifted.of(observation.by_label()).bordered(self.scene, operator, labels))
        self._give(view.name, self._lifted[view.name].ids)
        return observation

    def adopt_all(self, views: Sequence[View]) -> None:
        """Add views whose ids are the numbers of objects already, several at once; those that see nothing are not."""
        for view, lifted in each_with_made(self._lift, views, self.device, silent, "lift"):
            if self._add(view, lifted):
                self._give(view.name, self._lifted[view.name].ids)

    def reserve(self, number: int) -> None:
        """Give no new object a number up to this one."""
        self._largest = max(self._largest, number)

    def recall(self, votes: CSRRows) -> None:
        """Have the votes of views that are gone, N rows in px, count for `match`, as those of views that it forgot.

        Raises `SceneValueError` for votes of another number of Gaussians, or that are not finite.
        """
        if votes.num_rows != len(self.scene) or not np.isfinite(votes.data).all():
            shape = votes.num_rows, int(votes.indices.max(initial=0)) + 1
            found = f"votes have shape {shape}, {votes.data.min(initial=0)} to {votes.data.max(initial=0)}"
            raise SceneValueError(f"objects: {found}; expected ({len(self.scene)}, K), finite")
        self._forgotten = Profiles.of(votes)
        self._fill()

    def remove(self, name: str) -> None:
        """Take a view back, with all its evidence; raises `SettingsError` where there is no such view."""
        self._require(name)
        with all_or_nothing(self.checkpoint()):
            del self.views[name]
            self._lifted.pop(name, None)
            if self._objects.pop(name, None) is not None:
                self._fill()

    def sees(self, name: str) -> bool:
        """Whether a view counts: it was not set aside."""
        return name in self._lifted

    def sees_any(self, view: View, operator: ViewOperator | None = None) -> bool:
        """Whether a view has a mask and sees any Gaussian; takes what `add` does."""
        if (opened := self._open(view, operator)) is None:
            return False
        operator, labels, _ = opened
        return len(operator.lift(labels).gaussians) > 0

    def set_aside(self, view: View) -> None:
        """Keep a view that sees nothing for now; what was known from it is taken back."""
        if view.name in self.views:
            self.remove(view.name)
        self.views[view.name] = view

    def forget(self, name: str) -> None:
        """Drop a view; its evidence still counts for `match`, not for `solve`. Raises as `relabelled` and `remove`."""
        self._require(name)
        if name in self._lifted:
            self._forgotten.add(self._lifted[name], self._numbers(name))
            del self._lifted[name], self._objects[name]
        del self.views[name]

    def solve(self, progress: Progress = silent) -> Repair:
        """Find the objects from all views together.

        Objects that have a number keep it, by the largest overlap; new ones follow, the largest first.
        """
        progress("associate", 0, 1)
        with all_or_nothing(self.checkpoint()):
            solved, self._agreement = associate(self._lifted, self.settings)
            before, successors = self._objects, np.arange(self._largest + 1)
            if before:
                solved, successors = self._renumbered(solved)
            self._objects = solved
            self._largest = max([self._largest, *(int(objects.max(initial=0)) for objects in solved.values())])
            self._forgotten = self._forgotten.renumbered(successors)
            self._fill()
        progress("associate", 1, 1)
        changed = [name for name in solved if name not in before or (before[name] != solved[name]).any()]
        return Repair(changed, successors)

    def with_tree(self, segmentation: Segmentation) -> Segmentation:
        """Add parts and wholes to a segmentation of the scene whose classes are these objects, by the views kept."""
        segmentation.require(self.scene)
        labels, likely = segmentation.labels, np.maximum(largest(segmentation.shares)[1], 0)
        classes = np.where(labels == REMOVED, likely, labels)  # What was removed covers an object still.
        level = _EARLY_GRANULARITY if self._agreement is None else self._agreement
        tree = grow_tree(self.scene.means, classes, len(segmentation.class_names), self._lifted, level)
        return replace(segmentation, tree=tree)

    def relabelled(self, view: View) -> View:
        """Return a view as it came, with the numbers of objects for labels; ids that lie on no Gaussian are unknown.

        A view that `add` would not take comes back with nothing but background and unknown pixels, or as it is if it
        has no mask, so that a learner rejects it for the right reason. Raises `SettingsError` where a view was added
        and `solve` has not come yet.
        """
        lifted = self._lifted.get(view.name)
        if lifted is None:
            return _without_labels(view)
        labels = self.views[view.name].read_labels()
        table = np.full(int(labels.max()) + 2, UNKNOWN, np.int32)  # The last one is for unknown pixels.
        table[lifted.ids] = self._numbers(view.name)
        return replace(View.from_arrays(view.camera, table[labels]), image_path=view.image_path)

    def objects_in(self, name: str) -> ViewObjects:
        """Which object each id of a view stands for, and how many ids do not fit; raises as `relabelled` and `remove`.

        A view that was set aside has no ids.
        """
        self._require(name)
        if not self.sees(name):
            return ViewObjects({}, merged=0, split=0)
        lifted, objects = self._lifted[name], self._numbers(name)
        shown = objects[objects > 0]
        parts, _ = self._profiles.common(lifted)
        parts[:, 0], parts[lifted.ids == 0] = 0, 0
        size = parts.sum(axis=0)
        # Most of an object, as far as this view shows it, lies under an id: more than one, and the id has merged them.
        most = (parts > 0.5 * size) & (size >= FULL_SIGHT_PX)
        return ViewObjects(
            dict(sorted(zip(lifted.ids.tolist(), objects.tolist(), strict=True))),
            merged=int((most.sum(axis=1) > 1).sum()),
            split=len(shown) - len(np.unique(shown)),
        )

    def summary(self, result: Segmentation) -> dict[str, Any]:
        """Put together what `report.json` says of the ids, and of the parts and wholes of a result."""
        tree, counts = result.tree, result.counts()
        views = {name: asdict(self.objects_in(name)) for name in sorted(self._objects)}
        return {
            "objects": self.num_objects,
            "without_gaussians": [k for k in result.class_names if k and not counts[k]],
            "granularity": self._agreement,
            "segments": sum(len(lifted) for lifted in self._lifted.values()),
            "merged": sum(view["merged"] for view in views.values()),
            "split": sum(view["split"] for view in views.values()),
            "settings": asdict(self.settings),
            "views": views,
            **({} if tree is None else {"tree": tree.describe(result.class_names, tree.sizes(result.labels))}),
        }

    def _require(self, name: str) -> None:
        if name not in self.views:
            raise SettingsError(f"view {name!r} was not added; there are {len(self.views)} others")

    def _numbers(self, name: str) -> np.ndarray:
        """Return the object of each id of a view that counts, or raise `SettingsError` before it was given one."""
        if name not in self._objects:
            raise SettingsError(f"view {name!r} was added, and its objects are not known yet; expected solve() first")
        return self._objects[name]

    def _lift(self, view: View, operator: ViewOperator | None = None) -> Lifted | None:
        """Lift the segments of a view to the Gaussians; None where it has no labels or sees no Gaussian."""
        opened = self._open(view, operator)
        if opened is None:
            return None
        operator, labels, outermost = opened
        seen = operator.lift(labels)
        if not len(seen.gaussians):
            return None
        lifted = Lifted.of(seen).bordered(self.scene, operator, labels)
        return lifted if outermost is None else replace(lifted, wholes=outermost[lifted.ids])

    def _open(
        self, view: View, operator: ViewOperator | None = None
    ) -> tuple[ViewOperator, np.ndarray, np.ndarray | None] | None:
        """Make the operator of a view unless it is at hand, and read its labels, with `outermost`; None without any."""
        if not view.has_mask:
            return None
        # Names of classes say nothing of ids that are a view's own.
        seen = replace(view, class_names=None).read_seen()
        labels = seen.named()
        if not (labels >= 0).any():
            return None
        return operator or make_operator(self.scene, view.camera, self.device), labels, seen.outermost

    def _add(self, view: View, lifted: Lifted | None) -> bool:
        if lifted is None:
            return False
        if view.name in self.views:
            self.remove(view.name)
        self.views[view.name], self._lifted[view.name] = replace(view, class_names=None), lifted
        return True

    def _give(self, name: str, objects: np.ndarray) -> None:
        self._objects[name] = objects.astype(np.int32)
        self._largest = max(self._largest, int(objects.max(initial=0)))
        self._profiles.add(self._lifted[name], objects)

    def _fill(self) -> None:
        self._profiles = Profiles(self._forgotten.weights)
        for name, objects in self._objects.items():
            self._profiles.add(self._lifted[name], objects)

    def _renumbered(self, solved: dict[str, np.ndarray]) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """Give solved objects the numbers that most of their weight had before; second come the successors."""
        from scipy.optimize import linear_sum_assignment

        names = sorted(self._objects)
        old, new = (np.concatenate([part[name] for name in names]) for part in (self._objects, solved))
        size = np.concatenate([sums(self._lifted[name].weights, 1) for name in names])
        shared = np.zeros((max(int(part.max(initial=0)) for part in solved.values()) + 1, self._largest + 1))
        np.add.at(shared, (new, old), size)
        table = np.zeros(len(shared), np.int64)
        rows, columns = linear_sum_assignment(shared[1:, 1:], maximize=True)
        kept = shared[rows + 1, columns + 1] > 0
        table[rows[kept] + 1] = columns[kept] + 1
        fresh = np.flatnonzero(table[1:] == 0) + 1
        table[fresh] = self._largest + 1 + np.arange(len(fresh))
        successors = np.where(shared.any(axis=0), table[shared.argmax(axis=0)], np.arange(self._largest + 1))
        successors[0] = 0
        return {name: table[objects].astype(np.int32) for name, objects in solved.items()}, successors


def _without_labels(view: View) -> View:
    if not view.has_mask:
        return view
    labels = np.minimum(replace(view, class_names=None).read_labels(), 0)
    return replace(View.from_arrays(view.camera, labels), image_path=view.image_path)


def object_name(number: int) -> str:
    """Name an object by its number."""
    return f"object_{number:03d}" if number else BACKGROUND_NAME


def find_objects(
    scene: GaussianScene,
    views: Sequence[View],
    settings: AssociationSettings | None = None,
    *,
    device: str = "cpu",
    progress: Progress = silent,
) -> ObjectTable:
    """Find the objects of all views whose masks can be used."""
    table = ObjectTable(scene, settings, device=device)
    table.add_all(views, progress)
    table.solve(progress)
    return table
