"""Sixteen numbers at once: the arithmetic of the inner loops, as vector instructions.

A compiler that is left alone with a loop of sixteen unrolls it, cuts it into other widths or gives it up. Here the
operations are written as LLVM vectors of sixteen float32, which every processor gets in widths of its own: one register
of AVX-512, two of AVX, four of NEON.

Each `operation` below is a function for compiled code only. It takes C-contiguous float32 arrays whose last axis has
sixteen entries, and counts rows over all the other axes.
"""

from __future__ import annotations

import functools
import struct
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic as typed_intrinsic
from numba.extending import models, register_model

# Callers give all arguments but the first, which its types do not know.
intrinsic: Any = typed_intrinsic

LANES = 16

AHEAD = 12  # rows between the one that is worked on and the one to `prefetch`
FAST = {"contract", "nnan", "nsz", "reassoc"}  # what the compiler may do to sums of weights, none of which is NaN

F32, I32, I64 = ir.FloatType(), ir.IntType(32), ir.IntType(64)
ROW, BITS = ir.VectorType(F32, LANES), ir.VectorType(I32, LANES)

# 2^f on [-1/2, 1/2]: the polynomial of degree 5 of least relative error, 7.5e-8; the constant term first.
_EXP2 = (
    1.0000000716549167, 0.6931469670642137, 0.24022119722687324,
    0.055507132738379344, 0.009675541397010753, 0.0013276472058267423,
)  # fmt: skip


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
        kind = self.context.make_array(self.signature.args[position])
        array = kind(self.context, self.llvm, self.arguments[position])
        return self.llvm.gep(array.data, [number], source_etype=F32)

    def load(self, address: Any) -> Any:
        """Read a row; NumPy aligns arrays to 16 bytes only."""
        return self.llvm.load(address, align=4, typ=ROW)

    def store(self, value: Any, address: Any) -> None:
        """Write a row."""
        self.llvm.store(value, address, align=4)

    def broadcast(self, value: Any, kind: Any = ROW) -> Any:
        """Sixteen times a float32, or an int32 for `BITS`."""
        undefined, first = ir.Constant(kind, ir.Undefined), ir.Constant(I32, 0)
        single = self.llvm.insert_element(undefined, value, first)
        return self.llvm.shuffle_vector(single, undefined, ir.Constant(BITS, [0] * LANES))

    def bits(self, lanes: Any) -> Any:
        """Sixteen truth values as the low bits of an int64."""
        return self.llvm.zext(self.llvm.bitcast(lanes, ir.IntType(LANES)), I64)

    def lanes(self, bits: Any) -> Any:
        """Low bits of an int64 as sixteen truth values."""
        return self.llvm.bitcast(self.llvm.trunc(bits, ir.IntType(LANES)), ir.VectorType(ir.IntType(1), LANES))

    def minimum(self, a: Any, b: Any) -> Any:
        """Take the smaller one in each lane."""
        return self.llvm.select(self.llvm.fcmp_ordered("<", a, b), a, b)

    def maximum(self, a: Any, b: Any) -> Any:
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

    def sum_of_bits(self, a: Any) -> Any:
        """Sum of sixteen int32, which must be one."""
        return self.llvm.call(self._instruction("vector.reduce.add", I32, [BITS]), [a])

    def _instruction(self, name: str, result: Any, arguments: list[Any]) -> Any:
        kind = ir.FunctionType(result, arguments)
        insert: Any = cgutils.get_or_insert_function
        return insert(self.llvm.module, kind, f"llvm.{name}.v{LANES}{'i' if BITS in arguments else 'f'}32")

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


def operation(result: Any, *kinds: Any) -> Callable[[Callable[..., Any]], Any]:
    """Make a function for compiled code of one that writes its instructions.

    The latter is given a `Builder`, and then the arguments, which have the types `kinds`, None for any. What it returns
    is of the type `result`, nothing if that is void.
    """

    def make(write: Callable[..., Any]) -> Any:
        @functools.wraps(write)
        def typed(typing: Any, *given: Any) -> tuple[Any, Callable[..., Any]]:
            def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
                value = write(Builder(context, builder, signature, arguments), *arguments)
                return context.get_dummy_value() if value is None else value

            taken = (any_kind if kind is None else kind for kind, any_kind in zip(kinds, given, strict=True))
            return result(*taken), generate

        return intrinsic(typed)

    return make


def empty_rows(count: int) -> np.ndarray:
    """Make room for rows, (count, 16) float32, each of which is one line of the processor's cache and not in two."""
    line = LANES * np.dtype(np.float32).itemsize
    room = np.empty((count + 1) * line, np.uint8)
    first = -room.ctypes.data % line
    return room[first : first + count * line].view(np.float32).reshape(count, LANES)


@operation(types.int64, types.int64)
def first_bit(build: Builder, bits: Any) -> Any:
    """Position of the lowest bit that is set; there must be one."""
    return build.llvm.cttz(bits, ir.Constant(ir.IntType(1), 1))


@operation(types.int64, types.int64)
def count_bits(build: Builder, bits: Any) -> Any:
    """How many bits are set."""
    return build.llvm.ctpop(bits)


@operation(types.int64, None, None, types.int32)
def count_at_most(build: Builder, numbers: Any, i: Any, limit: Any) -> Any:
    """Count which of the sixteen int32 in row i are not above a limit."""
    address = build.llvm.bitcast(build.row(0), ir.PointerType(BITS))
    found = build.llvm.icmp_signed("<=", build.llvm.load(address, align=4, typ=BITS), build.broadcast(limit, BITS))
    return build.llvm.ctpop(build.bits(found))


@operation(types.int64, None, None, types.int64)
def sum_where(build: Builder, numbers: Any, i: Any, bits: Any) -> Any:
    """Sum of the sixteen int32 in row i in the lanes of the bits that are set; it must be one itself."""
    row = build.llvm.load(build.llvm.bitcast(build.row(0), ir.PointerType(BITS)), align=4, typ=BITS)
    kept = build.llvm.select(build.lanes(bits), row, ir.Constant(BITS, [0] * LANES))
    return build.llvm.sext(build.sum_of_bits(kept), I64)


@operation(row_type)
def zero_row(build: Builder) -> Any:
    """Sixteen zeros."""
    return constant(0.0)


@operation(types.void, None, None, None)
def store_row(build: Builder, target: Any, i: Any, a: Any) -> None:
    """Set target[i] to sixteen numbers."""
    build.store(a, build.row(0))


@operation(row_type, None, None)
def load_row(build: Builder, source: Any, i: Any) -> Any:
    """Read source[i]."""
    return build.load(build.row(0))


@operation(row_type, None, None, types.float32, types.float32, types.float32)
def squared_distances(build: Builder, points: Any, i: Any, x: Any, y: Any, z: Any) -> Any:
    """From (x, y, z) to sixteen points, whose coordinates are points[i] to points[i + 2]; unfused, as scalars are."""
    total = None
    for axis, center in enumerate((x, y, z)):
        number = build.llvm.add(i, ir.Constant(i.type, axis))
        offset = build.llvm.fsub(build.load(build.address(0, number)), build.broadcast(center))
        square = build.llvm.fmul(offset, offset)
        total = square if total is None else build.llvm.fadd(total, square)
    return total


@operation(types.int64, None, types.float32)
def at_most(build: Builder, a: Any, limit: Any) -> Any:
    """Bits of the lanes that are not above a limit."""
    return build.bits(build.llvm.fcmp_ordered("<=", a, build.broadcast(limit)))


@operation(row_type, types.int64, None, None)
def where(build: Builder, bits: Any, a: Any, b: Any) -> Any:
    """Take the one row in the lanes of the bits that are set, and the other one elsewhere."""
    return build.llvm.select(build.lanes(bits), a, b)


@operation(row_type, None, None)
def add(build: Builder, total: Any, a: Any) -> Any:
    """Add two rows."""
    return build.llvm.fadd(total, a)


@operation(row_type, None, None, None)
def add_product(build: Builder, total: Any, a: Any, b: Any) -> Any:
    """Add a product of two rows."""
    return build.fma(a, b, total)


@operation(row_type, None, None, types.float32)
def add_scaled(build: Builder, total: Any, a: Any, factor: Any) -> Any:
    """Add a multiple of a row."""
    return build.fma(build.broadcast(factor), a, total)


@operation(row_type, None, types.float32)
def divided(build: Builder, a: Any, number: Any) -> Any:
    """Divide a row by a number."""
    return build.llvm.fdiv(a, build.broadcast(number))


@operation(row_type, None, None)
def maximum(build: Builder, a: Any, b: Any) -> Any:
    """Take the larger one of two rows in each lane."""
    return build.maximum(a, b)


@operation(row_type, None, None)
def minimum(build: Builder, a: Any, b: Any) -> Any:
    """Take the smaller one of two rows in each lane."""
    return build.minimum(a, b)


@operation(types.int64, None, None, types.float32)
def above(build: Builder, a: Any, b: Any, margin: Any) -> Any:
    """Bits of the lanes in which one row exceeds another by more than a margin."""
    return build.bits(build.llvm.fcmp_ordered(">", build.llvm.fsub(a, b), build.broadcast(margin)))


@operation(types.int64, None, None, types.float32)
def differ(build: Builder, a: Any, b: Any, limit: Any) -> Any:
    """Bits of the lanes in which two rows differ by more than a limit."""
    difference = build.llvm.fsub(a, b)
    size = build.maximum(difference, build.llvm.fneg(difference))
    return build.bits(build.llvm.fcmp_ordered(">", size, build.broadcast(limit)))


@operation(types.float32, None)
def sum_row(build: Builder, a: Any) -> Any:
    """Sum of the sixteen."""
    return build.sum(a)


@operation(types.float32, None, None, None, None)
def dot(build: Builder, a: Any, i: Any, b: Any, j: Any) -> Any:
    """Sum of a[i] * b[j] over the sixteen."""
    return build.sum(build.llvm.fmul(build.load(build.row(0)), build.load(build.row(2))))


@operation(types.void, None, types.intp)
def prefetch(build: Builder, table: Any, i: Any) -> None:
    """Ask for a row of any array to be in the cache soon."""
    llvm, bytes_at = build.llvm, ir.PointerType(ir.IntType(8))
    array = build.context.make_array(build.signature.args[0])(build.context, llvm, table)
    stride = llvm.extract_value(array.strides, 0)
    address = llvm.gep(array.data, [llvm.mul(i, stride)], source_etype=ir.IntType(8))
    insert: Any = cgutils.get_or_insert_function
    function = insert(llvm.module, ir.FunctionType(ir.VoidType(), [bytes_at, I32, I32, I32]), "llvm.prefetch.p0")
    hints = [ir.Constant(I32, hint) for hint in (0, 3, 1)]  # to be read, and kept near; data, no code
    llvm.call(function, [llvm.bitcast(address, bytes_at), *hints])
