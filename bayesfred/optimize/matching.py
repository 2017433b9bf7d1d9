"""Where the search for the maximum begins: from counts alone to parameters inside its basin.

At a star's measured position (u, v) the equations of its image,

    u - x - offset_x + f(u, v, x, y) = 0,    v - y - offset_y + g(u, v, x, y) = 0,

are linear in the coefficients and in the pointing. So peaks are looked for in the frame, matched to
the catalogue and turned into coefficients by linear least squares, which has no local minima. The
matching goes outward: the distortion vanishes on the axis, and every fit foretells where the next
stars are imaged and how surely. A star is matched when one peak alone lies where it may be. The
prior keeps the fit from running away; weights that fall with the residual keep wrong matches from
bending it.

Where stars overlap or are too faint to be matched one by one, the likelihood does the same: it is
climbed on a disk around the axis that grows as far as the last climb foretells stars within the
PSF's width, and with a wider PSF, on a blurred frame, where even the innermost are foretold less
surely. From every disk only the places of its stars are taken over, under the prior. Climbs on the
way leave out what frame and catalogue do not have in common, see `clipping.py`.
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy import linalg, ndimage, spatial

from bayesfred._typing import Flags, Floats, Ints
from bayesfred.imaging.catalog import SourceCatalog
from bayesfred.imaging.forward import ForwardModel
from bayesfred.imaging.kernels.geometry import image_positions
from bayesfred.imaging.psf import GaussianPSF
from bayesfred.model.posterior import Posterior
from bayesfred.optimize.newton import maximize
from bayesfred.optimize.outliers import COARSE, STEPS, clip, vertex

SIGNIFICANCE = 4.0  # of a peak, in standard deviations of the filtered frame
CENTROID = 0.2  # error of a peak's position that is taken for granted, in PSF widths
GATE = 4.0  # a star is looked for within so many standard deviations of its predicted place
FOREIGN = 0.5  # ... as long as no more peaks of others than this are to be expected there
WIDENINGS = 2  # times that the last limit is raised where the matching comes to a halt
ROUNDS = 40
CROWDED = 0.3  # a star is matched if its neighbours displace its peak by less, in PSF widths
# a match is not trusted if more of the stars that stand alone have no peak where they are predicted
LOST = 0.3
LOST_AT_MOST = 0.45  # ... nor a climb from it
REACH = 0.7  # the likelihood finds a star that is predicted to so many PSF widths
FEWEST = 6  # stars of the innermost disk
PLAIN, DISK = "the prior's medians", "a growing disk"


class Start(NamedTuple):
    """Where to begin.

    Attributes
    ----------
    params : ndarray, shape (d,)
    path : str
        How they were found.
    matched : int
        Sources that were matched to a peak.
    """

    params: Floats
    path: str
    matched: int


def find_start(posterior: Posterior) -> Start:
    """Parameters from which a climb finds the maximum; they have density wherever the prior's medians do.

    Parameters
    ----------
    posterior : Posterior

    Returns
    -------
    Start

    Examples
    --------
    >>> import bayesfred as bf
    >>> model = bf.ForwardModel(
    ...     bf.Detector((165, 165)), bf.SourceCatalog.grid(7, 20.0, 1e4), bf.GaussianPSF(2.0),
    ...     bf.PolynomialDistortion(f_terms=[(1, 0, 2, 0)], g_terms=[]))
    >>> start = find_start(bf.Posterior(model, bf.simulate(model, [1e-4], 2.0, seed=1)))
    >>> start.path, start.matched, start.params.round(5)
    ('matched peaks', 49, array([1.e-04, 2.e+00]))
    """
    peaks = find_peaks(posterior)
    matches = []
    for looseness in (1.0, 4.0):  # the second for distortions that the prior holds for unlikely
        field = Field(posterior, looseness)
        z, covariance, matched = match(field, peaks)
        vague = (
            field.spread(field.everyone, field.predict(z), covariance).max()
            > REACH * posterior.model.psf.sigma
        )
        trusted = not vague and _lost(field, peaks, z) < LOST
        matches.append((trusted, matched, z))
        if trusted:
            break
    trusted, matched, z = max(matches, key=lambda each: each[:2])
    field, plain = Field(posterior), _plain(posterior)
    params = plain.copy()
    params[field.columns] = z
    params = _unfolded(posterior, np.clip(params, *posterior.support), plain)
    if not np.isfinite(posterior.log_prob(params)):
        return Start(plain, PLAIN, matched)
    if trusted:
        return Start(params, "matched peaks", matched)
    if _lost(field, peaks, z) < LOST_AT_MOST:
        params = maximize(clip(posterior, params, COARSE).posterior, params, steps=STEPS).params
        params = _unfolded(posterior, params, plain)
        if _lost(field, peaks, params[field.columns]) < LOST_AT_MOST:
            return Start(params, "matched peaks and a first climb", matched)
    grown = _unfolded(posterior, outward(field, plain), plain)
    if posterior.log_prob(grown) > posterior.log_prob(params):
        return Start(grown, DISK, matched)
    return Start(params, "matched peaks", matched)


def other_starts(posterior: Posterior, tried: Start) -> Iterator[Start]:
    """Where to begin anew after a start from which no maximum was found, as at the edge of folding."""
    plain = _plain(posterior)
    if tried.path != PLAIN:
        yield Start(plain, PLAIN, 0)
    if tried.path != DISK:
        yield Start(_unfolded(posterior, outward(Field(posterior), plain), plain), DISK, 0)


def _plain(posterior: Posterior) -> Floats:
    """No distortion, or the least that the priors admit."""
    field, plain = Field(posterior), posterior.start()
    plain[field.columns] = field.centre
    return np.clip(plain, *posterior.support)


def _unfolded(posterior: Posterior, params: Floats, plain: Floats) -> Floats:
    """Parameters with density: a map that folds is drawn back towards none."""
    for _ in range(60):
        if np.isfinite(posterior.log_prob(params)):
            return params
        params = plain + 0.9 * (params - plain)
    return plain


# --- peaks ----------------------------------------------------------------------------------------


def find_peaks(posterior: Posterior) -> Floats:
    """Positions of spots as wide as the PSF, whatever smooth background they stand on; strongest first, at most 3 a source.

    The frame, binned to what the PSF resolves, is filtered with minus the Laplacian of the PSF.
    Where there are B counts a pixel, the filtered frame's variance is B / 2 pi s^6, s being the
    PSF's width.

    Returns
    -------
    ndarray, shape (n, 2), fine pixel
        u, v.
    """
    detector = posterior.model.detector
    step = detector.binning
    width = np.hypot(posterior.model.psf.sigma / step, 12.0**-0.5)
    block = max(1, min(int(width / 1.5), min(detector.shape) // 3))
    s = max(np.sqrt(width**2 + (block**2 - 1) / 12.0) / block, 1.0)
    ny, nx = (n // block for n in detector.shape)

    def binned(frame: Floats) -> Floats:
        return np.asarray(
            frame[: ny * block, : nx * block].reshape(ny, block, nx, block).sum(axis=(1, 3))
        )

    used = binned(posterior.mask.astype(np.float64))
    total = binned(np.where(posterior.mask, posterior.counts, 0.0))
    level = np.median(total[used > 0] / used[used > 0]) if used.any() else 0.0
    image = total + level * (block**2 - used)
    variance = ndimage.gaussian_filter(
        np.maximum(image + posterior.noise.shift * block**2, 0.0), s
    ) / (2.0 * np.pi * s**6)
    filtered = -ndimage.gaussian_laplace(image, s)
    peak = (filtered == ndimage.maximum_filter(filtered, 3)) & (
        filtered > SIGNIFICANCE * np.sqrt(variance)
    )
    peak &= used > 0.5 * block**2
    peak[[0, -1]] = peak[:, [0, -1]] = False
    j, i = np.nonzero(peak)
    order = np.argsort(-filtered[j, i])[: 3 * len(posterior.model.sources)]
    places = block * (vertex(filtered, j, i)[order] + 0.5) - 0.5 * np.array(detector.shape)
    return np.asarray(
        places[:, ::-1] * step
    )  # from a block's index to the frame's middle, in fine pixels


def _alone(model: ForwardModel) -> Flags:
    """Which sources' peaks their neighbours leave where they are.

    In the filtered frame a spot at distance d is (1 - q) exp(-q) of its peak, q = d^2 / 4 sigma^2.
    To first order neighbours with r times a source's flux at the vectors d displace its peak by the
    sum of r d (1 - q/2) exp(-q).
    """
    s = model.sources
    place = np.stack([s.x, s.y], axis=1)
    pairs = spatial.cKDTree(place).query_pairs(
        12.0 * model.psf.sigma, output_type="ndarray"
    )  # exp(-36) is nothing
    source, other = np.concatenate([pairs, pairs[:, ::-1]]).T
    d = place[other] - place[source]
    q = (d**2).sum(axis=1) / (4.0 * model.psf.sigma**2)
    r = s.flux[other] / np.maximum(
        s.flux[source], 1e-9 * s.flux[other]
    )  # or it overflows, of a flux of next to nothing
    each = d.T * (1.0 - 0.5 * q) * np.exp(-q) * r
    shift = [np.bincount(source, along, len(s)) for along in each]
    return np.asarray(np.hypot(*shift) < CROWDED * model.psf.sigma)


# --- matching -------------------------------------------------------------------------------------


class Field:
    """The catalogue's images under a distortion, and the equations that measured images give for it.

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
        low, self.centre, high = (
            np.array([p.ppf(q) for p in marginals]) for q in (0.16, 0.5, 0.84)
        )
        self.scale = 0.5 * looseness * (high - low)
        self.everyone = np.arange(len(posterior.model.sources))
        self.alone = _alone(posterior.model)

    def predict(self, z: Floats) -> Floats:
        """Where the sources are imaged, shape (n, 2); a source without an image stays at its place."""
        n = self.posterior.model.distortion.n_terms
        offset = z[n:] if z.size > n else np.zeros(2)
        return np.asarray(
            image_positions(
                self.optics, z[:n].copy(), offset[0], offset[1], self.posterior.model.psf.sigma
            )
        )

    def design(self, sources: Ints, position: Floats) -> Floats:
        """Matrix (2, n, k) of the equations for sources imaged at these positions."""
        d, o = self.posterior.model.distortion, self.optics
        u, v = position.T[:, :, None]
        matrix = np.zeros((2, len(sources), self.columns.size))
        matrix[0, :, : len(d.f_terms)] = (
            o.f_object_powers[sources] * u ** o.f_powers[:, 0] * v ** o.f_powers[:, 1]
        )
        matrix[1, :, len(d.f_terms) : d.n_terms] = (
            o.g_object_powers[sources] * u ** o.g_powers[:, 0] * v ** o.g_powers[:, 1]
        )
        if self.columns.size > d.n_terms:
            matrix[0, :, -2] = matrix[1, :, -1] = -1.0
        return matrix

    def spread(self, sources: Ints, position: Floats, covariance: Floats) -> Floats:
        """Standard deviation of predicted positions along the worse axis."""
        matrix = self.design(sources, position)
        return np.asarray(
            np.sqrt(
                np.einsum("ank,kl,anl->an", matrix, covariance, matrix, optimize=True).max(axis=0)
            )
        )

    def fit(self, sources: Ints, position: Floats, error: float) -> tuple[Floats, Floats]:
        """Least squares under the prior with Cauchy's weights: z and its covariance, for centroids with this error or a larger."""
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
            inverse = linalg.inv((matrix.T * weight) @ matrix / scale**2 + np.eye(self.scale.size))
            z = inverse @ (matrix.T @ (weight * right)) / scale**2
            # studentised: a fit follows a star that alone determines it, right or wrong
            leverage = np.minimum(
                weight
                * np.einsum("ik,kl,il->i", matrix, inverse, matrix, optimize=True)
                / scale**2,
                0.99,
            )
            residual = np.hypot(*((right - matrix @ z) / np.sqrt(1.0 - leverage)).reshape(2, -1))
            scale = max(
                error, float(np.median(residual)) / 1.18
            )  # the median of a two-dimensional normal's distance
            weight = np.tile(1.0 / (1.0 + (residual / (3.0 * scale)) ** 2), 2)
        return self.centre + self.scale * z, inverse * np.outer(self.scale, self.scale)


def match(field: Field, peaks: Floats) -> tuple[Floats, Floats, int]:
    """Coefficients and pointing from peaks matched to the catalogue outward: z, its covariance, the number of matches."""
    found = [_match(field, peaks, *guess) for guess in _pointings(field, peaks)]
    return max(found, key=lambda result: result[2])


def _pointings(field: Field, peaks: Floats) -> list[tuple[Floats, Floats]]:
    """Where the matching may begin, z and its covariance: the prior; of an unknown pointing, what most pairs agree on.

    Every peak votes, with every star that the distortion leaves within the PSF's width, for the
    pointing that puts the star there. On a grid of stars several pointings get as many votes: the
    nine best are tried.
    """
    z, covariance = field.centre, np.diag(field.scale**2)
    n, sigma = field.posterior.model.distortion.n_terms, field.posterior.model.psf.sigma
    if z.size == n or not len(peaks):
        return [(z, covariance)]
    free = covariance.copy()
    free[n:, n:] = 0.0
    places = field.predict(z)
    order = np.argsort(field.spread(field.everyone, places, free))
    calm = order[: max(FEWEST, int(np.sum(field.spread(field.everyone, places, free) < sigma)))]
    votes = (peaks - places[calm][:, None]).reshape(-1, 2)
    distance = np.hypot(*(votes / field.scale[n:]).T)
    votes, distance = votes[distance < GATE], distance[distance < GATE]
    guesses: list[tuple[Floats, Floats]] = []
    covariance[n:, n:] = np.eye(2) * sigma**2
    while len(votes) and len(guesses) < 9:
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
        claims = np.bincount(
            nearest[sure, 0], minlength=len(peaks)
        )  # a peak that two sources claim belongs to neither
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


def _lost(field: Field, peaks: Floats, z: Floats) -> float:
    """The share of the stars in the frame that should be seen by themselves, but have no peak where they are predicted."""
    predicted = field.predict(z)
    half = 0.5 * np.array(field.posterior.model.detector.fine_shape[::-1])
    seen = field.alone & np.all(np.abs(predicted) < half, axis=1)
    if not seen.any() or not len(peaks):
        return 1.0
    distance, _ = spatial.cKDTree(peaks).query(predicted[seen])
    return float(np.mean(distance > GATE * CENTROID * field.posterior.model.psf.sigma))


# --- the likelihood on a growing disk -------------------------------------------------------------


def outward(field: Field, params: Floats) -> Floats:
    """Parameters climbed to on disks around the axis, each as far as the one before foretells stars within the PSF's width."""
    posterior, params = field.posterior, params.copy()
    sigma = posterior.model.psf.sigma
    pixels = np.hypot(*np.meshgrid(*posterior.model.detector.pixel_centres()))
    covariance, radius, width = np.diag(field.scale**2), 0.0, np.inf
    while radius < pixels.max() or width > sigma:
        predicted = field.predict(params[field.columns])
        spread = field.spread(field.everyone, predicted, covariance)
        distance = np.hypot(*predicted.T)
        innermost = np.sort(distance)[: min(FEWEST, distance.size)].max() + 2.0 * sigma
        radius = max(distance[spread > REACH * sigma].min(initial=np.inf), 1.15 * radius, innermost)
        inside = distance < radius
        width = max(sigma, min(spread[inside].max() / REACH, 0.7 * width))
        disk = posterior.mask & (pixels < radius)
        if not disk.any():
            continue
        part = _part(posterior, distance < radius + 4.0 * width, disk, width)
        shared = [
            k for k, name in enumerate(posterior.parameter_names) if name in part.parameter_names
        ]
        index = [part.parameter_names.index(posterior.parameter_names[k]) for k in shared]
        begin, background = part.start(), part.parameter_names.index("background")
        begin[index] = np.clip(params, *posterior.support)[shared]
        begin[background] = part.start()[background]
        begin = _unfolded(part, begin, part.start())
        if not np.isfinite(part.log_prob(begin)):
            break
        top = maximize(clip(part, begin, COARSE).posterior, begin, steps=STEPS)
        if not np.isfinite(top.distance):
            break
        params[shared], columns = top.params[index], [index[shared.index(k)] for k in field.columns]
        # photons measure bright stars better than the model is right: no star counts for more than
        # a centroid
        sources, places = field.everyone[inside], field.predict(params[field.columns])[inside]
        params[field.columns], error = field.fit(sources, places, CENTROID * width)
        covariance = top.covariance[np.ix_(columns, columns)] + error
    return params


def _part(posterior: Posterior, sources: Flags, pixels: Flags, width: float) -> Posterior:
    """The posterior of some of the sources in some of the pixels, the frame blurred to a PSF width."""
    model, s = posterior.model, posterior.model.sources
    blur = np.sqrt(width**2 - model.psf.sigma**2) / model.detector.binning
    few = SourceCatalog(s.x[sources], s.y[sources], s.flux[sources])
    flux = posterior.nuisances.flux
    return Posterior(
        replace(model, sources=few, psf=GaussianPSF(width) if blur > 0 else model.psf),
        ndimage.gaussian_filter(posterior.counts, blur) if blur > 0 else posterior.counts,
        prior={
            name: prior for name, prior in posterior.prior.items() if name != "position_scatter"
        },
        noise=posterior.noise,
        mask=pixels,
        nuisances=replace(
            posterior.nuisances,
            flux="scale" if flux == "free" else flux,
            footprint=None,
            position_scatter=False,
        ),
    )
