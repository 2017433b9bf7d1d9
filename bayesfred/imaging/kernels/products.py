"""Images that are products of a function of the column and one of the row.

Where f and g do not depend on u and v, a source's map is a translation, a = t + a_0 and b = w +
b_0, so that D is 1 and the image of a PSF that is a product, p = f(a) f(b), is one too, pixels
included. It takes one exponential a column and one a row in place of one a pixel, and what the
derivatives need are products of f, -f', f'', -a f' and a f'', averaged over pixels:

    -p_a = -f'(a) f(b),    p_aa = f''(a) f(b),    a p_a + b p_b = a f'(a) f(b) + f(a) b f'(b)

and for -p_a in place of p the same with -f' and f'' in place of f and -f'. Template 0 below is p,
template 1 is -p_a and template 2 is -p_b.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numba.core.types import NoneType  # type: ignore[attr-defined]
from numba.extending import overload

from bayesfred._typing import Floats
from bayesfred.imaging.kernels.compilation import INLINED, leaf, shared
from bayesfred.imaging.kernels.fastmath import FAST, REDUCE
from bayesfred.imaging.kernels.geometry import one_source
from bayesfred.imaging.kernels.psf_dispatch import psf_line


class Lines(NamedTuple):
    """A source's f, -f', f'', -a f' and a f'' on its columns and rows.

    `rows` have the factor norm / sigma^2 of the image.
    """

    columns: Floats  # (5, columns)
    rows: Floats  # (5, rows)
    low: int  # the first column
    top: int  # and row


@leaf(fastmath=FAST)
def _fill_line(o, t0, inverse, factor, out):
    """Fill a line of pixels whose middles are at a = t0 + ramp."""
    out[:] = 0.0
    psf, ramp, offsets, weights = o.psf, o.ramp, o.offsets, o.weights
    f, x, xx, ax, axx = out[0], out[1], out[2], out[3], out[4]
    for p in range(offsets.size):
        first, weight = t0 + offsets[p], factor * weights[p]
        for i in range(f.size):
            a = inverse * (first + ramp[i])
            value, slope, second = psf_line(psf, a)
            f[i] += weight * value
            x[i] += weight * inverse * slope
            xx[i] += weight * inverse * inverse * second
            ax[i] += weight * a * slope
            axx[i] += weight * inverse * a * second


@shared()
def _product_lines(layout, s, first, last):
    if first >= last:
        return Lines(np.empty((5, 0)), np.empty((5, 0)), 0, 0)
    o, fp, inverse = layout.optics, layout.footprints, 1.0 / layout.sigma
    source, low, high = one_source(layout.geometry, s), fp.low[first], 0
    for i in range(first, last):
        low, high = min(low, fp.low[i]), max(high, fp.low[i] + fp.size[i])
    top, below = fp.row[first], fp.row[last - 1] + 1
    columns, rows = np.empty((5, high - low)), np.empty((5, below - top))
    t = (low - 0.5 * (o.nx - 1)) * o.step - source.u + source.a[0, 0]
    w = (top - 0.5 * (o.ny - 1)) * o.step - source.v + source.b[0, 0]
    _fill_line(o, t, inverse, 1.0, columns)
    _fill_line(o, w, inverse, o.psf.norm * inverse * inverse, rows)
    return Lines(columns, rows, low, top)


@leaf(fastmath=FAST)
def _add_line(line, factor, out):
    for i in range(out.size):
        out[i] += factor * line[i]


@leaf(fastmath=FAST)
def _add_two(first, by_first, second, by_second, out):
    for i in range(out.size):
        out[i] += by_first * first[i] + by_second * second[i]


@leaf(fastmath=FAST)
def _set_line(line, factor, out):
    for i in range(out.size):
        out[i] = factor * line[i]


@shared()
def add_product(layout, s, rows, flux, canvas, alone):
    """Do what `render.add_source` does."""
    lines, fp = _product_lines(layout, s, rows[0], rows[1]), layout.footprints
    f, top, low, out, at = lines.rows[0], lines.top, lines.low, canvas.image, canvas.at
    lows, sizes, js = fp.low, fp.size, fp.row
    for i in range(rows[0], rows[1]):
        first, n = lows[i] - low, sizes[i]
        line, factor = lines.columns[0, first : first + n], flux * f[js[i] - top]
        _add_line(line, factor, out[at[i] : at[i] + n])
        if alone is not None:
            _set_line(line, factor, alone.image[alone.at[i] : alone.at[i] + n])


@shared()
def add_product_templates(layout, s, flux, stamps, wider):
    """Do what `render.add_templates` does."""
    fp = layout.footprints
    lines = _product_lines(layout, s, fp.first[s], fp.first[s + 1])
    for i in range(fp.first[s], fp.first[s + 1]):
        a, b = lines.columns[:, fp.low[i] - lines.low :], lines.rows[:, fp.row[i] - lines.top]
        own = slice(fp.start[i], fp.start[i + 1])
        _add_line(a[0], b[0], stamps[0, own])
        _add_line(a[1], flux * b[0], stamps[1, own])
        _add_line(a[0], flux * b[1], stamps[2, own])
        if wider is not None:
            _add_two(a[3], flux * b[0], a[0], flux * (b[3] - 2.0 * b[0]), wider[own])


@shared(_nrt=False)
def product_basis_row(lines, basis, inverse, j, low, out):
    """The rows of a basis on row j from column `low` on, see `jacobian.basis_row`.

    `basis` are the numbers of monomials of f and of g, each of which is 1, and whether the width is
    a parameter.
    """
    n_f, n_g, is_wider = basis
    a, b = lines.columns[:, low - lines.low :], lines.rows[:, j - lines.top]
    for k in range(n_f):
        _set_line(a[1], -b[0], out[k])
    for k in range(n_f, n_f + n_g):
        _set_line(a[0], -b[1], out[k])
    _set_line(a[0], b[0], out[n_f + n_g])
    if is_wider:
        row = out[n_f + n_g + 1]
        row[:] = 0.0
        _add_two(a[3], inverse * b[0], a[0], inverse * (b[3] - 2.0 * b[0]), row)


@leaf()
def is_product_row(lines, basis, inverse, place, out):
    """Do what `product_basis_row` does at (j, low, pixels); False without lines."""
    if lines is None:
        return False
    product_basis_row(lines, basis, inverse, place[0], place[1], out[:, : place[2]])
    return True


@shared(_nrt=False)
def fill_second_derivatives(lines, fp, s, flux, out):
    """Do what `jacobian.second_derivatives` does; False without lines."""
    if lines is None:
        return False
    begin = fp.start[fp.first[s]]
    for i in range(fp.first[s], fp.first[s + 1]):
        own = slice(fp.start[i] - begin, fp.start[i + 1] - begin)
        a, b = lines.columns[:, fp.low[i] - lines.low :], lines.rows[:, fp.row[i] - lines.top]
        _set_line(a[2], flux * b[0], out[0, own])
        _set_line(a[1], flux * b[1], out[1, own])
        _set_line(a[0], flux * b[2], out[2, own])
    return True


@leaf(fastmath=REDUCE)
def _three_dots(weight, first, second, third):
    one, two, three = 0.0, 0.0, 0.0
    for i in range(weight.size):
        one += weight[i] * first[i]
        two += weight[i] * second[i]
        three += weight[i] * third[i]
    return one, two, three


@shared(_nrt=False)
def product_sums(lines, fp, s, template, weight):
    """Sums of a weight times P, P_a, P_b and a P_a + b P_b over the pixels of source s.

    Returns whether there are lines before them.
    """
    if lines is None:
        return False, 0.0, 0.0, 0.0, 0.0
    total, by_a, by_b, wide = 0.0, 0.0, 0.0, 0.0
    p, q = (1 if template == 1 else 0), (1 if template == 2 else 0)
    begin = fp.start[fp.first[s]]
    for i in range(fp.first[s], fp.first[s + 1]):
        k, own = fp.low[i] - lines.low, weight[fp.start[i] - begin : fp.start[i + 1] - begin]
        a, b = lines.columns[:, k:], lines.rows[:, fp.row[i] - lines.top]
        one, slope, product = _three_dots(own, a[p], a[p + 1], a[p + 3])
        total += one * b[q]
        by_a -= slope * b[q]
        by_b -= one * b[q + 1]
        wide -= product * b[q] + one * b[q + 3]
    return True, total, by_a, by_b, wide


def by_image(product: Callable[..., Any], sampled: Callable[..., Any]) -> Callable[..., Any]:
    """A function of a layout that has another code where images are products."""

    def function(layout: Any, *others: Any) -> Any:
        raise NotImplementedError("for compiled code")

    @overload(function, INLINED, inline="always", strict=False)
    def choose(layout: Any, *others: Any) -> Any:
        optics = layout[layout.fields.index("optics")]
        translates, psf = (optics[optics.fields.index(name)] for name in ("translates", "psf"))
        is_product = not isinstance(translates, NoneType) and hasattr(psf.instance_class, "line")
        return product if is_product else sampled

    return function


def _some_lines(layout, s, first, last):
    return _product_lines(layout, s, first, last)


def _no_lines(layout, s, first, last):
    return None


# The lines of source s over the rows of the footprints from first to last - 1. They are None, a
# type of its own for which nothing else here is compiled, where images are no products.
lines_of = by_image(_some_lines, _no_lines)
