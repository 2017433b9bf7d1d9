"""Which parameters neither the frame nor a prior says anything about."""

import numpy as np

from bayesfred._typing import Flags, Floats
from bayesfred.errors import InputError
from bayesfred.model import priors
from bayesfred.model.noise import PoissonNoise
from bayesfred.model.posterior import Posterior

# A combination of parameters about which the frame adds less than this share to its prior's
# information is not measured.
LEAST_INFORMATION = 0.01

# ... nor is it missed if it makes up less than this share of what its priors allow.
LEAST_EFFECT = 0.01


def require_light(posterior: Posterior) -> None:
    """Refuse a frame that says nothing: one number in every pixel, or not a photon in any.

    Raises
    ------
    InputError
    """
    counts, used, number = posterior.counts, posterior.mask, int(posterior.mask.sum())
    low, high = float(counts[used].min()), float(counts[used].max())
    if (low == high and number > 1) or (
        isinstance(posterior.noise.pixelwise, PoissonNoise) and high < 1
    ):
        got = f"{high:g} in each" if low == high else f"at most {high:.2g}"
        raise InputError(
            f"counts: got {got} of {number} pixels, expected images of the sources: such a "
            "frame holds no information: check the exposure and the gain"
        )


def undetermined(
    posterior: Posterior, params: Floats, fisher: Floats, fitted: Flags | None = None
) -> tuple[str, ...]:
    """Parameters about which neither the frame nor a prior that was given says anything.

    With S the default priors' standard deviations, the eigenvalues of S I S compare, direction by
    direction, what is known with what the default priors know; I is the Fisher information,
    `fisher`, plus what the given priors know more than the default ones. The names are those that
    make up the directions whose eigenvalue is below `LEAST_INFORMATION`. Parameters that are not
    `fitted` are taken for known.
    """
    sd = np.array([p.prior.std() for p in posterior.parameters])
    given = np.array(
        [priors.slope(p, x)[1] for p, x in zip(posterior.prior.values(), params, strict=True)]
    )
    information = fisher + np.diag(np.maximum(given - sd**-2.0, 0.0))
    if fitted is not None:
        information = np.where(np.outer(fitted, fitted), information, np.diag(sd**-2.0))
    values, vectors = np.linalg.eigh(information * np.outer(sd, sd))
    lost = (values < LEAST_INFORMATION) & (_effect(posterior, sd, vectors) > LEAST_EFFECT)
    weak = (vectors[:, lost] ** 2).sum(axis=1) > 0.1
    return tuple(
        name for name, is_weak in zip(posterior.parameter_names, weak, strict=True) if is_weak
    )


def determined_degree(posterior: Posterior, params: Floats, fisher: Floats) -> int | None:
    """The highest degree up to which the frame determines all terms; None where it is none.

    The Fisher information is as for `undetermined`.
    """
    d = posterior.model.polynomial
    degrees = np.array([sum(term) for term in d.f_terms + d.g_terms])
    if d.basis is not None:  # a combination of monomials has the highest degree of them
        degrees = np.max(np.where(d.basis != 0.0, degrees[:, None], 0), axis=0)
    fitted = np.ones(len(params), bool)
    for degree in range(int(degrees.max()) - 1, 0, -1):
        fitted[: d.n_terms] = degrees <= degree
        if fitted[: d.n_terms].any() and not undetermined(posterior, params, fisher, fitted):
            return degree
    return None


def _effect(posterior: Posterior, sd: Floats, vectors: Floats) -> Floats:
    """How much each direction makes of what the priors allow, for unit vectors in units of `sd`.

    The vectors are columns. Of the coefficients what counts is the mean square by which they move
    points all over the frame, to first order, where u = x and v = y. Directions that only exchange
    u for x, such as u x against x^2, move nothing: where the distortion is small no frame tells
    these terms apart, and nothing depends on it.
    """
    d = posterior.model.polynomial
    half = 0.5 * np.array(posterior.model.detector.fine_shape[::-1], dtype=np.float64)
    x, y = (c.ravel() for c in np.meshgrid(*np.linspace(-half, half, 9).T))
    moves = d.design_matrix(x, y, x, y).reshape(-1, d.n_terms) * sd[: d.n_terms]
    squares = ((moves @ vectors[: d.n_terms]) ** 2).sum(axis=0)
    return np.asarray(squares / (moves**2).sum() + (vectors[d.n_terms :] ** 2).sum(axis=0))
