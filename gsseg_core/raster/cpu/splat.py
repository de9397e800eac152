"""One projected Gaussian over the pixels of a tile: which blocks it reaches, and how it is blended into one of them.

Both are vector instructions on sixteen numbers (`gsseg_core.simd`): the sixteen rows of a tile, and the sixteen pixels
of a block. A row of the table of projected Gaussians is what they read of it.
"""

from __future__ import annotations

import math
from typing import Any

from llvmlite import ir
from numba.core import cgutils, types

from gsseg_core.raster.constants import ALPHA_MAX, BLOCK, T_LIFTED, T_MIN
from gsseg_core.simd import BITS, F32, I64, LANES, ROW, Builder, constant, operation, row_type

OPEN = (1 << LANES) - 1  # of the bits of `blend_block`, those of the rays that are still open
LOG_ALPHA_MIN = -math.log2(255.0)  # log2 of the least alpha that counts

# Columns of the table of projected Gaussians.
U, V, SHEAR, WIDTH, HEIGHT, LOG_OPACITY, Y_REACH, X_TURN = range(8)

_ROWS = ir.Constant(ROW, [float(r) for r in range(LANES)])
_FOUR = ir.VectorType(F32, BLOCK)
_EACH_FOUR_TIMES = ir.Constant(BITS, [lane // BLOCK for lane in range(LANES)])
_COLUMNS_OF_BLOCKS = ir.Constant(
    ir.ArrayType(ROW, BLOCK),
    [ir.Constant(ROW, [float(BLOCK * i + lane % BLOCK) for lane in range(LANES)]) for i in range(BLOCK)],
)


def _row_of_lines(build: Builder, pair: Any, i: int) -> Any:
    """Find the number of row i of a pair of lines among the rows of all pairs."""
    return build.llvm.add(build.llvm.mul(pair, ir.Constant(pair.type, 2)), ir.Constant(pair.type, i))


def _four_of(build: Builder, position: int, pair: Any, i: int, block: Any) -> Any:
    """Entries of row i of a pair of lines that belong to the four rows of a block, each four times."""
    first = build.llvm.and_(block, ir.Constant(block.type, LANES - BLOCK))
    row = build.llvm.mul(_row_of_lines(build, pair, i), ir.Constant(pair.type, LANES))
    place = build.llvm.add(first, row)
    address = build.llvm.bitcast(build.element(position, place), ir.PointerType(_FOUR))
    four = build.llvm.load(address, align=4, typ=_FOUR)
    return build.llvm.shuffle_vector(four, ir.Constant(_FOUR, ir.Undefined), _EACH_FOUR_TIMES)


def _along_rows(build: Builder, position: int, rows: Any, left: Any, top: Any) -> tuple[Any, Any, Any]:
    """Column of the largest alpha in sixteen rows of a tile, log2 of that alpha, and the WIDTH of the Gaussian.

    Argument `position` is the table, the next one the row's number. The tile's first pixel has its centre at (left,
    top).
    """
    llvm, number = build.llvm, build.arguments[position + 1]
    first = llvm.mul(number, ir.Constant(number.type, 8))

    def column(j: int) -> Any:
        place = llvm.add(first, ir.Constant(number.type, j))
        return llvm.load(build.element(position, place), align=4, typ=F32)

    dy = llvm.fsub(rows, build.broadcast(llvm.fsub(column(V), top)))
    x = build.fma(build.broadcast(column(SHEAR)), dy, build.broadcast(llvm.fsub(column(U), left)))
    high = build.broadcast(llvm.fneg(column(HEIGHT)))
    return x, build.fma(high, llvm.fmul(dy, dy), build.broadcast(column(LOG_OPACITY))), column(WIDTH)


def _power(build: Builder, columns: Any, x: Any, peak: Any, wide: Any) -> Any:
    """Log2 of alpha at some columns, before it is clipped, in rows where its largest is `peak`, at column x."""
    offset = build.llvm.fsub(columns, x)
    return build.fma(build.broadcast(build.llvm.fneg(wide)), build.llvm.fmul(offset, offset), peak)


def _power_in_block(build: Builder, first: int) -> Any:
    """Log2 of alpha in a block, before it is clipped; arguments from `first` on: block, lines, pair and width."""
    block, _, pair, wide = build.arguments[first : first + 4]
    x, peak = (_four_of(build, first + 1, pair, i, block) for i in range(2))
    return _power(build, _pixel_columns(build, block), x, peak, wide)


def _counts(build: Builder, power: Any) -> Any:
    """Whether alpha is large enough to count, by log2 of it."""
    return build.llvm.fcmp_ordered(">=", power, constant(LOG_ALPHA_MIN))


def _alpha(build: Builder, power: Any) -> Any:
    """Alpha by log2 of it."""
    return build.minimum(build.exp2(power), constant(ALPHA_MAX))


def _pixel_columns(build: Builder, block: Any) -> Any:
    """Columns in the tile of the pixels of a block."""
    insert: Any = cgutils.global_constant
    table = insert(build.llvm.module, "columns_of_blocks", _COLUMNS_OF_BLOCKS)
    number = build.llvm.and_(block, ir.Constant(block.type, BLOCK - 1))
    place = build.llvm.gep(table, [ir.Constant(block.type, 0), number], source_etype=_COLUMNS_OF_BLOCKS.type)
    return build.llvm.load(place, align=4, typ=ROW)


@operation(types.int64, None, types.intp, types.float32, types.float32, None, types.int64)
def aim(build: Builder, table: Any, g: Any, left: Any, top: Any, lines: Any, pair: Any) -> Any:
    """Tell which blocks of a tile a Gaussian reaches: bit b is set if alpha is at least 1/255 at some pixel of block b.

    The tile's first pixel has its centre at (left, top). For each row of the tile, the first row of that pair of
    lines, (P, 2, 16) float32, gets the column of the largest alpha, and the second one what log2 of alpha would be
    there. A view of the pair would do, too, but kernels count who holds a view, and an atomic count takes as long as a
    block.
    """
    llvm, (x, peak, wide) = build.llvm, _along_rows(build, 0, _ROWS, left, top)
    build.store(x, build.address(4, _row_of_lines(build, pair, 0)))
    build.store(peak, build.address(4, _row_of_lines(build, pair, 1)))
    # In each row, no pixel of a block is nearer to the peak than this one, and its alpha is computed as `blend_block`
    # does: so the bits say exactly what will be found there.
    whole, bits = build.rint(x), ir.Constant(I64, 0)
    for i in range(BLOCK):
        nearest = build.minimum(build.maximum(whole, constant(float(BLOCK * i))), constant(BLOCK * i + BLOCK - 1.0))
        found = build.bits(_counts(build, _power(build, nearest, x, peak, wide)))
        bits = llvm.or_(bits, llvm.shl(found, ir.Constant(I64, LANES * i)))
    # Bit 16 i + r of these is row r's, in the i-th column of blocks. Rows of four are put together, and columns of
    # blocks beside each other.
    for shift in (1, 2):
        bits = llvm.or_(bits, llvm.lshr(bits, ir.Constant(I64, shift)))
    bits = llvm.and_(bits, ir.Constant(I64, 0x1111111111111111))
    for shift in (LANES - 1, 2 * LANES - 2):
        bits = llvm.or_(bits, llvm.lshr(bits, ir.Constant(I64, shift)))
    return llvm.and_(bits, ir.Constant(I64, OPEN))


_FOUND: Any = types.Tuple((row_type, types.int64))  # type: ignore[no-untyped-call]


@operation(_FOUND, None, types.int64, None, types.int64, types.float32)
def blend_block(build: Builder, rays: Any, b: Any, lines: Any, pair: Any, wide: Any) -> Any:
    """Blend one Gaussian into block b of the rays.

    In column c of row r its log2 of alpha is peak - wide * (c - x)^2, with x and peak of row r from `aim`; below that
    of 1/255 alpha counts as 0. Returns its weights, and bits: the low sixteen say which rays are still open, the next
    ones which were hit.
    """
    return _taken(build, _power_in_block(build, 1), lifts=False)


@operation(_FOUND, None, types.int64, None, types.int64, types.float32)
def lift_block(build: Builder, rays: Any, b: Any, lines: Any, pair: Any, wide: Any) -> Any:
    """Blend one Gaussian into block b of rays that lift a mask: as `blend_block`, but they end as `T_LIFTED` says."""
    return _taken(build, _power_in_block(build, 1), lifts=True)


@operation(_FOUND, None, None, None, None, types.intp, types.float32, types.float32)
def reach_pixels(build: Builder, rows: Any, columns: Any, b: Any, table: Any, g: Any, left: Any, top: Any) -> Any:
    """Tell which of any sixteen pixels of a tile a Gaussian reaches, by bits, and log2 of its alpha there.

    Their rows and columns in the tile are in row b of the two arrays. What comes out is bit for bit what `aim` and
    `blend_block` find.
    """
    x, peak, wide = _along_rows(build, 3, build.load(build.address(0, b)), left, top)
    power = _power(build, build.load(build.address(1, b)), x, peak, wide)
    found = build.bits(_counts(build, power))
    return build.context.make_tuple(build.llvm, build.signature.return_type, [power, found])


@operation(_FOUND, None, None, row_type)
def blend_pixels(build: Builder, rays: Any, b: Any, power: Any) -> Any:
    """Blend one Gaussian into the pixels of `reach_pixels`, which are row b of the rays, as `blend_block` does."""
    return _taken(build, power, lifts=False)


def _taken(build: Builder, power: Any, lifts: bool) -> Any:
    """Take what one Gaussian takes of sixteen rays, by log2 of its alpha; what is left of them is stored."""
    llvm = build.llvm
    address = build.row(0)
    before = build.load(address)
    hit = llvm.and_(_counts(build, power), llvm.fcmp_ordered(">=", before, constant(T_MIN)))
    # The flag keeps those off it by which a caller would fuse product and difference: where weights are not asked for,
    # rays would end a bit apart.
    taken = llvm.fmul(_alpha(build, power), before, flags=("nsz",))
    weight = llvm.select(hit, taken, constant(0.0))
    after = llvm.fsub(before, weight)
    goes_on = llvm.fcmp_ordered(">=", after, constant(T_LIFTED if lifts else T_MIN))
    if lifts:  # A ray that has ended has nothing left, so it stays as it is.
        weight, after = llvm.select(goes_on, weight, before), llvm.select(goes_on, after, constant(0.0))
    build.store(after, address)
    bits = llvm.or_(llvm.shl(build.bits(hit), ir.Constant(I64, LANES)), build.bits(goes_on))
    return build.context.make_tuple(llvm, build.signature.return_type, [weight, bits])


@operation(row_type, types.int64, None, types.int64, types.float32)
def alpha_of(build: Builder, b: Any, lines: Any, pair: Any, wide: Any) -> Any:
    """Alpha of one Gaussian in block b, as `blend_block` has it, whatever lies in front."""
    power = _power_in_block(build, 0)
    return build.llvm.select(_counts(build, power), _alpha(build, power), constant(0.0))
