"""What labels of masks mean: the segmenter's names for them, renamed or ignored, and the classes of the scene.

A mask's labels have names: those that come with it, those of `label_info`, or those of the parameter class_names. A
label map says what becomes of a name, or that its pixels are unknown. Then names are looked up among the classes of the
scene. So another segmenter, which numbers its classes in another way, goes on where the last one ended.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from gsseg_core.data.class_names import BACKGROUND_NAME, class_name, listed
from gsseg_core.data.label_images import UNKNOWN
from gsseg_core.data.label_map import map_labels
from gsseg_core.data.soft_masks import SeenLabels
from gsseg_core.live.session import LiveSession

UNLABELED = "unlabeled"
"""What vision_msgs calls pixels without a label, in whichever case."""


@dataclass(frozen=True)
class NewNames:
    """What a label map says: new names, None where pixels become unknown, by id, name or "*" of the segmenter."""

    given: Mapping[str, str | None]
    source: str

    def of(self, name: str) -> str | None:
        """Look up what becomes of a name."""
        return self.given[name] if name in self.given else self.given.get("*", name)

    def names(self, labels: Mapping[int, str]) -> dict[int, str | None]:
        """Look up what becomes of all labels of a segmenter; raises `LabelMapError` if a key is none of them."""
        found = map_labels(self.given, labels, self.source)
        return {k: None if new == UNKNOWN else found.class_names[new] for k, new in found.new_ids.items()}


class LabelSpace:
    """Turns labels of masks into classes of a session. Its methods may be called from any thread.

    `max_classes` holds without `class_names`: labels that have no name may be so many.
    """

    def __init__(self, class_names: tuple[str, ...], new_names: NewNames | None, max_classes: int) -> None:
        self._class_names, self._new_names, self._max_classes = dict(enumerate(class_names)), new_names, max_classes
        made = [] if new_names is None else [name for name in new_names.given.values() if name is not None]
        known = dict.fromkeys(class_names)
        # The classes by id, if they are declared: `class_names`, and after them what else the label map makes.
        self.classes = dict(enumerate(known | dict.fromkeys(made))) if class_names else {}
        self.heard: dict[int, str] | None = None  # the names of labels that `label_info` told last
        self._said: set[str] = set()  # Names that are none of the classes: detections bring others with every image.

    def hear(self, names: Mapping[int, str]) -> bool:
        """Take in the names of labels, and return whether they are news."""
        if names == self.heard:
            return False
        self.heard = dict(names)
        return True

    def classes_of(
        self,
        seen: SeenLabels,
        names: Mapping[int, str] | None,
        session: LiveSession,
        source: str,
        say: Callable[[str], None],
    ) -> SeenLabels:
        """Turn the labels of a mask into classes of the session, which gets new ones unless they are declared.

        `names` are those that came with the mask, which messages call `source`; `say` is told what a person should
        know. Raises `LabelMapError`: the label map names a class that the segmenter does not have; `UnknownLabelError`:
        the mask holds a label that has no name.
        """
        if names is not None:
            new_names = {k: self._new_names.of(name) if self._new_names else name for k, name in names.items()}
            return seen.relabelled(self._numbered(new_names, session, source, say, keep_numbers=False), source)
        if self.heard is None and self._new_names is None:
            return seen
        return seen.relabelled(self._ids(seen, session, source, say), source)

    def ignored(self, names: Mapping[int, str]) -> set[int]:
        """Labels whose pixels become unknown."""
        return {k for k, name in names.items() if self._new_names is not None and self._new_names.of(name) is None}

    def _ids(self, seen: SeenLabels, session: LiveSession, source: str, say: Callable[[str], None]) -> dict[int, int]:
        """Find the ids of the session's classes for the labels of masks that come without names."""
        labels, new_names = self.heard or self._class_names, self._new_names
        if new_names is not None and not labels:
            return self._ids_by_number(new_names, session, {*np.unique(seen.concerned).tolist()})
        labels = {0: BACKGROUND_NAME, **labels}
        names = dict(labels) if new_names is None else new_names.names(labels)
        labeled = {k: None if name is None or name.lower() == UNLABELED else name for k, name in names.items()}
        return self._numbered(labeled, session, source, say)

    def _ids_by_number(self, new_names: NewNames, session: LiveSession, present: set[int]) -> dict[int, int]:
        """Apply the label map to labels that have no names; those in the mask that stay are no class with a name."""
        labels = {k: class_name({0: BACKGROUND_NAME}, k) for k in range(self._max_classes)}
        found = map_labels(new_names.given, labels, new_names.source)
        names = {k: name for k, name in found.class_names.items() if name != labels.get(k) or k in present}
        ids = session.number_classes(names)
        return {k: ids.get(new, new) for k, new in found.new_ids.items()}

    def _numbered(
        self,
        names: Mapping[int, str | None],
        session: LiveSession,
        source: str,
        say: Callable[[str], None],
        *,
        keep_numbers: bool = True,
    ) -> dict[int, int]:
        """Ids of the session's classes by label, `UNKNOWN` where it has no name."""
        named = {k: BACKGROUND_NAME if n.lower() == BACKGROUND_NAME else n for k, n in names.items() if n is not None}
        others = sorted({*named.values()} - {*self.classes.values(), BACKGROUND_NAME} - self._said)
        if others and self.classes:
            self._said.update(others)
            say(
                f"{source}: its classes {listed(others)} are not among class_names, and become background; a label map "
                "can make them unknown (null) or others"
            )
        return {**dict.fromkeys(names, UNKNOWN), **session.number_classes(named, keep_numbers=keep_numbers)}
