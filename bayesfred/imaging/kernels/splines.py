"""Cubic splines on a square grid, at one point or in eight pixels of a row.

At a point of cell (j, i), where y and x of it have been passed, a spline is

    sum_kl B_k(y) c[j + k, i + l] B_l(x),    k, l = 0 ... 3,

with B_0 ... B_3 the cubic B-splines of the four coefficients that matter, as polynomials of what is
passed of the cell. Compilers do not find vectors in such a sum: left to themselves they fetch
sixteen coefficients one after the other, which takes twice as long. So the sum is written as LLVM's
instructions. The coefficients l = 0 ... 3 of a row lie side by side in memory and in a vector. Each
of the four B_k(y) multiplies such a vector, and their sum is multiplied by the vector B(x) in the
end.

Eight pixels of a row take less than two points. From pixel to pixel a point moves by about `stride`
coefficients along x and stays in its row of cells. So c[j + k, i + l] of all eight are in one SIMD
register if every `stride`-th coefficient of a row, a phase, lies side by side in memory. Where the
points drift off, by distortion, `run_length` says how many of the eight are right, and the next
eight begin with the first that is not.
"""

from collections.abc import Sequence
from typing import Any

import numba as nb
import numpy as np
from llvmlite import ir
from numba.extending import intrinsic

from bayesfred.imaging.kernels.compilation import inner
from bayesfred.imaging.kernels.contexts import LANES

BITS = 12  # a cell's number is that of its row, times 2^BITS, plus that of its column

# of B_0 ... B_3, a row for each power of what is passed of the cell
VALUE = (
    (1 / 6, 2 / 3, 1 / 6, 0.0),
    (-1 / 2, 0.0, 1 / 2, 0.0),
    (1 / 2, -1.0, 1 / 2, 0.0),
    (-1 / 6, 1 / 2, -1 / 2, 1 / 6),
)


def _derivative(table: Sequence[Sequence[float]]) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(m * c for c in row) for m, row in enumerate(table) if m > 0)


SLOPE = _derivative(VALUE)
CURVE = _derivative(SLOPE)

FLAGS = ("contract", "nsz", "nnan", "ninf")
FOUR = ir.VectorType(ir.DoubleType(), 4)
NOTHING = ir.Constant(FOUR, ir.Undefined)


def _pick(builder: Any, vector: Any, lanes: Sequence[int]) -> Any:
    """A vector of some of the numbers of another."""
    order = ir.Constant(ir.VectorType(ir.IntType(32), 4), list(lanes))
    return builder.shuffle_vector(vector, NOTHING, order)


def _times_plus(builder: Any, p: Any, q: Any, r: Any) -> Any:
    return builder.fadd(builder.fmul(p, q, flags=FLAGS), r, flags=FLAGS)


def _basis(builder: Any, x: Any, table: Sequence[Sequence[float]]) -> Any:
    """B_0 ... B_3, or derivatives of them."""
    first = builder.insert_element(NOTHING, x, ir.Constant(ir.IntType(32), 0))
    x = _pick(builder, first, (0, 0, 0, 0))
    *lower, out = (ir.Constant(FOUR, list(row)) for row in table)
    for row in reversed(lower):
        out = _times_plus(builder, out, x, row)
    return out


def _combined(builder: Any, rows: Sequence[Any], weights: Any) -> Any:
    """The weighted sum of four vectors."""
    out = builder.fmul(rows[0], _pick(builder, weights, (0, 0, 0, 0)), flags=FLAGS)
    for k in (1, 2, 3):
        out = _times_plus(builder, rows[k], _pick(builder, weights, (k, k, k, k)), out)
    return out


def _inner_product(builder: Any, p: Any, q: Any) -> Any:
    both = builder.fmul(p, q, flags=FLAGS)
    both = builder.fadd(both, _pick(builder, both, (2, 3, 2, 3)), flags=FLAGS)
    zero, one = (ir.Constant(ir.IntType(32), k) for k in (0, 1))
    return builder.fadd(
        builder.extract_element(both, zero), builder.extract_element(both, one), flags=FLAGS
    )


def _rows(context: Any, builder: Any, kind: Any, c: Any, at: Any) -> list[Any]:
    """Four coefficients of each of four rows, from number `at` of the grid on."""
    array = context.make_array(kind)(context, builder, c)
    width, rows = builder.extract_value(array.shape, 1), []
    for _ in range(4):
        place = builder.bitcast(builder.gep(array.data, [at]), FOUR.as_pointer())
        rows.append(builder.load(place, align=8))
        at = builder.add(at, width)
    return rows


def _sums(*wanted: tuple[Sequence[Sequence[float]], Sequence[Sequence[float]]]) -> Any:
    """A compiled function of (c, at, y, x): the sum for each pair of bases along y and x."""

    def sums(typingctx: Any, c: Any, at: Any, y: Any, x: Any) -> Any:
        def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            rows = _rows(context, builder, signature.args[0], args[0], args[1])
            across: dict[int, Any] = {}  # what several sums need is made once
            along: dict[int, Any] = {}
            out = []
            for by_y, by_x in wanted:
                if id(by_y) not in across:
                    across[id(by_y)] = _combined(builder, rows, _basis(builder, args[2], by_y))
                if id(by_x) not in along:
                    along[id(by_x)] = _basis(builder, args[3], by_x)
                out.append(_inner_product(builder, across[id(by_y)], along[id(by_x)]))
            return context.make_tuple(builder, signature.return_type, out)

        number = nb.types.float64
        returned = nb.types.UniTuple(number, len(wanted))
        return returned(c, nb.types.int64, number, number), codegen

    return intrinsic(sums)


# (s, s_x, s_y) and (s_x, s_y, s_xx, s_xy, s_yy) of a spline s, by samples
spline_slopes = _sums((VALUE, VALUE), (VALUE, SLOPE), (SLOPE, VALUE))
spline_second_derivatives = _sums(
    (VALUE, SLOPE), (SLOPE, VALUE), (VALUE, CURVE), (SLOPE, SLOPE), (CURVE, VALUE)
)


EIGHT = ir.VectorType(ir.DoubleType(), LANES)
EIGHT_INTEGERS = ir.VectorType(ir.IntType(64), LANES)


def _eight(context: Any, builder: Any, kind: Any, array: Any, n: Any, vector: Any) -> Any:
    """Where an array's numbers n ... n + 7 are."""
    data = context.make_array(kind)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [n]), vector.as_pointer())


def _bases(builder: Any, x: Any, table: Sequence[Sequence[float]]) -> list[Any]:
    """B_0 ... B_3 at eight points, or derivatives of them."""
    out = []
    for powers in zip(*table, strict=True):
        *lower, value = (ir.Constant(EIGHT, [c] * LANES) for c in powers)
        for c in reversed(lower):
            value = _times_plus(builder, value, x, c)
        out.append(value)
    return out


@intrinsic
def eight_values(typingctx: Any, c: Any, places: Any, passed: Any, n: Any, out: Any) -> Any:
    """out[n], ..., out[n + 7]: the spline in eight pixels.

    `places` are (columns, pitch): their first coefficients are c[columns[l]], ..., c[columns[l] +
    7], and the rows of coefficients are `pitch` apart. What has been passed of the cells is y[n],
    ... and x[n], ... of the two arrays `passed`.
    """

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        kinds = signature.args
        data = context.make_array(kinds[0])(context, builder, args[0]).data
        columns, pitch = (builder.extract_value(args[1], k) for k in range(2))
        across, along = (
            _bases(builder, builder.load(_eight(*way, args[3], EIGHT), align=8), VALUE)
            for way in (
                (context, builder, kinds[2][k], builder.extract_value(args[2], k)) for k in range(2)
            )
        )
        firsts = [builder.extract_value(columns, k) for k in range(4)]
        total = ir.Constant(EIGHT, [0.0] * LANES)
        for by_y in across:
            row = ir.Constant(EIGHT, [0.0] * LANES)
            for k, by_x in enumerate(along):
                at = builder.bitcast(builder.gep(data, [firsts[k]]), EIGHT.as_pointer())
                row = _times_plus(builder, builder.load(at, align=8), by_x, row)
                firsts[k] = builder.add(firsts[k], pitch)
            total = _times_plus(builder, row, by_y, total)
        builder.store(total, _eight(context, builder, kinds[4], args[4], args[3], EIGHT), align=8)
        return context.get_dummy_value()

    return nb.types.void(c, places, passed, n, out), codegen


@intrinsic
def run_length(typingctx: Any, at: Any, n: Any, stride: Any) -> Any:
    """How many of at[n], ..., at[n + 7] are at[n], at[n] + stride, at[n] + 2 stride, ..."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        at, n, stride = args
        place = _eight(context, builder, signature.args[0], at, n, EIGHT_INTEGERS)
        found = builder.load(place, align=8)
        nothing = ir.Constant(EIGHT_INTEGERS, ir.Undefined)
        zero, zeros = (
            ir.Constant(ir.IntType(32), 0),
            ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES),
        )
        first = builder.shuffle_vector(found, nothing, zeros)
        step = builder.insert_element(nothing, stride, zero)
        steps = builder.mul(
            builder.shuffle_vector(step, nothing, zeros),
            ir.Constant(EIGHT_INTEGERS, list(range(LANES))),
        )
        differs = builder.icmp_signed("!=", found, builder.add(first, steps))
        bits = builder.zext(builder.bitcast(differs, ir.IntType(LANES)), ir.IntType(64))
        bits = builder.or_(bits, ir.Constant(ir.IntType(64), 1 << LANES))
        return builder.cttz(bits, ir.Constant(ir.IntType(1), 1))

    return nb.types.int64(at, n, stride), codegen


@inner(inline="always")
def spline_cell(size, x):
    """The first of the four coefficients that matter at x, and what is passed of the cell.

    x is in samples from the middle. Beyond the outermost coefficients the spline is zero, as it is
    among the last four.
    """
    x = min(max(x + 0.5 * (size - 1), 1.0), size - 2.5)
    i = np.int64(x)
    return i - 1, x - i
