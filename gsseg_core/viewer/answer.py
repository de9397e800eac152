"""What the viewer answers to a click, to errors and while a long job runs, above the tabs of its panel.

viser draws Markdown with whatever HTML stands in it. So text of others, which names and errors hold, gets there only
through `paragraph` or `_isolated`, and into labels, which are text, only through `shown_name`.
"""

from __future__ import annotations

import unicodedata
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager

import numpy as np
import viser

from gsseg_core.data.class_names import class_name
from gsseg_core.errors import explained
from gsseg_core.text import counted, html_text, printable
from gsseg_core.viewer.picking import Picked, ViewVote
from gsseg_core.viewer.state import ViewerState

MOST_CLASSES, MOST_VIEWS = 5, 8  # of the probabilities and votes that the answer to a click names
LONGEST_NAME = 80  # characters of a name; of a longer one, the first
NOTICE: float | None = 10.0  # seconds for which a browser is told of an error beside the answer; None: until closed
_STYLE = "padding: 0 0.75em 0.75em; font-size: 0.875em; overflow-wrap: anywhere"
_LEAST = 0.005  # of a probability that is named beside the largest one: less reads 0.00
_ASK = "Click on something in the picture to ask what it is."


class Answer:
    """Answers the last click for as long as nothing else is asked, as what was hit changes; offers parts and wholes."""

    def __init__(self, gui: viser.GuiApi, state: ViewerState, level_changed: Callable[[], None]) -> None:
        self._state, self._level_changed = state, level_changed
        self._asked: object = None  # the last click, ...
        self._picked: tuple[Picked, Sequence[ViewVote] | None] | None = None  # ... and what it hit, while that is told
        self._node: int | None = None  # of which parts and whole are offered
        self._answer, self._failure = gui.add_html(paragraph(_ASK)), ""  # what is told; the last error that was
        self._parts, self._whole = (gui.add_button(f"its {what}", visible=False) for what in ("parts", "whole"))
        self._parts.on_click(lambda event: self._show_offered(event.client, state.show_parts))
        self._whole.on_click(lambda event: self._show_offered(event.client, state.show_whole))

    def ask(self) -> object:
        """Begin to answer a click: what earlier ones would still have to say is said no more."""
        self._asked = object()
        return self._asked

    def show_picked(self, asked: object, picked: Picked | None, votes: Sequence[ViewVote] | None = None) -> None:
        """Answer a click: the Gaussian that it hit, and the votes for that, if they are known."""
        with self._state.lock:
            if asked is self._asked:
                self._picked = None if picked is None else (picked, votes)
                if picked is None:
                    self._offer(None)
                    self._answer.content = paragraph("Nothing is there.")
                self.refresh()

    def refresh(self) -> None:
        """Tell what is known by now of the Gaussian that was clicked last."""
        with self._state.lock:
            if self._picked is not None:
                self._offer(self._state.node_of(self._picked[0].gaussian))
                told = self._told(*self._picked)
                if told != self._answer.content:
                    self._answer.content = told

    def show_progress(self, stage: str, done: int, total: int) -> None:
        """Say how far a long job is, below what was clicked."""
        with self._state.lock:
            told = self._told(*self._picked) if self._picked else ""
            progress = paragraph(f"{stage}: {done} of {total} views") if done < total else ""
            self._answer.content = told + progress or paragraph(_ASK)

    @contextmanager
    def telling(self, client: viser.ClientHandle | None, in_place: bool = True) -> Iterator[None]:
        """Show errors in the browser, in place of the last answer or beside it, until somebody's next act works."""
        try:
            yield
        except Exception as error:
            if (what := explained(error)) is None:
                raise
            if in_place:
                with self._state.lock:
                    self._picked = None
                    self._offer(None)
                    self._answer.content = self._failure = paragraph(f" {what}", title="That did not work.")
            if client is not None:
                text = printable(what)
                client.add_notification("That did not work", text, color="red", auto_close_seconds=NOTICE)
        else:
            with self._state.lock:
                if client is not None and self._answer.content == self._failure:
                    self._answer.content = paragraph(_ASK)

    def _show_offered(self, client: viser.ClientHandle | None, show: Callable[[int], None]) -> None:
        node = self._node  # Another browser may click on something else meanwhile, or choose a level.
        with self.telling(client), self._state.lock:
            if node is not None:
                show(node)
                self._level_changed()

    def _offer(self, node: int | None) -> None:
        tree, self._node = self._state.model.tree, node
        of = ([], None) if tree is None or node is None else (tree.parts(node), tree.whole(node))
        self._parts.visible, self._whole.visible = bool(of[0]), of[1] is not None

    def _told(self, picked: Picked, votes: Sequence[ViewVote] | None) -> str:
        model, classes = self._state.model, self._state.objects.class_names
        i = picked.gaussian
        known = model.labelling
        label, probabilities = int(known.labels[i]), known.shares.take(np.array([i])).dense(len(known.class_names))[0]
        least = min(_LEAST, max(probabilities.max(), 1e-9))
        ranked = np.argsort(-probabilities, kind="stable")[:MOST_CLASSES].tolist()
        best = [k for k in ranked if probabilities[k] >= least]
        names = _told_apart({k: model.name(k) for k in best}, model.ids())
        likely = ", ".join(f"{names[k]} {probabilities[k]:.2f}" for k in best)
        lines = [
            f", class {model.ids()[label]}" if label >= 0 else "",
            f"Gaussian {i}, {100 * picked.weight:.0f} % of the pixel",
            f"probabilities: {likely or 'none'}",
        ]
        if votes is not None:
            views = counted(len({vote.view for vote in votes}), "view")
            lines.append(f"{views} voted for it" + (", the largest votes:" if votes else ""))
            names = _told_apart({v.label: class_name(classes, v.label) for v in votes[:MOST_VIEWS]}, model.class_ids)
            lines += [f"{_isolated(v.view)}: {names[v.label]}, {v.weight:.1f} px" for v in votes[:MOST_VIEWS]]
        return _of_html(*lines, title=shown_name(model.name(label)))


def shown_name(name: str) -> str:
    """Make a name harmless, and short enough to be shown."""
    return printable(name[:LONGEST_NAME])


def label_name(name: str) -> str:
    """As `shown_name`; one that is read from the right leaves what stands beside it in a label, which is text."""
    text = shown_name(name)
    return f"\u2068{text}\u2069" if {"R", "AL"} & {*map(unicodedata.bidirectional, text)} else text


def paragraph(*lines: str, title: str = "") -> str:
    """HTML of lines that hold text of any origin; `title` begins the first one, in bold."""
    return _of_html(*map(html_text, lines), title=title)


def _isolated(name: str) -> str:
    """HTML of a name, which leaves in its place what stands beside it though it is read from the right."""
    return f"<bdi>{html_text(shown_name(name))}</bdi>"


def _told_apart(names: Mapping[int, str], ids: Sequence[int]) -> dict[int, str]:
    """HTML of names of classes by number; the ids of the classes stand behind those that occur again."""
    often = Counter(map(shown_name, names.values()))
    return {
        k: _isolated(name) + (f" ({ids[k] if k < len(ids) else k})" if often[shown_name(name)] > 1 else "")
        for k, name in names.items()
    }


def _of_html(*lines: str, title: str) -> str:
    """HTML of lines of HTML, and a title that is text; as `paragraph`."""
    return f'<div style="{_STYLE}"><strong>{html_text(title)}</strong>{"<br>".join(lines)}</div>'
