"""The tuples that the loops pass to each other: s counts sources, k terms."""

from typing import Any, Literal, NamedTuple

from bayesfred._typing import Floats, Ints

# rows are visited in multiples of this many pixels, which spares the loops their scalar remainders
LANES = 8
SEGMENT = 16  # pixels that are marked together as reached by a source


class Degrees(NamedTuple):
    """Degrees of a source's polynomials, each as the length of a tuple: a compile-time constant."""

    ab: tuple[int, ...]  # of a and b in u or v, whichever is higher
    q: tuple[int, ...]  # of a^2 + b^2
    d: tuple[int, ...]  # of D; empty where flux is not conserved


class Optics(NamedTuple):
    """A forward model as the loops need it."""

    psf: Any  # a PSF's compiled half, see `psf_dispatch`
    x: Floats  # (s,) pixel
    y: Floats
    f_powers: Ints  # (k, 2) powers of u and v
    g_powers: Ints
    f_object_powers: Floats  # (s, k) x^i y^j
    g_object_powers: Floats
    offsets: Floats  # quadrature nodes of a pixel along one axis, pixel
    weights: Floats
    step: float  # pitch of the recorded pixels in fine pixels
    ny: int
    nx: int
    support_radius: float  # (a, b) that lie farther from 0 are below the tolerance, sigma
    ramp: Floats  # (padded row,) u of pixels counted from a row's first
    degrees: Degrees
    # whether every source's map is a translation, f and g without u and v; None where not: a type
    # of its own, for which what renders products is not compiled
    translates: Literal[True] | None


class SourceNuisances(NamedTuple):
    """What acts on all sources beside the distortion."""

    flux_scale: float
    offset_x: float  # pixel
    offset_y: float
    psf_sigma: float
    position_scatter: float
    model_error: float  # the sources' light is right to this fraction in every pixel


class Geometry(NamedTuple):
    """Where the sources are imaged and which pixels they reach."""

    a: Floats  # (s, degree + 1, degree + 1) coefficients about the peak, powers of u first
    b: Floats
    q: Floats  # (s, q_degree + 1, q_degree + 1) of a^2 + b^2, powers of v first
    d: Floats  # (s, d_degree + 1, d_degree + 1) of D, or 1 where flux is not conserved
    peak: Floats  # (s, 2) u, v
    ellipse: Floats  # (s, 4) alpha, beta, gamma, R^2: alpha t^2 + 2 beta t w + gamma w^2 <= R^2
    rows: Ints  # (s, 2) first row and the one after the last
    first: int  # number of the first source, where these are some of all


class Source(NamedTuple):
    """One source's polynomials about its peak at (u, v)."""

    a: Floats
    b: Floats
    q: Floats
    d: Floats
    u: float
    v: float
    number: int  # among all sources


class Footprints(NamedTuple):
    """The pixels of every source, as rows: of source s those from first[s] to first[s + 1]."""

    first: Ints  # (s + 1,)
    low: Ints  # (rows,) first pixel
    size: Ints  # pixels
    start: Ints  # (rows + 1,) where the row's samples begin, counted over all sources
    row: Ints  # the frame's row


class Layout(NamedTuple):
    """The sources as they lie on the frame for one parameter vector."""

    optics: Optics
    geometry: Geometry
    footprints: Footprints
    sigma: float  # the PSF's width, pixel
    work: Floats  # a row's polynomials: of p, D, a, b, a_v, b_v, and one to spare
    places: Any  # room for what a PSF looks up, see `psf_dispatch`


class Canvas(NamedTuple):
    """Where sources are rendered: the samples of row i of the footprints from image[at[i]] on."""

    image: Floats
    at: Ints


class Basis(NamedTuple):
    """What derivatives consist of: those of a unit source with respect to single monomials.

    d K / d theta_k of a source is factors[s, k] times row[k] of the basis: first the monomials
    u^m v^n of f, then those of g, then K itself (flux), then dK/dsigma.
    """

    f: Ints  # (., 2) powers of u and v
    g: Ints
    row: Ints  # (parameters,)
    factors: Floats  # (s, parameters): x^i y^j for the terms of f and g


def stride(nx: int) -> int:
    """Pixels a padded image row takes.

    An odd number of segments, lest the rows' pixels fall on the same cache lines.
    """
    return (-(-(nx + LANES) // SEGMENT) | 1) * SEGMENT
