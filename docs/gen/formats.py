"""Tables what gsseg opens, from the tables of the code: python docs/gen/formats.py.

A table of docs/formats.md stands between `<!-- NAME -->` and `<!-- end -->`; a test says when it is not the code's.
"""

from __future__ import annotations

import re
from pathlib import Path

from gsseg_core.data.camera_formats.table import CAMERA_FORMATS
from gsseg_core.data.mask_formats.table import MASK_FORMATS
from gsseg_core.scene.lens import LENS_MODELS
from gsseg_core.scene.scene_formats import SCENE_FORMATS

PAGE = Path(__file__).parents[2] / "docs/formats.md"


def scenes() -> str:
    """Table the formats of scenes, and what each keeps of a Gaussian."""
    rows = [
        f"| {known.name} | {', '.join(f'`{suffix}`' for suffix in known.suffixes)} | {known.keeps} |"
        for known in SCENE_FORMATS
    ]
    return "\n".join(["| format | files | what it keeps |", "|---|---|---|", *rows])


def masks() -> str:
    """Table the formats of masks."""
    rows = [f"| {known.name} | {known.looked_for} | {known.ids} | {known.on_top} |" for known in MASK_FORMATS]
    return "\n".join(["| format | recognised by | ids | on top, where shapes overlap |", "|---|---|---|---|", *rows])


def lenses() -> str:
    """Table the lens models."""
    rows = [
        f"| {known.name} | {known.projection.value} | {', '.join(known.coefficients) or 'none'} | {known.ros} |"
        for known in LENS_MODELS
    ]
    header = "| in files of COLMAP and nerfstudio | distance of a ray at an angle a | coefficients | in ROS |"
    return "\n".join([header, "|---|---|---|---|", *rows])


def cameras() -> str:
    """Table the formats of cameras."""
    rows = [f"| {known.name} | {known.looked_for} |" for known in CAMERA_FORMATS]
    return "\n".join(["| format | recognised by |", "|---|---|", *rows])


TABLES = {"scenes": scenes, "masks": masks, "cameras": cameras, "lenses": lenses}


def page() -> str:
    """Make the page with its tables as they are today."""
    text = PAGE.read_text(encoding="utf-8")
    for name, table in TABLES.items():
        made = table() + "\n"
        text = re.sub(rf"(?<=<!-- {name} -->\n).*?(?=<!-- end -->)", lambda _, made=made: made, text, flags=re.DOTALL)
    return text


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
