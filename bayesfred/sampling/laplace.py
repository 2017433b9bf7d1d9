"""Draws of the Laplace approximation: errors from the information at the maximum, in seconds.

Around its maximum m the log-posterior is, to second order,

    log p(x) = log p(m) - (x - m)^T I (x - m) / 2,

I the Fisher information plus the curvature of the prior. So the posterior is approximated by the
normal distribution of mean m and covariance I^-1. Here independent draws are made from it, so that
everything that is read off a chain can be read off these draws too. A prior that ends near m cuts
the distribution there, see `LaplaceMove`; what else is corrected for, such as a hyperparameter, is
in `approximations`. The posterior itself is not evaluated at the draws: that would cost as much as
sampling it. `check_approximation` does so at some of them, to see how good the approximation is.

References
----------
L. Tierney & J. B. Kadane (1986), JASA 81, 82.
A. Kong, J. S. Liu, W. H. Wong (1994), JASA 89, 278: the effective sample size of weighted draws.
"""

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

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

__all__ = ["ApproximationCheck", "check_approximation", "laplace"]

DRAWS = 1000
MIN_EFFICIENCY = 0.8  # the mean of any quantity is within half a standard deviation then
MAX_SHIFT = 0.5  # standard deviations: the same, found rather than bounded
MAX_WIDENING = 1.25
# Numbers of draws at which the posterior is evaluated, one after the other until they tell that the
# approximation holds, by two standard deviations: of all it would take minutes.
WEIGHTED = 16, 64, 128, 256
HOPELESS = 0.1  # efficiency below which these tell nothing


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


class ApproximationCheck(NamedTuple):
    """How well draws of a Laplace approximation represent the posterior.

    Attributes
    ----------
    efficiency : float
        Importance efficiency, from 0 to 1; 1 where the posterior is normal.
    shift : float
        How far the posterior's mean is from the draws', in standard deviations in the direction
        where it is farthest.
    widening : float
        The posterior's standard deviation over that of the draws, of the parameter where it is
        farthest from 1 beyond two Monte Carlo errors.
    """

    efficiency: float
    shift: float
    widening: float

    @property
    def holds(self) -> bool:
        """Whether means and errors that are read off the draws are the posterior's."""
        wide = max(self.widening, 1.0 / self.widening) if self.widening > 0.0 else np.inf
        found = self.shift <= MAX_SHIFT and wide <= MAX_WIDENING
        return self.efficiency >= MIN_EFFICIENCY or found

    def __str__(self) -> str:
        said = f"importance efficiency {self.efficiency:.0%}"
        if self.efficiency >= MIN_EFFICIENCY or np.isnan(self.shift):
            return said
        return (
            f"{said}, the posterior's mean {self.shift:.1f} standard deviations off, its errors "
            f"at worst {self.widening:.2f} times as large"
        )


def check_approximation(chain: Chain) -> ApproximationCheck:
    r"""How well the draws of a Laplace approximation represent the posterior.

    Draws from a density q represent the posterior p when each is weighted by w = p / q. Of n such
    draws (sum w)^2 / sum w^2 are effective. Their share estimates 1 / (1 + c) with c = Var_q(w) /
    E_q(w)^2, the chi-square distance of the two densities. By Cauchy and Schwarz the posterior
    mean of any quantity lies within sqrt(c) standard deviations of the approximation's.

    That bound is far from what is found where there are many parameters. If the information of the
    posterior differs from the approximation's by a symmetric matrix E, relative to the latter, c is
    about tr(E^2) / 2: of 80 parameters elements of 0.013 make the efficiency 60 %, and no mean or
    error differs. So means and errors are compared as well. Let w_i have the mean 1 and let y_i be
    the draws in coordinates where their mean is zero and their covariance is the identity. The
    posterior's mean is mu = E_q((w - 1) y) there, and

        |mu|^2 = sum_{i != j} (w_i - 1) (w_j - 1) y_i . y_j / (n (n - 1))

    is estimated without bias. |mu| is the largest shift in any direction.

    Parameters
    ----------
    chain : Chain
        Draws that `laplace` made; of a frame among several those of all are judged.

    Returns
    -------
    ApproximationCheck
        It is from 16 to 256 of the draws. Where they tell nothing, or there are fewer than two for
        each parameter, shift and widening are nan.

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
    >>> check = check_approximation(laplace(posterior, seed=1, progress=False))
    >>> check.holds, check.efficiency > 0.99, check.shift < 0.1
    (True, True, True)
    """
    chain = chain.whole or chain
    draws, log_q = chain.chain.reshape(-1, len(chain.parameter_names)), chain.log_prob.ravel()
    log_weights = np.empty(0)
    enough = len(draws) >= 2 * draws.shape[1]
    with one_blas_thread():
        standard = _standardised(draws) if enough else None
        for number in WEIGHTED:  # the draws are independent, so the first ones are as good as any
            more = slice(log_weights.size, number)
            log_p = chain.density.log_prob(draws[more])
            log_weights = np.append(log_weights, log_p - log_q[more])
            weights = _weights(log_weights)
            efficiency, sd = _efficiency(weights)
            found = None if standard is None else _moments(weights, *standard)
            holds = efficiency - 2.0 * sd > MIN_EFFICIENCY or (found and found.surely_hold)
            # a few draws may have missed large weights
            is_known = holds and number > WEIGHTED[0]
            if is_known or efficiency + 2.0 * sd < HOPELESS or log_weights.size == len(draws):
                break
    if efficiency < HOPELESS or found is None:
        return ApproximationCheck(efficiency, np.nan, np.nan)
    return ApproximationCheck(efficiency, found.shift, found.widening)


def _weights(log_weights: Floats) -> Floats:
    """Weights of mean 1; all of them zero where the posterior has no density."""
    log_weights = np.where(log_weights < np.inf, log_weights, -np.inf)
    if not np.any(log_weights > -np.inf):
        return np.zeros(log_weights.size)
    weights = np.exp(log_weights - log_weights.max())
    return np.asarray(weights / weights.mean())


def _efficiency(weights: Floats) -> tuple[float, float]:
    """The efficiency that weights tell, and its standard deviation to first order in theirs."""
    square = np.mean(weights**2)
    if square == 0.0:
        return 0.0, 0.0
    spread = np.std(weights**2 - 2.0 * square * weights) / np.sqrt(weights.size)
    return float(1.0 / square), float(spread / square**2)


class _Moments(NamedTuple):
    """What weights tell of the posterior's mean and variances, beside those of the draws.

    Attributes
    ----------
    square, square_sd : float
        The mean's squared distance, without bias, and its standard deviation where it is zero.
    change, change_sd : ndarray, shape (d,)
        Every parameter's variance over that of the draws, less 1.
    """

    square: float
    square_sd: float
    change: Floats
    change_sd: Floats

    @property
    def shift(self) -> float:
        return float(np.sqrt(max(self.square, 0.0)))

    @property
    def widening(self) -> float:
        beyond = np.maximum(np.abs(self.change) - 2.0 * self.change_sd, 0.0)
        ratio = np.sqrt(np.maximum(1.0 + np.sign(self.change) * beyond, 0.0))
        return float(ratio[np.argmax(np.maximum(ratio, 1.0 / np.maximum(ratio, 1e-9)))])

    @property
    def surely_hold(self) -> bool:
        """Whether both are within their bounds by two standard deviations."""
        near = max(self.square, 0.0) + 2.0 * self.square_sd <= MAX_SHIFT**2
        narrow = self.change - 2.0 * self.change_sd >= MAX_WIDENING**-2 - 1.0
        wide = self.change + 2.0 * self.change_sd <= MAX_WIDENING**2 - 1.0
        return bool(near and np.all(narrow & wide))


def _standardised(draws: Floats) -> tuple[Floats, Floats]:
    """Draws whose variances are 1, and such that their covariance is the identity."""
    z = (draws - draws.mean(axis=0)) / draws.std(axis=0)
    return z, np.linalg.qr(z)[0] * np.sqrt(len(z))  # Q^T Q = 1


def _moments(weights: Floats, z: Floats, white: Floats) -> _Moments:
    """By the weights of the first of all draws."""
    n, excess = weights.size, weights - 1.0
    mean = excess @ white[:n]
    pairs = mean @ mean - excess**2 @ np.sum(white[:n] ** 2, axis=1)  # of different draws
    changes = excess[:, None] * (z[:n] ** 2 - 1.0)
    return _Moments(
        square=float(pairs / (n * (n - 1))),
        square_sd=float((2.0 * z.shape[1]) ** 0.5 * np.mean(excess**2) / n),
        change=changes.mean(axis=0) - (excess @ z[:n] / n) ** 2,
        change_sd=changes.std(axis=0) / np.sqrt(n),
    )
