"""The evidence of a model: how probable it makes the counts, before any parameter is known.

Z is the integral of likelihood times prior, both normalised. With the proposal q of `LaplaceMove`,
which is a normalised density close to the posterior p / Z, and the ratios l = p / q:

- draws of q alone give Z as the mean of l (importance sampling);
- draws of the posterior as well give it more exactly, and safely where a tail of the posterior is
  heavier than that of q. Of all functions h for which Z = E_q[h p] / E_post[h q], the optimal one
  is h = 1 / (s1 p + s2 Z q), with the shares s1, s2 of the n1 effective draws of the posterior and
  the n2 of q (bridge sampling). Z is then the root of

      mean over q of   l / (s1 l + s2 Z)   =   mean over the posterior of   Z / (s1 l + s2 Z),

  whose left side falls with Z while its right side rises.

The squared relative error of Z is the sum of those of the two means,

    Var_q(f1) / (n2 E_q[f1]^2) + Var_post(f2) / (n1 E_post[f2]^2),

n1 now the effective number of draws for the mean of f2. One draw of q in 20 is from its share with
tails, not left to chance; so Var_q is that within the shares. q is centred on the maximum and does
not depend on the draws. The chain has stored p at its draws, so the bridge costs one posterior for
each draw of q.

References
----------
X.-L. Meng, W. H. Wong (1996), Statistica Sinica 6, 831: the optimal bridge.
C. H. Bennett (1976), Journal of Computational Physics 22, 245: its equation.
S. Fruehwirth-Schnatter (2004), Econometrics Journal 7, 143: the error, from correlated draws.
Q. F. Gronau et al. (2017), Journal of Mathematical Psychology 81, 80.
"""

import math
from typing import NamedTuple

import numpy as np
from arviz_stats.base import array_stats
from scipy import optimize
from scipy.special import expit, log_expit, logsumexp

from bayesfred._typing import Flags, Floats
from bayesfred.errors import InputError
from bayesfred.model.protocol import TargetDensity
from bayesfred.model.threads import one_blas_thread
from bayesfred.optimize.estimate import MapEstimate
from bayesfred.sampling.chain import Chain
from bayesfred.sampling.convergence import effective_size
from bayesfred.sampling.moves import HEAVY_SHARE, LaplaceMove

__all__ = [
    "Evidence",
    "draws_needed",
    "evidence_with_ratios",
    "importance_evidence",
    "log_evidence",
    "random_numbers",
]

PROPOSALS = 1000  # at most
PRECISE = 0.01  # error of a chain's log-evidence with which fewer do
PARTS = 10  # in which these are drawn: after each the error is looked at
PERIOD = round(1.0 / HEAVY_SHARE)  # draws of which one is from the proposal's share with tails
MANY = 2  # draws for each parameter, above which it pays to extrapolate free fluxes
COARSE = 0.3  # error above which a few draws decide
EVEN = 5.0  # largest weight over their mean: the shape of such a tail is noise, and no matter
STREAM = 20  # apart from the random numbers that made the chain
OUTSIDE = "the proposal of the maximum finds no posterior, expected the posterior's maximum"


class Evidence(NamedTuple):
    """The evidence of a model.

    Attributes
    ----------
    log_evidence : float
        Natural logarithm of the integral of likelihood times prior.
    error : float
        Standard deviation of its Monte Carlo error.
    """

    log_evidence: float
    error: float


def log_evidence(chain: Chain) -> Evidence:
    """The evidence of a chain's model, by bridge sampling.

    Parameters
    ----------
    chain : Chain
        Sampled well. Of draws that `laplace` made, which are not draws of the posterior, the
        evidence is that of importance sampling.

    Returns
    -------
    Evidence

    Raises
    ------
    InputError
        If the chain's maximum is not where its posterior is.

    Notes
    -----
    It depends on the priors, also on the width of one that is wide. The fluxes and shifts that
    are not sampled are integrated out of the likelihood in the Laplace approximation.

    References
    ----------
    Gronau et al. (2017), Eq. 14 to 16.

    Examples
    --------
    >>> import bayesfred as bf
    >>> model = bf.ForwardModel(
    ...     bf.Detector((65, 65)), bf.SourceCatalog.grid(3, 20.0, 1e4), bf.GaussianPSF(3.0),
    ...     bf.PolynomialDistortion(f_terms=[(1, 0, 1, 0)], g_terms=[]))
    >>> posterior = bf.Posterior(model, bf.simulate(model, [1e-4], 2.0, seed=1))
    >>> found = bf.log_evidence(bf.sample(posterior, seed=1, target_ess=200, progress=False))
    >>> f"{found.log_evidence:.1f}", found.error < 0.05
    ('-10360.3', True)
    """
    return evidence_with_ratios(chain)[0]


def evidence_with_ratios(chain: Chain) -> tuple[Evidence, Floats]:
    """The evidence as `log_evidence` finds it, and the ratios that it took.

    Parameters
    ----------
    chain : Chain

    Returns
    -------
    evidence : Evidence
    ratios : ndarray, shape (n,)
        Logarithms of posterior over proposal at draws of the proposal.
    """
    random, density, top = random_numbers(chain), chain.density, chain.estimate
    with one_blas_thread():
        move, near = LaplaceMove.of(density, top), density.near(top.params, top.covariance)
        if chain.method == "laplace":
            ratios = _proposed(near, move, PROPOSALS, random)
            return _mean(ratios), ratios
        kept = chain.log_prob[:, chain.burn_in :]
        draws = chain.chain[:, chain.burn_in :].reshape(-1, len(chain.parameter_names))
        log_q = move.log_density(draws).reshape(kept.shape)
        walkers = (kept - log_q).transpose(0, 2, 1).reshape(-1, kept.shape[1])
        ratios = np.empty(0)
        for _ in range(PARTS):
            ratios = np.append(ratios, _proposed(near, move, PROPOSALS // PARTS, random))
            found = _bridge(walkers, ratios)
            if found.error <= PRECISE:
                break
        return found, ratios


def draws_needed(ratios: Floats, error: float, most: int) -> int:
    """How many draws of the proposal give the evidence with an error, at most so many.

    Parameters
    ----------
    ratios : ndarray, shape (n,)
        Of other draws of such a proposal, see `evidence_with_ratios`.
    error : float
    most : int
    """
    needed = ratios.size * (_mean(ratios).error / error) ** 2
    return min(PERIOD * math.ceil(needed / PERIOD), most)


def importance_evidence(
    density: TargetDensity,
    top: MapEstimate,
    number: int,
    random: np.random.RandomState,
) -> tuple[Evidence, float]:
    """The evidence by importance sampling from the proposal at a maximum.

    Parameters
    ----------
    density : TargetDensity
    top : MapEstimate
        Its maximum.
    number : int
        Draws of the proposal: a multiple of 20.
    random : RandomState

    Returns
    -------
    evidence : Evidence
    pareto_k : float
        Shape of the tail of the weights; -inf where none is 5 times their mean, inf where the
        error exceeds 0.3, as a few draws then have all the weight. Above
        min(1 - 1 / log10(number), 0.7) neither the evidence nor its error is to be trusted.

    Raises
    ------
    InputError
        If no draw of the proposal has posterior density.

    References
    ----------
    A. Vehtari et al. (2024), Journal of Machine Learning Research 25, 72: the shape and its limit.
    """
    move = LaplaceMove.of(density, top)
    if number > MANY * top.params.size:
        density = density.near(top.params, top.covariance)
    ratios = _proposed(density, move, number, random)
    found, weights = _mean(ratios), np.exp(ratios - ratios.max())
    if found.error > COARSE:
        shape = np.inf
    elif weights.max() <= EVEN * weights.mean():
        shape = -np.inf
    else:
        with np.errstate(all="ignore"):  # of weights that are zero
            shape = float(array_stats.psislw(-ratios)[1])
    return found, shape


def random_numbers(chain: Chain) -> np.random.RandomState:
    """Random numbers of a chain's seed, independent of the numbers that made it."""
    return np.random.RandomState(np.random.MT19937(np.random.SeedSequence([chain.seed, STREAM])))


def _proposed(
    density: TargetDensity, move: LaplaceMove, number: int, random: np.random.RandomState
) -> Floats:
    """Logarithms of posterior over proposal at draws of the proposal."""
    draws = move.draw(number, random, _heavy(number))
    values = density.log_prob(draws)
    values = np.where(values < np.inf, values, -np.inf)  # as the sampler takes them
    if not np.any(values > -np.inf):
        raise InputError(f"estimate: {OUTSIDE}: see find_map")
    return np.asarray(values - move.log_density(draws))


def _mean(ratios: Floats) -> Evidence:
    """The evidence by importance sampling."""
    weights = np.exp(ratios - ratios.max())
    error = math.sqrt(_variance(weights)) / float(weights.mean())
    return Evidence(float(logsumexp(ratios) - math.log(ratios.size)), error)


def _heavy(n: int) -> Flags:
    """Which of n draws are from the share with tails: not left to chance, it has less error."""
    return np.asarray(np.arange(n) % PERIOD == 0, dtype=np.bool_)


def _variance(values: Floats) -> float:
    """Of the mean over draws of the proposal, each share of which has its own.

    Few draws are heavy. Their variance is told as if there were two more, of no weight and of that
    which the others have: the draws that there are may have missed either.
    """
    heavy = _heavy(values.size)
    light = values[~heavy]
    known = np.append(values[heavy], [0.0, light.mean()])
    every = np.where(heavy, np.var(known), np.var(light, ddof=1))
    return float(every.mean()) / values.size


def _bridge(walkers: Floats, proposed: Floats) -> Evidence:
    """The root of the bridge's equation.

    Its arguments are log p - log q at draws of the posterior, shape (n_chains, n_steps), and at
    draws of the proposal.
    """
    n1, n2 = max(effective_size(walkers), 1.0), float(proposed.size)
    lead = math.log(n1 / n2)

    def excess(log_z: float) -> float:
        left = logsumexp(log_expit(proposed - log_z + lead)) - math.log(n1 * proposed.size)
        right = logsumexp(log_expit(log_z - lead - walkers)) - math.log(n2 * walkers.size)
        return float(left - right)

    finite = np.concatenate([walkers.ravel(), proposed[proposed > -np.inf]])
    margin = 1.0 + math.log(n2)  # for proposals without posterior
    log_z = float(optimize.brentq(excess, finite.min() - margin, finite.max() + 1.0, xtol=1e-10))
    f1, f2 = expit(proposed - log_z + lead), expit(log_z - lead - walkers)
    error = _variance(f1) / np.mean(f1) ** 2
    error += np.var(f2) / max(effective_size(f2), 1.0) / np.mean(f2) ** 2
    return Evidence(log_z, math.sqrt(error))
