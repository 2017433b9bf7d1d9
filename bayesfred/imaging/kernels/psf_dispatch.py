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

A family that varies over the field has instead `of_source(psf, s)`: the compiled half of another
family, the PSF of source s.

The classes in `imaging/psf` are examples. One that is defined outside the package works like them.
"""

from collections.abc import Callable
from typing import Any

from numba.extending import overload

from bayesfred.imaging.kernels.polynomials import map_on_row, polynomial_on_row


def by_type(choice: Callable[[Any], Callable[..., Any]]) -> Callable[..., Any]:
    """A function whose code is chosen by the named tuple class of its first argument."""

    def function(first: Any, *others: Any) -> Any:
        raise NotImplementedError("for compiled code")

    @overload(function, inline="always", strict=False)
    def choose(first: Any, *others: Any) -> Any:
        return choice(first.instance_class)

    return function


psf_value = by_type(lambda family: family.value)
psf_slopes = by_type(lambda family: family.slopes)
psf_second_derivatives = by_type(lambda family: family.second_derivatives)
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


def _radial_on_row(psf, t, r, ra, rb, degrees):
    top = len(degrees.q)
    z = r[top]
    for m in range(top):
        z = z * t + r[top - 1 - m]
    return _radial(psf, z)


def _plane_on_row(psf, t, r, ra, rb, degrees):
    top = len(degrees.ab)
    a, b = ra[top], rb[top]
    for m in range(top):
        a = a * t + ra[top - 1 - m]
        b = b * t + rb[top - 1 - m]
    return psf_value(psf, a, b)


# Fill the rows 0, 2 and 3 of `work` with the polynomials on the row at v = v_peak + w, from which
# `psf_on_row` makes p at u = u_peak + t.
fill_psf_row = by_type(lambda family: _fill_radial if hasattr(family, "radial") else _fill_plane)
psf_on_row = by_type(lambda family: _radial_on_row if hasattr(family, "radial") else _plane_on_row)
