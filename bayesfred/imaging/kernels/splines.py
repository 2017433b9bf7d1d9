"""Cubic splines on a square grid, with four coefficients in one SIMD register.

At a point of cell (j, i), where y and x of it have been passed, a spline is

    sum_kl B_k(y) c[j + k, i + l] B_l(x),    k, l = 0 ... 3,

with B_0 ... B_3 the cubic B-splines of the four coefficients that matter, as polynomials of what is
passed of the cell. Compilers do not find vectors in such a sum: left to themselves they fetch
sixteen coefficients one after the other, which takes twice as long. So the sum is written as LLVM's
instructions. The coefficients l = 0 ... 3 of a row lie side by side in memory and in a vector. Each
of the four B_k(y) multiplies such a vector, and their sum is multiplied by the vector B(x) in the
end.
"""

from collections.abc import Sequence
from typing import Any

import numba as nb
import numpy as np
from llvmlite import ir
from numba.extending import intrinsic

from bayesfred.imaging.kernels.compilation import inner

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


# (s,), (s, s_x, s_y) and (s_x, s_y, s_xx, s_xy, s_yy) of a spline s, by samples
spline_value = _sums((VALUE, VALUE))
spline_slopes = _sums((VALUE, VALUE), (VALUE, SLOPE), (SLOPE, VALUE))
spline_second_derivatives = _sums(
    (VALUE, SLOPE), (SLOPE, VALUE), (VALUE, CURVE), (SLOPE, SLOPE), (CURVE, VALUE)
)


@inner(inline="always")
def spline_cell(size, x):
    """The first of the four coefficients that matter at x, and what is passed of the cell.

    x is in samples from the middle. Beyond the outermost coefficients the spline is zero, as it is
    among the last four.
    """
    x = min(max(x + 0.5 * (size - 1), 1.0), size - 2.5)
    i = np.int64(x)
    return i - 1, x - i
