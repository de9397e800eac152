"""Views as a run learnt from them: with the masks, and in the classes, that its `report.json` names."""

from __future__ import annotations

from collections import ChainMap
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from gsseg_core.data.dataset import Dataset
from gsseg_core.data.label_images import PER_VIEW, UNKNOWN
from gsseg_core.data.label_map import LabelMap
from gsseg_core.data.view import View
from gsseg_core.errors import LabelMapError, StateFileError
from gsseg_core.files.json_files import read_json
from gsseg_core.files.limits import MAX_LABEL

_IGNORED = dict.fromkeys(range(MAX_LABEL + 1), UNKNOWN)


@dataclass(frozen=True)
class LearntFrom:
    """What the `report.json` of a run says of the views that it learnt from; what it does not say is the default."""

    report: Path | None = None
    reliability: Mapping[str, float] = field(default_factory=dict)  # how far each can be trusted, in [0, 1], by name
    labels: str = "labels"
    label_map: str | None = None
    objects: Mapping[str, Mapping[int, int]] | None = None  # of the ids of each view, where these are its own

    @classmethod
    def read(cls, report: Path) -> LearntFrom:
        """Read a report, if there is one; `StateFileError` if the file is there and no report."""
        if not report.is_file():
            return cls()
        content: Any = read_json(report, StateFileError)
        try:
            entries = content["views"].get("reliability", [])
            reliability = {str(e["name"]): float(e["reliability"]) for e in entries if e["reliability"] is not None}
            settings, objects = content.get("settings", {}), None
            labels, label_map = settings.get("labels", cls.labels), settings.get("label_map")
            if not isinstance(labels, str) or not isinstance(label_map, str | None):
                raise TypeError(f"masks are {labels!r}, renamed by {label_map!r}")
            if settings.get("ids") == PER_VIEW:
                found = content["ids"]["views"].items()
                objects = {name: {int(i): int(k) for i, k in one["objects"].items()} for name, one in found}
                if not all(0 <= n <= MAX_LABEL for ids in objects.values() for n in (*ids, *ids.values())):
                    raise ValueError("ids or objects that are no labels")
            return cls(report, reliability, labels, label_map, objects)
        except (KeyError, TypeError, AttributeError, ValueError) as error:
            raise StateFileError(
                f"{report}: no report of a run ({error}); expected the report.json of `gsseg segment`"
            ) from error

    def dataset(self, root: str) -> Dataset:
        """Open a dataset with the masks of the run; raises what `Dataset` does."""
        try:
            return Dataset(root, self.labels, label_map=self.label_map)
        except LabelMapError as error:
            raise LabelMapError(f"{error}; {self.report} says that the run took it: start where that was") from error

    def views(self, dataset: Dataset) -> list[View]:
        """List the train views that have masks, which are in the classes that the run learnt."""
        views = [view for view in dataset.views("train") if view.has_mask]
        if self.objects is None:
            return views
        maps = {name: LabelMap(ChainMap(dict(ids), _IGNORED), {}) for name, ids in self.objects.items()}
        return [
            replace(view, class_names=None, numbering=None, label_map=maps[view.name])
            for view in views
            if view.name in maps
        ]
