"""Tell whether it is faster to keep the weights of a view than to make them again, and whether 16 bits are enough.

    python benchmarks/bench_weights.py        # on $GSSEG_DATA, default ../shared/data, and on a made-up room

Of a prepared view, gsseg keeps which Gaussians are seen in which blocks of which tiles, and makes their weights again
in every step. Here the same step reads the weights instead, stored as multiples of 1 / 65535. What is told: seconds of
a step over one view and bytes of the view in either way, and how many labels are other ones after EM.
"""

from __future__ import annotations

import statistics
import sys
from typing import Any

import numba as nb
import numpy as np
from jobs import small_room
from llvmlite import ir
from machine import asked_anew, describe, parser_of, timed
from numba.core import types
from workloads import REAL, RoomSize

from gsseg_core.data.dataset import Dataset
from gsseg_core.data.soft_masks import SeenLabels
from gsseg_core.data.view import View, spread
from gsseg_core.learn.em.block_weights import block_weights
from gsseg_core.learn.em.em_learner import EMLearner
from gsseg_core.raster.backends import make_operator
from gsseg_core.raster.cpu import label_pairs
from gsseg_core.raster.cpu.blending import open_rays
from gsseg_core.raster.cpu.lifting import Lifted
from gsseg_core.raster.cpu.splat import WIDTH, aim, lift_block
from gsseg_core.raster.cpu.tile_operator import TileObservation
from gsseg_core.raster.cpu.tiling import TILE
from gsseg_core.raster.observation import VoteShares
from gsseg_core.raster.view_operator import ViewOperator
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.simd import FAST, LANES, add_scaled, first_bit, intrinsic, load_row, store_row, where
from gsseg_core.warm_up import warm_up

STEPS = 65535.0


def main() -> None:
    """Measure and print."""
    parser = parser_of(__doc__)
    parser.add_argument("--gaussians", type=int, default=1_000_000, help="of the room")
    parser.add_argument("--views", type=int, default=20, help="views to learn from")
    parser.add_argument("--runs", type=int, default=5)
    options = parser.parse_args()
    print(describe())
    warm_up()
    room, views, _ = small_room(RoomSize(options.gaussians, options.views, 10, 640, 480))
    compare("room", room, views, 10, options.runs)
    if (options.data / REAL[0]).is_dir():
        data = Dataset(options.data / REAL[0], "labels_noisy")
        scene = GaussianScene.load(options.data / REAL[0] / "scene.ply")
        compare(REAL[0], scene, spread(data.views("train"), options.views), data.num_classes, options.runs)
    else:
        print(f"skipped: no {options.data / REAL[0]}")


def compare(name: str, scene: GaussianScene, views: list[View], num_classes: int, runs: int) -> None:
    """Print what both ways cost on a scene, and how far their labels agree."""
    made, read, sizes = [], [], []
    for view in spread(views, 5):
        operator, mask = make_operator(scene, view.camera), view.read_labels()
        ours, stored = operator.observe(mask), StoredWeights(operator, mask)
        said, rest = np.full(len(ours.labels), 0.1, np.float32), np.ones(len(ours.classes), np.float32)
        made.append(statistics.median(timed(asked_anew(ours, said, rest), runs)))
        read.append(statistics.median(timed(asked_anew(stored, said, rest), runs)))
        sizes.append((ours.nbytes, stored.nbytes))
    print(
        f"{name}: a step over one view, mean of {len(made)}: weights made {1e3 * statistics.mean(made):.1f} ms, ",
        end="",
    )
    print(f"read {1e3 * statistics.mean(read):.1f} ms; bytes of a view: ", end="")
    print(", ".join(f"{statistics.mean(size) / 1e6:.1f} MB" for size in zip(*sizes, strict=True)))
    plain = EMLearner(scene, num_classes)
    plain.observe_all(views)
    with_stored = StoringLearner(scene, num_classes)
    with_stored.observe_all(views)
    one, other = plain.fit(), with_stored.fit()
    differ = int((one.codes_.argmax(axis=1) != other.codes_.argmax(axis=1))[one.observed_].sum())
    print(f"{name}: {differ} of {int(one.observed_.sum()):,} labels differ, ", end="")
    print(f"codes by at most {np.abs(one.codes_ - other.codes_).max():.1g}; {len(one.history_)} steps")


class StoredWeights(TileObservation):
    """An observation that keeps the weights of all its records."""

    def __init__(self, operator: ViewOperator, labels: np.ndarray, weights: np.ndarray | None = None) -> None:
        lifted = Lifted.of(operator._tiles, labels, weights)
        super().__init__(operator.camera.name, operator.ids, operator._tiles, lifted)
        self._first = np.concatenate([[0], np.cumsum(self._records)])
        self._kept = np.empty((self._first[-1], LANES), np.uint16)
        self._left_over = np.empty((len(self._records), TILE, TILE), np.float32)
        store(self._shared, self._blocks, self._first, self._kept, self._left_over)

    @property
    def nbytes(self) -> int:
        """What a step needs: not the Gaussians, but the weights."""
        return super().nbytes - self._tiles.table.nbytes + self._kept.nbytes + self._left_over.nbytes

    def _shares(self, likelihood: np.ndarray, rest: np.ndarray) -> VoteShares:
        """Share out as ever, with stored weights."""
        mask = self._mask
        logs, left_over = np.zeros(len(self._records)), np.zeros(len(mask.present))
        sums = np.empty(self._slot_start[-1], np.float32)
        share_stored(
            self._shared.start, self._blocks, self._first, self._kept, self._left_over, mask, self._slot_start,
            self._pair, likelihood, rest, logs, left_over, sums,
        )  # fmt: skip
        parts = label_pairs.add_up(self._slot_start, self._pair, sums, len(likelihood))
        total = np.bincount(mask.present, weights=left_over, minlength=len(rest))
        return VoteShares(parts.sum(axis=0), total, float(logs.sum()))


class StoringLearner(EMLearner):
    """EM with views that keep their weights."""

    def _prepare(self, view: View, seen: SeenLabels, operator: ViewOperator | None = None) -> StoredWeights:
        operator = operator or make_operator(self.scene, view.camera)
        used = self._used_labels(seen, operator)
        observation = StoredWeights(operator, used.labels, block_weights(used.labels, seen.labels))
        if used.evidence is not None:
            observation.evidence = used.evidence
        return observation


@intrinsic
def load_steps(typing: Any, source: Any, i: Any, target: Any) -> Any:
    """Copy a row of sixteen uint16 to target[0], as float32."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        arrays = [
            context.make_array(kind)(context, builder, array)
            for kind, array in zip((signature.args[0], signature.args[2]), (arguments[0], arguments[2]), strict=True)
        ]
        short, row = ir.VectorType(ir.IntType(16), LANES), ir.VectorType(ir.FloatType(), LANES)
        first = builder.mul(arguments[1], ir.Constant(ir.IntType(64), LANES))
        place = builder.gep(arrays[0].data, [first], source_etype=ir.IntType(16))
        steps = builder.load(builder.bitcast(place, ir.PointerType(short)), align=2, typ=short)
        wide = builder.sitofp(builder.zext(steps, ir.VectorType(ir.IntType(32), LANES)), row)
        builder.store(wide, builder.bitcast(arrays[1].data, ir.PointerType(row)), align=4)
        return context.get_dummy_value()

    return types.void(source, types.int64, target), generate


@nb.njit(parallel=True, error_model="numpy")
def store(tiles, blocks, first, kept, left_over) -> None:  # type: ignore[no-untyped-def]
    """Make all weights of a view once, and keep them."""
    table, start, entries = tiles.table, tiles.start, tiles.entries
    for tile in nb.prange(start.shape[0] - 1):
        rays, lines, record = left_over[tile], np.empty((2, TILE), np.float32), np.empty((1, TILE), np.float32)
        left, top, _ = open_rays(tiles, tile, rays)
        n = first[tile]
        for e in range(start[tile], start[tile + 1]):
            g = entries[e]
            aim(table, g, left, top, lines, 0)
            todo = np.int64(blocks[e])
            while todo:
                b = first_bit(todo)
                todo &= todo - 1
                weight, _ = lift_block(rays, b, lines, 0, table[g, WIDTH])
                store_row(record, 0, weight)
                for c in range(TILE):
                    kept[n, c] = np.uint16(record[0, c] * np.float32(STEPS) + np.float32(0.5))
                n += 1


@nb.njit(parallel=True, fastmath=FAST, error_model="numpy")
def share_stored(  # type: ignore[no-untyped-def]
    start, blocks, first, kept, final, mask, slot_start, pair, said, rest, logs, left_over, sums,
) -> None:  # fmt: skip
    """Do what `label_pairs.share` does."""
    label_start, slots, lanes = mask.start, mask.slots, mask.lanes
    for tile in nb.prange(start.shape[0] - 1):
        labels = mask.present[label_start[tile] : label_start[tile + 1]]
        many = labels.shape[0]
        logs[tile] = 0.0
        if many == 0:
            continue
        spans = mask.span_start[tile * TILE : tile * TILE + TILE + 1]
        here = pair[slot_start[tile] : slot_start[tile + 1]]
        value, weights = np.zeros((TILE, TILE), np.float32), np.empty((first[tile + 1] - first[tile], TILE), np.float32)
        n = 0
        for e in range(start[tile], start[tile + 1]):
            only = said[here[e - start[tile]]] * np.float32(1 / STEPS) if many == 1 else np.float32(0.0)
            todo = np.int64(blocks[e])
            while todo:
                b = first_bit(todo)
                todo &= todo - 1
                load_steps(kept, first[tile] + n, weights[n:])
                weight = load_row(weights, n)
                n += 1
                total = load_row(value, b)
                if many == 1:
                    total = add_scaled(total, weight, only)
                else:
                    for span in range(spans[b], spans[b + 1]):
                        s = max(here[(e - start[tile]) * many + slots[span]], 0)
                        more = add_scaled(total, weight, said[s] * np.float32(1 / STEPS))
                        total = where(np.int64(lanes[span]), more, total)
                store_row(value, b, total)
        spare = left_over[label_start[tile] : label_start[tile + 1]]
        logs[tile] = label_pairs.invert(spans, mask, mask.weights[tile], rest[labels], final[tile], value, spare)
        mine = sums[slot_start[tile] : slot_start[tile + 1]]
        label_pairs.sum_shares(blocks[start[tile] : start[tile + 1]], many, spans, mask, value, weights, mine)
        mine *= np.float32(1 / STEPS)


if __name__ == "__main__":
    sys.exit(main())
