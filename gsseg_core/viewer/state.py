"""What a viewer shows and what people change of it, apart from the browsers that they do it in."""

from __future__ import annotations

import itertools
import tempfile
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from gsseg_core.csr_rows import CSRRows
from gsseg_core.data.class_names import class_name
from gsseg_core.data.object_tree import ObjectTree
from gsseg_core.data.view import View
from gsseg_core.errors import SettingsError
from gsseg_core.export.class_files import write_selection
from gsseg_core.export.collision import check_collision
from gsseg_core.learn.all_or_nothing import all_or_nothing, checkpoint
from gsseg_core.progress import Progress, silent
from gsseg_core.raster.backends import make_operator
from gsseg_core.scene.camera import Camera
from gsseg_core.scene.scene_writers import SCENE_WRITERS, check_format
from gsseg_core.segmentation import REMOVED, UNOBSERVED, Segmentation
from gsseg_core.viewer.corrections import Corrections
from gsseg_core.viewer.model import BY_RELIABILITY, MODES, ClassRow, Labelling, ViewModel, at_level, completed
from gsseg_core.viewer.picking import ViewVotes
from gsseg_core.viewer.picture import Picture, cut
from gsseg_core.viewer.turns import Turns


class ViewerState:
    """A segmentation, how it is shown, and its corrections; safe to change from several threads."""

    def __init__(self, model: ViewModel, views: Sequence[View], reliability: Mapping[str, float], device: str) -> None:
        self.model, self.device = model, device  # what is shown; where clicks and corrections are rendered
        self.views = tuple(views)  # those that the segmentation was learnt from
        self.reliability = dict(reliability)  # how far each can be trusted, in [0, 1], as far as that is known, by name
        self.corrections = Corrections(model.scene, device=device)  # what people drew
        self.added_names: dict[int, str] = {}  # of classes that were added in the viewer
        self.stale = threading.Event()  # set by every change: what browsers show is out of date
        self.objects = self._learnt = model.labelling  # the classes with their corrections, ...
        self.granularity = model.tree.level if model.tree else 0.0  # ... of which the model shows this level of a tree
        self._view_votes: ViewVotes | None = None
        self._view_votes_lock = threading.Lock()
        self.lock = Turns()  # held by whoever needs that nothing of this changes meanwhile
        self._parts = cut(model.labelling.labels, model.labelling.confidence)

    def seen(self) -> tuple[Picture, list[ClassRow]]:
        """Return the scene as it is to be seen now, and the list of classes."""
        with self.lock:
            model = self.model
            return Picture(model.scene, self._parts, model.shown(), model.colors()), model.rows()

    def change(self, action: Callable[[ViewModel], object]) -> None:
        """Change what is shown, and have the browsers follow; changes that come fast are shown together."""
        with self.lock:
            action(self.model)
        self.stale.set()

    def set_mode(self, mode: str, progress: Progress = silent) -> None:
        """Colour by something else; `progress` is told of the views where their votes have to be collected for it.

        Raises `SettingsError` where there is no such mode, or it is the reliability of views and that is not known.
        """
        if mode not in MODES:
            raise SettingsError(f"colour by {mode!r}; expected one of {', '.join(MODES)}")
        new: dict[str, Any] = {"mode": mode}
        if mode == BY_RELIABILITY and self.model.reliability is None:
            if not self.reliability or not self.views:
                raise SettingsError(
                    "view reliability is not known; expected --data, and a report.json of `gsseg segment --learner em` "
                    "beside the segmentation"
                )
            new["reliability"] = self.view_votes(progress).mean_reliability(self.reliability)
        self.change(lambda model: vars(model).update(new))

    def set_level(self, granularity: float, inside: int | None = None) -> None:
        """Show the level of the tree at a granularity: all of it, or only what lies inside one node."""
        tree = self._tree()
        with self.lock:
            self._relabel(granularity)
            model, shown = self.model, None if inside is None else {inside, *tree.inside(inside)}
            ids, model.hidden, model.removed = model.ids(), set(), set()
            if shown is not None:
                model.hidden = {label for label in model.labels_in_use if label < 0 or ids[label] not in shown}

    def node_of(self, gaussian: int) -> int | None:
        """Node of the tree that a Gaussian is in as it is shown; None if none."""
        with self.lock:
            label, ids, tree = int(self.model.labelling.labels[gaussian]), self.model.ids(), self.model.tree
        return None if tree is None or label < 0 or ids[label] >= len(tree) else ids[label]

    def show_parts(self, node: int) -> None:
        """Show the parts of a node, alone, where it has any."""
        tree = self._tree()
        if tree.parts(node):
            self.set_level(tree.opened(node), node)

    def show_whole(self, node: int) -> None:
        """Show what a node is a part of, alone, where that is anything."""
        tree = self._tree()
        if (whole := tree.whole(node)) is not None:
            self.set_level(tree.closed(whole), whole)

    def _tree(self) -> ObjectTree:
        if self.model.tree is None:
            raise SettingsError("parts and wholes are not known; expected a segmentation of ids of each view's own")
        return self.model.tree

    def view_votes(self, progress: Progress = silent) -> ViewVotes:
        """Return the votes of each view for each Gaussian; collected when first asked for."""
        with self._view_votes_lock:
            if self._view_votes is None:
                self._view_votes = ViewVotes(self.model.scene, self.views, device=self.device, progress=progress)
            return self._view_votes

    def label_map(self, camera: Camera) -> np.ndarray:
        """Render labels (H, W) int64 of what is shown, -1 where nothing is."""
        with self.lock:
            labelling, shown = self.model.labelling, self.model.shown()
        # What has no class is a region as well. There may be far more classes than are in use.
        used, place = np.unique(np.maximum(labelling.labels, -1), return_inverse=True)
        one_hot = CSRRows(np.arange(len(place) + 1), place.astype(np.uint32), np.ones(len(place), np.float32))
        operator = make_operator(self.model.scene, camera, self.device).without(~shown)
        anything = np.ones((len(operator.ids), 1), np.float32)
        found = operator.strongest(one_hot, len(used), False, beside=anything)
        assert found.beside is not None
        return np.where(found.beside.image[..., 0] > 0, used[found.classes].astype(np.int64), -1)

    def correct(self, view: View) -> int:
        """Learn what was drawn in a picture of what is shown; return how many Gaussians that changed.

        Raises `NoUsableViewsError` where nothing was drawn on any Gaussian; after any error, nothing is learnt.
        """
        with self.lock:
            before = self.model.labelling.labels
            with self._relabelling():
                self.corrections.add(view, self.model.shown())
            return int(np.count_nonzero(before != self.model.labelling.labels))

    def undo(self) -> bool:
        """Take the last correction back; return whether there was one."""
        with self._relabelling():
            return self.corrections.undo()

    def replace(self, learnt: Labelling) -> None:
        """Show what a live source has learnt by now, under the same corrections.

        Classes that were added here make room for those that turn up there; one of the same name becomes that class. So
        do classes that were corrected or switched off, where the source was reset and numbers its classes anew.
        """
        with self._relabelling():
            before, taken, model = self._learnt.class_names, learnt.class_names, self.model
            held = before.keys() & {*self.corrections.labels(), *model.hidden, *model.removed}
            # What had but a number may get a name.
            gone = {k: before[k] for k in held if before[k] not in (taken.get(k), class_name({}, k))}
            added = {**gone, **self.added_names}
            known, free = {name: k for k, name in taken.items()}, itertools.count(max([*taken, *added]) + 1)
            moved = {k: name for k, name in added.items() if k in taken or name in known}
            ids = {k: known[name] if name in known else next(free) for k, name in moved.items()}
            if ids:
                self.corrections.renumber(ids)
                model.hidden, model.removed = ({ids.get(k, k) for k in off} for off in (model.hidden, model.removed))
            self.added_names = {ids.get(k, k): name for k, name in added.items() if ids.get(k, k) not in taken}
            self._learnt = learnt

    def selection(self, scene_format: str, collision: str | None = None) -> tuple[str, bytes]:
        """Write what is shown in a format of `gsseg_core.scene.scene_writers.SCENE_WRITERS`: a file name and its bytes.

        With `collision`, one of `gsseg_core.export.collision.KINDS`, a USD has a mesh of each object, too. Raises
        `EmptySceneError` where nothing is shown; `SettingsError` where there is no such format or kind of mesh, the
        library that makes it is not installed, or the format holds no meshes; `SceneValueError` where the format cannot
        hold what is shown.
        """
        check_format(scene_format)
        check_collision(collision)
        if collision and not SCENE_WRITERS[scene_format].together:
            raise SettingsError(f"format {scene_format}: holds no meshes to collide with; expected usd, or none")
        with self.lock:
            scene, shown, known, ids = self.model.scene, self.model.shown(), self.model.labelling, self.model.ids()
        name = f"selection{SCENE_WRITERS[scene_format].suffixes[0]}"
        given = np.array([*ids, REMOVED, UNOBSERVED])[known.labels]  # labels -1 and -2 are its last two
        names = {ids[k]: text for k, text in known.class_names.items()}
        selected = scene, shown, given, known.confidence, names
        return name, _as_file(lambda path: write_selection(*selected, path, scene_format, collision), name)

    def segmentation_npz(self) -> tuple[str, bytes]:
        """Write labels and class probabilities, corrections included: the name `segmentation.npz`, and its bytes."""
        with self.lock:
            objects, tree, read = self.objects, self.model.tree, self.model.read
            ids = self.model.ids() if tree is None else at_level(objects, tree, tree.level).nodes
        scene, names, nothing = self.model.scene, objects.class_names, np.zeros(len(objects.labels), bool)
        shares = completed(objects.shares, len(names))
        result = Segmentation(objects.labels, shares, names, scene.digest, nothing, CSRRows.empty(0), ids=scene.ids)
        if read is not None:  # What blends into views is what was learnt, but for what was corrected.
            now, then = objects.shares.united(read.shares)
            same = now.with_data(now.data != then.data).sums() == 0
            learnt = read.learnt.take(np.flatnonzero(same[read.clustered]))
            result = replace(result, clustered=read.clustered & same, learnt=learnt, temperature=read.temperature)
        # Classes that were added are in no tree.
        result = replace(result, tree=tree) if ids is None else result.with_ids(ids)
        return "segmentation.npz", _as_file(result.save, "segmentation.npz")

    @contextmanager
    def _relabelling(self) -> Iterator[None]:
        """Change the corrections or what was learnt, and show what follows; where that fails, nothing has changed."""
        with self.lock, all_or_nothing(*map(checkpoint, (self, self.model, self.corrections))):
            yield
            self._relabel(self.granularity)

    def _relabel(self, granularity: float) -> None:
        """Show what follows from the corrections, at a level; all of it, or nothing where memory runs out."""
        objects, tree = self.corrections.apply(self._learnt, self.added_names), self.model.tree
        shown = at_level(objects, tree, granularity) if tree else objects
        self._parts = cut(shown.labels, shown.confidence)
        self.objects, self.granularity = objects, granularity
        self.model.labelling = shown
        self.stale.set()


def _as_file(write: Callable[[Path], Any], name: str) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        write(Path(folder) / name)
        return (Path(folder) / name).read_bytes()
