"""The place of masks, a file or a folder, and what formats are recognised by: names of views, and what files hold."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path, PureWindowsPath
from typing import TypeVar

from gsseg_core.errors import MaskFormatError
from gsseg_core.files.input_files import IMAGE_SUFFIXES, list_below, list_folder, open_expected, read_input
from gsseg_core.files.json_files import read_json
from gsseg_core.text import clipped, composed

T = TypeVar("T")

SUPERVISES = "supervises.json"
"""Which classes were looked for in gsseg's own label images; see `data/mask_files.py`."""

_SUFFIXES = IMAGE_SUFFIXES | {".json", ".npz", ".txt", ".xml"}
_MARK = re.compile(r"[_.-](?:masks?|labels?|seg|segmentation)$", re.IGNORECASE)
_RENAMED = re.compile(  # by Roboflow, by Label Studio, by Grounded SAM 2
    r"_(?:bmp|jpe?g|png|tiff?|webp)\.rf\.[0-9a-f]+$|^[0-9a-f]{8}-|^masks?[_-]", re.IGNORECASE
)
_FOLDERS = 4  # above a file that may be part of its view's name
_PEEKED = 4096


def view_of(name: str, stems: Collection[str]) -> str | None:
    """Find the view that a file of masks belongs to, by its name; None if there is none.

    `frame_1.png`, `frame_1.jpg.png`, `frame_1_mask.png`, `mask_frame_1.png`, `images/frame_1.jpg` and the like all
    belong to `frame_1`, and `left/1.png` to `left_1`, unless there is a view that is closer to the name.
    """
    candidates = possible_stems(name)
    for _ in range(4):
        tried = list(dict.fromkeys(s for c in candidates for s in (c, _MARK.sub("", c), _RENAMED.sub("", c))))
        for stem in tried:
            if stem in stems:
                return stem
        parts = [name.rpartition(".") for name in tried]
        candidates = [stem for stem, dot, suffix in parts if dot + suffix.lower() in _SUFFIXES]
    return None


def possible_stems(name: str) -> list[str]:
    """List the names that `read_cameras` may give a file: its own, alone and after those of the folders above it."""
    parts = PureWindowsPath(composed(name[-1000:])).parts  # takes both kinds of slash
    return ["_".join(parts[-count:]) for count in range(1, min(len(parts), 1 + _FOLDERS) + 1)]


@dataclass(frozen=True, eq=False)
class Place:
    """The file or folder that `--labels` names; it and all below must lie in `within`, if that is given."""

    path: Path
    stems: frozenset[str]
    within: Path | None = None
    depth: int = _FOLDERS  # of folders in it that may hold masks of views
    unmatched: list[str] = field(default_factory=list)  # names that belong to no view, for messages

    @cached_property
    def entries(self) -> list[Path]:
        """Files and folders in it, by `listed`, without gsseg's own `supervises.json`; none if it is a file."""
        return [path for path in self.listed(self.path) if path.name != SUPERVISES]

    @property
    def folders(self) -> list[Path]:
        """Folders among its entries."""
        return [path for path in self.entries if path.is_dir()]

    def view_of(self, name: str) -> str | None:
        """Find the view that a name belongs to by the function `view_of`, and keep names that belong to none."""
        view = view_of(name, self.stems)
        if view is None:
            self.unmatched.append(name)
        return view

    def by_view(self, suffix: str) -> dict[str, Path]:
        """Find the files with a suffix that belong to a view, by view: those in a folder, or the file itself.

        In a folder of folders alone, as images may lie, they are those of `views_below`. If the place is a file and
        there is one view only, it belongs to that view, whatever its name. Raises `MaskFormatError` where a view has
        two.
        """
        files = [path for path in self.entries or [self.path] if path.suffix.lower() == suffix and not path.is_dir()]
        if len(self.stems) == 1 and files == [self.path]:
            return dict.fromkeys(self.stems, self.path)
        if self._has_masks:
            return self.views(((path.name, path) for path in files), self.path)
        return self.views_below(suffix)

    def views_below(self, *suffixes: str) -> dict[str, Path]:
        """Find the files that belong to views in folders as their images are, `depth` levels down: `left/1.png`.

        Where a view has several of those, they are something else, one for each class perhaps, and there is none.
        """
        found: dict[str, Path] = {}
        for path in list_below(self.path, MaskFormatError, self.within, self.depth):
            view = view_of(str(path.relative_to(self.path)), self.stems) if path.suffix.lower() in suffixes else None
            if view in found:
                return {}
            if view is not None:
                found[view] = path
        return found

    @cached_property
    def _has_masks(self) -> bool:
        """Whether masks are in it itself: something that is called after a view, or one file for all views."""
        of_views = any(view_of(path.name, self.stems) for path in self.entries)
        return of_views or not self.entries or any(self.only(suffix) for suffix in (".json", ".xml"))

    def views(self, named: Iterable[tuple[str, T]], where: Path) -> dict[str, T]:
        """Find the views that names belong to, and what has these names; raises as `by_view` does, of `where` it is."""
        found: dict[str, tuple[str, T]] = {}
        for name, one in named:
            view = self.view_of(name)
            if view in found:
                raise MaskFormatError(
                    f"{where}: has {clipped(found[view][0])} and {clipped(name)} for view '{view}'; expected one mask "
                    "per view"
                )
            if view is not None:
                found[view] = name, one
        return {view: one for view, (_, one) in found.items()}

    @cached_property
    def sample(self) -> tuple[Path, object]:
        """The JSON file by which formats are told apart, with what it holds, None where there is none.

        It is the first of a view, or the only one. An empty list is passed over: it says that nothing was found in an
        image, and nothing of the format.
        """
        path, content = self.path, None
        for path in self.by_view(".json").values() or filter(None, [self.only(".json")]):
            content = self.json(path)
            if content != []:
                break
        return path, content

    def sample_has(self, **fields: type) -> bool:
        """Tell whether the sample is an object with these fields, each of a type; `object` is any."""
        content = self.sample[1]
        return isinstance(content, dict) and all(
            key in content and isinstance(content[key], kind) for key, kind in fields.items()
        )

    def only(self, suffix: str) -> Path | None:
        """Find the only file with a suffix, the place itself perhaps; None where single views have masks beside it."""
        files = [path for path in self.entries or [self.path] if path.suffix.lower() == suffix and path.is_file()]
        of_views = (path for path in self.entries if path.suffix.lower() != ".xml" and view_of(path.name, self.stems))
        return files[0] if len(files) == 1 and next(of_views, None) is None else None

    def holds(self, path: Path, pattern: bytes) -> bool:
        """Tell whether a file begins with a pattern, a regular expression, within its first 4096 bytes."""
        with open_expected(path, MaskFormatError, within=self.within) as file:
            return re.match(pattern, file.read(_PEEKED)) is not None

    def listed(self, folder: Path) -> list[Path]:
        """List what is in a folder, by `list_folder`."""
        return list_folder(folder, MaskFormatError, self.within)

    def json(self, path: Path) -> object:
        """Read a JSON file, by `read_json`."""
        return read_json(path, MaskFormatError, self.within)

    def read(self, path: Path) -> bytes:
        """Read a file; `MaskFormatError` if it cannot be read, or is larger than any such file is."""
        return read_input(path, MaskFormatError, self.within)

    def text(self, path: Path) -> str:
        """Read a file of text; raises as `read` does, or if it is none."""
        try:
            return self.read(path).decode("utf-8-sig")
        except UnicodeDecodeError as cause:
            raise MaskFormatError(f"{path}: is not UTF-8 text ({cause.reason}); expected text") from cause
