r"""The random field of displacements that neighbouring sources have in common, told by a frame.

Source s is found x_s from where the coefficients put it, x_s = F_s c + d_s + e_s along each axis: c
is what the fit took away from the displacements and what terms of up to two degrees more would, d
the random field of `model.displacement_errors`, and e_s has the variance of the source's counts and
that of a scatter of its own. What more terms describe is no random field but their lack, which
other tests see. With V the covariance of d + e and c integrated out under a flat prior, x has the
restricted likelihood

    -2 log L = log|V| + log|F^T V^-1 F| + x^T V^-1 x - x^T V^-1 F (F^T V^-1 F)^-1 F^T V^-1 x,

of which the field's sd and length and the scatter are the maximum. Without the second term a field
that terms have followed in part would seem to be weaker and shorter than it is. A source displaced
by more than `OUTLYING` standard deviations has as much larger an error. There is a field if
Akaike's criterion prefers its two numbers to none. It is no longer than half the frame: what varies
as slowly is the trend's.

The field is split into blocks of neighbouring sources, halved across the longer side again and
again, and blocks are taken as independent: a composite likelihood, of which pairs on both sides of
a cut are no part. Of many blocks some are used, spread over the field.

References
----------
H. Akaike (1974), IEEE Trans. Automatic Control 19, 716: the criterion.
H. D. Patterson, R. Thompson (1971), Biometrika 58, 545: restricted maximum likelihood.
P. K. Kitanidis (1983), Water Resources Research 19, 909: of a random field with a trend.
J. Eidsvik et al. (2014), J. Comp. Graph. Stat. 23, 295: composite likelihoods of blocks.
"""

from typing import NamedTuple

import numpy as np
from scipy import linalg, optimize, sparse, spatial
from scipy.spatial import distance

from bayesfred._typing import Floats, Ints
from bayesfred.analysis.absorbed import responses
from bayesfred.analysis.neighbours import FEWEST, FOLLOWED, OUTLYING, distance_of_neighbours
from bayesfred.analysis.sources import SourceFits
from bayesfred.model.displacement_errors import RandomField
from bayesfred.model.kernels.fisher import EXPECTED
from bayesfred.model.likelihood import FrameLikelihood
from bayesfred.model.posterior import Posterior

__all__ = ["FieldLeft", "Placed", "find_field", "placed", "shared_products"]

BLOCK = 250  # sources at most
MOST = 8  # blocks
EVALUATIONS = 150  # of the likelihood at most: a field that is there needs fewer
REACH = 6.0  # lengths, beyond which the field is not followed
ROWS, PAIRS = 1000, 20_000  # sources whose pairs are made at a time, and pairs
TOLD = 1e-8  # of the largest singular value, below which coefficients are not told apart
CLOSE = 0.02  # of the logarithms of sd, length and scatter
ROUNDING = 1e-12  # of a square of which the trend may leave nothing
NONE = 0.03  # of the displacements, at which a scatter makes no difference
AKAIKE = 4.0  # by which twice the logarithm of the likelihood has to be larger for two numbers


class Placed(NamedTuple):
    """Where the sources of a frame are found, in fine pixels along u and v.

    Attributes
    ----------
    number : ndarray of int, shape (n,)
        Which of all sources these are.
    images, found : ndarray, shape (n, 2)
        Where the model has them, and how far from there they are found.
    errors, scatter : ndarray, shape (n, 2, 2)
        Covariance that the fit takes the latter to have, by the sources' counts and by their
        scatter.
    slopes : ndarray, shape (n, 2, d)
        Derivatives of the images by the parameters.
    """

    number: Ints
    images: Floats
    found: Floats
    errors: Floats
    scatter: Floats
    slopes: Floats

    @property
    def precision(self) -> Floats:
        """The weight of the sources in the fit, shape (n, 2, 2)."""
        return np.asarray(np.linalg.inv(self.errors + self.scatter))

    @property
    def pulls(self) -> Floats:
        """How displacements move the gradient of the log-posterior, shape (n, 2, d)."""
        return np.asarray(self.precision @ self.slopes)


def placed(
    posterior: Posterior,
    params: Floats,
    fits: SourceFits,
    wanted: tuple[FrameLikelihood, Floats] | None = None,
) -> Placed:
    """Where the sources of a frame are found.

    Parameters
    ----------
    posterior : Posterior
    params : ndarray, shape (d,)
    fits : SourceFits
    wanted : tuple of FrameLikelihood and ndarray, optional
        Another model with its parameters, by which to take the derivatives.

    Returns
    -------
    Placed
        Of the sources that are found.
    """
    errors, images, to_image = fits.moved_covariance, fits.own.image, fits.to_image
    told = np.isfinite(images + fits.moved).all(axis=1) & np.isfinite(errors).all(axis=(1, 2))
    some = np.flatnonzero(told)
    square = to_image[some] @ to_image[some].swapaxes(1, 2)
    # as the information takes it: the average curvature of the shifts' prior
    scatter = fits.scatter[some, None, None] / EXPECTED * square
    model, at = wanted or (posterior, params)
    slopes = to_image @ responses(model, at, fits)[:, 1:3]
    return Placed(some, images[some], fits.moved[some], errors[some], scatter, slopes[some])


def find_field(sources: Placed, trend: Floats) -> RandomField | None:
    """The field of displacements under which the sources' are most likely.

    Parameters
    ----------
    sources : Placed
        Isolated ones.
    trend : ndarray, shape (n, 2, k)
        Displacements that are none of the field's: those by the parameters and by more terms.

    Returns
    -------
    RandomField or None
        None where sources are on a line, as likely displaced independently, or too few to tell the
        field from the trend.
    """
    try:
        step = distance_of_neighbours(sources.images) if len(sources.images) >= FEWEST else 0.0
    except spatial.QhullError:  # on a line
        return None
    if not (step > 0.0 and np.any(sources.found)):
        return None
    found, square = sources.found, 1.0 / np.diagonal(sources.precision, axis1=1, axis2=2)
    far_off = np.maximum((found / OUTLYING) ** 2 - square, 0.0)
    variance = np.diagonal(sources.errors, axis1=1, axis2=2) + far_off
    blocks = _blocks(sources.images, np.arange(len(found)))
    blocks = blocks[:: -(-len(blocks) // MOST)]
    some = np.concatenate(blocks)
    basis = _basis(trend[some].reshape(2 * some.size, -1)).reshape(some.size, 2, -1)
    if basis.shape[2] > some.size:
        return None
    trend = np.zeros((*found.shape, basis.shape[2]))
    trend[some] = basis
    distances = [distance.squareform(distance.pdist(sources.images[block])) for block in blocks]
    size = float(np.sqrt(np.mean(np.minimum(found**2, OUTLYING**2 * square))))

    def minus_log_likelihood(logs: Floats) -> float:
        sd, length, scatter = np.exp(logs)
        field, size = RandomField(sd, length), trend.shape[2]
        products, total = np.zeros((size + 1, size + 1)), 0.0
        for block, apart in zip(blocks, distances, strict=True):
            shared = field.covariance(apart)
            for axis in range(2):
                covariance = shared + np.diag(variance[block, axis] + scatter**2)
                lower = linalg.cholesky(covariance, lower=True, check_finite=False)
                both = np.column_stack([trend[block, axis], found[block, axis]])
                both = linalg.solve_triangular(lower, both, lower=True, check_finite=False)
                products += both.T @ both
                total += 2.0 * float(np.log(np.diag(lower)).sum())
        # the determinant of all is that of the trend times what it leaves of the square
        products[-1, -1] *= 1.0 + ROUNDING
        lower = linalg.cholesky(products, lower=True)
        total += 2.0 * float(np.log(np.diag(lower)[:-1]).sum()) + float(lower[-1, -1] ** 2)
        return 0.5 * total

    least, largest = np.log([NONE * size, 2.0 * size])
    alone = optimize.minimize_scalar(
        lambda scatter: minus_log_likelihood(np.array([-np.inf, np.log(step), scatter])),
        bounds=(least, largest), method="bounded", options={"xatol": CLOSE},
    )  # fmt: skip
    low = np.array([least, np.log(0.25 * step), least])
    longest = min(FOLLOWED * step, 0.5 * float(np.ptp(sources.images, axis=0).max()))
    high = np.array([largest + 1.0, np.log(longest), largest])
    best = optimize.minimize(
        minus_log_likelihood, np.log([0.7 * size, 1.5 * step, 0.7 * size]), method="Nelder-Mead",
        bounds=optimize.Bounds(low, high),
        options={"xatol": CLOSE, "fatol": CLOSE, "maxfev": EVALUATIONS},
    )  # fmt: skip
    if not 2.0 * (alone.fun - best.fun) > AKAIKE:
        return None
    return RandomField(*np.exp(best.x).tolist())


def shared_products(field: RandomField, sources: Placed, moves: Floats) -> Floats:
    """What the field adds to the covariance of numbers that displacements move.

    Parameters
    ----------
    field : RandomField
    sources : Placed
    moves : ndarray, shape (n, 2, k)
        Of k numbers by displacements along each axis.

    Returns
    -------
    ndarray, shape (k, k)
    """
    total = np.einsum("nak,nal->kl", moves, _through(field, sources, moves))
    return np.asarray(0.5 * (total + total.T))


class FieldLeft(NamedTuple):
    """What a fit leaves of the field's displacements.

    Attributes
    ----------
    field : RandomField
    sources : Placed
    covariance : ndarray, shape (d, d)
        Of the parameters with sources that are displaced independently.
    """

    field: RandomField
    sources: Placed
    covariance: Floats

    def __call__(self, pairs: Ints) -> Floats:
        """Covariance of the displacements of pairs of sources, (p, 2), along each axis, (2, p)."""
        s = self.sources
        row = np.zeros(int(s.number.max()) + 1, dtype=int)
        row[s.number] = np.arange(s.number.size)
        through = _through(self.field, s, s.pulls)
        taken = s.slopes @ self.covariance
        both = taken @ np.einsum("nak,nal->kl", s.pulls, through) - through
        out = np.empty((2, len(pairs)))
        for first in range(0, len(pairs), PAIRS):
            some = slice(first, first + PAIRS)
            one, two = row[pairs[some].T]
            left = self.field.covariance(np.hypot(*(s.images[one] - s.images[two]).T))
            moved = np.einsum("pak,pak->ap", both[one], taken[two])
            out[:, some] = left + moved - np.einsum("pak,pak->ap", taken[one], through[two])
        return out


def _through(field: RandomField, sources: Placed, moves: Floats) -> Floats:
    """What the field adds to the covariance of displacements, times moves, shape (n, 2, k)."""
    images = sources.images
    own = (field.sd**2 + field.scatter**2) * np.eye(2) - sources.scatter
    tree, out = spatial.cKDTree(images), own @ moves
    for first in range(0, len(images), ROWS):
        rows = slice(first, first + ROWS)
        some = spatial.cKDTree(images[rows])
        pairs = some.sparse_distance_matrix(tree, REACH * field.length, output_type="ndarray")
        pairs = pairs[pairs["i"] + first != pairs["j"]]
        where = (pairs["i"], pairs["j"])
        shared = sparse.csr_matrix((field.covariance(pairs["v"]), where), (some.n, tree.n))
        for axis in range(2):
            out[rows, axis] += shared @ moves[:, axis]
    return out


def _blocks(images: Floats, index: Ints) -> list[Ints]:
    """Neighbouring sources of at most `BLOCK`, halved across the longer side."""
    if index.size <= BLOCK:
        return [index]
    own = images[index]
    longer = int(np.argmax(np.ptp(own, axis=0)))
    order = index[np.argsort(own[:, longer], kind="stable")]
    half = index.size // 2
    return [*_blocks(images, order[:half]), *_blocks(images, order[half:])]


def _basis(columns: Floats) -> Floats:
    """An orthonormal basis of the columns' span."""
    size = np.sqrt(np.sum(columns**2, axis=0))
    columns = columns[:, size > 0.0] / size[size > 0.0]
    left, singular, _ = np.linalg.svd(columns, full_matrices=False)
    return np.asarray(left[:, singular > TOLD * singular.max(initial=0.0)])
