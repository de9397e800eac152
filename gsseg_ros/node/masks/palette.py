"""Palettes of colour masks: which label a colour stands for."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from gsseg_core.data.label_images import UNKNOWN
from gsseg_core.errors import MaskFormatError, SettingsError
from gsseg_core.files.limits import MAX_LABEL
from gsseg_core.text import quoted

_COLOR = re.compile(r"#?([0-9a-fA-F]{6})")
_PLACES = np.array([1 << 16, 1 << 8, 1], np.int32)


class Palette:
    """Colours by label: such as "#0080ff", red, green and blue in hexadecimal; the index is the label.

    Raises `SettingsError`: one is no colour, occurs twice, or there are more than labels.
    """

    def __init__(self, colors: Sequence[str]) -> None:
        if len(colors) > MAX_LABEL + 1:
            raise SettingsError(f"parameter palette has {len(colors):,} colours; expected at most {MAX_LABEL + 1:,}")
        found = [_COLOR.fullmatch(color) for color in colors]
        for label, color in enumerate(found):
            if color is None:
                raise SettingsError(
                    f"parameter palette: label {label} has the colour {quoted(colors[label])}; expected one such as "
                    "#0080ff (red, green, blue)"
                )
        codes = np.array([int(color[1], 16) for color in found if color], np.int32)
        self._labels = np.argsort(codes, kind="stable").astype(np.int32)
        self._codes = codes[self._labels]
        twice = np.flatnonzero(np.diff(self._codes) == 0)
        if len(twice):
            one, two = self._labels[twice[0] : twice[0] + 2].tolist()
            raise SettingsError(
                f"parameter palette: labels {one} and {two} have the same colour, {colors[two]}; expected different "
                "ones"
            )

    def labels(
        self,
        pixels: npt.NDArray[np.uint8],  # (H, W, 3) red, green, blue
        source: str,
    ) -> npt.NDArray[np.int32]:
        """Look up the labels (H, W) of the colours of a mask.

        Raises `MaskFormatError`: a colour is not in the palette. Then either the palette is another segmenter's, or
        colours were blended, by scaling or as JPEG, and the labels of other pixels would be wrong, too.
        """
        codes = pixels @ _PLACES  # (H, W)
        place = np.minimum(np.searchsorted(self._codes, codes), len(self._codes) - 1)
        labels: npt.NDArray[np.int32] = np.where(self._codes[place] == codes, self._labels[place], UNKNOWN)
        foreign = codes[labels == UNKNOWN]
        if len(foreign):
            raise MaskFormatError(
                f"{source}: {len(foreign):,} pixels have a colour that is not in the palette, first #{foreign[0]:06x}; "
                "expected those of the parameter palette only, neither scaled smoothly nor compressed as JPEG"
            )
        return labels
