"""What the loops ask of a PSF, answered at compile time by the type of the PSF.

The compiled half of a family of PSFs is a named tuple class. Its fields are numbers and arrays; one
of them, `norm`, is a factor that the methods leave out. Its static methods are compiled into the
loops. With a and b in units of the width sigma, a family has

    value(psf, a, b)                 p
    slopes(psf, a, b)                p, -p_a, -p_b
    second_derivatives(psf, a, b)    -p_a, -p_b, p_aa, p_ab, p_bb

A family that depends on a^2 + b^2 alone is faster with two more, because a^2 + b^2 is one
polynomial on a row of pixels:

    radial_scale(psf)                c
    radial(psf, z)                   p where z = c (a^2 + b^2)

One that is a product, p = f(a) f(b), is faster where the map is a translation with one more:

    line(psf, a)                     f, -f', f''

One that has to look something up does so for all pixels of a row at once, and so does one for which
two loops are faster than one. Neither needs a `value`:

    new_places(psf, width)              room for a row's places in the table
    find_places(psf, pixels, work, degrees, places)
                                        fill it: a and b are the polynomials work[2] and work[3] of
                                        degree ab, or with a `radial_scale` z is work[0] of degree
                                        q, in t = t0 + ramp[n], n < size; `pixels` are (t0, ramp,
                                        size), `degrees` are the `Degrees` of `contexts`
    at_place(psf, places, n)            p in the row's pixel n

A family that varies over the field has instead `of_source(psf, s)`: the compiled half of another
family, the PSF of source s.

The classes in `imaging/psf` are examples. One that is defined outside the package works like them.
"""

from collections.abc import Callable
from typing import Any

from numba.extending import overload

from bayesfred.imaging.kernels.compilation import INLINED
from bayesfred.imaging.kernels.polynomials import map_on_row, polynomial_on_row


def by_type(choice: Callable[[Any], Callable[..., Any]]) -> Callable[..., Any]:
    """A function whose code is chosen by the named tuple class of its first argument."""

    def function(first: Any, *others: Any) -> Any:
        raise NotImplementedError("for compiled code")

    @overload(function, INLINED, inline="always", strict=False)
    def choose(first: Any, *others: Any) -> Any:
        return choice(first.instance_class)

    return function


psf_value = by_type(lambda family: family.value)
psf_slopes = by_type(lambda family: family.slopes)
psf_second_derivatives = by_type(lambda family: family.second_derivatives)
psf_line = by_type(lambda family: family.line)
_radial_scale = by_type(lambda family: family.radial_scale)
_radial = by_type(lambda family: family.radial)


def _of_field(psf, s):
    return psf


# The PSF of source s, counted among all of the catalogue.
psf_of_source = by_type(lambda family: getattr(family, "of_source", _of_field))


def _fill_radial(psf, source, w, sigma, work, degrees):
    factor = _radial_scale(psf) / (sigma * sigma)
    polynomial_on_row(source.q, w, factor, work[0], degrees.q)


def _fill_plane(psf, source, w, sigma, work, degrees):
    map_on_row(source, w, work, degrees.ab)
    for m in range(len(degrees.ab) + 1):
        work[2, m] /= sigma
        work[3, m] /= sigma


def _no_places(psf, width):
    return ()


def _find_none(psf, pixels, work, degrees, places):
    pass


def _band(psf):
    return 32  # of a source: what they look up stays in the caches for the next


def _every_row(psf):
    return 1 << 60


def _radial_on_row(psf, t, n, work, degrees, places):
    r = work[0]
    top = len(degrees.q)
    z = r[top]
    for m in range(top):
        z = z * t + r[top - 1 - m]
    return _radial(psf, z)


def _plane_on_row(psf, t, n, work, degrees, places):
    ra, rb = work[2], work[3]
    top = len(degrees.ab)
    a, b = ra[top], rb[top]
    for m in range(top):
        a = a * t + ra[top - 1 - m]
        b = b * t + rb[top - 1 - m]
    return psf_value(psf, a, b)


# Fill the rows 0, 2 and 3 of `work` with the polynomials on the row at v = v_peak + w, from which
# `psf_on_row` makes p at u = u_peak + t, in the row's pixel n.
fill_psf_row = by_type(
    lambda family: _fill_radial if hasattr(family, "radial_scale") else _fill_plane
)
new_places = by_type(lambda family: getattr(family, "new_places", _no_places))
find_places = by_type(lambda family: getattr(family, "find_places", _find_none))
rows_at_once = by_type(lambda family: _band if hasattr(family, "find_places") else _every_row)
_at_place = by_type(lambda family: family.at_place)


def _placed_on_row(psf, t, n, work, degrees, places):
    return _at_place(psf, places, n)


def _choose_on_row(family: Any) -> Callable[..., Any]:
    if hasattr(family, "radial"):
        return _radial_on_row
    return _placed_on_row if hasattr(family, "at_place") else _plane_on_row


psf_on_row = by_type(_choose_on_row)
