"""Sixteen pixels at once: the arithmetic of one row of a tile, as vector instructions.

A compiler that is left alone with a loop of sixteen unrolls it, cuts it into other widths or gives it up. Here the
operations are written as LLVM vectors of sixteen float32, which every processor gets in widths of its own: one register
of AVX-512, two of AVX, four of NEON.

The functions below are for compiled code only. Each takes C-contiguous float32 arrays whose last axis has sixteen
entries, and counts rows over all the other axes.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Sequence
from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic as typed_intrinsic
from numba.extending import models, register_model

# Callers give all arguments but the first, which its types do not know.
intrinsic: Any = typed_intrinsic

LANES = 16

SIDE = 4
"""Side of a block in px: its sixteen pixels, row by row, are one vector."""

OPEN = (1 << LANES) - 1
"""Of the bits of `blend_row`, those of the rays that are still open."""

FAST = {"contract", "nnan", "nsz", "reassoc"}
"""What the compiler may do to sums of weights, none of which is NaN."""

ALPHA_MAX = 0.99
LOG_ALPHA_MIN = -math.log2(255.0)
"""log2 of the least alpha that counts."""

T_MIN = 1e-4
"""A ray ends when its transmittance falls below this."""

# Columns of the table of projected Gaussians.
U, V, SHEAR, WIDTH, HEIGHT, LOG_OPACITY, Y_REACH, X_TURN = range(8)

_F32, _I32, _I64 = ir.FloatType(), ir.IntType(32), ir.IntType(64)
_ROW, _BITS = ir.VectorType(_F32, LANES), ir.VectorType(_I32, LANES)
_COLUMNS = ir.Constant(_ROW, [float(i) for i in range(LANES)])

_FOUR = ir.VectorType(_F32, SIDE)
_EACH_FOUR_TIMES = ir.Constant(_BITS, [lane // SIDE for lane in range(LANES)])
_COLUMNS_OF_BLOCKS = ir.Constant(
    ir.ArrayType(_ROW, SIDE),
    [ir.Constant(_ROW, [float(SIDE * i + lane % SIDE) for lane in range(LANES)]) for i in range(SIDE)],
)

# 2^f on [-1/2, 1/2]: the polynomial of degree 5 of least relative error, 7.5e-8; the constant term first.
_EXP2 = (
    1.0000000716549167,
    0.6931469670642137,
    0.24022119722687324,
    0.055507132738379344,
    0.009675541397010753,
    0.0013276472058267423,
)


class _RowType(types.Type):
    """Sixteen float32 in a register."""

    def __init__(self) -> None:
        super().__init__(name="Row")


_row_type: Any = _RowType()


@register_model(_RowType)
class _RowModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _ROW)  # type: ignore[no-untyped-call]


class _Builder:
    """Writes operations on rows of sixteen into the code of one function."""

    def __init__(self, context: Any, builder: Any, signature: Any, arguments: Sequence[Any]) -> None:
        self.context, self.llvm = context, builder
        self.signature, self.arguments = signature, arguments

    def row(self, position: int) -> Any:
        """Address of a row: argument `position` is the array, the next one the row's number."""
        return self.address(position, self.arguments[position + 1])

    def address(self, position: int, number: Any) -> Any:
        """Address of a row of the array that is argument `position`."""
        first = self.llvm.mul(number, ir.Constant(number.type, LANES))
        return self.llvm.bitcast(self.element(position, first), ir.PointerType(_ROW))

    def element(self, position: int, number: Any) -> Any:
        """Address of one entry of the array that is argument `position`."""
        array = self.context.make_array(self.signature.args[position])(
            self.context, self.llvm, self.arguments[position]
        )
        return self.llvm.gep(array.data, [number], source_etype=_F32)

    def columns(self, position: int) -> Callable[[int], Any]:
        """Columns of a row of eight: argument `position` is the array, the next one the row's number."""
        number = self.arguments[position + 1]
        first = self.llvm.mul(number, ir.Constant(number.type, 8))

        def column(j: int) -> Any:
            place = self.llvm.add(first, ir.Constant(number.type, j))
            return self.llvm.load(self.element(position, place), align=4, typ=_F32)

        return column

    def four_of(self, position: int, i: int, block: Any) -> Any:
        """Entries of row i that belong to the four rows of a block, each four times."""
        first = self.llvm.and_(block, ir.Constant(block.type, LANES - SIDE))
        place = self.llvm.add(first, ir.Constant(block.type, i * LANES))
        address = self.llvm.bitcast(self.element(position, place), ir.PointerType(_FOUR))
        four = self.llvm.load(address, align=4, typ=_FOUR)
        return self.llvm.shuffle_vector(four, ir.Constant(_FOUR, ir.Undefined), _EACH_FOUR_TIMES)

    def columns_of(self, position: int) -> Any:
        """Columns in the tile of the pixels of a block, which is argument `position`."""
        block = self.arguments[position]
        constant: Any = cgutils.global_constant
        table = constant(self.llvm.module, "columns_of_blocks", _COLUMNS_OF_BLOCKS)
        number = self.llvm.and_(block, ir.Constant(block.type, SIDE - 1))
        place = self.llvm.gep(table, [ir.Constant(block.type, 0), number], source_etype=_COLUMNS_OF_BLOCKS.type)
        return self.llvm.load(place, align=4, typ=_ROW)

    def load(self, address: Any) -> Any:
        """Read a row; NumPy aligns arrays to 16 bytes only."""
        return self.llvm.load(address, align=4, typ=_ROW)

    def store(self, value: Any, address: Any) -> None:
        """Write a row."""
        self.llvm.store(value, address, align=4)

    def scalar(self, position: int) -> Any:
        """Argument `position`, a float32, sixteen times."""
        return self.spread(self.arguments[position])

    def spread(self, value: Any) -> Any:
        """Sixteen times a float32."""
        undefined, first = ir.Constant(_ROW, ir.Undefined), ir.Constant(_I32, 0)
        single = self.llvm.insert_element(undefined, value, first)
        return self.llvm.shuffle_vector(single, undefined, ir.Constant(_BITS, [0] * LANES))

    def bits(self, lanes: Any) -> Any:
        """Sixteen truth values as the low bits of an int64."""
        return self.llvm.zext(self.llvm.bitcast(lanes, ir.IntType(LANES)), _I64)

    def lanes(self, position: int) -> Any:
        """Low bits of argument `position`, an int64, as sixteen truth values."""
        low = self.llvm.trunc(self.arguments[position], ir.IntType(LANES))
        return self.llvm.bitcast(low, ir.VectorType(ir.IntType(1), LANES))

    def least(self, a: Any, b: Any) -> Any:
        """Take the smaller one in each lane."""
        return self.llvm.select(self.llvm.fcmp_ordered("<", a, b), a, b)

    def most(self, a: Any, b: Any) -> Any:
        """Take the larger one in each lane."""
        return self.llvm.select(self.llvm.fcmp_ordered(">", a, b), a, b)

    def rint(self, a: Any) -> Any:
        """Round to whole numbers."""
        # Not by adding and subtracting a large number, which a caller compiled with fastmath would cancel.
        return self.llvm.call(self._instruction("rint", _ROW, [_ROW]), [a])

    def fma(self, a: Any, b: Any, c: Any) -> Any:
        """Multiply and add, a * b + c, with one rounding."""
        return self.llvm.call(self._instruction("fma", _ROW, [_ROW] * 3), [a, b, c])

    def sum(self, a: Any) -> Any:
        """Sum of the sixteen, in pairs."""
        add = self._instruction("vector.reduce.fadd", _F32, [_F32, _ROW])
        return self.llvm.call(add, [ir.Constant(_F32, -0.0), a], fastmath=("reassoc", "nsz"))

    def _instruction(self, name: str, result: Any, arguments: list[Any]) -> Any:
        kind = ir.FunctionType(result, arguments)
        insert: Any = cgutils.get_or_insert_function
        return insert(self.llvm.module, kind, f"llvm.{name}.v{LANES}f32")

    def exp2(self, power: Any) -> Any:
        """2^power for powers in [-126, 127]; anything for others."""
        llvm = self.llvm
        whole = self.rint(power)
        f = llvm.fsub(power, whole)
        value = _row(_EXP2[-1])
        for coefficient in _EXP2[-2::-1]:
            value = self.fma(value, f, _row(coefficient))
        exponent = llvm.shl(llvm.fptosi(whole, _BITS), ir.Constant(_BITS, [23] * LANES))
        return llvm.bitcast(llvm.add(llvm.bitcast(value, _BITS), exponent), _ROW)


def _row(value: float) -> Any:
    """Sixteen times a number, rounded to float32."""
    return ir.Constant(_ROW, [struct.unpack("f", struct.pack("f", value))[0]] * LANES)


@intrinsic
def aim(typing: Any, table: Any, g: Any, left: Any, top: Any, lines: Any) -> tuple[Any, Callable[..., Any]]:
    """Tell which blocks of a tile a Gaussian reaches: bit b is set if alpha is at least 1/255 at some pixel of block b.

    The tile's first pixel has its centre at (left, top). For each row of the tile, lines[0] gets the column of the
    largest alpha, and lines[1] what log2 of alpha would be there.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        row = _Builder(context, builder, signature, arguments)
        column = row.columns(0)
        dy = builder.fsub(_COLUMNS, row.spread(builder.fsub(column(V), arguments[3])))
        x = row.fma(row.spread(column(SHEAR)), dy, row.spread(builder.fsub(column(U), arguments[2])))
        high, wide = row.spread(builder.fneg(column(HEIGHT))), row.spread(builder.fneg(column(WIDTH)))
        peak = row.fma(high, builder.fmul(dy, dy), row.spread(column(LOG_OPACITY)))
        row.store(x, row.address(4, ir.Constant(_I64, 0)))
        row.store(peak, row.address(4, ir.Constant(_I64, 1)))
        # In each row, no pixel of a block is nearer to the peak than this one, and its alpha is computed as
        # `blend_block` does: so the bits say exactly what will be found there.
        whole, bits = row.rint(x), ir.Constant(_I64, 0)
        for i in range(SIDE):
            nearest = row.least(row.most(whole, _row(float(SIDE * i))), _row(SIDE * i + SIDE - 1.0))
            offset = builder.fsub(nearest, x)
            power = row.fma(wide, builder.fmul(offset, offset), peak)
            found = row.bits(builder.fcmp_ordered(">=", power, _row(LOG_ALPHA_MIN)))
            bits = builder.or_(bits, builder.shl(found, ir.Constant(_I64, LANES * i)))
        # Bit 16 i + r of these is row r's, in the i-th column of blocks. Rows of four are put together, and columns
        # of blocks beside each other.
        for shift in (1, 2):
            bits = builder.or_(bits, builder.lshr(bits, ir.Constant(_I64, shift)))
        bits = builder.and_(bits, ir.Constant(_I64, 0x1111111111111111))
        for shift in (LANES - 1, 2 * LANES - 2):
            bits = builder.or_(bits, builder.lshr(bits, ir.Constant(_I64, shift)))
        return builder.and_(bits, ir.Constant(_I64, OPEN))

    number = types.float32
    return types.int64(table, types.intp, number, number, lines), generate


@intrinsic
def first_bit(typing: Any, bits: Any) -> tuple[Any, Callable[..., Any]]:
    """Position of the lowest bit that is set; there must be one."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.cttz(arguments[0], ir.Constant(ir.IntType(1), 1))

    return types.int64(types.int64), generate


@intrinsic
def count_bits(typing: Any, bits: Any) -> tuple[Any, Callable[..., Any]]:
    """How many bits are set."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.ctpop(arguments[0])

    return types.int64(types.int64), generate


@intrinsic
def count_at_most(typing: Any, numbers: Any, i: Any, limit: Any) -> tuple[Any, Callable[..., Any]]:
    """Count which of the sixteen int32 in row i are not above a limit."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        row = _Builder(context, builder, signature, arguments)
        address = builder.bitcast(row.row(0), ir.PointerType(_BITS))
        first = builder.insert_element(ir.Constant(_BITS, ir.Undefined), arguments[2], ir.Constant(_I32, 0))
        most = builder.shuffle_vector(first, first, ir.Constant(_BITS, [0] * LANES))
        found = builder.icmp_signed("<=", builder.load(address, align=4, typ=_BITS), most)
        return builder.ctpop(row.bits(found))

    return types.int64(numbers, i, types.int32), generate


@intrinsic
def blend_block(typing: Any, rays: Any, b: Any, lines: Any, wide: Any) -> tuple[Any, Callable[..., Any]]:
    """Blend one Gaussian into block b of the rays.

    In column c of row r its log2 of alpha is peak - wide * (c - x)^2, with x and peak of row r from `aim`; below that
    of 1/255 alpha counts as 0. Returns its weights, and bits: the low sixteen say which rays are still open, the next
    ones which were hit.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        row = _Builder(context, builder, signature, arguments)
        offset = builder.fsub(row.columns_of(1), row.four_of(2, 0, arguments[1]))
        peak = row.four_of(2, 1, arguments[1])
        power = row.fma(row.spread(builder.fneg(arguments[3])), builder.fmul(offset, offset), peak)
        alpha = row.exp2(power)
        alpha = builder.select(builder.fcmp_ordered("<", alpha, _row(ALPHA_MAX)), alpha, _row(ALPHA_MAX))
        address = row.row(0)
        before = row.load(address)
        hit = builder.and_(
            builder.fcmp_ordered(">=", power, _row(LOG_ALPHA_MIN)), builder.fcmp_ordered(">=", before, _row(T_MIN))
        )
        weight = builder.select(hit, builder.fmul(alpha, before), _row(0.0))
        after = builder.fsub(before, weight)
        row.store(after, address)
        still_open = row.bits(builder.fcmp_ordered(">=", after, _row(T_MIN)))
        bits = builder.or_(builder.shl(row.bits(hit), ir.Constant(_I64, LANES)), still_open)
        return context.make_tuple(builder, signature.return_type, [weight, bits])

    both: Any = types.Tuple((_row_type, types.int64))  # type: ignore[no-untyped-call]
    return both(rays, b, lines, types.float32), generate


@intrinsic
def nothing(typing: Any) -> tuple[Any, Callable[..., Any]]:
    """Sixteen zeros."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return _row(0.0)

    return _row_type(), generate


@intrinsic
def store_row(typing: Any, target: Any, i: Any, a: Any) -> tuple[Any, Callable[..., Any]]:
    """Set target[i] to sixteen numbers."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        row = _Builder(context, builder, signature, arguments)
        row.store(arguments[2], row.row(0))
        return context.get_dummy_value()

    return types.void(target, i, a), generate


@intrinsic
def load_row(typing: Any, source: Any, i: Any) -> tuple[Any, Callable[..., Any]]:
    """Read source[i]."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        row = _Builder(context, builder, signature, arguments)
        return row.load(row.row(0))

    return _row_type(source, i), generate


@intrinsic
def squared_distances(typing: Any, points: Any, i: Any, x: Any, y: Any, z: Any) -> tuple[Any, Callable[..., Any]]:
    """From (x, y, z) to sixteen points, whose coordinates are points[i] to points[i + 2]; unfused, as scalars are."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        row = _Builder(context, builder, signature, arguments)
        total = None
        for axis in range(3):
            number = builder.add(arguments[1], ir.Constant(arguments[1].type, axis))
            offset = builder.fsub(row.load(row.address(0, number)), row.scalar(2 + axis))
            square = builder.fmul(offset, offset)
            total = square if total is None else builder.fadd(total, square)
        return total

    number = types.float32
    return _row_type(points, i, number, number, number), generate


@intrinsic
def at_most(typing: Any, a: Any, limit: Any) -> tuple[Any, Callable[..., Any]]:
    """Bits of the lanes that are not above a limit."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        row = _Builder(context, builder, signature, arguments)
        return row.bits(builder.fcmp_ordered("<=", arguments[0], row.scalar(1)))

    return types.int64(a, types.float32), generate


@intrinsic
def add_where(typing: Any, total: Any, a: Any, lanes: Any) -> tuple[Any, Callable[..., Any]]:
    """Add two rows in the lanes of the bits that are set; elsewhere the first stays."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        row = _Builder(context, builder, signature, arguments)
        return builder.select(row.lanes(2), builder.fadd(arguments[0], arguments[1]), arguments[0])

    return _row_type(total, a, types.int64), generate


@intrinsic
def add_product(typing: Any, total: Any, a: Any, b: Any) -> tuple[Any, Callable[..., Any]]:
    """Add a product of two rows."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        row = _Builder(context, builder, signature, arguments)
        return row.fma(arguments[1], arguments[2], arguments[0])

    return _row_type(total, a, b), generate


@intrinsic
def add_scaled(typing: Any, total: Any, a: Any, factor: Any) -> tuple[Any, Callable[..., Any]]:
    """Add a multiple of a row."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        row = _Builder(context, builder, signature, arguments)
        return row.fma(row.scalar(2), arguments[1], arguments[0])

    return _row_type(total, a, types.float32), generate


@intrinsic
def add_product_where(typing: Any, total: Any, a: Any, b: Any, lanes: Any) -> tuple[Any, Callable[..., Any]]:
    """Add a product of two rows in the lanes of the bits that are set."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        row = _Builder(context, builder, signature, arguments)
        return builder.select(row.lanes(3), row.fma(arguments[1], arguments[2], arguments[0]), arguments[0])

    return _row_type(total, a, b, types.int64), generate


@intrinsic
def add_scaled_where(typing: Any, total: Any, a: Any, factor: Any, lanes: Any) -> tuple[Any, Callable[..., Any]]:
    """Add a multiple of a row in the lanes of the bits that are set."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        row = _Builder(context, builder, signature, arguments)
        return builder.select(row.lanes(3), row.fma(row.scalar(2), arguments[1], arguments[0]), arguments[0])

    return _row_type(total, a, types.float32, types.int64), generate


@intrinsic
def sum_row(typing: Any, a: Any) -> tuple[Any, Callable[..., Any]]:
    """Sum of the sixteen."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return _Builder(context, builder, signature, arguments).sum(arguments[0])

    return types.float32(a), generate


@intrinsic
def dot(typing: Any, a: Any, i: Any, b: Any, j: Any) -> tuple[Any, Callable[..., Any]]:
    """Sum of a[i] * b[j] over the sixteen."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        row = _Builder(context, builder, signature, arguments)
        return row.sum(builder.fmul(row.load(row.row(0)), row.load(row.row(2))))

    return types.float32(a, i, b, j), generate


@intrinsic
def prefetch(typing: Any, table: Any, row: Any) -> tuple[Any, Callable[..., Any]]:
    """Ask for a row of any array to be in the cache soon."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        array = context.make_array(signature.args[0])(context, builder, arguments[0])
        stride = builder.extract_value(array.strides, 0)
        address = builder.gep(array.data, [builder.mul(arguments[1], stride)], source_etype=ir.IntType(8))
        kind = ir.FunctionType(ir.VoidType(), [ir.PointerType(ir.IntType(8)), _I32, _I32, _I32])
        insert: Any = cgutils.get_or_insert_function
        function = insert(builder.module, kind, "llvm.prefetch.p0")
        address = builder.bitcast(address, ir.PointerType(ir.IntType(8)))
        builder.call(function, [address, ir.Constant(_I32, 0), ir.Constant(_I32, 3), ir.Constant(_I32, 1)])
        return context.get_dummy_value()

    return types.void(table, types.intp), generate
