"""Peaks matched to the catalogue: from positions in a frame to coefficients, without local minima.

At a star's measured position (u, v) the equations of its image,

    u - x - offset_x + f(u, v, x, y) = 0,    v - y - offset_y + g(u, v, x, y) = 0,

are linear in the coefficients and in the pointing. So the peaks of a frame are matched to the
catalogue and turned into coefficients by linear least squares. The matching goes outward: the
distortion vanishes on the axis, and every fit predicts where the next stars are imaged and how
surely. A star is matched when one peak alone lies where it may be. The prior keeps the fit from
running away; weights that fall with the residual keep wrong matches from bending it.
"""

from functools import lru_cache
from typing import Any

import numpy as np
from scipy import spatial

from bayesfred._typing import Flags, Floats, Ints
from bayesfred.imaging.forward import ForwardModel
from bayesfred.imaging.kernels.geometry import image_positions
from bayesfred.model.pixels import OVERLAP
from bayesfred.model.posterior import Posterior

CENTROID = 0.2  # error of a peak's position that is taken for granted, in PSF widths
GATE = 4.0  # a star is looked for within this many standard deviations of its predicted position
FOREIGN = 0.5  # ... as long as no more peaks of others than this are to be expected there
WIDENINGS = 2  # times that the last limit is raised where the matching comes to a halt
ROUNDS = 40
CROWDED = 0.3  # a star is matched if its neighbours displace its peak by less, in PSF widths
MOST_POINTINGS = 9
FEWEST = 6  # stars that vote for a pointing, and of the innermost disk


def _alone(model: ForwardModel) -> Flags:
    """Which sources' peaks their neighbours leave where they are.

    In the filtered frame an image at distance d is (1 - q) exp(-q) of its peak, with
    q = d^2 / 4 sigma^2. To first order neighbours with r times a source's flux at the vectors d
    displace its peak by the sum of r d (1 - q/2) exp(-q).
    """
    s = model.sources
    position = np.stack([s.x, s.y], axis=1)
    far = OVERLAP * model.psf.sigma  # exp(-36) is nothing
    pairs = spatial.cKDTree(position).query_pairs(far, output_type="ndarray")
    source, other = np.concatenate([pairs, pairs[:, ::-1]]).T
    d = position[other] - position[source]
    q = (d**2).sum(axis=1) / (4.0 * model.psf.sigma**2)
    least = 1e-9 * s.flux[other]  # or the ratio overflows where a flux is next to nothing
    r = s.flux[other] / np.maximum(s.flux[source], least)
    each = d.T * (1.0 - 0.5 * q) * np.exp(-q) * r
    shift = [np.bincount(source, along, len(s)) for along in each]
    return np.asarray(np.hypot(*shift) < CROWDED * model.psf.sigma)


@lru_cache(maxsize=4096)
def _central(prior: Any) -> tuple[float, float, float]:
    """The median of a distribution between the ends of its central 68 %."""
    low, median, high = prior.ppf([0.16, 0.5, 0.84])
    return float(low), float(median), float(high)


class Field:
    """The catalogue's images under a distortion, and the equations that images give for it.

    z holds the coefficients, then the pointing if it is free: the parameters `columns` of the
    posterior. `centre` and `scale` are their priors' medians and half the widths of their central
    68 %, times `looseness`.
    """

    def __init__(self, posterior: Posterior, looseness: float = 1.0) -> None:
        self.posterior = posterior
        self.optics = posterior.model.optics()
        names, n = posterior.parameter_names, posterior.model.distortion.n_terms
        self.columns = np.array(
            [*range(n), *(names.index(name) for name in ("offset_x", "offset_y") if name in names)]
        )
        marginals = [posterior.prior[names[k]] for k in self.columns]
        low, self.centre, high = np.array([_central(prior) for prior in marginals]).T
        self.scale = 0.5 * looseness * (high - low)
        self.everyone = np.arange(len(posterior.model.sources))
        self.alone = _alone(posterior.model)

    def predict(self, z: Floats) -> Floats:
        """Where the sources are imaged, shape (n, 2); without an image, their own position."""
        d = self.posterior.model.polynomial
        offset = z[d.n_terms :] if z.size > d.n_terms else np.zeros(2)
        theta = d.monomial_coefficients(z[: d.n_terms].copy())
        sigma = self.posterior.model.psf.sigma
        return np.asarray(image_positions(self.optics, theta, *offset, sigma))

    def design(self, sources: Ints, position: Floats) -> Floats:
        """Matrix (2, n, k) of the equations for sources imaged at these positions."""
        d, o = self.posterior.model.polynomial, self.optics
        matrix = np.zeros((2, len(sources), self.columns.size))
        matrix[:, :, : d.n_terms] = d.design_matrix(
            position[:, 0], position[:, 1], o.x[sources], o.y[sources]
        )
        if self.columns.size > d.n_terms:
            matrix[0, :, -2] = matrix[1, :, -1] = -1.0
        return matrix

    def spread(self, sources: Ints, position: Floats, covariance: Floats) -> Floats:
        """Standard deviation of predicted positions along the worse axis."""
        matrix = self.design(sources, position)
        variance = np.sum((matrix @ covariance) * matrix, axis=2)
        return np.asarray(np.sqrt(variance.max(axis=0)))

    def fit(self, sources: Ints, position: Floats, error: float) -> tuple[Floats, Floats]:
        """Least squares under the prior with Cauchy's weights: z and its covariance.

        The centroids have this error or a larger one.
        """
        matrix = self.design(sources, position)
        right = (
            np.stack([self.optics.x[sources], self.optics.y[sources]])
            - position.T
            - matrix @ self.centre
        )
        matrix, right = matrix.reshape(-1, self.scale.size) * self.scale, right.ravel()
        weight = np.ones(right.size)
        scale = error
        for _ in range(6):
            inverse = np.linalg.inv(
                (matrix.T * weight) @ matrix / scale**2 + np.eye(self.scale.size)
            )
            z = inverse @ (matrix.T @ (weight * right)) / scale**2
            # studentised: a fit follows a star that alone determines it, right or wrong
            own = np.sum((matrix @ inverse) * matrix, axis=1)
            leverage = np.minimum(weight * own / scale**2, 0.99)
            residual = np.hypot(*((right - matrix @ z) / np.sqrt(1.0 - leverage)).reshape(2, -1))
            # 1.18 is the median of a two-dimensional normal's distance
            scale = max(error, float(np.median(residual)) / 1.18)
            weight = np.tile(1.0 / (1.0 + (residual / (3.0 * scale)) ** 2), 2)
        return self.centre + self.scale * z, inverse * np.outer(self.scale, self.scale)


def match(field: Field, peaks: Floats) -> tuple[Floats, Floats, int]:
    """Match peaks to the catalogue outward: z, its covariance and the number of matches."""
    found = [_match(field, peaks, *guess) for guess in _pointings(field, peaks)]
    return max(found, key=lambda result: result[2])


def _pointings(field: Field, peaks: Floats) -> list[tuple[Floats, Floats]]:
    """Where the matching may begin: z and its covariance.

    That is the prior; for an unknown pointing, what most pairs agree on. Every peak votes, with
    every star that the distortion leaves within the PSF's width, for the pointing that puts the
    star there. On a grid of stars several pointings get equally many votes: the `MOST_POINTINGS`
    best are tried.
    """
    z, covariance = field.centre, np.diag(field.scale**2)
    n, sigma = field.posterior.model.distortion.n_terms, field.posterior.model.psf.sigma
    if z.size == n or not len(peaks):
        return [(z, covariance)]
    free = covariance.copy()
    free[n:, n:] = 0.0
    positions = field.predict(z)
    order = np.argsort(field.spread(field.everyone, positions, free))
    calm = order[: max(FEWEST, int(np.sum(field.spread(field.everyone, positions, free) < sigma)))]
    votes = (peaks - positions[calm][:, None]).reshape(-1, 2)
    distance = np.hypot(*(votes / field.scale[n:]).T)
    votes, distance = votes[distance < GATE], distance[distance < GATE]
    guesses: list[tuple[Floats, Floats]] = []
    covariance[n:, n:] = np.eye(2) * sigma**2
    while len(votes) and len(guesses) < MOST_POINTINGS:
        number = spatial.cKDTree(votes).query_ball_point(votes, sigma, return_length=True)
        best = votes[np.argmax(number - 0.5 * distance**2)]
        near = np.hypot(*(votes - best).T) < sigma
        guesses.append((np.append(z[:n], z[n:] + votes[near].mean(axis=0)), covariance))
        far = np.hypot(*(votes - best).T) > 3.0 * sigma
        votes, distance = votes[far], distance[far]
    return guesses or [(z, np.diag(field.scale**2))]


def _match(
    field: Field, peaks: Floats, z: Floats, covariance: Floats
) -> tuple[Floats, Floats, int]:
    """The matching from one guess of the pointing."""
    if len(peaks) < 2:
        return z, covariance, 0
    error = CENTROID * field.posterior.model.psf.sigma
    tree = spatial.cKDTree(peaks)
    widest = np.sqrt(FOREIGN * np.prod(np.ptp(peaks, axis=0)) / (np.pi * len(peaks)))
    pairs: frozenset[tuple[int, int]] = frozenset()
    seen, widened = set(), 0
    for _ in range(ROUNDS):
        predicted = field.predict(z)
        gate = GATE * np.hypot(field.spread(field.everyone, predicted, covariance), error)
        distance, nearest = tree.query(predicted, k=2)
        sure = field.alone & (gate < widest) & (distance[:, 0] < gate) & (distance[:, 1] > gate)
        # a peak that two sources claim belongs to neither
        claims = np.bincount(nearest[sure, 0], minlength=len(peaks))
        sources = field.everyone[sure]
        sources = sources[claims[nearest[sources, 0]] == 1]
        pairs = frozenset(zip(sources.tolist(), nearest[sources, 0].tolist(), strict=True))
        if pairs and pairs not in seen:
            seen.add(pairs)
            z, covariance = field.fit(sources, peaks[nearest[sources, 0]], error)
        elif widened < WIDENINGS:
            widest, widened = 1.2 * widest, widened + 1
        else:
            break
    return z, covariance, len(pairs)


def lost(field: Field, peaks: Floats, z: Floats) -> float:
    """The share of the stars in the frame that stand alone and have no peak where predicted."""
    predicted = field.predict(z)
    half = 0.5 * np.array(field.posterior.model.detector.fine_shape[::-1])
    seen = field.alone & np.all(np.abs(predicted) < half, axis=1)
    if not seen.any() or not len(peaks):
        return 1.0
    distance, _ = spatial.cKDTree(peaks).query(predicted[seen])
    return float(np.mean(distance > GATE * CENTROID * field.posterior.model.psf.sigma))
