"""A live session: fuses views of one scene as they arrive, learns from the last ones, and segments at any time."""

from __future__ import annotations

import os
import threading
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from weakref import WeakKeyDictionary

import numpy as np

from gsseg_core.csr_rows import CSRRows
from gsseg_core.data.class_names import class_name
from gsseg_core.data.dataset import Dataset
from gsseg_core.data.view import View, spread
from gsseg_core.errors import GssegError, NoCodesError, NoUsableViewsError, SettingsError, StateFileError
from gsseg_core.learn.all_or_nothing import all_or_nothing
from gsseg_core.learn.learner_state import OBJECTS_OF_ONE_SESSION, Learnt, State
from gsseg_core.learn.registry import make_learner
from gsseg_core.learn.usable_views import UnusableViewError
from gsseg_core.learn.vote_learner import VoteLearner
from gsseg_core.live.current_codes import current_codes, current_evidence
from gsseg_core.live.living_votes import without_groups
from gsseg_core.live.results import SCENE_CHANGED, Outcome, Rejection, Report, observe_and_fit
from gsseg_core.live.session_classes import SessionClasses
from gsseg_core.progress import Stopwatch
from gsseg_core.raster.view_operator import ViewOperator
from gsseg_core.refine.settings import UNREFINED, RefineSettings
from gsseg_core.scene.camera import Camera
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.segmentation import Segmentation
from gsseg_core.spatial.neighbourhood import find_neighbours


class LiveSession:
    """Fuses views as they arrive, learns better class probabilities when asked, and segments at any time.

    Safe to use from several threads: `fuse`, `segmentation` and the rest answer while `learn` runs.

    After `learn`, the learnt class probabilities hold for every Gaussian that its views saw; those of all others come
    from the votes, which grow with every view. Without `learn`, all come from the votes.

    Parameters
    ----------
    scene : GaussianScene
        N Gaussians.
    class_names : mapping from id to name, optional
        If given, there are no other classes. If not, classes are added as their labels turn up.
    max_views : int
        The last so many views are kept for `learn`; votes are never dropped.
    device : str
        Where views are rendered.
    max_classes : int
        Without `class_names`: a label that would make more classes than this, the background included, is refused.

    Attributes
    ----------
    rejected : Counter of str
        Views that could not be used, by reason.
    num_fused : int
        Views in the votes.
    """

    # How the error of one class too many begins and ends; whether classes are objects that the session found itself.
    _LABEL, _REMEDY, _PER_VIEW = "mask holds the label", ", or class_names that declare it", False
    _learnt: Learnt | None
    _segmented: tuple[object, Segmentation] | None
    _cameras: list[Camera]  # of the dataset that was learnt from

    def __init__(
        self, scene: GaussianScene, class_names: Mapping[int, str] | None = None, *,
        max_views: int = 200, device: str = "cpu", max_classes: int = 256,
    ) -> None:  # fmt: skip
        for name, value in (("max_views", max_views), ("max_classes", max_classes)):
            if not isinstance(value, int | np.integer) or value < 1:
                raise SettingsError(f"{name} is {value}; expected at least 1, a whole number")
        self.scene, self.max_views, self.device = scene, int(max_views), device  # NumPy's may have no sign
        self.rejected: Counter[str] = Counter()
        self._classes = SessionClasses(class_names, int(max_classes))
        self._lock, self._version = threading.RLock(), 0
        self._scenes: WeakKeyDictionary[Segmentation, GaussianScene] = WeakKeyDictionary()
        self._forget({}, self._no_votes(self._classes.least))

    @property
    def class_names(self) -> dict[int, str]:
        """Names by id, of every class; one without a name is called like "class_07"."""
        names = self._classes.names  # At once: nobody who asks for names waits for a view that is being fused.
        return {k: class_name(names, k) for k in range(self._live.num_classes)}

    @property
    def version(self) -> int:
        """Version of the class probabilities: another one after each change that `segmentation` depends on."""
        return self._version

    @property
    def era(self) -> object:
        """Token of all that is known; `reset`, `load` and `retire` begin another era, with another token."""
        return self._era

    @property
    def num_views(self) -> int:
        """Views that are kept for `learn`."""
        return len(self._live.views)

    @property
    def view_names(self) -> list[str]:
        """Names of the views that are kept, in the order in which they came."""
        with self._lock:
            return list(self._live.views)

    @property
    def learnt(self) -> Learnt | None:
        """Class probabilities of the last `learn`."""
        return self._learnt

    @property
    def has_codes(self) -> bool:
        """Whether anything is known of the scene."""
        return self._learnt is not None or self.num_fused > 0

    def number_classes(self, names: Mapping[int, str], *, keep_numbers: bool = True) -> dict[int, int]:
        """Find the ids of a segmenter's classes, by its numbers, and add those that are new; see `ids_by_name`."""
        with self._lock:
            ids, any_new = self._classes.number(names, self._live.num_classes, keep_numbers=keep_numbers)
            self._version += any_new
            return ids

    def fuse(self, view: View, era: object = None) -> Rejection | None:
        """Add a view with a mask to the votes, and keep it for `learn`.

        A view that is kept under the same name is replaced, its votes taken back: it still is one view. The names of
        views that are not kept any more are not known, so that under one of these comes another view.

        Parameters
        ----------
        view : View
            With a mask, which is kept as it is now, whatever becomes of its file.
        era : object, optional
            What `era` was when the view was taken: if that has changed, the view belongs to what was forgotten, and is
            neither used nor counted as rejected.

        Returns
        -------
        Rejection or None
            Why it cannot be used; then nothing has changed but the count of rejected views.
        """
        with self._lock:
            if era is not None and era is not self._era:
                return Rejection(SCENE_CHANGED, f"view '{view.name}': it came before all that was known was forgotten")
            try:
                # With a view that is not used no classes come; and after too little memory, all is still of use.
                with all_or_nothing(partial(self._live.resize, self._live.num_classes)):
                    self._fuse(view)
            except UnusableViewError as why:
                return self.reject(Rejection(str(why).replace(" ", "_"), f"view '{view.name}': {why}"))
            except GssegError as error:
                return self.reject(Rejection.of(error))
        return None

    def _fuse(self, view: View, operator: ViewOperator | None = None) -> None:
        """Add a view; raises `UnusableViewError` where nothing can be learnt from it."""
        self._grow_for(view)
        repeated = view.name in self._live.views
        if not self._live.observe(view, operator):
            raise UnusableViewError(self._live.rejected.pop(view.name))
        self.num_fused += not repeated
        self._version += 1
        self._drop_old_views()

    def reject(self, rejection: Rejection) -> Rejection:
        """Count a view that could not be used."""
        with self._lock:
            self.rejected[rejection.reason] += 1
        return rejection

    def learn(
        self, learner: str = "em", dataset: Dataset | None = None, *,
        num_views: int | None = None, max_steps: int | None = None,
        report: Report = lambda stage, done, total, loss: None, watch: Stopwatch | None = None,
    ) -> Outcome:  # fmt: skip
        """Learn class probabilities from the views kept, or from the train views of a dataset.

        Whatever `report` raises ends the work, and then, as after any error, nothing has changed.

        Parameters
        ----------
        learner : str
            One of `gsseg_core.learn.registry.LEARNERS`.
        dataset : Dataset, optional
            Learn from this in place of the views kept.
        num_views : int, optional
            Use this many views, spread evenly.
        max_steps : int, optional
            Stop after this many steps.
        report : Report
            Called after every view.
        watch : Stopwatch, optional
            Gets the seconds of each stage.

        Raises
        ------
        NoUsableViewsError
            There is no view to learn from, or all that was known was forgotten meanwhile.
        UnknownLabelError, ClassesFileError, GssegError
            The dataset has more classes than there may be, calls one otherwise than it is called here, or is broken.
        """
        with self._lock:
            views, num_classes, era, scene = self._posed_views(), self._live.num_classes, self._era, self.scene
            carried = self._carrier()
        if dataset is not None:
            views = dataset.views("train")
            self._classes.check_dataset(dataset, fused=self.num_fused > 0)
            num_classes = self._classes.count_with(dataset, num_classes, self._live)
        made = make_learner(learner, scene, num_classes, max_steps=max_steps, device=self.device)
        views = spread(views, num_views)
        outcome = observe_and_fit(learner, made, views, report, watch or Stopwatch(), named=not self._PER_VIEW)
        with self._lock:
            if era is not self._era:
                raise NoUsableViewsError("all views were forgotten while they were learnt from; nothing was learnt")
            if dataset is not None:
                self._classes.add(dataset, fused=self.num_fused > 0)  # Views may have come meanwhile.
            self._live.resize(max(num_classes, self._live.num_classes))
            self._learnt = learnt = carried(outcome.learnt)
            self._cameras = [] if dataset is None else [view.camera for view in views]
            self._version += 1
        return replace(outcome, learnt=learnt)

    def codes(self) -> np.ndarray:
        """Class probabilities of every Gaussian as they are now, (N, K) float32; a row of zeros where nothing is known.

        Raises `NoCodesError` where nothing has been fused or learnt yet.
        """
        with self._lock:
            return self._code_rows().dense(self._live.num_classes)

    def _code_rows(self) -> CSRRows:
        if not self.has_codes:
            raise NoCodesError("no view has been fused and nothing learnt; expected at least one posed mask")
        return current_codes(self._live, self._learnt)

    def segmentation(self, settings: RefineSettings | None = None, watch: Stopwatch | None = None) -> Segmentation:
        """Refine the class probabilities and label every Gaussian; kept until they or the settings change.

        After `learn`, probabilities are calibrated (see `gsseg_core.learn.calibrate`). Those of mere votes are shares
        of the pixels that saw a Gaussian, and so less sure than they might be.

        Raises
        ------
        NoCodesError
            Nothing has been fused or learnt yet.
        """
        settings, watch = settings or RefineSettings(), watch or Stopwatch()
        with self._lock:
            key = self._version, settings
            if self._segmented is not None and self._segmented[0] == key:
                return self._segmented[1]
            scene, names, temperature = self.scene, self.class_names, self._temperature
            # Of a dataset's views and of those that are kept; a state without either has nothing carved.
            cameras = [*self._cameras, *(view.camera for view in self._posed_views())]
            with watch.stage("codes"):
                codes, weighs = self._code_rows(), settings.cluster and settings.weigh
                evidence = current_evidence(self._live, self._learnt) if weighs else None
        # All of that are copies: the session goes on meanwhile.
        with watch.stage("knn"):
            result = Segmentation.unfiltered(scene, codes, names, settings, evidence)
        if settings.filter:
            with watch.stage("filter"):
                result = result.filtered(scene, settings)
        if settings.carve:
            with watch.stage("carve"):
                result = result.carved(scene, cameras, self.device, settings.carve_views)
        result = result.calibrated(temperature)
        self._segmented = key, result
        self._scenes[result] = scene
        return result

    def unrefined(self) -> Segmentation:
        """Segment without refinement, beside what `segmentation` keeps; raises `NoCodesError`, as `codes` does."""
        with self._lock:
            result = Segmentation.unfiltered(self.scene, self._code_rows(), self.class_names, UNREFINED)
            result = result.calibrated(self._temperature)
            self._scenes[result] = self.scene
        return result

    @property
    def _temperature(self) -> float:
        return 1.0 if self._learnt is None else self._learnt.temperature

    def scene_of(self, result: Segmentation) -> GaussianScene:
        """Return the scene as it was for a result of `segmentation` or `unrefined`."""
        return self._scenes.get(result, self.scene)

    def save(self, path: str | os.PathLike[str]) -> int:
        """Save votes, views and class probabilities, atomically; return the number of views that they come from.

        Raises
        ------
        NoCodesError
            There is nothing to save.
        PathTakenError
            Something is there that is no saved state; it is unchanged.
        WriteError
            The file cannot be written; an earlier one is unchanged.
        """
        with self._lock:
            if not self.has_codes:
                raise NoCodesError(f"{path}: nothing to save; expected at least one view to be fused first")
            learnt, fused, scene = self._learnt, self.num_fused, self.scene
            known, names = self._live.state(), {**self._classes.names, **self.class_names}  # of those not yet seen, too
            state = replace(known, num_fused=fused, class_names=names, learnt=learnt, per_view=self._PER_VIEW)
        state.save(path, scene.digest)
        return learnt.num_views if learnt is not None else fused

    def load(self, path: str | os.PathLike[str], within: Path | None = None) -> int:
        """Replace all that is known by a saved state; return the number of views in its votes or codes.

        Raises
        ------
        StateFileError
            The file is missing or damaged, or has more classes than there are names for, or without names than there
            may be, or other names than were given, or objects of a `PerViewSession`. Nothing has changed.
        StateMismatchError
            It belongs to another scene. Nothing has changed.
        PathNotAllowedError
            The file lies outside the folder `within`, links followed. Nothing has changed.
        """
        state = self._read_state(Path(path), within)
        self._check_classes(path, state)
        votes = self._no_votes(state.num_classes)
        votes.adopt(state)  # To cast votes of old anew takes long.
        votes.resize(max(state.num_classes, self._classes.least))  # Out of memory here, nothing is forgotten.
        votes.keep_last(self.max_views)
        with self._lock:
            self._forget(state.class_names, votes, state.num_fused)
            self._learnt = state.learnt
        return state.learnt.num_views if state.learnt is not None else state.num_fused

    def prepare(self, settings: RefineSettings) -> None:
        """Find what the first request needs of the scene, in a thread of its own: its digest, and all neighbours."""

        def find(scene: GaussianScene) -> None:
            _ = scene.digest  # It is kept.
            find_neighbours(scene, settings.k)

        threading.Thread(target=find, args=(self.scene,), name="neighbours").start()

    def retire(self) -> None:
        """Begin another `era`, so that what is still being fused or learnt is refused; what is known stays."""
        self._era = object()

    def reset(self) -> int:
        """Forget votes, views, class probabilities and classes that turned up; return how many views were forgotten."""
        with self._lock:
            dropped = self.num_fused
            self.rejected.clear()
            self._forget({}, self._no_votes(self._classes.least))
        return dropped

    def _forget(self, class_names: Mapping[int, str], votes: VoteLearner, num_fused: int = 0) -> None:
        """Replace all that is known by names of classes and the votes of a state, or of none."""
        self._classes.reset(class_names)
        self._live, self._cameras, self.num_fused = votes, [], num_fused
        self._learnt = self._segmented = None
        self._version += 1
        self.retire()

    def _no_votes(self, num_classes: int) -> VoteLearner:
        # Views are rendered again by `learn`; to keep them prepared would take far more memory than their masks.
        return VoteLearner(self.scene, num_classes, device=self.device, memory_budget=0)

    def _read_state(self, path: Path, within: Path | None) -> State:
        return without_groups(State.load(path, self.scene.digest, len(self.scene), within), self.device)

    def _check_classes(self, path: str | os.PathLike[str], state: State) -> None:
        """Raise `StateFileError` if a state has too many classes, other names than were declared, or objects."""
        if state.per_view and not self._PER_VIEW:
            raise StateFileError(f"{path}: {OBJECTS_OF_ONE_SESSION}; expected classes, or a session with ids per-view")
        self._classes.check_state(state, path, self._live)

    def _posed_views(self) -> list[View]:
        """List the views that are kept, posed in the scene as it is now."""
        return list(self._live.views.values())

    def _carrier(self) -> Callable[[Learnt], Learnt]:
        """Return a function that fits what is learnt of the session as it is now to what it is when that is called."""
        return lambda learnt: learnt

    def _grow_for(self, view: View) -> None:
        """Add classes up to the largest label of a view, unless they were declared."""
        if not self._classes.declared and view.has_mask and view.largest_label >= self._live.num_classes:
            found = f"view '{view.name}': {self._LABEL} {view.largest_label}"
            self._classes.check_label(view.largest_label, self._live, found, self._REMEDY)
            self._live.resize(view.largest_label + 1)

    def _drop_old_views(self) -> None:
        self._live.keep_last(self.max_views)
