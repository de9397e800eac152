"""Sixteen numbers at once: the arithmetic of the inner loops, as vector instructions.

A compiler that is left alone with a loop of sixteen unrolls it, cuts it into other widths or gives it up. Here the
operations are written as LLVM vectors of sixteen float32, which every processor gets in widths of its own: one register
of AVX-512, two of AVX, four of NEON.

The functions below are for compiled code only. Each takes C-contiguous float32 arrays whose last axis has sixteen
entries, and counts rows over all the other axes.
"""

from __future__ import annotations

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

FAST = {"contract", "nnan", "nsz", "reassoc"}
"""What the compiler may do to sums of weights, none of which is NaN."""

F32, I32, I64 = ir.FloatType(), ir.IntType(32), ir.IntType(64)
ROW, BITS = ir.VectorType(F32, LANES), ir.VectorType(I32, LANES)

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


row_type: Any = _RowType()


@register_model(_RowType)
class _RowModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, ROW)  # type: ignore[no-untyped-call]


class Builder:
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
        return self.llvm.bitcast(self.element(position, first), ir.PointerType(ROW))

    def element(self, position: int, number: Any) -> Any:
        """Address of one entry of the array that is argument `position`."""
        array = self.context.make_array(self.signature.args[position])(
            self.context, self.llvm, self.arguments[position]
        )
        return self.llvm.gep(array.data, [number], source_etype=F32)

    def load(self, address: Any) -> Any:
        """Read a row; NumPy aligns arrays to 16 bytes only."""
        return self.llvm.load(address, align=4, typ=ROW)

    def store(self, value: Any, address: Any) -> None:
        """Write a row."""
        self.llvm.store(value, address, align=4)

    def scalar(self, position: int) -> Any:
        """Argument `position`, a float32, sixteen times."""
        return self.spread(self.arguments[position])

    def spread(self, value: Any) -> Any:
        """Sixteen times a float32."""
        undefined, first = ir.Constant(ROW, ir.Undefined), ir.Constant(I32, 0)
        single = self.llvm.insert_element(undefined, value, first)
        return self.llvm.shuffle_vector(single, undefined, ir.Constant(BITS, [0] * LANES))

    def bits(self, lanes: Any) -> Any:
        """Sixteen truth values as the low bits of an int64."""
        return self.llvm.zext(self.llvm.bitcast(lanes, ir.IntType(LANES)), I64)

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
        return self.llvm.call(self._instruction("rint", ROW, [ROW]), [a])

    def fma(self, a: Any, b: Any, c: Any) -> Any:
        """Multiply and add, a * b + c, with one rounding."""
        return self.llvm.call(self._instruction("fma", ROW, [ROW] * 3), [a, b, c])

    def sum(self, a: Any) -> Any:
        """Sum of the sixteen, in pairs."""
        add = self._instruction("vector.reduce.fadd", F32, [F32, ROW])
        return self.llvm.call(add, [ir.Constant(F32, -0.0), a], fastmath=("reassoc", "nsz"))

    def _instruction(self, name: str, result: Any, arguments: list[Any]) -> Any:
        kind = ir.FunctionType(result, arguments)
        insert: Any = cgutils.get_or_insert_function
        return insert(self.llvm.module, kind, f"llvm.{name}.v{LANES}f32")

    def exp2(self, power: Any) -> Any:
        """2^power for powers in [-126, 127]; anything for others."""
        llvm = self.llvm
        whole = self.rint(power)
        f = llvm.fsub(power, whole)
        value = constant(_EXP2[-1])
        for coefficient in _EXP2[-2::-1]:
            value = self.fma(value, f, constant(coefficient))
        exponent = llvm.shl(llvm.fptosi(whole, BITS), ir.Constant(BITS, [23] * LANES))
        return llvm.bitcast(llvm.add(llvm.bitcast(value, BITS), exponent), ROW)


def constant(value: float) -> Any:
    """Sixteen times a number, rounded to float32."""
    return ir.Constant(ROW, [struct.unpack("f", struct.pack("f", value))[0]] * LANES)


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
        row = Builder(context, builder, signature, arguments)
        address = builder.bitcast(row.row(0), ir.PointerType(BITS))
        first = builder.insert_element(ir.Constant(BITS, ir.Undefined), arguments[2], ir.Constant(I32, 0))
        most = builder.shuffle_vector(first, first, ir.Constant(BITS, [0] * LANES))
        found = builder.icmp_signed("<=", builder.load(address, align=4, typ=BITS), most)
        return builder.ctpop(row.bits(found))

    return types.int64(numbers, i, types.int32), generate


@intrinsic
def nothing(typing: Any) -> tuple[Any, Callable[..., Any]]:
    """Sixteen zeros."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return constant(0.0)

    return row_type(), generate


@intrinsic
def store_row(typing: Any, target: Any, i: Any, a: Any) -> tuple[Any, Callable[..., Any]]:
    """Set target[i] to sixteen numbers."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        row = Builder(context, builder, signature, arguments)
        row.store(arguments[2], row.row(0))
        return context.get_dummy_value()

    return types.void(target, i, a), generate


@intrinsic
def load_row(typing: Any, source: Any, i: Any) -> tuple[Any, Callable[..., Any]]:
    """Read source[i]."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        row = Builder(context, builder, signature, arguments)
        return row.load(row.row(0))

    return row_type(source, i), generate


@intrinsic
def squared_distances(typing: Any, points: Any, i: Any, x: Any, y: Any, z: Any) -> tuple[Any, Callable[..., Any]]:
    """From (x, y, z) to sixteen points, whose coordinates are points[i] to points[i + 2]; unfused, as scalars are."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        row = Builder(context, builder, signature, arguments)
        total = None
        for axis in range(3):
            number = builder.add(arguments[1], ir.Constant(arguments[1].type, axis))
            offset = builder.fsub(row.load(row.address(0, number)), row.scalar(2 + axis))
            square = builder.fmul(offset, offset)
            total = square if total is None else builder.fadd(total, square)
        return total

    number = types.float32
    return row_type(points, i, number, number, number), generate


@intrinsic
def at_most(typing: Any, a: Any, limit: Any) -> tuple[Any, Callable[..., Any]]:
    """Bits of the lanes that are not above a limit."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        row = Builder(context, builder, signature, arguments)
        return row.bits(builder.fcmp_ordered("<=", arguments[0], row.scalar(1)))

    return types.int64(a, types.float32), generate


@intrinsic
def add_where(typing: Any, total: Any, a: Any, lanes: Any) -> tuple[Any, Callable[..., Any]]:
    """Add two rows in the lanes of the bits that are set; elsewhere the first stays."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        row = Builder(context, builder, signature, arguments)
        return builder.select(row.lanes(2), builder.fadd(arguments[0], arguments[1]), arguments[0])

    return row_type(total, a, types.int64), generate


@intrinsic
def add_product(typing: Any, total: Any, a: Any, b: Any) -> tuple[Any, Callable[..., Any]]:
    """Add a product of two rows."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        row = Builder(context, builder, signature, arguments)
        return row.fma(arguments[1], arguments[2], arguments[0])

    return row_type(total, a, b), generate


@intrinsic
def add_scaled(typing: Any, total: Any, a: Any, factor: Any) -> tuple[Any, Callable[..., Any]]:
    """Add a multiple of a row."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        row = Builder(context, builder, signature, arguments)
        return row.fma(row.scalar(2), arguments[1], arguments[0])

    return row_type(total, a, types.float32), generate


@intrinsic
def add_product_where(typing: Any, total: Any, a: Any, b: Any, lanes: Any) -> tuple[Any, Callable[..., Any]]:
    """Add a product of two rows in the lanes of the bits that are set."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        row = Builder(context, builder, signature, arguments)
        return builder.select(row.lanes(3), row.fma(arguments[1], arguments[2], arguments[0]), arguments[0])

    return row_type(total, a, b, types.int64), generate


@intrinsic
def add_scaled_where(typing: Any, total: Any, a: Any, factor: Any, lanes: Any) -> tuple[Any, Callable[..., Any]]:
    """Add a multiple of a row in the lanes of the bits that are set."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        row = Builder(context, builder, signature, arguments)
        return builder.select(row.lanes(3), row.fma(row.scalar(2), arguments[1], arguments[0]), arguments[0])

    return row_type(total, a, types.float32, types.int64), generate


@intrinsic
def sum_row(typing: Any, a: Any) -> tuple[Any, Callable[..., Any]]:
    """Sum of the sixteen."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return Builder(context, builder, signature, arguments).sum(arguments[0])

    return types.float32(a), generate


@intrinsic
def dot(typing: Any, a: Any, i: Any, b: Any, j: Any) -> tuple[Any, Callable[..., Any]]:
    """Sum of a[i] * b[j] over the sixteen."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        row = Builder(context, builder, signature, arguments)
        return row.sum(builder.fmul(row.load(row.row(0)), row.load(row.row(2))))

    return types.float32(a, i, b, j), generate


@intrinsic
def prefetch(typing: Any, table: Any, row: Any) -> tuple[Any, Callable[..., Any]]:
    """Ask for a row of any array to be in the cache soon."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        array = context.make_array(signature.args[0])(context, builder, arguments[0])
        stride = builder.extract_value(array.strides, 0)
        address = builder.gep(array.data, [builder.mul(arguments[1], stride)], source_etype=ir.IntType(8))
        kind = ir.FunctionType(ir.VoidType(), [ir.PointerType(ir.IntType(8)), I32, I32, I32])
        insert: Any = cgutils.get_or_insert_function
        function = insert(builder.module, kind, "llvm.prefetch.p0")
        address = builder.bitcast(address, ir.PointerType(ir.IntType(8)))
        builder.call(function, [address, ir.Constant(I32, 0), ir.Constant(I32, 3), ir.Constant(I32, 1)])
        return context.get_dummy_value()

    return types.void(table, types.intp), generate
