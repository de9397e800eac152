"""The table of mask formats of other programs: how each is recognised, and what reads it.

gsseg's own masks, a label image, probabilities or detections per view, are not in it: see `data/mask_files.py`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from gsseg_core.data.class_names import BACKGROUND_NAME
from gsseg_core.data.label_images import mask_header
from gsseg_core.data.mask_files import CLASS_ID, DETECTIONS, mask_files, masks_below
from gsseg_core.data.mask_formats.coco import is_coco, read_coco
from gsseg_core.data.mask_formats.cvat import is_cvat, read_cvat
from gsseg_core.data.mask_formats.eiseg import is_eiseg, read_eiseg
from gsseg_core.data.mask_formats.grounded_sam import is_grounded_sam, parse_grounded_sam
from gsseg_core.data.mask_formats.isat import is_isat, parse_isat
from gsseg_core.data.mask_formats.labelme import is_labelme, parse_labelme
from gsseg_core.data.mask_formats.masks import MaskSet
from gsseg_core.data.mask_formats.named import read_named
from gsseg_core.data.mask_formats.place import Place
from gsseg_core.data.mask_formats.sam import METADATA, is_sam_folder, is_sam_json, read_sam_folder, read_sam_json
from gsseg_core.data.mask_formats.sam2 import is_sam2, read_sam2
from gsseg_core.data.mask_formats.yolo import is_yolo, read_yolo
from gsseg_core.errors import MaskFormatError
from gsseg_core.files.input_files import reason
from gsseg_core.text import quoted


@dataclass(frozen=True)
class MaskFormat:
    """A format of masks: what messages call it, by what it is recognised, and how it is read.

    `recognise` and `read` get the place that `--labels` names. `looked_for` is what marks the format, `ids` what the
    labels are, and `on_top` what is seen where shapes overlap, all for messages and docs/formats.md. `own` finds what
    in such a place may be gsseg's own masks, among which nobody could tell which are meant.
    """

    name: str
    recognise: Callable[[Place], bool]
    read: Callable[[Place], MaskSet]
    looked_for: str
    ids: str
    on_top: str
    own: Callable[[Place], Mapping[str, Path]] = masks_below


LABEL_IMAGES = "label images"
"""What messages call gsseg's own masks; those of Gaussian Grouping, DEVA, SAM 2 and DAVIS are the same."""

MASK_FORMATS = [
    MaskFormat(
        "COCO", is_coco, read_coco, "a JSON file with `images`, `annotations` and `categories`",
        "those of the categories", "the last annotation",
    ),
    MaskFormat(
        "SAM JSON", is_sam_json, read_sam_json, "`<stem>.json`, a list of masks with RLE and `predicted_iou`; SA-1B",
        "per view", "the smaller mask",
    ),
    MaskFormat(
        "SAM folders", is_sam_folder, read_sam_folder, "`<stem>/` with `0.png`, `1.png` ... and `metadata.csv`",
        "per view", "the smaller mask",
    ),
    MaskFormat(
        "SAM 2 video", is_sam2, read_sam2, "`001/<stem>.png`, a folder for each object",
        "those of the objects", "the smaller id", own=mask_files,  # Its folders are of objects.
    ),
    MaskFormat(
        "LabelMe", is_labelme, partial(read_named, parse=parse_labelme), "`<stem>.json` with `shapes` and `imagePath`",
        "from 1, names from A to Z", "the last shape",
    ),
    MaskFormat(
        "ISAT (LERF)", is_isat, partial(read_named, parse=parse_isat), "`<stem>.json` with `info` and `objects`",
        "from 1, names from A to Z", "the higher `layer`",
    ),
    MaskFormat(
        "Grounded SAM 2", is_grounded_sam, partial(read_named, parse=parse_grounded_sam),
        "`<stem>.json` with `annotations` and `img_width`", "from 1, names from A to Z", "the smaller mask",
    ),
    MaskFormat(
        "CVAT", is_cvat, read_cvat, "an XML file of CVAT for images 1.1",
        "from 1, in the order of the task's labels", "the higher `z_order`",
    ),
    MaskFormat(
        "YOLO", is_yolo, read_yolo, "`<stem>.txt` with classes and outlines; names in `data.yaml`",
        "one more than the class", "the last line",
    ),
    MaskFormat(
        "EISeg", is_eiseg, read_eiseg, "`<stem>.png` or `<stem>.json`, and `autosave_label.txt`",
        "those of the labels", "the last polygon", own=lambda place: {},  # It has label images itself.
    ),
]  # fmt: skip
"""All formats; a new one is added here."""

# JSON that is not read, by fields of its first record: whose it is, and what to do.
_FOREIGN = [
    ({"annotations", "data"}, "Label Studio's own: export it as COCO"),
    ({"annotation_id", "lead_time"}, "Label Studio's own: export it as COCO"),
    ({"objects", "size"}, "Supervisely's: export it as COCO"),
    ({"filename", "regions"}, "VIA's: export it as COCO"),
    ({"image_id", "category_id"}, "COCO's results alone: expected a whole file, with `images` and `categories`"),
]


def open_masks(place: Place) -> MaskSet | None:
    """Open the masks of another program, recognised by what they hold; None for gsseg's own, or where there are none.

    Raises `MaskFormatError` where they are of no known format, or may be of several, are broken, or of no view;
    `PathNotAllowedError` where they lie outside `Place.within`; `SettingsError` where a library that is needed is not
    installed.
    """
    path = place.path
    try:
        if not path.exists():
            return None
        found = [known for known in MASK_FORMATS if known.recognise(place)]
        names = [known.name for known in found]
        own = (file for known in found for file in known.own(place).values())
        if any(_is_own(file, place) for file in own):  # Photos beside annotations are none.
            names.append(LABEL_IMAGES)
        if len(names) > 1:
            raise MaskFormatError(
                f"{path}: may be masks of {' or '.join(names)}; expected those of one program: name the file itself, "
                "or a folder without the others"
            )
        if not found and (unknown := _unknown(place)):
            hint = _foreign_hint(place.sample[1])
            raise MaskFormatError(
                f"{unknown}: is not a file of masks in a known format{hint}; gsseg reads {known_formats()}"
            )
        masks = found[0].read(place) if found else None
    except RecursionError as cause:
        raise MaskFormatError(f"{path}: is nested too deep; expected masks") from cause
    except OSError as cause:
        raise MaskFormatError(f"{path}: cannot be read ({reason(cause)}); expected masks") from cause
    if masks is not None and not masks.views:
        names_of_views = ", ".join(map(quoted, sorted(place.stems)[:3]))
        others = f" but of {quoted(place.unmatched[-1])}" if place.unmatched else ""
        raise MaskFormatError(
            f"{path}: has masks of no view{others}; expected names of views, such as {names_of_views}"
        )
    if masks is None or masks.class_names is None:
        return masks and replace(masks, format=found[0].name)
    names_by_id = {0: BACKGROUND_NAME, **masks.class_names}
    return replace(masks, format=found[0].name, class_names=dict(sorted(names_by_id.items())))


def known_formats() -> str:
    """List all formats for messages."""
    own = f"{LABEL_IMAGES} (a folder of <stem>.png)"
    return ", ".join([own, *(f"{known.name} ({known.looked_for.replace('`', '')})" for known in MASK_FORMATS)])


def _foreign_hint(content: object) -> str:
    """Say whose a JSON file is that is not read, and what to do, if its first record tells."""
    if content == []:
        return ", but an empty list, and so are those of the other views: nothing was found in any"
    listed = content if isinstance(content, list) else [content, *content.values()] if isinstance(content, dict) else []
    fields = [record.keys() for record in listed[:2] if isinstance(record, dict)]
    return next((f", but {told}" for marks, told in _FOREIGN if any(marks <= keys for keys in fields)), "")


def _unknown(place: Place) -> Path | None:
    """Find a file of no known format that is meant as masks: the place itself, or, without gsseg's own, a view's."""
    if not place.path.is_dir():
        return place.path
    described = next(iter([*place.by_view(".json").values(), *place.by_view(".txt").values()]), None)
    return None if described is None or masks_below(place) else described


def _is_own(path: Path, place: Place) -> bool:
    """Whether what has the name of a view is a mask of gsseg's own kinds."""
    if path.is_dir():
        ids = [file.stem for file in place.listed(path) if file.suffix.lower() in DETECTIONS]
        return not (path / METADATA).exists() and any(re.fullmatch(CLASS_ID, stem) for stem in ids)
    with suppress(MaskFormatError):
        return path.suffix.lower() == ".npz" or bool(mask_header(path, place.within))
    return False
