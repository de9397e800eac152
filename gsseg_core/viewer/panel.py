"""The panel of the viewer: its widgets, and what they call.

viser draws Markdown with whatever HTML stands in it. So text of others, which names and errors hold, gets there only
through `_paragraph`, and into labels, which are text, only through `_shown`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np
import viser

from gsseg_core.data.dataset import View
from gsseg_core.errors import GssegError, SettingsError
from gsseg_core.scene.camera import Camera
from gsseg_core.text import html_text, printable
from gsseg_core.viewer.corrections import box, disc, region
from gsseg_core.viewer.model import MODES, ClassRow
from gsseg_core.viewer.picking import Picked, Voice
from gsseg_core.viewer.splat_chunks import BANDS

if TYPE_CHECKING:
    from gsseg_core.viewer.viewer import Viewer

MOST_CLASSES, MOST_VIEWS = 5, 8
"""Of probabilities and views that the answer to a click names."""

LONGEST_NAME = 80
"""Characters of a name; of a longer one, the first."""

ONLY, REMOVE = "only this", "remove"
REGION, DISC = "the whole region", "a disc"
_OFF = (73, 80, 87)
_STYLE = "padding: 0 0.75em 0.75em; font-size: 0.875em; overflow-wrap: anywhere"
_ASK = "Click on something in the picture to ask what it is."


class Panel:
    """All widgets of a viewer, and the callbacks behind them.

    Parameters
    ----------
    viewer : Viewer
        Whose state it shows and changes.
    """

    def __init__(self, viewer: Viewer) -> None:
        self._viewer, self._gui = viewer, viewer.server.gui
        self._rows: dict[int, tuple[ClassRow, viser.GuiButtonHandle, viser.GuiButtonGroupHandle]] = {}
        self._live: viser.GuiHtmlHandle | None = None
        self._gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False, control_width="medium")
        self._gui.set_panel_label("gsseg")
        self._answer = self._gui.add_html(_paragraph(_ASK))
        tabs = self._gui.add_tab_group()
        with tabs.add_tab("Classes"):
            self._build_classes()
        if viewer.views:
            with tabs.add_tab("Views"):
                self._build_views()
        with tabs.add_tab("Correct"):
            self._build_correct()
        with tabs.add_tab("Save"):
            self._build_save()

    # Tabs.

    def _build_classes(self) -> None:
        gui, viewer = self._gui, self._viewer
        self._mode = gui.add_dropdown("colour by", MODES, initial_value=viewer.model.mode)
        self._confidence = gui.add_slider(
            "confidence", 0.0, 1.0, 1 / BANDS, 0.0, hint="hide Gaussians that are less sure of their class than this"
        )
        self._probability = gui.add_slider(
            "probability",
            0.0,
            1.0,
            1 / BANDS,
            0.0,
            hint="above 0: show what has at least this probability of a shown class, whatever its label is",
        )
        self._listen(self._mode, self._choose_mode)
        self._listen(self._confidence, lambda: self._threshold("min_confidence", self._confidence))
        self._listen(self._probability, lambda: self._threshold("min_probability", self._probability))
        show_all = gui.add_button("show all", icon=viser.Icon.EYE)
        self._press(show_all, self._show_all)
        self._list = gui.add_folder("classes")

    def _build_views(self) -> None:
        gui = self._gui
        self._texts = _distinct([self._view_text(view) for view in self._viewer.views])
        self._view = gui.add_dropdown("view", self._texts)
        self._with_mask = gui.add_checkbox("mask over it", True)
        go = gui.add_button("go there", icon=viser.Icon.CAMERA)
        steps = gui.add_button_group("", ("previous", "next"))
        leave = gui.add_button("take the mask off")

        def jump(event: viser.GuiEvent[Any]) -> None:
            if event.client is None:  # It was set from here, and whoever did that goes there.
                return
            with self.telling(event.client):
                view = self._viewer.views[_chosen(self._view, self._texts)]
                self._viewer.jump(event.client, view, self._with_mask.value)

        go.on_click(jump)
        self._view.on_update(jump)
        self._with_mask.on_update(jump)

        @steps.on_click
        def _step(event: viser.GuiEvent[Any]) -> None:
            with self.telling(event.client):
                step = 1 if event.target.value == "next" else -1
                _set(self._view, self._texts[(_chosen(self._view, self._texts) + step) % len(self._texts)])
                jump(event)

        self._press(leave, self._viewer.hide_mask)

    def _build_correct(self) -> None:
        gui = self._gui
        gui.add_markdown("**Shift + click** or **shift + drag** a box in the picture: what is there is")
        self._target = gui.add_dropdown("class", self._target_names())
        self._new = gui.add_text("new class", "")
        add = gui.add_button("add the class", icon=viser.Icon.PLUS)
        self._tool = gui.add_dropdown("a click means", (REGION, DISC))
        self._radius = gui.add_slider("disc, % of height", 0.5, 20.0, 0.5, 3.0)
        undo = gui.add_button("take the last one back", icon=viser.Icon.ARROW_BACK_UP)
        self._corrected = gui.add_markdown("No corrections yet.")
        self._press(add, self._add_class)
        self._press(undo, self._undo)

    def _build_save(self) -> None:
        ply = self._gui.add_button("what is shown, as PLY", icon=viser.Icon.DOWNLOAD)
        npz = self._gui.add_button("the segmentation, as npz", icon=viser.Icon.DOWNLOAD)

        @ply.on_click
        def _ply(event: viser.GuiEvent[Any]) -> None:
            with self.telling(event.client):
                self._send(event.client, "selection.ply", self._viewer.selection_ply())

        @npz.on_click
        def _npz(event: viser.GuiEvent[Any]) -> None:
            with self.telling(event.client):
                self._send(event.client, "segmentation.npz", self._viewer.segmentation_npz())

        if self._viewer.follows:
            self._live = self._gui.add_html(_paragraph("live: waiting for the first codes"))

    # What the viewer tells.

    def refresh(self) -> None:
        """Have the list of classes agree with the model; widgets that are right stay."""
        with self._viewer.lock:
            rows = self._viewer.model.rows()
        listed = [(row.label, row.name) for row in rows]
        if listed != [(row.label, row.name) for row, _, _ in self._rows.values()]:
            for _, button, group in self._rows.values():
                button.remove()
                group.remove()
            with self._list:
                self._rows = {row.label: (row, *self._add_row(row)) for row in rows}
            self._target.options = self._target_names()
        for row in rows:
            known, button, group = self._rows[row.label]
            if row != known:
                button.label, button.color, button.icon = _text(row), _color(row), _icon(row)
                self._rows[row.label] = row, button, group

    def show_picked(self, picked: Picked | None, voices: Sequence[Voice] | None) -> None:
        """Answer a click: what it hit, and what the views say of that, if that is known."""
        if picked is None:
            self._answer.content = _paragraph("Nothing is there.")
            return
        model = self._viewer.model
        i = picked.gaussian
        label, probabilities = int(model.labelling.labels[i]), model.labelling.probabilities[i]
        best = [k for k in np.argsort(-probabilities, kind="stable")[:MOST_CLASSES].tolist() if probabilities[k] > 0]
        lines = [
            f", class {model.ids()[label]}" if label >= 0 else "",
            f"Gaussian {i}, {100 * picked.weight:.0f} % of the pixel",
            "probabilities: " + (", ".join(f"{_shown(model.name(k))} {probabilities[k]:.2f}" for k in best) or "none"),
        ]
        if voices is not None:
            said = [f"{_shown(v.view)}: {_shown(model.name(v.label))}, {v.weight:.1f} px" for v in voices[:MOST_VIEWS]]
            count = len({voice.view for voice in voices})
            lines.append(f"{count} view{'s' * (count != 1)} spoke for it" + (", the loudest:" if said else ""))
            lines += said
        self._answer.content = _paragraph(*lines, title=_shown(model.name(label)))

    def show_progress(self, stage: str, done: int, total: int) -> None:
        """Say how far a long job is."""
        if done < total:
            self._answer.content = _paragraph(f"{stage}: {done} of {total} views")
        else:
            self._answer.content = _paragraph(_ASK)

    def show_live(self, text: str) -> None:
        """Say what the live source has."""
        if self._live is not None:
            self._live.content = _paragraph(f"live: {text}")

    def tell_corrected(self, changed: int) -> None:
        """Say what the last correction did."""
        count = len(self._viewer.corrections)
        self._corrected.content = (
            f"{count} correction{'s' if count != 1 else ''}; the last one changed {changed:,} Gaussians."
        )

    @contextmanager
    def telling(self, client: viser.ClientHandle | None) -> Iterator[None]:
        """Tell the browser of errors that its user can do something about."""
        try:
            yield
        except GssegError as error:
            self._answer.content = _paragraph(f" {error}", title="That did not work.")
            if client is not None:
                text = printable(str(error))
                client.add_notification("That did not work", text, color="red", auto_close_seconds=10.0)

    # Corrections as they are set up in the panel.

    def drawn(self, camera: Camera, column: float, row: float, label_map: Callable[[], np.ndarray]) -> View:
        """Turn a click into a correction."""
        if self._tool.value == REGION:
            return region(camera, label_map(), column, row, self._label())
        radius = _number(self._radius, 0, 100) / 100 * camera.height
        return disc(camera, column, row, radius, self._label())

    def drawn_box(self, camera: Camera, corner: tuple[float, ...], opposite: tuple[float, ...]) -> View:
        """Turn a rectangle into a correction."""
        return box(camera, (corner[0], corner[1]), (opposite[0], opposite[1]), self._label())

    def _label(self) -> int:
        return _chosen(self._target, self._target_names())

    # Callbacks.

    def _choose_mode(self) -> None:
        try:
            self._viewer.set_mode(self._mode.value)
        except GssegError:
            _set(self._mode, self._viewer.model.mode)
            raise

    def _threshold(self, name: str, slider: viser.GuiSliderHandle[float]) -> None:
        value = _number(slider, 0, 1)
        self._viewer.change(lambda model: setattr(model, name, value))

    def _show_all(self) -> None:
        self._viewer.change(lambda model: model.show_all())
        _set(self._confidence, 0.0)
        _set(self._probability, 0.0)

    def _add_class(self) -> None:
        name, names = printable(self._new.value.strip()), self._target_names()
        if not 0 < len(name) <= LONGEST_NAME:
            raise SettingsError(f"new class: name has {len(name)} characters; expected 1 to {LONGEST_NAME}")
        if name not in names:
            self._viewer.added_names[len(names)] = name
            self._target.options = (*names, name)
        _set(self._target, name)

    def _undo(self) -> None:
        if self._viewer.undo():
            count = len(self._viewer.corrections)
            self._corrected.content = f"{count} correction{'s' if count != 1 else ''} left." if count else "None left."

    def _add_row(self, row: ClassRow) -> tuple[viser.GuiButtonHandle, viser.GuiButtonGroupHandle]:
        button = self._gui.add_button(_text(row), color=_color(row), icon=_icon(row), hint="switch it on or off")
        group = self._gui.add_button_group("", (ONLY, REMOVE))
        label = row.label
        self._press(button, lambda: self._viewer.change(lambda model: model.toggle(label)))

        @group.on_click
        def _pressed(event: viser.GuiEvent[Any]) -> None:
            with self.telling(event.client):
                if event.target.value == ONLY:
                    self._viewer.change(lambda model: model.isolate(label))
                elif event.target.value == REMOVE:
                    self._viewer.change(lambda model: model.remove(label))

        return button, group

    def _target_names(self) -> tuple[str, ...]:
        """Names by class id, as they are shown."""
        known = {**self._viewer.added_names, **self._viewer.model.labelling.class_names}
        return _distinct([_shown(known.get(k, f"class_{k:02d}")) for k in range(max(known) + 1)])

    def _view_text(self, view: View) -> str:
        trust = self._viewer.reliability.get(view.name, math.nan)
        return _shown(view.name) + ("" if math.isnan(trust) else f" ({100 * trust:.0f} % reliable)")

    def _listen(self, widget: Any, action: Callable[[], object]) -> None:
        @widget.on_update
        def _updated(event: viser.GuiEvent[Any]) -> None:
            with self.telling(event.client):
                action()

    def _press(self, button: viser.GuiButtonHandle, action: Callable[[], object]) -> None:
        @button.on_click
        def _pressed(event: viser.GuiEvent[Any]) -> None:
            with self.telling(event.client):
                action()

    @staticmethod
    def _send(client: viser.ClientHandle | None, name: str, content: bytes) -> None:
        if client is not None:
            client.send_file_download(name, content, save_immediately=True)


def _set(widget: Any, value: object) -> None:
    """Set a widget from here; to mypy, the decorator that viser has around its setters hides them."""
    widget.value = value


def _number(slider: viser.GuiSliderHandle[float], lowest: float, highest: float) -> float:
    """Value of a slider; a browser may say anything."""
    value = float(slider.value)
    if not lowest <= value <= highest:
        raise SettingsError(f"{slider.label} is {value:g}; expected {lowest:g} to {highest:g}")
    return value


def _chosen(dropdown: viser.GuiDropdownHandle[str], options: Sequence[str]) -> int:
    """Which of the options is chosen; a browser may say anything."""
    if dropdown.value not in options:
        raise SettingsError(f"{dropdown.label} is {_shown(dropdown.value)!r}; expected one of the list")
    return options.index(dropdown.value)


def _distinct(texts: Sequence[str]) -> tuple[str, ...]:
    """Append its number to a text that occurs a second time: texts are the only key that a dropdown has."""
    found: dict[str, None] = {}
    for k, text in enumerate(texts):
        while text in found:
            text = f"{text} ({k})"
        found[text] = None
    return tuple(found)


def _shown(name: str) -> str:
    return printable(name[:LONGEST_NAME])


def _paragraph(*lines: str, title: str = "") -> str:
    """HTML of lines that hold text of any origin; `title` begins the first one, in bold."""
    content = "<br>".join(map(html_text, lines))
    return f'<div style="{_STYLE}"><strong>{html_text(title)}</strong>{content}</div>'


def _text(row: ClassRow) -> str:
    return f"{_shown(row.name)}  {row.size:,}"


def _color(row: ClassRow) -> tuple[int, int, int]:
    return row.color if row.shown else _OFF


def _icon(row: ClassRow) -> viser.IconName:
    return viser.Icon.EYE if row.shown else viser.Icon.EYE_OFF
