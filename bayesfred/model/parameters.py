"""The table of a frame's parameters: what each one means is said here, once.

A parameter has a name, a unit, a label, a neutral value (at which it changes nothing), a start, a
default prior and a slot, its place in the arguments of the kernels. Distortion coefficients come
first, then the background, then what `Nuisances` leaves free. A new nuisance of the sources is a
row of `SOURCE_NUISANCES` and a field of the kernels' `Nuisance` tuple.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from math import comb
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from scipy import stats

from bayesfred._typing import Floats
from bayesfred.errors import InputError
from bayesfred.imaging.distortion import PolynomialDistortion
from bayesfred.imaging.forward import ForwardModel
from bayesfred.imaging.monomials import term_name
from bayesfred.io.serialize import serializable
from bayesfred.model.kernels.contexts import BACKGROUND_POWERS, MOST_ORDER

FluxMode = Literal["fixed", "scale", "free"]
LEAST_SHAPE = 1.0  # of a Gamma prior; the integral over fluxes is expanded in its inverse


@serializable("nuisances")
@dataclass(frozen=True)
class Nuisances:
    """What else is unknown beside the distortion and a constant background.

    Parameters
    ----------
    flux : {"fixed", "scale", "free"}
        Catalogue fluxes are exact; or right but for a common factor, the parameter `flux_scale`; or
        each is free. Free fluxes are not sampled: the likelihood is integrated over them, under a
        Gamma prior whose mean is the catalogue's flux; see `model/kernels/expansion.py`.
    offset : bool
        Whether the pointing is unknown: parameters `offset_x`, `offset_y`, pixel, added to every
        source's position.
    psf_sigma : bool
        Whether the PSF's width is unknown: parameter `psf_sigma`, pixel, the `sigma` that a PSF of
        any kind has.
    background_order : {0, 1, 2, 3, 4}
        Degree of the background polynomial in u and v, which run from -1 to 1 over the frame:
        parameters `background`, then `background_u`, `background_v`, then `background_u2`,
        `background_uv`, `background_v2` and so on, counts per pixel. A lens that vignettes the
        light of the sky needs 4.
    footprint : float or None, pixel
        Only pixels within this distance of a catalogue position enter the likelihood; for frames
        with sources that the catalogue lacks. `follow_images` puts the images in the place of the
        catalogue's positions; so do run files.
    position_scatter : bool
        Whether the sources lie off their catalogue positions: parameter `position_scatter`, pixel,
        as imaged, the scale of Student's t distribution with 3 degrees of freedom, whose heavy
        tails hold sources that are far off. Needs free fluxes. Like these, the shifts are not
        sampled. Sources scatter independently; see `marginalize_displacements` for neighbours that
        are displaced alike.
    flux_shape : float
        Shape of the free fluxes' Gamma prior, at least 1, which has the relative standard deviation
        1/sqrt(flux_shape): 2, the default, says little, 25 that the catalogue's fluxes are right to
        20 %. With 1 a PSF's width from 1,000 sources of 5 photons is biased by 0.2 standard
        deviations, from 2 on by less than 0.1.
    model_error : bool
        Whether the sources' light is known to a fraction only, as where the PSF is not quite
        right: parameter `model_error`, the fraction eps. The variance of a pixel's counts is that
        of the noise plus the square of eps times the sources' light in it, as independent errors
        of the pixels.

    Raises
    ------
    InputError
        If a value is not one of those listed, or positions scatter with fluxes that are not free.

    Examples
    --------
    >>> Nuisances(flux="scale", offset=True).names
    ('flux_scale', 'offset_x', 'offset_y')
    """

    flux: FluxMode = "fixed"
    offset: bool = False
    psf_sigma: bool = False
    background_order: int = 0
    footprint: float | None = None
    position_scatter: bool = False
    flux_shape: float = field(default=2.0, metadata={"since": 5})
    model_error: bool = field(default=False, metadata={"since": 6})

    def __post_init__(self) -> None:
        if self.flux not in get_args(FluxMode):
            expected = ", ".join(get_args(FluxMode))
            raise InputError(f"nuisances: flux: got {self.flux!r}, expected one of {expected}")
        if self.background_order not in range(MOST_ORDER + 1):
            raise InputError(
                f"nuisances: background_order: got {self.background_order!r}, expected an integer "
                f"from 0 to {MOST_ORDER}"
            )
        if self.footprint is not None and not (np.isfinite(self.footprint) and self.footprint > 0):
            raise InputError(
                f"nuisances: footprint: got {self.footprint}, expected a radius in pixels > 0"
            )
        if self.position_scatter and self.flux != "free":
            raise InputError(
                f"nuisances: position_scatter: got it with {self.flux} fluxes, expected free ones: "
                "set flux to free"
            )
        if not (np.isfinite(self.flux_shape) and self.flux_shape >= LEAST_SHAPE):
            raise InputError(
                f"nuisances: flux_shape: got {self.flux_shape}, expected a number >= {LEAST_SHAPE}"
            )

    @property
    def profiled(self) -> int:
        """Numbers of every source that are not sampled: flux, and shift along u and v."""
        return 3 if self.position_scatter else int(self.flux == "free")

    @property
    def source_names(self) -> tuple[str, ...]:
        """The nuisance parameters that act on the sources."""
        return tuple(row.name for row in SOURCE_NUISANCES if row.is_free(self))

    @property
    def background_names(self) -> tuple[str, ...]:
        """The coefficients of the background polynomial."""
        return BACKGROUND_TERMS[: comb(self.background_order + 2, 2)]

    @property
    def names(self) -> tuple[str, ...]:
        """All nuisance parameters but the constant background."""
        return (*self.source_names, *self.background_names[1:])


class _Context(NamedTuple):
    """What neutral values, starts and default priors depend on."""

    sigma: float  # width of the reference PSF, pixel
    half_width: float  # of the frame, fine pixel
    half_height: float
    level: float  # mean counts per pixel
    background: float  # to start from


class _SourceNuisance(NamedTuple):
    """A row of the table; its place in `SOURCE_NUISANCES` is its slot in the kernels."""

    name: str
    pixels: int
    is_free: Callable[[Nuisances], bool]
    neutral: Callable[[float], float]  # of the reference PSF's width
    start: Callable[[float], float]
    prior: Callable[[_Context], Any]


# scipy takes a millisecond for each, longer than a likelihood
@lru_cache(maxsize=4096)
def _frozen(family: Any, *args: float, **kwds: float) -> Any:
    return family(*args, **kwds)


def _zero(sigma: float) -> float:
    return 0.0


def _one(sigma: float) -> float:
    return 1.0


def _width(sigma: float) -> float:
    return sigma


SOURCE_NUISANCES = (
    _SourceNuisance(
        "flux_scale", 0, lambda n: n.flux == "scale", _one, _one,
        lambda c: _frozen(stats.lognorm, 1.0),
    ),
    _SourceNuisance(
        "offset_x", 1, lambda n: n.offset, _zero, _zero,
        lambda c: _frozen(stats.norm, 0.0, 0.1 * c.half_width),
    ),
    _SourceNuisance(
        "offset_y", 1, lambda n: n.offset, _zero, _zero,
        lambda c: _frozen(stats.norm, 0.0, 0.1 * c.half_height),
    ),
    _SourceNuisance(
        "psf_sigma", 1, lambda n: n.psf_sigma, _width, _width,
        lambda c: _frozen(stats.truncnorm, -0.4 / 0.3, 1.0 / 0.3, loc=c.sigma, scale=0.3 * c.sigma),
    ),
    _SourceNuisance(
        "position_scatter", 1, lambda n: n.position_scatter, _zero, lambda sigma: 0.1 * sigma,
        lambda c: _frozen(stats.gamma, 2.0, scale=0.1 * c.sigma),
    ),
    _SourceNuisance(
        "model_error", 0, lambda n: n.model_error, _zero, lambda sigma: 0.01,
        lambda c: _frozen(stats.gamma, 2.0, scale=0.02),
    ),
)  # fmt: skip
SCALES = ("position_scatter", "model_error")  # they leave the expected counts as they are
BACKGROUND_TERMS = (
    "background",
    *(term_name("background", (0, 0, m, n)) for m, n in BACKGROUND_POWERS[1:]),
)


@dataclass(frozen=True, eq=False)
class Parameter:
    """One parameter of a frame's posterior.

    A distortion coefficient's default prior is normal with the scale at which its term moves a star
    anywhere in the frame by at most 10 % of the half-width along the axis concerned, and so are
    those of the pointing offsets. The background is half-normal with ten times the frame's level,
    its slopes normal with that level; a common flux factor is log-normal by a factor e; the PSF's
    width is normal around the reference width by 30 %, cut at 0.6 and 2 times it. The scatter of
    the sources' positions is Gamma(2) with a mean of a fifth of that width, and so is the model
    error, with a mean of 4 %: a density that vanishes at 0 keeps the maximum off that boundary and
    costs little where the frame tells otherwise.

    Attributes
    ----------
    name : str
    letter : str
        What a label begins with, and `powers` follow; "" where the name is the label.
    powers : tuple of (str, int)
        Variables and their powers.
    unit : str
        Its leading word, such as counts.
    pixels : int
        Power of a pixel that multiplies it; 0 where the basis of the distortion decides.
    neutral : float
        The value at which the parameter changes nothing; for the background, the frame's level.
    start : float
        Where a search begins.
    prior : frozen scipy.stats distribution
        The prior unless another is given.
    slot : int
        Place among the distortion's coefficients, `SOURCE_NUISANCES` or `BACKGROUND_TERMS`.
    kind : {"distortion", "source", "background"}
        Which of the three.

    References
    ----------
    Y. Chung et al., "A nondegenerate penalized likelihood estimator for variance parameters in
    multilevel models", Psychometrika 78 (2013): the gamma prior.
    """

    name: str
    letter: str
    powers: tuple[tuple[str, int], ...]
    unit: str
    pixels: int
    neutral: float
    start: float
    prior: Any
    slot: int
    kind: Literal["distortion", "source", "background"]


def parameter_table(
    model: ForwardModel, nuisances: Nuisances, counts: Floats
) -> tuple[Parameter, ...]:
    """All parameters of a frame, in the order of every parameter vector.

    Parameters
    ----------
    model : ForwardModel
    nuisances : Nuisances
    counts : ndarray, shape (n,), counts
        Those in the likelihood.

    Returns
    -------
    tuple of Parameter
    """
    ny, nx = model.detector.fine_shape
    mean, median = float(np.mean(counts)), float(np.median(counts))
    level = max(mean, 1.0 / counts.size)  # at least one count in the frame
    start = median if median > 0 else max(0.1 * mean, 1e-6)
    context = _Context(model.psf.sigma, 0.5 * nx, 0.5 * ny, level, start)
    background = [
        _background_term(slot, context) for slot in range(len(nuisances.background_names))
    ]
    return (
        *_distortion_terms(model, context),
        background[0],
        *(
            Parameter(
                row.name, "", (), "", row.pixels, row.neutral(context.sigma),
                row.start(context.sigma), row.prior(context), slot, "source",
            )
            for slot, row in enumerate(SOURCE_NUISANCES)
            if row.is_free(nuisances)
        ),
        *background[1:],
    )  # fmt: skip


def displacing(parameters: Sequence[Parameter], vectors: Floats) -> tuple[Floats, Floats]:
    """The parts of parameter vectors that say where an object is imaged.

    Parameters
    ----------
    parameters : sequence of Parameter, length d
    vectors : ndarray, shape (d,) or (n, d)

    Returns
    -------
    theta : ndarray, shape (n_terms,) or (n, n_terms)
        The coefficients of the distortion.
    offset : ndarray, shape (2,) or (n, 2), pixel
        0 where the pointing is not a parameter.
    """
    names = [parameter.name for parameter in parameters]
    theta = vectors[..., [k for k, p in enumerate(parameters) if p.kind == "distortion"]]
    offset = np.zeros((*vectors.shape[:-1], 2))
    for axis, name in enumerate(("offset_x", "offset_y")):
        if name in names:
            offset[..., axis] = vectors[..., names.index(name)]
    return theta, offset


def _distortion_terms(model: ForwardModel, context: _Context) -> list[Parameter]:
    d = model.polynomial
    f, g = d.largest_displacement(context.half_width, context.half_height)
    scales = 0.1 / np.maximum(f / context.half_width, g / context.half_height)
    terms = (*d.f_terms, *d.g_terms) if d.basis is None else ((0, 0, 0, 0),) * d.n_terms
    table = []
    for slot, (name, term) in enumerate(zip(d.names, terms, strict=True)):
        i, j, m, n = term
        powers = tuple((v, p) for v, p in zip("uvxy", (m, n, i, j), strict=True) if p)
        letter, pixels = (name[0], 1 - sum(term)) if d.basis is None else ("", 0)
        prior = _frozen(stats.norm, 0.0, float(scales[slot]))
        table.append(
            Parameter(name, letter, powers, "", pixels, 0.0, 0.0, prior, slot, "distortion")
        )
    return table


def _background_term(slot: int, context: _Context) -> Parameter:
    constant = slot == 0
    prior = (
        _frozen(stats.halfnorm, 0.0, 10.0 * context.level)
        if constant
        else _frozen(stats.norm, 0.0, context.level)
    )
    start = context.background if constant else 0.0
    powers = tuple((v, p) for v, p in zip("uv", BACKGROUND_POWERS[slot], strict=True) if p)
    return Parameter(
        BACKGROUND_TERMS[slot], "" if constant else "b", powers, "counts", 0,
        context.level if constant else 0.0, start, prior, slot, "background",
    )  # fmt: skip


def chain_rule(
    parameters: tuple[Parameter, ...],
    params: Floats,
    distortion: PolynomialDistortion,
    moving: list[str],
) -> Floats:
    """Derivatives of what the kernels differentiate by with respect to the parameters.

    Its rows are the distortion's monomials, the free nuisances of the sources, `SCALES` and the
    background's terms. The kernels' derivative by flux is relative to the scaled flux.

    Parameters
    ----------
    parameters : tuple of Parameter
    params : ndarray, shape (d,)
    distortion : PolynomialDistortion
    moving : list of str
        The free nuisances that change the expected counts.

    Returns
    -------
    ndarray, shape (rows, d)
    """
    change = np.eye(distortion.n_terms) if distortion.basis is None else distortion.basis
    monomials, sources = len(change), len(change) + len(moving)
    out = np.zeros((sources + len(SCALES) + len(BACKGROUND_TERMS), len(parameters)))
    for k, parameter in enumerate(parameters):
        if parameter.kind == "distortion":
            out[:monomials, k] = change[:, parameter.slot]
        elif parameter.kind == "background":
            out[sources + len(SCALES) + parameter.slot, k] = 1.0
        elif parameter.name in SCALES:
            out[sources + SCALES.index(parameter.name), k] = 1.0
        else:
            scale = 1.0 / params[k] if parameter.name == "flux_scale" else 1.0
            out[monomials + moving.index(parameter.name), k] = scale
    return out
