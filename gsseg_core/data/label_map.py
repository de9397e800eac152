"""Label maps: a file that renames, merges and ignores the classes of masks.

    {"armchair": "chair", "stool": "chair", "17": "wall", "person": null, "*": "background"}

A key is an id or the name of a class that the masks have (a name stands for all classes of that name), or "*" for all
that no other key names; without it, those stay as they are. A value is the new name: classes that are given the same
one, or the one of a class that stays, are merged. null, or "ignore", makes pixels unknown.

Classes merged into one that stays get its id, others the smallest of theirs. 0 is the background and stays free for it:
where an object has it, `{"0": "floor"}`, that gets the next id after the largest; `{"background": null}` makes the rest
unknown.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gsseg_core.data.class_names import BACKGROUND_NAME, check_class_name, id_of, listed, meant_by
from gsseg_core.data.label_images import UNKNOWN
from gsseg_core.errors import LabelMapError
from gsseg_core.files.json_files import read_json
from gsseg_core.files.limits import MAX_LABEL
from gsseg_core.files.yaml_files import read_yaml
from gsseg_core.text import quoted

_OTHERS = "*"
_IGNORE = "ignore"
_EXPECTED = 'an object such as {"armchair": "chair", "17": "wall", "person": null}'


@dataclass(frozen=True)
class LabelMap:
    """What becomes of the ids of masks."""

    new_ids: Mapping[int, int]  # `UNKNOWN` where it is ignored
    class_names: Mapping[int, str]  # ascending, the background included


def read_label_map(
    path: str | os.PathLike[str], class_names: Mapping[int, str], within: Path | None = None
) -> LabelMap:
    """Read a label map, JSON or (.yaml, .yml) YAML, for masks with these classes.

    Raises `LabelMapError` where it is missing or broken or names a class that there is not, `PathNotAllowedError` where
    it lies outside `within`, `SettingsError` where it is YAML and PyYAML is not installed.
    """
    return map_labels(read_new_names(path, within), class_names, str(path))


def read_new_names(path: str | os.PathLike[str], within: Path | None = None) -> dict[str, str | None]:
    """Read what a label map says, new names (None: ignored) by id, name or "*"; raises as `read_label_map` does."""
    path = Path(path)
    is_yaml = path.suffix.lower() in (".yaml", ".yml")
    content: Any = (read_yaml if is_yaml else read_json)(path, LabelMapError, within)
    if not isinstance(content, dict):
        raise LabelMapError(f"{path}: holds no object; expected {_EXPECTED}")
    named = {key: new for key, new in content.items() if type(key) in (str, int)}
    who = f"{path}: gives"
    given = {
        str(key): None if new in (None, _IGNORE) else check_class_name(new, LabelMapError, f"{who} {quoted(key)}")
        for key, new in named.items()
    }
    if len(given) < len(content):
        raise LabelMapError(f"{path}: has keys that are neither names nor ids; expected {_EXPECTED}")
    return given


def map_labels(given: Mapping[str, str | None], class_names: Mapping[int, str], source: str) -> LabelMap:
    """Apply what a label map says, new names (None: ignored) by id, name or "*", to classes.

    Raises `LabelMapError` where it names a class that there is not, or would need more ids than there are labels.
    """
    renamed: dict[int, str | None] = dict.fromkeys(class_names, given[_OTHERS]) if _OTHERS in given else {}
    # Ids after names, since an id says which of several classes of one name is meant.
    named = (key for key in given if key != _OTHERS)
    for key in sorted(named, key=lambda key: id_of(key, class_names) is not None):
        meant = meant_by(key, class_names)
        if not meant:
            known = listed(f"{k} ({name})" for k, name in class_names.items())
            raise LabelMapError(f"{source}: names {quoted(key)}, which the masks do not have; expected some of {known}")
        renamed.update(dict.fromkeys(meant, given[key]))
    new_ids, names, of_name = {}, {0: BACKGROUND_NAME}, {BACKGROUND_NAME: 0}
    for k, name in class_names.items():  # What stays takes its place before others join it.
        if k not in renamed:
            new_ids[k] = k
            names[k] = name
            of_name.setdefault(name, k)
    following = max(class_names, default=0)
    for k, new_name in sorted(renamed.items()):
        if new_name is None:
            new_ids[k] = UNKNOWN
            continue
        if new_name not in of_name:
            following += k == 0
            of_name[new_name] = following if k == 0 else k
        new_ids[k] = of_name[new_name]
        names[of_name[new_name]] = new_name
    if following > MAX_LABEL:
        raise LabelMapError(f"{source}: needs the id {following} for class 0; expected at most {MAX_LABEL}")
    return LabelMap(new_ids, dict(sorted(names.items())))
