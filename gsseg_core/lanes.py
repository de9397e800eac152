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

# Callers give all arguments but the first, which its types do not know.
intrinsic: Any = typed_intrinsic

LANES = 16

ALPHA_MAX = 0.99
LOG_ALPHA_MIN = -math.log2(255.0)
"""log2 of the least alpha that counts."""

T_MIN = 1e-4
"""A ray ends when its transmittance falls below this."""

_F32, _I32 = ir.FloatType(), ir.IntType(32)
_ROW, _BITS = ir.VectorType(_F32, LANES), ir.VectorType(_I32, LANES)
_COLUMNS = ir.Constant(_ROW, [float(i) for i in range(LANES)])

# 2^f on [-1/2, 1/2]: the polynomial of degree 5 of least relative error, 7.5e-8; the constant term first.
_EXP2 = (
    1.0000000716549167,
    0.6931469670642137,
    0.24022119722687324,
    0.055507132738379344,
    0.009675541397010753,
    0.0013276472058267423,
)


class _Builder:
    """Writes operations on rows of sixteen into the code of one function."""

    def __init__(self, context: Any, builder: Any, signature: Any, arguments: Sequence[Any]) -> None:
        self.context, self.llvm = context, builder
        self.signature, self.arguments = signature, arguments

    def row(self, position: int) -> Any:
        """Address of a row: argument `position` is the array, the next one the row's number."""
        kind = self.signature.args[position]
        array = self.context.make_array(kind)(self.context, self.llvm, self.arguments[position])
        number = self.arguments[position + 1]
        first = self.llvm.mul(number, ir.Constant(number.type, LANES))
        address = self.llvm.gep(array.data, [first], source_etype=_F32)
        return self.llvm.bitcast(address, ir.PointerType(_ROW))

    def load(self, address: Any) -> Any:
        """Read a row; NumPy aligns arrays to 16 bytes only."""
        return self.llvm.load(address, align=4, typ=_ROW)

    def store(self, value: Any, address: Any) -> None:
        """Write a row."""
        self.llvm.store(value, address, align=4)

    def scalar(self, position: int) -> Any:
        """Argument `position`, a float32, sixteen times."""
        undefined, first = ir.Constant(_ROW, ir.Undefined), ir.Constant(_I32, 0)
        single = self.llvm.insert_element(undefined, self.arguments[position], first)
        return self.llvm.shuffle_vector(single, undefined, ir.Constant(_BITS, [0] * LANES))

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
        # Not by adding and subtracting a large number, which a caller compiled with fastmath would cancel.
        whole = llvm.call(self._instruction("rint", _ROW, [_ROW]), [power])
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
def blend_row(
    typing: Any, rays: Any, r: Any, records: Any, n: Any, x: Any, peak: Any, wide: Any
) -> tuple[Any, Callable[..., Any]]:
    """Blend one Gaussian into row r of the rays: write its weights to record n, return whether a ray is still open.

    In column c its log2 of alpha is peak - wide * (c - x)^2; below that of 1/255 alpha counts as 0.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        row = _Builder(context, builder, signature, arguments)
        offset = builder.fsub(_COLUMNS, row.scalar(4))
        power = row.fma(builder.fneg(row.scalar(6)), builder.fmul(offset, offset), row.scalar(5))
        alpha = row.exp2(power)
        alpha = builder.select(builder.fcmp_ordered("<", alpha, _row(ALPHA_MAX)), alpha, _row(ALPHA_MAX))
        address = row.row(0)
        before = row.load(address)
        counts = builder.and_(
            builder.fcmp_ordered(">=", power, _row(LOG_ALPHA_MIN)), builder.fcmp_ordered(">=", before, _row(T_MIN))
        )
        weight = builder.select(counts, builder.fmul(alpha, before), _row(0.0))
        after = builder.fsub(before, weight)
        row.store(weight, row.row(2))
        row.store(after, address)
        open_rays = builder.bitcast(builder.fcmp_ordered(">=", after, _row(T_MIN)), ir.IntType(LANES))
        hit = builder.bitcast(counts, ir.IntType(LANES))
        return builder.or_(builder.shl(builder.zext(hit, _I32), ir.Constant(_I32, 16)), builder.zext(open_rays, _I32))

    number = types.float32
    return types.uint32(rays, r, records, n, number, number, number), generate


@intrinsic
def dot(typing: Any, a: Any, i: Any, b: Any, j: Any) -> tuple[Any, Callable[..., Any]]:
    """Sum of a[i] * b[j] over the sixteen."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        row = _Builder(context, builder, signature, arguments)
        return row.sum(builder.fmul(row.load(row.row(0)), row.load(row.row(2))))

    return types.float32(a, i, b, j), generate


@intrinsic
def add_scaled(typing: Any, target: Any, i: Any, a: Any, j: Any, factor: Any) -> tuple[Any, Callable[..., Any]]:
    """Add factor * a[j] to target[i]."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        row = _Builder(context, builder, signature, arguments)
        address = row.row(0)
        row.store(row.fma(row.scalar(4), row.load(row.row(2)), row.load(address)), address)
        return context.get_dummy_value()

    return types.void(target, i, a, j, types.float32), generate


@intrinsic
def add_product(typing: Any, target: Any, i: Any, a: Any, j: Any, b: Any, k: Any) -> tuple[Any, Callable[..., Any]]:
    """Add a[j] * b[k] to target[i]."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        row = _Builder(context, builder, signature, arguments)
        address = row.row(0)
        row.store(row.fma(row.load(row.row(2)), row.load(row.row(4)), row.load(address)), address)
        return context.get_dummy_value()

    return types.void(target, i, a, j, b, k), generate


@intrinsic
def add_scaled_product(
    typing: Any, target: Any, i: Any, a: Any, j: Any, b: Any, k: Any, factor: Any
) -> tuple[Any, Callable[..., Any]]:
    """Add factor * a[j] * b[k] to target[i]."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        row = _Builder(context, builder, signature, arguments)
        address = row.row(0)
        product = builder.fmul(row.load(row.row(2)), row.load(row.row(4)))
        row.store(row.fma(row.scalar(6), product, row.load(address)), address)
        return context.get_dummy_value()

    return types.void(target, i, a, j, b, k, types.float32), generate


@intrinsic
def take_sum(typing: Any, a: Any, i: Any) -> tuple[Any, Callable[..., Any]]:
    """Sum of a[i] over the sixteen; a[i] is zero afterwards."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        row = _Builder(context, builder, signature, arguments)
        address = row.row(0)
        total = row.sum(row.load(address))
        row.store(_row(0.0), address)
        return total

    return types.float32(a, i), generate


@intrinsic
def prefetch(typing: Any, table: Any, row: Any) -> tuple[Any, Callable[..., Any]]:
    """Ask for a row of any 2D array of float32 to be in the cache soon."""

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
