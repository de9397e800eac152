"""`split.json`: which views of a dataset are learnt from, and which are kept for testing."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection
from pathlib import Path

from gsseg_core.errors import SplitFileError
from gsseg_core.files.input_files import is_there
from gsseg_core.files.json_files import kind_of, read_json
from gsseg_core.text import clipped, quoted


def read_split(path: Path, views: Collection[str], within: Path | None = None) -> dict[str, list[str]]:
    """Read which views are for training and which for testing: stems by "train" and "test"; without a file, all train.

    Raises
    ------
    SplitFileError
        The file is broken, names a view without a camera, or one twice.
    PathNotAllowedError
        Links lead out of the folder `within`.
    """
    if not is_there(path, SplitFileError):
        return {"train": list(views), "test": []}
    content = read_json(path, SplitFileError, within)
    if not isinstance(content, dict):
        raise SplitFileError(f'{path}: holds {kind_of(content)}; expected {{"train": [stems], "test": [stems]}}')
    if "train" not in content:
        raise SplitFileError(f'{path}: no "train" in it; expected {{"train": [stems], "test": [stems]}}')
    split = {name: content.get(name, []) for name in ("train", "test")}
    for name, stems in split.items():
        if not isinstance(stems, list) or not all(isinstance(stem, str) for stem in stems):
            raise SplitFileError(f'{path}: "{name}" is {clipped(stems)}; expected a list of image stems')
        unknown_stems = [stem for stem in stems if stem not in views]
        if unknown_stems:
            raise SplitFileError(
                f'{path}: "{name}" names views without a camera ({len(unknown_stems)}, the first '
                f"{quoted(unknown_stems[0])}); expected stems such as {quoted(next(iter(views)))}"
            )
    stem, count = Counter(split["train"] + split["test"] or [""]).most_common(1)[0]
    if count > 1:
        raise SplitFileError(f"{path}: stem {quoted(stem)} occurs {count} times; expected each stem once, in one split")
    return split
