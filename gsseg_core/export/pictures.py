"""Pictures for people: a palette, label overlays, contact sheets and legends, all as (H, W, 3) uint8 RGB arrays."""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from unicodedata import combining, normalize

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from gsseg_core.data.label_images import run_text
from gsseg_core.files.atomic import write_atomically
from gsseg_core.kernels.compiler import kernel
from gsseg_core.text import composed, printable

BACKGROUND = (58, 60, 66)  # colour of label 0, a dark neutral grey
PAPER, INK, FAINT_INK = (255, 255, 255), (32, 34, 38), (128, 131, 138)
FILL = 0.55  # share of a label's colour in an overlaid pixel
CELL_PX = 480  # longest side of the pictures of a contact sheet, which is looked at as a whole
LEGEND_ROWS = 24  # lines in a column of a legend, at most, unless it would become wider than high
_SEEN_WITHOUT = (  # What who lacks red, or green, sees of linear RGB: Machado et al. 2009, severity 1.
    ((0.152286, 1.052583, -0.204868), (0.114503, 0.786281, 0.099216), (-0.003882, -0.048116, 1.051998)),
    ((0.367322, 0.860646, -0.227968), (0.280085, 0.672501, 0.047413), (-0.011820, 0.042940, 0.968881)),
)
_LONGEST = 400  # characters of a name that are drawn at most; no picture is wide enough for more


@lru_cache(maxsize=8)
def palette(num_classes: int) -> np.ndarray:
    """Colours for K labels, as different from each other as they can be: (K, 3) uint8, read-only.

    Row 0 is `BACKGROUND`. Every other colour is the one of a fixed set that lies farthest, in OKLab, from all
    earlier ones, so the colours of a smaller palette are the first ones of a larger one. Eyes that lack red or green
    are to tell them apart, too: how far two lie from each other is the least of the distances that such eyes see, each
    trebled, and of that to others. Beyond about 1,500 classes they start to repeat.
    """
    levels = np.arange(15, 256, 16)
    candidates = np.stack(np.meshgrid(levels, levels, levels, indexing="ij"), axis=-1).reshape(-1, 3)
    looks = _looks(candidates)
    light, chroma = looks[0, 0], np.hypot(looks[0, 1], looks[0, 2])
    pleasant = (light > 0.5) & (light < 0.9) & (chroma > 0.07) & (chroma < 0.21)
    candidates, looks = candidates[pleasant], looks[..., pleasant]

    chosen = [int(np.argmin(np.abs(candidates - np.array([79, 143, 239])).sum(axis=1)))]  # a clear blue first
    distance = _distance(looks, _looks(np.array([BACKGROUND])))
    while len(chosen) < min(num_classes - 1, len(candidates)):
        distance = np.minimum(distance, _distance(looks, looks[..., chosen[-1:]]))
        chosen.append(int(np.argmax(distance)))
    colors = np.empty((num_classes, 3), np.uint8)
    colors[:1] = BACKGROUND
    colors[1:] = np.resize(candidates[chosen], (max(num_classes - 1, 0), 3))
    colors.setflags(write=False)
    return colors


def overlay(
    image: np.ndarray,  # (H, W, 3) uint8: what was seen
    labels: np.ndarray,  # (H, W) int: of each pixel, all below K
    colors: np.ndarray,  # (K, 3) uint8: `palette(K)`
) -> np.ndarray:
    """Lay labels over an image: tinted areas, and a thin line in the label's full colour along every class border.

    Background (0) and unknown (negative) pixels keep the image, a little greyed. Raises `ValueError` where labels are
    of another size, or have no colour: a kernel would read beyond the arrays.
    """
    largest = int(labels.max(initial=0))
    if labels.shape != image.shape[:2] or largest >= len(colors):
        found, expected = f"{labels.shape} labels, up to {largest}", f"{image.shape[:2]}, below {len(colors)}"
        raise ValueError(f"overlay: found {found}; expected {expected}")
    tints = FILL * colors.astype(np.float32)
    tints[:1] = 0.65 * 30
    lines = np.minimum(1.12 * colors, 255).astype(np.float32)
    return _tinted(np.array(image, order="C"), np.array(labels, np.int32, order="C"), tints, lines)


@kernel  # By one thread: several pictures are drawn at once.
def _tinted(image: np.ndarray, labels: np.ndarray, tints: np.ndarray, lines: np.ndarray) -> np.ndarray:
    """Tint an image (H, W, 3) uint8 by labels (H, W) int32, with what areas and lines get of each, (K, 3) float32."""
    height, width = labels.shape
    out = np.empty((height, width, 3), np.uint8)
    for y in range(height):
        for x in range(width):
            label, r, g, b = labels[y, x], image[y, x, 0], image[y, x, 1], image[y, x, 2]
            line = (x > 0 and labels[y, x - 1] != label) or (x + 1 < width and labels[y, x + 1] != label)
            line |= (y > 0 and labels[y - 1, x] != label) or (y + 1 < height and labels[y + 1, x] != label)
            grey = (np.float32(r) + np.float32(g) + np.float32(b)) / np.float32(3)
            for c in range(3):
                if label > 0:
                    value = lines[label, c] if line else np.float32(1 - FILL) * grey + tints[label, c]
                else:
                    value = np.float32(0.35) * np.float32(image[y, x, c]) + np.float32(0.65 * 0.75) * grey
                    value = (value + tints[0, c]) * np.float32(0.45 if line else 1)
                out[y, x, c] = np.uint8(np.rint(value))
    return out


def shown_at(px: int, image: np.ndarray, *labels: np.ndarray) -> tuple[np.ndarray, ...]:
    """Reduce a picture (H, W, 3) uint8, and label maps of its size, by a whole factor to no less than `px` a side.

    So a line that is drawn on it is still seen when it is shown with `px` a side at most.
    """
    step = max(image.shape[:2]) // px
    if step < 2:
        return image, *labels
    centres = (np.minimum(np.arange(0, size, step) + step // 2, size - 1) for size in image.shape[:2])
    kept = np.ix_(*centres)
    return np.asarray(Image.fromarray(image).reduce(step)), *(each[kept] for each in labels)


def contact_sheet(images: Sequence[np.ndarray], captions: Sequence[str], columns: int) -> np.ndarray:
    """Lay pictures, (H, W, 3) uint8 each, at least one, out in rows of `columns`, with their captions below.

    They are shrunk to `CELL_PX` a side at most; smaller ones are centred in cells of the largest one's size.
    """
    gap, text = 12, 14
    images = [shrunk(image, CELL_PX) for image in images]
    height, width = np.max([image.shape[:2] for image in images], axis=0).tolist()
    columns = min(columns, len(images))
    rows = -(-len(images) // columns)
    step_x, step_y = width + gap, height + gap + text + 6
    sheet = Image.new("RGB", (columns * step_x + gap, rows * step_y + gap), PAPER)
    draw = ImageDraw.Draw(sheet)
    font = ImageFont.load_default(text)
    for i, (image, caption) in enumerate(zip(images, captions, strict=True)):
        x, y = gap + i % columns * step_x, gap + i // columns * step_y
        sheet.paste(Image.fromarray(image), (x + (width - image.shape[1]) // 2, y + (height - image.shape[0]) // 2))
        draw.text((x + width / 2, y + height + 4), _shorten(caption, font, width), INK, font, anchor="ma")
    return np.asarray(sheet)


def legend(
    class_names: Mapping[int, str],
    colors: np.ndarray,  # (K, 3) uint8
    counts: np.ndarray,  # (K,) of each class, such as the number of Gaussians
    ids: Sequence[int] | None = None,  # (K,) by which files know the classes, if not by the numbers in `class_names`
) -> np.ndarray:
    """Draw one line a class, in the order given, in as many columns of even length as it takes.

    It has the class's colour, id, name, and count.
    """
    margin, line, font = 16, 26, ImageFont.load_default(15)
    entries = [
        (str(k if ids is None else ids[k]), _shorten(name, font, 260), f"{counts[k]:,}")
        for k, name in class_names.items()
    ]
    id_width, name_width, count_width = (
        max((font.getlength(entry[i]) for entry in entries), default=0) for i in range(3)
    )
    column = round(30 + id_width + 12 + name_width + 24 + count_width)
    as_in_a_square = round((len(entries) * (column + 2 * margin) / line) ** 0.5)
    columns = max(1, -(-len(entries) // max(LEGEND_ROWS, as_in_a_square)))
    rows = max(1, -(-len(entries) // columns))
    sheet = Image.new("RGB", (columns * (column + 2 * margin), rows * line + 2 * margin), PAPER)
    draw = ImageDraw.Draw(sheet)
    for i, (k, (label, name, count)) in enumerate(zip(class_names, entries, strict=True)):
        x, y = margin + i // rows * (column + 2 * margin), margin + i % rows * line
        draw.rounded_rectangle((x, y + 4, x + 18, y + 21), 4, fill=tuple(colors[k].tolist()))
        middle = y + line / 2
        draw.text((x + 30 + id_width, middle), label, FAINT_INK, font, anchor="rm")
        draw.text((x + 30 + id_width + 12, middle), name, INK, font, anchor="lm")
        draw.text((x + column, middle), count, FAINT_INK, font, anchor="rm")
    return np.asarray(sheet)


def save_png(path: str | Path, image: np.ndarray, run: str | None = None) -> None:
    """Write a picture as PNG, atomically (`WriteError`); `run`, the id of a run, becomes a text in the file."""
    with write_atomically(path) as temporary:
        # A third of the time of Pillow's own level; of renderings, nothing comes again but the byte before.
        Image.fromarray(image).save(
            temporary, format="PNG", compress_level=1, compress_type=zlib.Z_RLE, pnginfo=run_text(run)
        )


def outline(labels: np.ndarray) -> np.ndarray:
    """Mark the pixels of a label map (H, W) with another label beside, above or below them, (H, W) bool."""
    border = np.zeros(labels.shape, bool)
    across, down = labels[:, 1:] != labels[:, :-1], labels[1:] != labels[:-1]
    border[:, 1:] |= across
    border[:, :-1] |= across
    border[1:] |= down
    border[:-1] |= down
    return border


def shrunk(image: np.ndarray, px: int) -> np.ndarray:  # (H, W, 3) uint8
    """Shrink a picture so that neither side is longer than `px`."""
    if max(image.shape[:2]) <= px:
        return image
    picture = Image.fromarray(image)
    picture.thumbnail((px, px), Image.Resampling.BOX)
    return np.asarray(picture)


def _shorten(text: str, font: ImageFont.FreeTypeFont | ImageFont.ImageFont, width: float) -> str:
    """Cut a text in its middle so that it fits into a width in px: names are told apart by their end, too."""
    # The font has ASCII and little more. Letters go without their accents; of those of other scripts there is a box.
    letters = (c for c in composed(printable(text[:_LONGEST])) if not combining(c))
    text = shown = "".join(normalize("NFD", c).encode("ascii", "ignore").decode() or c for c in letters)
    kept = len(text)
    while kept and font.getlength(shown) > width:
        kept -= 1
        shown = f"{text[: (kept + 1) // 2]}...{text[len(text) - kept // 2 :]}"
    return shown


def _looks(rgb: np.ndarray) -> np.ndarray:
    """How colours (M, 3) of 0 to 255 look: (3, 3, M) OKLab, to most eyes, and trebled, to eyes without red or green."""
    share = rgb / 255.0
    linear = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    lacking = [3 * _oklab(np.clip(linear @ np.transpose(seen), 0, 1)).T for seen in _SEEN_WITHOUT]
    return np.array([_oklab(linear).T, *lacking])


def _distance(looks: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Square of how far colours are from another, (M,): the least of what the three kinds of eyes see."""
    gap = looks - other
    return np.asarray(np.einsum("ecm,ecm->em", gap, gap).min(axis=0))


def _oklab(linear: np.ndarray) -> np.ndarray:
    """Linear RGB (M, 3), 0 to 1, to OKLab (lightness, green-red, blue-yellow), by Ottosson's published matrices."""
    to_cones = np.array(
        [[0.4122214708, 0.5363325363, 0.0514459929], [0.2119034982, 0.6806995451, 0.1073969566],
         [0.0883024619, 0.2817188376, 0.6299787005]]
    )  # fmt: skip
    to_lab = np.array(
        [[0.2104542553, 0.7936177850, -0.0040720468], [1.9779984951, -2.4285922050, 0.4505937099],
         [0.0259040371, 0.7827717662, -0.8086757660]]
    )  # fmt: skip
    return np.cbrt(linear @ to_cones.T) @ to_lab.T
