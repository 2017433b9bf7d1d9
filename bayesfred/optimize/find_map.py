"""The posterior's maximum: `matching` says where to begin, `newton` maximises, here it is judged."""

from collections.abc import Callable, Iterator, Sequence

import numpy as np
from threadpoolctl import threadpool_limits

from bayesfred._typing import Floats
from bayesfred.errors import InputError
from bayesfred.model import priors
from bayesfred.model.posterior import Posterior
from bayesfred.optimize.estimate import MapEstimate
from bayesfred.optimize.fit_statistics import CONSISTENT, fit_statistics, misfit
from bayesfred.optimize.matching import Start, find_start, other_starts
from bayesfred.optimize.newton import NewtonResult, maximize
from bayesfred.optimize.outliers import Clipped, settle, whole

# A combination of parameters about which the frame adds less than this share to its prior's
# information is not measured.
LEAST_INFORMATION = 0.01

# ... nor is it missed if it makes up less than this share of what its priors allow.
LEAST_EFFECT = 0.01

# The maximum is found where a Newton step from it would move no parameter by more than this share
# of its error.
CLOSENESS = 1e-3


def undetermined(posterior: Posterior, params: Floats, fisher: Floats) -> tuple[str, ...]:
    """Parameters about which neither the frame nor a prior that was given says anything.

    With S the default priors' standard deviations, the eigenvalues of S I S compare, direction by
    direction, what is known with what the default priors know; I is the Fisher information,
    `fisher`, plus what the given priors know more than the default ones. The names are those that
    make up the directions whose eigenvalue is below `LEAST_INFORMATION`.
    """
    sd = np.array([posterior.default_prior(name).std() for name in posterior.parameter_names])
    given = np.array(
        [priors.slope(p, x)[1] for p, x in zip(posterior.prior.values(), params, strict=True)]
    )
    information = fisher + np.diag(np.maximum(given - sd**-2.0, 0.0))
    values, vectors = np.linalg.eigh(information * np.outer(sd, sd))
    lost = (values < LEAST_INFORMATION) & (_effect(posterior, sd, vectors) > LEAST_EFFECT)
    weak = (vectors[:, lost] ** 2).sum(axis=1) > 0.1
    return tuple(
        name for name, is_weak in zip(posterior.parameter_names, weak, strict=True) if is_weak
    )


def _effect(posterior: Posterior, sd: Floats, vectors: Floats) -> Floats:
    """How much of what the priors allow to happen each direction is: unit vectors, columns, in units of `sd`.

    Of the coefficients what counts is the mean square by which they move points all over the frame,
    to first order, where u = x and v = y. Directions that only exchange u for x, such as u x
    against x^2, move nothing: where the distortion is small no frame tells these terms apart, and
    nothing depends on it.
    """
    d = posterior.model.polynomial
    half = 0.5 * np.array(posterior.model.detector.fine_shape[::-1], dtype=np.float64)
    x, y = (c.ravel() for c in np.meshgrid(*np.linspace(-half, half, 9).T))
    moves = d.design_matrix(x, y, x, y).reshape(-1, d.n_terms) * sd[: d.n_terms]
    squares = ((moves @ vectors[: d.n_terms]) ** 2).sum(axis=0)
    return np.asarray(squares / (moves**2).sum() + (vectors[d.n_terms :] ** 2).sum(axis=0))


def find_map(posterior: Posterior, start: Sequence[float] | Floats | None = None) -> MapEstimate:
    """Maximise the posterior.

    Parameters
    ----------
    posterior : Posterior
    start : array_like, shape (d,), optional
        Where to begin; by default what the counts alone say: peaks matched to the catalogue, and
        other starts where no maximum is found from there, see `start.py`.

    Returns
    -------
    MapEstimate

    Raises
    ------
    InputError
        If the start has no posterior density, or the frame cannot determine some parameters, which
        are named.

    References
    ----------
    J. Nocedal & S. Wright, Numerical Optimization, 2nd ed., chapter 4.

    Examples
    --------
    >>> import bayesfred as bf
    >>> model = bf.ForwardModel(
    ...     bf.Detector((65, 65)), bf.SourceCatalog.grid(3, 20.0, 1e4), bf.GaussianPSF(3.0),
    ...     bf.PolynomialDistortion(f_terms=[(1, 0, 1, 0)], g_terms=[]))
    >>> posterior = bf.Posterior(model, bf.simulate(model, [1e-4], 2.0, seed=1))
    >>> find_map(posterior).fits_data
    True
    """
    return _search(whole, posterior, start)[1]


def reject_outliers(
    posterior: Posterior, start: Sequence[float] | Floats | None = None
) -> tuple[Posterior, MapEstimate]:
    """Leave out what frame and catalogue do not have in common, and maximise the posterior of the rest.

    Sources that are missing from the frame are taken off the catalogue; spots of no source, and
    whatever else stands out of the noise by 5 standard deviations at the maximum, are masked. Where
    nothing does, the posterior is the one that was given.

    Parameters
    ----------
    posterior : Posterior
    start : array_like, shape (d,), optional
        Where to begin; as in `find_map`.

    Returns
    -------
    posterior : Posterior
        The one to sample, of the sources and the pixels that remain.
    estimate : MapEstimate
        Its maximum; the message says how many sources and pixels are left out.

    Raises
    ------
    InputError
        As `find_map` does.

    Notes
    -----
    What is left out is chosen by the counts, and taken for certain. Of a frame with nothing but
    noise 5 standard deviations leave out one place in millions. Where more than seven in ten
    sources would have to go, the model is taken to be wrong, not the catalogue: only what exceeds a
    share of the light of the stars nearby is left out then, or nothing.

    Examples
    --------
    >>> import bayesfred as bf
    >>> model = bf.ForwardModel(
    ...     bf.Detector((65, 65)), bf.SourceCatalog.grid(3, 20.0, 1e4), bf.GaussianPSF(2.0),
    ...     bf.PolynomialDistortion(f_terms=[(1, 0, 1, 0)], g_terms=[]))
    >>> counts = bf.simulate(model, [1e-4], 2.0, seed=1)
    >>> counts[40:43, 20:23] += 500.0  # in no catalogue
    >>> posterior = bf.Posterior(model, counts)
    >>> find_map(posterior).fits_data
    False
    >>> clipped, estimate = reject_outliers(posterior)
    >>> estimate.fits_data, bool(clipped.mask[41, 21]), len(clipped.model.sources)
    (True, False, 9)
    """
    return _search(settle, posterior, start)


def _search(
    clipping: Callable[[Posterior, Floats], tuple[Clipped, Floats, int]],
    posterior: Posterior,
    start: Sequence[float] | Floats | None,
) -> tuple[Posterior, MapEstimate]:
    """The posterior that clipping leaves, and its maximum."""
    with threadpool_limits(
        1, user_api="blas"
    ):  # idle BLAS threads spin, and take the cores from what is at work
        top, evaluations = None, 0
        for begun in _starts(posterior, start):
            if not np.isfinite(posterior.log_prob(begun.params)):
                if top is not None:
                    continue
                raise InputError(
                    "start: the posterior has no density there, expected parameters within the "
                    "prior whose map does not fold"
                )
            fisher = posterior.fisher(begun.params) if top is None else None
            if fisher is not None and (weak := undetermined(posterior, begun.params, fisher)):
                raise InputError(
                    f"parameters: the frame cannot determine {', '.join(weak)}, expected each to "
                    "move the counts by more than "
                    "their noise: leave out terms, add sources, or give these parameters a "
                    "narrower prior"
                )
            clipped, origin, spent = clipping(posterior, begun.params)
            again = maximize(
                clipped.posterior, origin, fisher=fisher if origin is begun.params else None
            )
            evaluations += spent + again.evaluations
            if top is None or again.distance < CLOSENESS:
                top, found, how = again, clipped, _how(posterior, begun)
            if again.distance < CLOSENESS:
                break
        assert top is not None, "a first start"
        return found.posterior, _judged(posterior, found.posterior, top, evaluations, how)


def _starts(posterior: Posterior, start: Sequence[float] | Floats | None) -> Iterator[Start]:
    """Where to begin, and where to begin anew while no maximum is found."""
    if start is not None:
        yield Start(np.array(start, dtype=np.float64), "", 0)
        return
    begun = find_start(posterior)
    yield begun
    yield from other_starts(posterior, begun)


def _judged(
    given: Posterior, posterior: Posterior, top: NewtonResult, evaluations: int, how: str
) -> MapEstimate:
    """Whether it is a maximum of what is left of the posterior that was given, and whether the model fits there."""
    at_maximum = top.distance < CLOSENESS
    excess = misfit(fit_statistics(posterior, top.params))
    message = (
        f"gradient {top.distance:.1g} standard deviations from zero after {evaluations} "
        f"evaluations{how}"
    )
    if posterior is not given:
        sources = len(given.model.sources) - len(posterior.model.sources)
        message += (
            f", {sources} sources and {given.mask.sum() - posterior.mask.sum()} pixels left out"
        )
    bounds = zip(posterior.parameter_names, top.params, *posterior.support, strict=True)
    if at_bound := [name for name, x, low, high in bounds if x in (low, high)]:
        message += f", {', '.join(at_bound)} at a bound of the prior"
    if not at_maximum:
        message = (
            f"not found, {message}: begin elsewhere (start), fit fewer terms, or narrow the priors"
        )
    elif not abs(excess) <= CONSISTENT:
        message = f"found, {message}; {_advice(excess, clipped=posterior is not given)}"
    else:
        message = f"found, {message}; residuals as the noise makes them"
    fits = abs(excess) <= CONSISTENT
    return MapEstimate(
        top.params, top.covariance, top.log_prob, evaluations, message, at_maximum, fits
    )


def _how(posterior: Posterior, begun: Start) -> str:
    return (
        f" from {begun.path}, {begun.matched} of {len(posterior.model.sources)} sources matched"
        if begun.path
        else ""
    )


def _advice(excess: float, *, clipped: bool) -> str:
    """What to do about residuals that are not those of the noise."""
    if excess > 0:
        spots = (
            ""
            if clipped
            else ", or sources that the catalogue lacks or the frame misses (reject_outliers "
            "leaves them out)"
        )
        return (
            f"but the residuals exceed the noise (deviance {excess:.0f} standard deviations above "
            "its expectation): look at "
            f"them for a PSF or fluxes that are not right, terms left out{spots}"
        )
    return (
        f"but the residuals are less than the noise (deviance {-excess:.0f} standard deviations "
        "below its expectation): check "
        "gain and read noise"
    )
