"""Draws of the Laplace approximation: errors from the information at the maximum, in seconds.

Around its maximum m the log-posterior is, to second order,

    log p(x) = log p(m) - (x - m)^T I (x - m) / 2,

I the Fisher information plus the curvature of the prior. So the posterior is approximated by the
normal distribution of mean m and covariance I^-1. Here independent draws are made from it, so that
everything that is read off a chain can be read off these draws too. A prior that ends near m cuts
the distribution there, see `LaplaceMove`; what else is corrected for, such as a hyperparameter, is
in `approximations`. The posterior itself is not evaluated at the draws: that would cost as much as
sampling it. `importance_efficiency` does so at some of them, to see how good the approximation is.

References
----------
L. Tierney & J. B. Kadane (1986), JASA 81, 82.
A. Kong, J. S. Liu, W. H. Wong (1994), JASA 89, 278: the effective sample size of weighted draws.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from bayesfred._typing import Floats, PathLike
from bayesfred.errors import InputError
from bayesfred.io.lock import only_writer
from bayesfred.io.paths import may_write
from bayesfred.model.protocol import TargetDensity
from bayesfred.model.threads import one_blas_thread
from bayesfred.optimize.estimate import MapEstimate
from bayesfred.optimize.find_map import find_map
from bayesfred.sampling.chain import Chain
from bayesfred.sampling.chainfile import write_chain
from bayesfred.sampling.moves import LaplaceMove
from bayesfred.sampling.progress import working
from bayesfred.sampling.record import RunRecord
from bayesfred.sampling.sampler import check_estimate, check_output, versions

__all__ = ["MIN_EFFICIENCY", "importance_efficiency", "laplace"]

DRAWS = 1000
MIN_EFFICIENCY = 0.8  # any posterior mean is within half a standard deviation then
# Numbers of draws at which the posterior is evaluated, one after the other until they tell on which
# side of the bound the efficiency is, by two standard deviations: of all it would take minutes.
WEIGHTED = 16, 64, 256


def laplace(
    posterior: TargetDensity,
    estimate: MapEstimate | None = None,
    *,
    seed: int,
    path: PathLike | None = None,
    draws: int = DRAWS,
    overwrite: bool = False,
    progress: bool = True,
    record: RunRecord | None = None,
) -> Chain:
    """Draw from the Laplace approximation of a posterior, in memory or into a chain file.

    Parameters
    ----------
    posterior : Posterior or TargetDensity
        As `sample` takes it.
    estimate : MapEstimate, optional
        Its maximum; by default found by `find_map`.
    seed : int
        The same seed, posterior and estimate give the same draws.
    path : path-like, optional
        The chain file, HDF5. Without it the chain is kept in memory alone.
    draws : int
        Number of independent draws. With 1000 the standard deviations are known to 2 %.
    overwrite : bool
        Replace the file.
    progress : bool
        Say in a terminal that the maximum is being searched for.
    record : RunRecord, optional
        Title, frame, settings, notes and truth, kept with the draws.

    Returns
    -------
    Chain
        Of one ensemble of one walker, whose steps are the draws. Its `method` is "laplace", and
        its `log_prob` is the approximation's log-density, equal to the posterior's at the maximum.

    Raises
    ------
    InputError
        If the file exists and may not be replaced, cannot hold such a posterior or cannot be
        written; if fewer than 2 draws are asked for, or the estimate is another posterior's.

    References
    ----------
    L. Tierney & J. B. Kadane (1986), JASA 81, 82.

    Examples
    --------
    >>> import bayesfred as bf
    >>> model = bf.ForwardModel(
    ...     bf.Detector((65, 65)), bf.SourceCatalog.grid(3, 20.0, 1e4), bf.GaussianPSF(3.0),
    ...     bf.PolynomialDistortion(f_terms=[(1, 0, 1, 0)], g_terms=[]))
    >>> posterior = bf.Posterior(model, bf.simulate(model, [1e-4], 2.0, seed=1))
    >>> chain = laplace(posterior, seed=1, progress=False)
    >>> chain.method, chain.draws().shape
    ('laplace', (1000, 2))
    """
    if draws < 2:
        raise InputError(f"laplace: draws: got {draws}, expected at least 2")
    if path is None and overwrite:
        raise InputError("laplace: path: got none with overwrite, expected the chain file")
    with one_blas_thread():  # idle BLAS threads spin and take half the cores
        if path is None:
            chain = _drawn(posterior, estimate, seed, draws, progress)
            return replace(chain, record=record)
        path = Path(path)
        check_output(path, posterior)
        with only_writer(path):
            may_write(path, overwrite=overwrite)
            chain = _drawn(posterior, estimate, seed, draws, progress)
            chain = replace(chain, path=path, record=record)
            write_chain(chain)
            return chain


def _drawn(
    posterior: TargetDensity, estimate: MapEstimate | None, seed: int, n: int, progress: bool
) -> Chain:
    if estimate is None:
        with working(show=progress):
            estimate = find_map(posterior)
    check_estimate(posterior, estimate)
    move = LaplaceMove.of(posterior, estimate, heavy_share=0.0)
    random = np.random.RandomState(np.random.MT19937(np.random.SeedSequence(seed)))
    coords = move.draw(n, random)
    top = move.log_density(estimate.params[None])
    log_prob = move.log_density(coords) - top + estimate.log_prob
    return Chain(
        path=None,
        density=posterior,
        chain=coords[None, :, None],
        log_prob=log_prob[None, :, None],
        accepted=np.full((1, 1), n),
        random_states=(tuple(random.get_state()),),
        burn_in=0,
        seed=seed,
        estimate=estimate,
        versions=versions(),
        target_ess=float(n),
        method="laplace",
    )


def importance_efficiency(chain: Chain) -> float:
    """How well the draws of a Laplace approximation represent the posterior.

    Draws from a density q represent the posterior p when each is weighted by w = p / q. Of n such
    draws (sum w)^2 / sum w^2 are effective. Their share estimates 1 / (1 + c) with c = Var_q(w) /
    E_q(w)^2, the chi-square distance of the two densities. By Cauchy and Schwarz the posterior
    mean of any parameter lies within sqrt(c) standard deviations of the approximation's.

    Parameters
    ----------
    chain : Chain
        Draws that `laplace` made; of a frame among several those of all are judged.

    Returns
    -------
    float
        From 0 to 1; 1 where the posterior is normal. It is from 16 to 256 of the draws, as many
        as tell whether it is below `MIN_EFFICIENCY`.

    References
    ----------
    A. Kong, J. S. Liu, W. H. Wong (1994), JASA 89, 278.

    Examples
    --------
    >>> import bayesfred as bf
    >>> model = bf.ForwardModel(
    ...     bf.Detector((65, 65)), bf.SourceCatalog.grid(3, 20.0, 1e4), bf.GaussianPSF(3.0),
    ...     bf.PolynomialDistortion(f_terms=[(1, 0, 1, 0)], g_terms=[]))
    >>> posterior = bf.Posterior(model, bf.simulate(model, [1e-4], 2.0, seed=1))
    >>> importance_efficiency(laplace(posterior, seed=1, progress=False)) > 0.99
    True
    """
    chain = chain.whole or chain
    draws, log_q = chain.chain.reshape(-1, len(chain.parameter_names)), chain.log_prob.ravel()
    log_weights = np.empty(0)
    for number in WEIGHTED:  # the draws are independent, so the first ones are as good as any
        more = slice(log_weights.size, number)
        log_p = chain.density.log_prob(draws[more])
        log_weights = np.append(log_weights, log_p - log_q[more])
        efficiency, sd = _efficiency(log_weights)
        above = efficiency - MIN_EFFICIENCY
        # a few draws may have missed large weights
        is_known = above < -2.0 * sd or (above > 2.0 * sd and number > WEIGHTED[0])
        if is_known or log_weights.size == len(draws):
            break
    return efficiency


def _efficiency(log_weights: Floats) -> tuple[float, float]:
    """The efficiency that weights tell, and its standard deviation to first order in theirs."""
    log_weights = np.where(log_weights < np.inf, log_weights, -np.inf)
    if not np.any(log_weights > -np.inf):
        return 0.0, 0.0
    weights = np.exp(log_weights - log_weights.max())
    weights /= weights.mean()
    square = np.mean(weights**2)
    spread = np.std(weights**2 - 2.0 * square * weights) / np.sqrt(weights.size)
    return float(1.0 / square), float(spread / square**2)
