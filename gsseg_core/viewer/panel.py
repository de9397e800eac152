"""The panel of the viewer: its widgets, and what they call.

viser draws Markdown with whatever HTML stands in it. So text of others, which names and errors hold, gets there only
through `_paragraph`, and into labels, which are text, only through `_shown`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Protocol

import numpy as np
import viser

from gsseg_core.data.class_names import class_name
from gsseg_core.data.view import View
from gsseg_core.errors import GssegError, SettingsError
from gsseg_core.scene.camera import Camera
from gsseg_core.text import counted, html_text, printable
from gsseg_core.viewer.corrections import Corrections, box, disc, region
from gsseg_core.viewer.model import MODES, ClassRow, ViewModel
from gsseg_core.viewer.picking import Picked, ViewVote
from gsseg_core.viewer.splat_chunks import BANDS

MOST_CLASSES, MOST_VIEWS = 5, 8
"""Of the probabilities and votes that the answer to a click names."""

LONGEST_NAME = 80
"""Characters of a name; of a longer one, the first."""

ONLY, REMOVE = "only this", "remove"
REGION, DISC = "the whole region", "a disc"
_OFF = (73, 80, 87)
_STYLE = "padding: 0 0.75em 0.75em; font-size: 0.875em; overflow-wrap: anywhere"
_ASK = "Click on something in the picture to ask what it is."


class PanelHost(Protocol):
    """What a panel needs of the viewer that it belongs to; see `gsseg_core.viewer.viewer.Viewer` for each."""

    server: viser.ViserServer
    model: ViewModel
    views: tuple[View, ...]
    reliability: dict[str, float]
    corrections: Corrections
    added_names: dict[int, str]

    @property
    def follows(self) -> bool:
        """Whether class probabilities change while the viewer runs."""

    def change(self, action: Callable[[ViewModel], object]) -> None:
        """Change what is shown."""

    def set_mode(self, mode: str) -> None:
        """Colour by something else."""

    def jump(self, client: viser.ClientHandle, view: View, with_mask: bool) -> None:
        """Look from where a view was taken."""

    def hide_mask(self) -> None:
        """Take the mask off the picture."""

    def selection_ply(self) -> bytes:
        """Write what is shown as a 3DGS PLY."""

    def segmentation_npz(self) -> bytes:
        """Write the corrected segmentation as a `segmentation.npz`."""

    def undo(self) -> bool:
        """Take the last correction back."""


class Panel:
    """All widgets of a viewer, and the callbacks behind them.

    Parameters
    ----------
    viewer : PanelHost
        Whose state it shows and changes.
    """

    def __init__(self, viewer: PanelHost) -> None:
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
        self._call(self._choose_mode, self._mode.on_update)
        self._call(lambda: self._threshold("min_confidence", self._confidence), self._confidence.on_update)
        self._call(lambda: self._threshold("min_probability", self._probability), self._probability.on_update)
        self._call(self._show_all, gui.add_button("show all", icon=viser.Icon.EYE).on_click)
        self._list = gui.add_folder("classes")

    def _build_views(self) -> None:
        gui = self._gui
        self._texts = _distinct([self._view_text(view) for view in self._viewer.views])
        self._view = gui.add_dropdown("view", self._texts)
        self._with_mask = gui.add_checkbox("mask over it", True)
        go = gui.add_button("go there", icon=viser.Icon.CAMERA)
        steps = gui.add_button_group("", ("previous", "next"))
        self._call(self._viewer.hide_mask, gui.add_button("take the mask off").on_click)

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

    def _build_correct(self) -> None:
        gui = self._gui
        gui.add_markdown("**Shift + click** or **shift + drag** a box in the picture: what is there is")
        self._target = gui.add_dropdown("class", self._target_names())
        self._new = gui.add_text("new class", "")
        self._call(self._add_class, gui.add_button("add the class", icon=viser.Icon.PLUS).on_click)
        self._tool = gui.add_dropdown("a click means", (REGION, DISC))
        self._radius = gui.add_slider("disc, % of height", 0.5, 20.0, 0.5, 3.0)
        self._call(self._undo, gui.add_button("take the last one back", icon=viser.Icon.ARROW_BACK_UP).on_click)
        self._corrected = gui.add_markdown("No corrections yet.")

    def _build_save(self) -> None:
        for text, name, content in (
            ("what is shown, as PLY", "selection.ply", self._viewer.selection_ply),
            ("the segmentation, as npz", "segmentation.npz", self._viewer.segmentation_npz),
        ):
            button = self._gui.add_button(text, icon=viser.Icon.DOWNLOAD)
            button.on_click(self._sender(name, content))
        if self._viewer.follows:
            self._live = self._gui.add_html(_paragraph("live: waiting for the first probabilities"))

    # What the viewer tells.

    def show_classes(self, rows: Sequence[ClassRow]) -> None:
        """List the classes; widgets that are right already stay."""
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
                for key, value in _look(row).items():
                    setattr(button, key, value)
                self._rows[row.label] = row, button, group

    def show_picked(self, picked: Picked | None, votes: Sequence[ViewVote] | None) -> None:
        """Answer a click: the Gaussian that it hit, and the votes for that, if they are known."""
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
        if votes is not None:
            views = counted(len({vote.view for vote in votes}), "view")
            lines.append(f"{views} voted for it" + (", the largest votes:" if votes else ""))
            lines += [f"{_shown(v.view)}: {_shown(model.name(v.label))}, {v.weight:.1f} px" for v in votes[:MOST_VIEWS]]
        self._answer.content = _paragraph(*lines, title=_shown(model.name(label)))

    def show_progress(self, stage: str, done: int, total: int) -> None:
        """Say how far a long job is."""
        self._answer.content = _paragraph(f"{stage}: {done} of {total} views" if done < total else _ASK)

    def show_live(self, text: str) -> None:
        """Say what the live source has."""
        if self._live is not None:
            self._live.content = _paragraph(f"live: {text}")

    def tell_corrected(self, changed: int) -> None:
        """Say what the last correction did."""
        count = counted(len(self._viewer.corrections), "correction")
        self._corrected.content = f"{count}; the last one changed {changed:,} Gaussians."

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
            self._corrected.content = f"{counted(count, 'correction')} left." if count else "None left."

    def _add_row(self, row: ClassRow) -> tuple[viser.GuiButtonHandle, viser.GuiButtonGroupHandle]:
        button = self._gui.add_button(**_look(row), hint="switch it on or off")
        group = self._gui.add_button_group("", (ONLY, REMOVE))
        label = row.label
        self._call(lambda: self._viewer.change(lambda model: model.toggle(label)), button.on_click)

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
        return _distinct([_shown(class_name(known, k)) for k in range(max(known) + 1)])

    def _view_text(self, view: View) -> str:
        trust = self._viewer.reliability.get(view.name, math.nan)
        return _shown(view.name) + ("" if math.isnan(trust) else f" ({100 * trust:.0f} % reliable)")

    def _call(self, action: Callable[[], object], register: Callable[[Callable[[Any], None]], object]) -> None:
        """Have a widget call an action, `register` being its `on_click` or `on_update`; errors are told."""

        def called(event: viser.GuiEvent[Any]) -> None:
            with self.telling(event.client):
                action()

        register(called)

    def _sender(self, name: str, content: Callable[[], bytes]) -> Callable[[viser.GuiEvent[Any]], None]:
        """Make a callback that sends a file to the browser that asked for it."""

        def send(event: viser.GuiEvent[Any]) -> None:
            with self.telling(event.client):
                if event.client is not None:
                    event.client.send_file_download(name, content(), save_immediately=True)

        return send


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


def _look(row: ClassRow) -> dict[str, Any]:
    """Label, color and icon of the button that switches a class."""
    return {
        "label": f"{_shown(row.name)}  {row.size:,}",
        "color": row.color if row.shown else _OFF,
        "icon": viser.Icon.EYE if row.shown else viser.Icon.EYE_OFF,
    }
