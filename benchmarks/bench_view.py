"""Measure `gsseg view` in a real headless Chromium: first picture, class toggles, thresholds, and bytes on the wire.

Twice: once the server draws, and once the browser. The page runs in WebGL by software where there is no GPU, so every
picture that the browser draws costs processor time that a GPU would save. One time ends when the button that was
pressed changes, which the server asks for after the picture; the other when the first picture that differs has been
drawn, which is read back from the canvas in that frame. Bytes are counted between the server and the browser, as
compressed. Toggles of a browser that draws are measured once more with the drawing itself left out, as if a GPU took no
time at all for it: what is left is what this program, the connection and the page's own work take.

Usage: python benchmarks/bench_view.py [--gaussians 300000] [--classes 40] [--toggles 15] [--draw server]
"""

from __future__ import annotations

import argparse
import math
import socket
import statistics
import sys
import threading
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import NamedTuple

import numpy as np
from machine import describe
from room import build_room

sys.path.insert(0, str(Path(__file__).parents[1] / "tests/helpers"))
from browser import opened_page, started_chromium, why_missing
from playwright.sync_api import Page

from gsseg_core.csr_rows import CSRRows
from gsseg_core.data.view import View
from gsseg_core.raster.backends import make_operator
from gsseg_core.viewer.access import listen
from gsseg_core.viewer.clients import BROWSER, SERVER
from gsseg_core.viewer.model import Labelling, ViewModel
from gsseg_core.viewer.viewer import Viewer

LIMIT = 200
"""Milliseconds that a toggle may take at 300,000 Gaussians."""

PORT, PATIENCE, SETTLED = 18200, 60.0, 1.5
WIDTH, HEIGHT = 960, 640

# After each draw of splats, or of an image in their place, compares a grid of pixels with those when `watch` was
# called.
PROBE = """
((images) => {
  const draw = WebGL2RenderingContext.prototype.drawElementsInstanced;
  const probe = { changed: null, base: null, last: null, waiting: false, answered: null, frames: 0, pictures: 0,
    skip: false, sent: false };
  window.probe = probe;
  const answer = new MutationObserver(() => { probe.answered ??= performance.now(); });
  document.addEventListener('DOMContentLoaded', () =>
    answer.observe(document.body, { subtree: true, attributes: true, attributeFilter: ['style'] }));
  // All at once: each call of readPixels waits for the drawing. Then every 26th row, which is enough to look at.
  const read = (gl) => {
    const width = gl.drawingBufferWidth, height = gl.drawingBufferHeight, all = new Uint8Array(height * width * 4);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, all);
    const rows = 24, some = new Uint8Array(rows * width * 4);
    for (let i = 0; i < rows; i++) {
      const from = Math.floor((i + 0.5) * height / rows) * width * 4;
      some.set(all.subarray(from, from + width * 4), i * width * 4);
    }
    return some;
  };
  const differing = (a, b) => {
    let count = 0;
    for (let i = 0; i < a.length; i++) count += Math.abs(a[i] - b[i]) > 24;
    return count;
  };
  const upload = WebGL2RenderingContext.prototype.texSubImage2D;
  WebGL2RenderingContext.prototype.texSubImage2D = function (...args) {
    upload.apply(this, args);
    probe.sent = true;
  };
  const look = (gl) => {
    const seen = read(gl);
    if (probe.last === null || differing(seen, probe.last) > 0) probe.pictures++;
    if (!probe.waiting) probe.base = seen;
    else if (differing(seen, probe.base) > 60) { probe.changed = performance.now(); probe.waiting = false; }
    probe.last = seen;
  };
  WebGL2RenderingContext.prototype.drawElementsInstanced = function (...args) {
    probe.frames++;
    if (probe.skip) {
      if (probe.waiting && probe.sent) { probe.changed = performance.now(); probe.waiting = false; }
      return;
    }
    draw.apply(this, args);
    look(this);
  };
  const plain = WebGL2RenderingContext.prototype.drawElements;
  WebGL2RenderingContext.prototype.drawElements = function (...args) {
    plain.apply(this, args);
    if (!images) return;
    look(this);
    if (probe.pictures > 1) probe.frames++;
  };
})(IMAGES);
"""


class Result(NamedTuple):
    """Milliseconds until a picture that differs was drawn, and until a widget changed; bytes that were sent."""

    drawn: float
    answered: float
    sent: int


class Counter:
    """Forwards connections to the viewer, and counts what it sends."""

    def __init__(self, port: int, target: int) -> None:
        self.received, self._target = 0, target
        self._server = socket.create_server(("127.0.0.1", port))
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        while True:
            try:
                browser, _ = self._server.accept()
            except OSError:
                return
            viewer = socket.create_connection(("127.0.0.1", self._target))
            threading.Thread(target=self._pump, args=(browser, viewer, False), daemon=True).start()
            threading.Thread(target=self._pump, args=(viewer, browser, True), daemon=True).start()

    def _pump(self, source: socket.socket, sink: socket.socket, counted: bool) -> None:
        try:
            while data := source.recv(1 << 16):
                self.received += len(data) * counted
                sink.sendall(data)
        except OSError:
            pass
        finally:
            sink.close()

    def close(self) -> None:
        self._server.shutdown(socket.SHUT_RDWR)  # Which also ends a thread that waits in `accept`.
        self._server.close()


class Watched:
    """A page whose pictures are watched."""

    def __init__(self, page: Page, counter: Counter) -> None:
        self._page, self._counter = page, counter

    def settle(self) -> None:
        """Wait until the picture stays as it is; the same one may be drawn again and again."""
        pictures = -1
        while pictures != (pictures := self._page.evaluate("probe.pictures")):
            self._page.wait_for_timeout(1000 * SETTLED)

    def measure(self, script: str = "", act: Callable[[], object] = lambda: None) -> Result:
        """Do something in the page or here, and wait until the picture has settled."""
        self.settle()
        before = self._counter.received
        start = self._page.evaluate(
            f"() => {{ const start = performance.now(); probe.waiting = true; probe.sent = false; "
            f"probe.answered = null; {script}; "
            "return start; }"
        )
        act()
        self._page.wait_for_function("!probe.waiting", timeout=1000 * PATIENCE, polling=20)
        drawn = self._page.evaluate("probe.changed") - start
        self.settle()
        answered = self._page.evaluate("probe.answered")
        return Result(drawn, math.nan if answered is None else answered - start, self._counter.received - before)


def room_model(gaussians: int, classes: int) -> tuple[ViewModel, list[View]]:
    """Build a room whose classes are known, with confidences as learning gives them, most of them high; and a view."""
    room = build_room(gaussians, num_classes=classes, num_views=4)
    rng = np.random.default_rng(0)
    sure = 1 - 0.6 * rng.beta(1, 6, gaussians).astype(np.float32)
    shares = CSRRows(np.arange(gaussians + 1), room.truth.astype(np.uint32), sure)
    names = {k: f"thing {k:02d}" for k in range(classes)}
    return ViewModel(room.scene, Labelling(room.truth.astype(np.int32), shares, names)), [View(room.cameras[0])]


def seen(model: ViewModel, view: View) -> list[str]:
    """Names of the classes that fill a hundredth of a view and more: a toggle of another might change no pixel."""
    labels, _, names, _ = model.labelling
    image = make_operator(model.scene, view.camera).render(np.eye(len(names), dtype=np.float32)[labels])
    areas = np.bincount(image.argmax(axis=2).ravel(), minlength=len(names))
    return [names[k] for k in np.flatnonzero(areas >= areas.sum() / 100).tolist()]


def press(name: str) -> str:
    """Script that presses the button of a class."""
    return f"[...document.querySelectorAll('button')].find(b => b.innerText.startsWith('{name}')).click()"


def row(what: str, results: list[Result]) -> None:
    drawn, answered, sent = (statistics.median(column) for column in zip(*results, strict=True))
    slowest = max(result.drawn for result in results)
    print(f"{what:<38}{answered:>12,.0f}{drawn:>12,.0f}{slowest:>12,.0f}{sent:>12,.0f}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--gaussians", type=int, default=300_000)
    parser.add_argument("--classes", type=int, default=40)
    parser.add_argument("--toggles", type=int, default=15)
    parser.add_argument("--draw", nargs="+", choices=(SERVER, BROWSER), default=(SERVER, BROWSER), help="who draws")
    options = parser.parse_args()
    why = why_missing()
    if why:
        sys.exit(f"bench_view: {why}")
    model, views = room_model(options.gaussians, options.classes)
    print(", ".join(f"{key} {value}" for key, value in describe().items()))
    print(f"{options.gaussians:,} Gaussians, {options.classes} classes, page of {WIDTH} x {HEIGHT}, WebGL by software")
    for draw in options.draw:
        measure_page(model, views, draw, options.toggles)


def measure_page(model: ViewModel, views: list[View], draw: str, toggles: int) -> None:
    started = time.monotonic()
    model.show_all()
    viewer = Viewer(model, views, listener=listen(port=PORT), draw=draw)
    counter = Counter(PORT + 500, viewer.server.get_port())
    with closing(viewer), closing(counter), started_chromium() as browser:
        print(f"\ndrawn by the {draw}: ready after {time.monotonic() - started:.1f} s")
        with opened_page(browser, WIDTH, HEIGHT, tolerated="computeBoundingSphere") as page:
            page.add_init_script(PROBE.replace("IMAGES", "true" if draw == SERVER else "false"))
            started = time.monotonic()
            page.goto(f"http://127.0.0.1:{PORT + 500}")
            page.wait_for_function("probe.frames > 0", timeout=1000 * PATIENCE)
            first = time.monotonic() - started
            watched = Watched(page, counter)
            watched.settle()
            print(f"first picture {first:.1f} s after the page was asked for, {counter.received:,} bytes on the wire")
            measure_all(watched, page, viewer, draw, toggles)


def measure_all(watched: Watched, page: Page, viewer: Viewer, draw: str, toggles: int) -> None:
    print(f"\n{'medians':<38}{'widget, ms':>12}{'picture, ms':>12}{'longest':>12}{'bytes':>12}")
    names = seen(viewer.state.model, viewer.state.views[0])
    presses = [press(names[i // 2 % len(names)]) for i in range(toggles)]
    drawn = [watched.measure(script) for script in presses]
    row("toggle of a class", drawn)
    alone = []
    if draw == BROWSER:
        page.evaluate("probe.skip = true")
        alone = [watched.measure(script) for script in presses]
        row("the same, nothing drawn", alone)
        page.evaluate("probe.skip = false")
    page.get_by_role("button", name="show all").click()
    for what, values in {"at a mark of the slider": (0.9, 0.95, 0.8), "between two marks": (0.93, 0.87)}.items():
        row(f"confidence, {what}", [by_server(watched, viewer, "min_confidence", value) for value in values])
    viewer.state.change(lambda model: model.show_all())
    row("colours of another mode", [by_server(watched, viewer, "mode", mode) for mode in ("true colours", "class")])
    print()
    for what, results in {"": drawn, ", nothing drawn": alone}.items():
        if not results:
            continue
        median = statistics.median(max(result.drawn, result.answered) for result in results)
        held = "holds" if median <= LIMIT else "does not hold"
        print(f"a toggle within {LIMIT} ms{what}: {held} ({median:,.0f} ms)")


def by_server(watched: Watched, viewer: Viewer, name: str, value: object) -> Result:
    """Change the model while the page is watched."""
    return watched.measure(act=lambda: viewer.state.change(lambda model: setattr(model, name, value)))


if __name__ == "__main__":
    main()
