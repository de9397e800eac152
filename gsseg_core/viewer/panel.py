"""The panel of the viewer: its widgets, and what they call. Text of others gets there as `answer.py` says."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import takewhile
from typing import Any
from weakref import WeakKeyDictionary

import viser

from gsseg_core.data.class_names import class_name
from gsseg_core.data.view import View
from gsseg_core.errors import GssegError, SettingsError, UnknownLabelError
from gsseg_core.export.collision import KINDS
from gsseg_core.scene.camera import Camera
from gsseg_core.scene.scene_writers import SCENE_WRITERS
from gsseg_core.text import counted, printable, searched
from gsseg_core.viewer.answer import LONGEST_NAME, Answer, label_name, paragraph, shown_name
from gsseg_core.viewer.corrections import box, disc, looks_alike, region
from gsseg_core.viewer.model import MODES, ClassRow, ViewModel
from gsseg_core.viewer.picture import BANDS
from gsseg_core.viewer.state import ViewerState
from gsseg_core.viewer.viewpoint import Viewpoint

SWITCH, ONLY, REMOVE = "switch it on or off", "only this", "remove"
REGION, DISC, ALIKE = "the whole region", "a disc", "all that looks alike there"
_OFF = (73, 80, 87)
_NO_MESH = "none"
_IN_COLUMNS = """<style>
div:has(> .gsseg-columns) { display: none }
div:has(> div > .gsseg-columns) { display: grid; grid-template-columns: repeat(2, minmax(0, 1fr)); padding: 0 4px }
div:has(> div > .gsseg-columns) > div { margin: 0 2px !important; padding: 0 0 3px !important }
div:has(> div > .gsseg-columns) button { height: 20px !important; padding: 0 4px !important; font-size: 11px }
div:has(> div > .gsseg-columns) .mantine-Button-inner { justify-content: start }
@media (pointer: coarse) { div:has(> div > .gsseg-columns) button { height: 28px !important } }
</style><i class="gsseg-columns"></i>"""
"""viser knows no columns. Where its page is built otherwise, the rows stand below each other."""

Event = viser.GuiEvent[Any]
Place = tuple[Camera, float, float]  # a column and a row in a camera's picture


class Panel:
    """All widgets of a viewer, in viser's `gui`, and the callbacks behind them.

    They show and change a state, and move cameras by a viewpoint; `live` says whether to tell of a live source.
    """

    def __init__(self, gui: viser.GuiApi, state: ViewerState, viewpoint: Viewpoint, live: bool) -> None:
        self._gui, self._state, self._viewpoint = gui, state, viewpoint
        self._rows: dict[int, tuple[ClassRow, viser.GuiButtonHandle]] = {}
        self.clicked: WeakKeyDictionary[viser.ClientHandle, Place] = WeakKeyDictionary()  # where, last, in each browser
        gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False, control_width="medium")
        gui.set_panel_label("gsseg")
        self.answer = Answer(gui, state, self._show_level)
        tabs = gui.add_tab_group()
        with tabs.add_tab("Classes"):
            self._build_classes()
        if state.views:
            with tabs.add_tab("Views"):
                self._build_views()
        with tabs.add_tab("Correct"):
            self._build_correct()
        with tabs.add_tab("Save"):
            as_format = gui.add_dropdown("format", tuple(SCENE_WRITERS))
            mesh = gui.add_dropdown("mesh to collide with, in usd", (_NO_MESH, *KINDS))
            self._add_download(
                "what is shown",
                lambda: state.selection(str(as_format.value), None if mesh.value == _NO_MESH else str(mesh.value)),
            )
            self._add_download("the segmentation, as npz", state.segmentation_npz)
            self._live = gui.add_html(paragraph("live: waiting for the first probabilities")) if live else None

    # Tabs.

    def _build_level(self) -> None:
        """Choose a level of the tree of parts and wholes."""
        tree = self._state.model.tree
        if tree is None or len(tree.granularities) < 2:
            return
        names = _distinct([tree.level_name(g) for g in tree.granularities])
        self._levels = dict(zip(names, tree.granularities, strict=True))
        self._level = self._gui.add_dropdown("show", names, initial_value=tree.level_name(tree.level))

        def choose(event: Event) -> None:
            with self._state.lock:  # Whoever comes last, it is what was chosen last.
                if event.client is not None:  # Else it was set from here.
                    self._state.set_level(self._levels[names[_chosen(self._level, names)]])

        self._on(self._level.on_update, choose)

    def _show_level(self) -> None:
        _set(self._level, next(name for name, g in self._levels.items() if g == self._state.granularity))

    def _build_classes(self) -> None:
        gui = self._gui
        self._build_level()
        mode = gui.add_dropdown("colour by", MODES, initial_value=self._state.model.mode)
        hint = "hide Gaussians that are less sure of their class than this"
        confidence = gui.add_slider("confidence", 0.0, 1.0, 1 / BANDS, 0.0, hint=hint)
        hint = "above 0: show what has at least this probability of a shown class, whatever its label is"
        probability = gui.add_slider("probability", 0.0, 1.0, 1 / BANDS, 0.0, hint=hint)
        show_all = gui.add_button("show all", icon=viser.Icon.EYE)
        self._press = gui.add_dropdown("a press on a class", (SWITCH, ONLY, REMOVE))
        self._search = gui.add_text("search", "")
        self._list = gui.add_folder("classes")
        with self._list:
            gui.add_html(_IN_COLUMNS)

        def choose_mode(_: Event) -> None:
            try:
                while mode.value != self._state.model.mode:  # Another may be chosen while votes are collected.
                    self._state.set_mode(mode.value, self.answer.show_progress)
            except GssegError:
                _set(mode, self._state.model.mode)
                raise

        def set_threshold(name: str, slider: viser.GuiSliderHandle[float]) -> None:
            # It is read where no other thread can set what it said before.
            self._state.change(lambda model: setattr(model, name, _number(slider, 0, 1)))

        def show(_: Event) -> None:
            self._state.change(lambda model: model.show_all())
            _set(confidence, 0.0)
            _set(probability, 0.0)

        self._on(mode.on_update, choose_mode)
        self._on(confidence.on_update, lambda _: set_threshold("min_confidence", confidence))
        self._on(probability.on_update, lambda _: set_threshold("min_probability", probability))
        self._on(show_all.on_click, show)
        self._on(self._search.on_update, lambda _: self._filter())

    def _build_views(self) -> None:
        gui, views = self._gui, self._state.views
        texts = _distinct([self._view_text(view) for view in views])
        chosen = gui.add_dropdown("view", texts)
        with_mask = gui.add_checkbox("mask over it", True)
        go = gui.add_button("go there", icon=viser.Icon.CAMERA)
        steps = gui.add_button_group("", ("previous", "next"))
        hide = gui.add_button("take the mask off")

        def jump(event: Event) -> None:
            if event.client is not None:  # Else it was set from here, and whoever did that goes there.
                self._viewpoint.jump(event.client, views[_chosen(chosen, texts)], with_mask.value)

        def step(event: Event) -> None:
            by = 1 if event.target.value == "next" else -1
            _set(chosen, texts[(_chosen(chosen, texts) + by) % len(texts)])
            jump(event)

        def uncover(event: Event) -> None:
            if event.client is not None:
                self._viewpoint.hide_mask(event.client)

        for register in (go.on_click, chosen.on_update, with_mask.on_update):
            self._on(register, jump)
        self._on(steps.on_click, step)
        self._on(hide.on_click, uncover)

    def _build_correct(self) -> None:
        gui = self._gui
        gui.add_markdown(
            "**Shift + click** or **shift + drag** a box in the picture, or click and press below: what is there is"
        )
        self._target = gui.add_dropdown("class", self._target_names())
        self._new = gui.add_text("new class", "")
        self._on(gui.add_button("add the class", icon=viser.Icon.PLUS).on_click, lambda _: self._add_class())
        self._tool = gui.add_dropdown("a click means", (REGION, ALIKE, DISC))
        self._radius = gui.add_slider("disc, % of height", 0.5, 20.0, 0.5, 3.0)
        there = gui.add_button("correct what was clicked last", icon=viser.Icon.POINTER)
        self._on(there.on_click, self._correct_clicked)
        undo = gui.add_button("take the last one back", icon=viser.Icon.ARROW_BACK_UP)
        self._on(undo.on_click, lambda _: self._undo())
        self._corrected = gui.add_markdown("No corrections yet.")

    def _add_download(self, text: str, made: Callable[[], tuple[str, bytes]]) -> None:
        """Add a button that has the browser save a file, which is made when it is asked for: its name and content."""

        def send(event: Event) -> None:
            if event.client is not None:
                event.client.send_file_download(*made(), save_immediately=True)

        self._on(self._gui.add_button(text, icon=viser.Icon.DOWNLOAD).on_click, send)

    def _add_row(self, row: ClassRow) -> viser.GuiButtonHandle:
        button = self._gui.add_button(**_look(row), hint=f"{shown_name(row.name)}: {counted(row.size, 'Gaussian')}")

        def pressed(_: Event) -> None:
            action = {ONLY: ViewModel.isolate, REMOVE: ViewModel.remove}.get(self._press.value, ViewModel.toggle)

            def act(model: ViewModel) -> None:
                if model.name(row.label) != row.name:  # Another class has the number by now, as on another level.
                    name = shown_name(row.name)
                    raise UnknownLabelError(f"class {name!r} is not in the list any more; expected one that is")
                action(model, row.label)

            self._state.change(act)

        self._on(button.on_click, pressed)
        return button

    def _filter(self) -> None:
        """List only the classes whose name has what is searched for."""
        with self._state.lock:
            wanted = searched(self._search.value.strip())
            for row, button in self._rows.values():
                button.visible = wanted in searched(row.name)

    def _on(self, register: Callable[[Callable[[Any], None]], object], action: Callable[[Event], object]) -> None:
        """Have a widget call an action, `register` being its `on_click` or `on_update`; errors are told."""

        def called(event: Event) -> None:
            with self.answer.telling(event.client):
                action(event)

        register(called)

    # What the viewer tells.

    def show_classes(self, rows: Sequence[ClassRow]) -> None:
        """List the classes; the widgets before the first that is another one stay, for somebody may press them."""
        with self._state.lock:  # Somebody may search them meanwhile.
            before = [row for row, _ in self._rows.values()]
            alike = takewhile(lambda pair: pair[0][:2] == pair[1][:2], zip(rows, before, strict=False))  # label, name
            kept = sum(1 for _ in alike)
            for gone in before[kept:]:
                self._rows.pop(gone.label)[1].remove()
            with self._list:
                self._rows |= {row.label: (row, self._add_row(row)) for row in rows[kept:]}
            if kept < len(rows):
                self._filter()
            for row in rows:
                known, button = self._rows[row.label]
                if row != known:
                    for key, value in _look(row).items():
                        setattr(button, key, value)
                    self._rows[row.label] = row, button
        self._offer_targets()
        self.answer.refresh()

    def show_live(self, text: str) -> None:
        """Say what the live source has."""
        if self._live is not None:
            self._live.content = paragraph(f"live: {text}")

    # Corrections, as they are set up in the panel.

    def correct_at(self, camera: Camera, column: float, row: float) -> None:
        """Correct what a click hit, in pixels of the camera."""
        # An earlier correction may last, and people choose what comes next meanwhile.
        target, tool = self._target.value, self._tool.value
        radius = _number(self._radius, 0, 100) / 100 * camera.height if tool == DISC else 0.0
        with self._state.lock:  # Classes may get other numbers meanwhile.
            label, model = self._label(target), self._state.model
            if tool == REGION:
                drawn = region(camera, self._state.label_map(camera), column, row, label)
            elif tool == ALIKE:
                seen = model.scene.subset(model.shown())
                drawn = looks_alike(seen, camera, column, row, label, device=self._state.device)
            else:
                drawn = disc(camera, column, row, radius, label)
            self._correct(drawn)

    def correct_box(self, camera: Camera, corner: Sequence[float], opposite: Sequence[float]) -> None:
        """Correct what is in a box between two corners, column and row in pixels of the camera."""
        target = self._target.value
        with self._state.lock:
            self._correct(box(camera, corner, opposite, self._label(target)))

    def _correct_clicked(self, event: Event) -> None:
        place = None if event.client is None else self.clicked.get(event.client)
        if place is None:
            raise SettingsError(
                "correction: nothing was clicked in this browser; expected a click in the picture first"
            )
        self.correct_at(*place)

    def _correct(self, drawn: View) -> None:
        changed = self._state.correct(drawn)
        count = counted(len(self._state.corrections), "correction")
        self._corrected.content = f"{count}; the last one changed {changed:,} Gaussians."

    def _label(self, target: str) -> int:
        return _chosen(self._target, self._target_names(), target)

    def _add_class(self) -> None:
        name = printable(self._new.value.strip())
        if not 0 < len(name) <= LONGEST_NAME:
            raise SettingsError(f"new class: name has {len(name)} characters; expected 1 to {LONGEST_NAME}")
        with self._state.lock:
            names = self._target_names()
            if name not in names:
                self._state.added_names[len(names)] = name
        self._offer_targets()
        _set(self._target, name)

    def _offer_targets(self) -> None:
        """Offer the classes of now; the one that is chosen stays, even where it has another name, or is gone."""
        with self._state.lock:
            names, before, chosen = self._target_names(), self._target.options, self._target.value
            if names != before:
                self._target.options = names
                place = before.index(chosen) if chosen in before and chosen not in names else len(names)
                _set(self._target, names[place] if place < len(names) else chosen)

    def _undo(self) -> None:
        with self._state.lock:  # Another browser may correct meanwhile.
            if self._state.undo():
                count = len(self._state.corrections)
                self._corrected.content = f"{counted(count, 'correction')} left." if count else "None left."

    def _target_names(self) -> tuple[str, ...]:
        """Names by class id, as they are shown."""
        known, ids = {**self._state.added_names, **self._state.objects.class_names}, self._state.model.class_ids
        every = range(max(known) + 1)
        return _distinct([shown_name(class_name(known, k)) for k in every], [*ids, *every[len(ids) :]])

    def _view_text(self, view: View) -> str:
        trust = self._state.reliability.get(view.name, math.nan)
        return label_name(view.name) + ("" if math.isnan(trust) else f" ({100 * trust:.0f} % reliable)")


def _set(widget: Any, value: object) -> None:
    """Set a widget from here; to mypy, the decorator that viser has around its setters hides them."""
    widget.value = value


def _number(slider: viser.GuiSliderHandle[float], lowest: float, highest: float) -> float:
    """Value of a slider; a browser may say anything."""
    value = float(slider.value)
    if not lowest <= value <= highest:
        raise SettingsError(f"{slider.label} is {value:g}; expected {lowest:g} to {highest:g}")
    return value


def _chosen(dropdown: viser.GuiDropdownHandle[str], options: Sequence[str], earlier: str | None = None) -> int:
    """Which of the options is chosen, or was chosen `earlier`; a browser may say anything."""
    value = dropdown.value if earlier is None else earlier
    if value not in options:
        raise SettingsError(f"{dropdown.label} is {shown_name(value)!r}; expected one of the list")
    return options.index(value)


def _distinct(texts: Sequence[str], numbers: Sequence[int] = ()) -> tuple[str, ...]:
    """Append its number, by default its place, to a text that occurs again: a dropdown has no other key than texts."""
    found: dict[str, None] = {}
    for k, text in zip(numbers or range(len(texts)), texts, strict=False):
        while text in found:
            text = f"{text} ({k})"
        found[text] = None
    return tuple(found)


def _look(row: ClassRow) -> dict[str, Any]:
    """Label, color and icon of the button that switches a class."""
    return {
        "label": f"{label_name(row.name)}  {row.size:,}",
        "color": row.color if row.shown else _OFF,
        "icon": viser.Icon.EYE if row.shown else viser.Icon.EYE_OFF,
    }
