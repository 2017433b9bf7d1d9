"""Priors: frozen scipy.stats distributions by parameter name, with their derivatives.

The optimiser needs the slope and the curvature of every log-density, in closed form, and the
sampler the log-densities themselves at less than scipy's price, which is a fifth of a likelihood;
`DENSITIES` lists the families for which they are known. The default
priors, which are weak, are in the table of `parameters`.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from scipy import stats
from scipy.special import xlogy

from bayesfred._typing import Floats
from bayesfred.errors import InputError
from bayesfred.model.parameters import Parameter

# log p up to a constant, d log p / dz and -d^2 log p / dz^2 in the standardised z = (x - loc) /
# scale; s are the shape parameters.
Density = Callable[[Floats, tuple[Any, ...]], tuple[Floats, Floats, Floats]]

LEAST_SCALE = 1e-100
MOST_SHAPE = 1e6

DENSITIES: dict[str, Density] = {
    "norm": lambda z, s: (-0.5 * z * z, -z, np.ones_like(z)),
    "truncnorm": lambda z, s: (-0.5 * z * z, -z, np.ones_like(z)),
    "halfnorm": lambda z, s: (-0.5 * z * z, -z, np.ones_like(z)),
    "uniform": lambda z, s: (np.zeros_like(z), np.zeros_like(z), np.zeros_like(z)),
    "expon": lambda z, s: (-z, -np.ones_like(z), np.zeros_like(z)),
    "gamma": lambda z, s: (xlogy(s[0] - 1, z) - z, (s[0] - 1) / z - 1, (s[0] - 1) / z**2),
    "lognorm": lambda z, s: (
        -np.log(z) * (1 + 0.5 * np.log(z) / s[0] ** 2),
        -(1 + np.log(z) / s[0] ** 2) / z,
        (1 - s[0] ** 2 - np.log(z)) / (s[0] * z) ** 2,
    ),
    "t": lambda z, s: (
        -0.5 * (s[0] + 1) * np.log1p(z**2 / s[0]),
        -(s[0] + 1) * z / (s[0] + z**2),
        (s[0] + 1) * (s[0] - z**2) / (s[0] + z**2) ** 2,
    ),
    "cauchy": lambda z, s: (-np.log1p(z**2), -2 * z / (1 + z**2), 2 * (1 - z**2) / (1 + z**2) ** 2),
    "loguniform": lambda z, s: (-np.log(z), -1 / z, -1 / z**2),
}


@lru_cache(maxsize=4096)  # scipy is slow to say it
def _standard(distribution: Any) -> tuple[tuple[float, ...], float, float]:
    """Shape parameters, location and scale of a frozen distribution."""
    shapes, loc, scale = distribution.dist._parse_args(*distribution.args, **distribution.kwds)
    return tuple(float(s) for s in shapes), float(loc), float(scale)


@lru_cache(maxsize=4096)
def _anchor(distribution: Any) -> tuple[float, float, float, float]:
    """Both ends of the support, the median, and the log-density there."""
    low, high = distribution.support()
    middle = distribution.median()
    return float(low), float(high), float(middle), float(distribution.logpdf(middle))


def log_density(prior: Mapping[str, Any]) -> Callable[[Floats], Floats]:
    """The log-density of parameter vectors of shape (n, d), one call a family."""
    groups: dict[str, list[int]] = {}
    for k, distribution in enumerate(prior.values()):
        groups.setdefault(distribution.dist.name, []).append(k)
    families = []
    for name, places in groups.items():
        members = [list(prior.values())[k] for k in places]
        *rest, loc, scale = np.array(
            [(*s, loc, scale) for s, loc, scale in map(_standard, members)]
        ).T
        low, high, middle, known = np.array([_anchor(member) for member in members]).T
        density, shapes = DENSITIES[name], tuple(rest)
        constant = known - density((middle - loc) / scale, shapes)[0]
        families.append((density, places, shapes, loc, scale, low, high, constant))

    def evaluate(vectors: Floats) -> Floats:
        total = np.zeros(len(vectors))
        with np.errstate(all="ignore"):  # outside the support
            for density, places, shapes, loc, scale, low, high, constant in families:
                x = vectors[:, places]
                values = density((x - loc) / scale, shapes)[0] + constant
                for column in np.where(
                    (low <= x) & (x <= high), values, -np.inf
                ).T:  # in this order for any number of vectors
                    total += column
        return total

    return evaluate


def check(name: str, distribution: Any) -> None:
    """Refuse what is not a frozen scipy.stats distribution of a family in `DENSITIES`."""
    family = getattr(getattr(distribution, "dist", None), "name", None)
    if family not in DENSITIES:
        raise InputError(
            f"prior: {name}: got {family or type(distribution).__name__}, expected a frozen "
            "scipy.stats distribution "
            f"among {', '.join(DENSITIES)}"
        )
    shapes, loc, scale = _standard(distribution)
    if not LEAST_SCALE <= scale <= 1.0 / LEAST_SCALE:  # its square is a number > 0 too
        raise InputError(
            f"prior: {name}: scale: got {scale}, expected a number > 0, from {LEAST_SCALE:g} to "
            f"{1.0 / LEAST_SCALE:g}"
        )
    sizes = np.abs([shape for shape in shapes if shape and not np.isinf(shape)])
    usable = np.all((sizes >= 1.0 / MOST_SHAPE) & (sizes <= MOST_SHAPE))
    if not (abs(loc) <= 1.0 / LEAST_SCALE and usable and distribution.dist._argcheck(*shapes)):
        raise InputError(
            f"prior: {name}: got {family} with {', '.join(f'{x:g}' for x in (*shapes, loc))}, "
            f"expected valid parameters of scipy.stats.{family}, shapes from {1.0 / MOST_SHAPE:g} "
            f"to {MOST_SHAPE:g}"
        )


def make(name: str, family: str, parameters: Mapping[str, float]) -> Any:
    """The frozen distribution of a family, from its scipy.stats keywords."""
    if family not in DENSITIES:
        raise InputError(
            f"prior.{name}: distribution: got {family!r}, expected one of {', '.join(DENSITIES)}"
        )
    for key, value in parameters.items():
        if not (isinstance(value, int | float) and math.isfinite(value)):
            raise InputError(f"prior.{name}: {key}: got {value!r}, expected a finite number")
    if parameters.get("scale", 1.0) <= 0:
        raise InputError(f"prior.{name}: scale: got {parameters['scale']}, expected a number > 0")
    try:
        distribution = getattr(stats, family)(**parameters)
        shapes = _standard(distribution)[0]
    except TypeError as error:
        raise InputError(
            f"prior.{name}: got {dict(parameters)} for {family}: {error}; see scipy.stats.{family}"
        ) from None
    if not np.all(distribution.dist._argcheck(*shapes)):
        raise InputError(
            f"prior.{name}: got {dict(parameters)}, expected valid parameters of "
            f"scipy.stats.{family}"
        )
    return distribution


def same(one: Any, other: Any) -> bool:
    """Whether two distributions are of one family with the same parameters."""
    return bool(one.dist.name == other.dist.name and _standard(one) == _standard(other))


def slope(distribution: Any, x: float) -> tuple[float, float]:
    """Derivative of the log-density at x, and minus its second derivative."""
    shapes, loc, scale = _standard(distribution)
    _, first, second = DENSITIES[distribution.dist.name](np.array((x - loc) / scale), shapes)
    return float(first) / scale, float(second) / scale**2


def with_defaults(given: Mapping[str, Any], parameters: Sequence[Parameter]) -> dict[str, Any]:
    """The given priors, checked, and the default ones of the other parameters."""
    names = [parameter.name for parameter in parameters]
    if unknown := sorted(set(given) - set(names)):
        expected = ", ".join(names)
        raise InputError(f"prior: got {', '.join(unknown)}, expected names among {expected}")
    for name, distribution in given.items():
        check(name, distribution)
    return {parameter.name: given.get(parameter.name, parameter.prior) for parameter in parameters}
