"""One projected Gaussian over the pixels of a tile: which blocks it reaches, and how it is blended into one of them.

Both are vector instructions on sixteen numbers (`gsseg_core.simd`): the sixteen rows of a tile, and the sixteen pixels
of a block. A row of the table of projected Gaussians is what they read of it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba.core import cgutils, types

from gsseg_core.raster.constants import ALPHA_MAX, BLOCK, T_LIFTED, T_MIN
from gsseg_core.simd import BITS, F32, I64, LANES, ROW, Builder, constant, intrinsic, row_type

SIDE = BLOCK
OPEN = (1 << LANES) - 1  # of the bits of `blend_block`, those of the rays that are still open
LOG_ALPHA_MIN = -math.log2(255.0)  # log2 of the least alpha that counts

# Columns of the table of projected Gaussians.
U, V, SHEAR, WIDTH, HEIGHT, LOG_OPACITY, Y_REACH, X_TURN = range(8)

_ROWS = ir.Constant(ROW, [float(r) for r in range(LANES)])
_FOUR = ir.VectorType(F32, SIDE)
_EACH_FOUR_TIMES = ir.Constant(BITS, [lane // SIDE for lane in range(LANES)])
_COLUMNS_OF_BLOCKS = ir.Constant(
    ir.ArrayType(ROW, SIDE),
    [ir.Constant(ROW, [float(SIDE * i + lane % SIDE) for lane in range(LANES)]) for i in range(SIDE)],
)


class _Splat(Builder):
    """Reads the table and the lines of one Gaussian."""

    def projected(self, position: int) -> Callable[[int], Any]:
        """Columns of a row of the table: argument `position` is the table, the next one the row's number."""
        number = self.arguments[position + 1]
        first = self.llvm.mul(number, ir.Constant(number.type, 8))

        def column(j: int) -> Any:
            place = self.llvm.add(first, ir.Constant(number.type, j))
            return self.llvm.load(self.element(position, place), align=4, typ=F32)

        return column

    def four_of(self, position: int, i: int, block: Any) -> Any:
        """Entries of row i that belong to the four rows of a block, each four times."""
        first = self.llvm.and_(block, ir.Constant(block.type, LANES - SIDE))
        place = self.llvm.add(first, ir.Constant(block.type, i * LANES))
        address = self.llvm.bitcast(self.element(position, place), ir.PointerType(_FOUR))
        four = self.llvm.load(address, align=4, typ=_FOUR)
        return self.llvm.shuffle_vector(four, ir.Constant(_FOUR, ir.Undefined), _EACH_FOUR_TIMES)

    def alpha(self, first: int) -> tuple[Any, Any]:
        """Alpha in a block, and log2 of it before it is clipped; arguments from `first` on: block, lines and width."""
        block, _, width = self.arguments[first : first + 3]
        offset = self.llvm.fsub(self.pixel_columns(block), self.four_of(first + 1, 0, block))
        peak, wide = self.four_of(first + 1, 1, block), self.spread(self.llvm.fneg(width))
        power = self.fma(wide, self.llvm.fmul(offset, offset), peak)
        return self.least(self.exp2(power), constant(ALPHA_MAX)), power

    def pixel_columns(self, block: Any) -> Any:
        """Columns in the tile of the pixels of a block."""
        insert: Any = cgutils.global_constant
        table = insert(self.llvm.module, "columns_of_blocks", _COLUMNS_OF_BLOCKS)
        number = self.llvm.and_(block, ir.Constant(block.type, SIDE - 1))
        place = self.llvm.gep(table, [ir.Constant(block.type, 0), number], source_etype=_COLUMNS_OF_BLOCKS.type)
        return self.llvm.load(place, align=4, typ=ROW)


@intrinsic
def aim(typing: Any, table: Any, g: Any, left: Any, top: Any, lines: Any) -> tuple[Any, Callable[..., Any]]:
    """Tell which blocks of a tile a Gaussian reaches: bit b is set if alpha is at least 1/255 at some pixel of block b.

    The tile's first pixel has its centre at (left, top). For each row of the tile, lines[0] gets the column of the
    largest alpha, and lines[1] what log2 of alpha would be there.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        row = _Splat(context, builder, signature, arguments)
        column = row.projected(0)
        dy = builder.fsub(_ROWS, row.spread(builder.fsub(column(V), arguments[3])))
        x = row.fma(row.spread(column(SHEAR)), dy, row.spread(builder.fsub(column(U), arguments[2])))
        high, wide = row.spread(builder.fneg(column(HEIGHT))), row.spread(builder.fneg(column(WIDTH)))
        peak = row.fma(high, builder.fmul(dy, dy), row.spread(column(LOG_OPACITY)))
        row.store(x, row.address(4, ir.Constant(I64, 0)))
        row.store(peak, row.address(4, ir.Constant(I64, 1)))
        # In each row, no pixel of a block is nearer to the peak than this one, and its alpha is computed as
        # `blend_block` does: so the bits say exactly what will be found there.
        whole, bits = row.rint(x), ir.Constant(I64, 0)
        for i in range(SIDE):
            nearest = row.least(row.most(whole, constant(float(SIDE * i))), constant(SIDE * i + SIDE - 1.0))
            offset = builder.fsub(nearest, x)
            power = row.fma(wide, builder.fmul(offset, offset), peak)
            found = row.bits(builder.fcmp_ordered(">=", power, constant(LOG_ALPHA_MIN)))
            bits = builder.or_(bits, builder.shl(found, ir.Constant(I64, LANES * i)))
        # Bit 16 i + r of these is row r's, in the i-th column of blocks. Rows of four are put together, and columns
        # of blocks beside each other.
        for shift in (1, 2):
            bits = builder.or_(bits, builder.lshr(bits, ir.Constant(I64, shift)))
        bits = builder.and_(bits, ir.Constant(I64, 0x1111111111111111))
        for shift in (LANES - 1, 2 * LANES - 2):
            bits = builder.or_(bits, builder.lshr(bits, ir.Constant(I64, shift)))
        return builder.and_(bits, ir.Constant(I64, OPEN))

    number = types.float32
    return types.int64(table, types.intp, number, number, lines), generate


@intrinsic
def blend_block(typing: Any, rays: Any, b: Any, lines: Any, wide: Any) -> tuple[Any, Callable[..., Any]]:
    """Blend one Gaussian into block b of the rays.

    In column c of row r its log2 of alpha is peak - wide * (c - x)^2, with x and peak of row r from `aim`; below that
    of 1/255 alpha counts as 0. Returns its weights, and bits: the low sixteen say which rays are still open, the next
    ones which were hit.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return _blended(_Splat(context, builder, signature, arguments), lifts=False)

    return _BLENDED(rays, b, lines, types.float32), generate


@intrinsic
def lift_block(typing: Any, rays: Any, b: Any, lines: Any, wide: Any) -> tuple[Any, Callable[..., Any]]:
    """Blend one Gaussian into block b of rays that lift a mask: as `blend_block`, but they end as `T_LIFTED` says."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return _blended(_Splat(context, builder, signature, arguments), lifts=True)

    return _BLENDED(rays, b, lines, types.float32), generate


_BLENDED: Any = types.Tuple((row_type, types.int64))  # type: ignore[no-untyped-call]


def _blended(row: _Splat, lifts: bool) -> Any:
    """Weights and bits of `blend_block`, or of `lift_block`; what is left of the rays is stored."""
    llvm = row.llvm
    alpha, power = row.alpha(1)
    address = row.row(0)
    before = row.load(address)
    hit = llvm.and_(
        llvm.fcmp_ordered(">=", power, constant(LOG_ALPHA_MIN)), llvm.fcmp_ordered(">=", before, constant(T_MIN))
    )
    weight = llvm.select(hit, llvm.fmul(alpha, before), constant(0.0))
    after = llvm.fsub(before, weight)
    goes_on = llvm.fcmp_ordered(">=", after, constant(T_LIFTED if lifts else T_MIN))
    if lifts:  # A ray that has ended has nothing left, so it stays as it is.
        weight, after = llvm.select(goes_on, weight, before), llvm.select(goes_on, after, constant(0.0))
    row.store(after, address)
    bits = llvm.or_(llvm.shl(row.bits(hit), ir.Constant(I64, LANES)), row.bits(goes_on))
    return row.context.make_tuple(llvm, row.signature.return_type, [weight, bits])


@intrinsic
def alpha_of(typing: Any, b: Any, lines: Any, wide: Any) -> tuple[Any, Callable[..., Any]]:
    """Alpha of one Gaussian in block b, as `blend_block` has it, whatever lies in front."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        alpha, power = _Splat(context, builder, signature, arguments).alpha(0)
        return builder.select(builder.fcmp_ordered(">=", power, constant(LOG_ALPHA_MIN)), alpha, constant(0.0))

    return row_type(b, lines, types.float32), generate
