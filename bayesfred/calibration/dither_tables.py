"""Tables of dithered frames and their sources, and whether a posterior is normal.

A frame is judged by its deviance and Pearson's statistic, as `optimize.fit_statistics` does. What
frames share, coefficients and positions, is paid for by all of them in proportion to their sources.
A source is judged by the deviance of its pixels, and by how far its images scatter about their
places: squares of displacements in standard deviations, two numbers less than twice the images.

Is the posterior normal? If it is, a Newton step from any point ends at the maximum m: with the
exact gradient g and the covariance C, x + C g(x) = m. Draws x = m + z of the approximation come in
pairs with opposite z. The mean of r = x + C g(x) - m over draws estimates, by Stein's identity, how
far the posterior's mean is from m, and the mean of r z how much its variance differs; both in
standard deviations. What counts is the larger one plus twice its Monte Carlo error, of the
displacement at points of the field, of the pointings and turns, and of every position. This is
exact in the density, asks for no weights, which in hundreds of dimensions say nothing, and judges
every quantity by itself.

References
----------
C. Stein (1981), Annals of Statistics 9, 1135: E[z g] for a normal z.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy import stats

from bayesfred._typing import Floats, Ints
from bayesfred.analysis.sources import source_table
from bayesfred.io.summary_table import Table, make_table
from bayesfred.model.dither_layout import POINTING
from bayesfred.model.dithered import DitheredPosterior
from bayesfred.optimize.fit_statistics import fit_statistics, misfit

__all__ = ["NORMAL", "frame_table", "newton_misses", "source_summary"]

PAIRS = (8, 32)  # of draws: more where fewer do not show that the posterior is normal
NORMAL = 0.3  # standard deviations that it may differ by
POINTS = 6  # along each axis of the field
FALSE_ALARM = 0.003  # chance that any source fails if the model is true


def newton_misses(
    posterior: DitheredPosterior, params: Floats, covariance: Floats
) -> tuple[float, Floats]:
    """How far the posterior is from the normal distribution of the Laplace approximation.

    Parameters
    ----------
    posterior : DitheredPosterior
    params : ndarray, shape (d,)
        The maximum.
    covariance : ndarray, shape (d, d)

    Returns
    -------
    instrument : float
        The largest of the displacement over the field, pointings and turns; standard deviations.
    positions : ndarray, shape (n,)
        The larger one of every source's x and y.
    """
    layout, sd = posterior.layout, np.sqrt(np.diag(covariance))
    n = layout.n_sources
    if not np.isfinite(sd).all():
        return np.inf, np.full(n, np.inf)
    functions = _functions(posterior, params)
    spread = np.sqrt(np.einsum("kd,de,ke->k", functions, covariance, functions, optimize=True))
    kept = spread > 0.0  # of fixed coefficients there may be none
    functions, spread = functions[kept], spread[kept]
    root = np.linalg.cholesky(covariance / np.outer(sd, sd)) * sd[:, None]
    random = np.random.default_rng(0)
    moves: list[Floats] = []
    misses: list[Floats] = []
    for most in PAIRS:
        while len(misses) < 2 * most:
            z = root @ random.standard_normal(sd.size)
            for draw in (z, -z):
                miss = draw + covariance @ posterior.gradient(params + draw)
                moves.append(np.append(functions @ draw / spread, (draw / sd)[layout.n_dense :]))
                misses.append(np.append(functions @ miss / spread, (miss / sd)[layout.n_dense :]))
        z, r = np.array(moves), np.array(misses)
        of_mean = r.reshape(-1, 2, r.shape[1]).mean(axis=1)  # of pairs
        of_variance = (r * z).reshape(-1, 2, r.shape[1]).mean(axis=1)
        worst = np.zeros(r.shape[1])
        for each in (of_mean, of_variance):
            error = each.std(axis=0, ddof=1) / np.sqrt(len(each))
            worst = np.maximum(worst, np.abs(each.mean(axis=0)) + 2.0 * error)
        worst = np.where(np.isfinite(worst), worst, np.inf)
        instrument = float(worst[: len(functions)].max())
        if instrument < NORMAL:
            break
    return instrument, worst[len(functions) :].reshape(n, 2).max(axis=1)


def _functions(posterior: DitheredPosterior, params: Floats) -> Floats:
    """Displacements at points of the field, pointings and turns, linear in the parameters."""
    layout, model = posterior.layout, posterior.reference.model
    ny, nx = model.detector.fine_shape
    u, v = (c.ravel() for c in np.meshgrid(*(np.linspace(-0.5, 0.5, POINTS) * n for n in (nx, ny))))
    free, theta = layout.parts[0].theta, layout.theta(params)
    moves = model.polynomial.displacement_jacobian(theta, u, v)[..., free].reshape(-1, free.size)
    moves = moves[np.isfinite(moves).all(axis=1)]
    pointing = [k for part in layout.parts for k in part.pointing if k >= 0]
    out = np.zeros((len(moves) + len(pointing), len(layout.names)))
    out[: len(moves), : free.size] = moves
    out[len(moves) + np.arange(len(pointing)), pointing] = 1.0
    return out


def frame_table(posterior: DitheredPosterior, params: Floats, covariance: Floats) -> Table:
    """A row for each frame: where it points, and how well the model fits it.

    Parameters
    ----------
    posterior : DitheredPosterior
    params : ndarray, shape (d,)
        The maximum.
    covariance : ndarray, shape (d, d)

    Returns
    -------
    astropy.table.Table
        `SelfCalibration` has the columns.
    """
    layout, sd = posterior.layout, np.sqrt(np.diag(covariance))
    p, members = layout.parts[0].theta.size, [part.members.size for part in layout.parts]
    share = (p + 2 * layout.n_sources) / sum(members)
    rows: list[dict[str, Any]] = []
    for name, part in zip(posterior.frames, layout.parts, strict=True):
        frame, own = posterior.frame_posterior(name, params), layout.frame_params(name, params)
        fit = fit_statistics(frame, own)
        for each in ("deviance", "pearson"):  # the coefficients are counted there as its own
            fit[f"{each}_expected"] -= share * part.members.size - len(layout.coefficients)
        (x, y), turn = layout.pose(name, params)
        rows.append({"name": name})
        for column, value, k in zip(POINTING, (x, y, turn), part.pointing, strict=True):
            rows[-1] |= {column: float(value), f"{column}_sd": sd[k] if k >= 0 else np.nan}
        rows[-1] |= {
            "sources": part.members.size,
            "deviance_z": misfit(fit),
            "pearson_z": misfit(fit, "pearson"),
        }
    return make_table({key: [row[key] for row in rows] for key in rows[0]})


def source_summary(
    posterior: DitheredPosterior, params: Floats, covariance: Floats, misses: Floats
) -> Table:
    """A row for each source: its position and flux, and how well the model fits it.

    Parameters
    ----------
    posterior : DitheredPosterior
    params : ndarray, shape (d,)
        The maximum.
    covariance : ndarray, shape (d, d)
    misses : ndarray, shape (n,)
        Of `newton_misses`.

    Returns
    -------
    astropy.table.Table
        `SelfCalibration` has the columns.
    """
    layout = posterior.layout
    first, n = layout.n_dense, layout.n_sources
    sums, catalogue = np.zeros((6, n)), np.full(n, np.nan)
    for name, part in zip(posterior.frames, layout.parts, strict=True):
        frame = posterior.frame_posterior(name, params)
        table = source_table(frame, layout.frame_params(name, params))
        _add(sums, part.members, {c: np.array(table[c], np.float64) for c in table.colnames})
        catalogue[part.members] = frame.model.sources.flux
    weighted, weight, chi2, frames, square, number = sums
    with np.errstate(divide="ignore", invalid="ignore"):
        chi2_z = chi2 / np.sqrt(frames)
        dof = np.where(number > 2.0, number - 2.0, np.nan)  # its position follows its images
        spread = 2.0 / (9.0 * dof)
        place_z = ((square / dof) ** (1.0 / 3.0) - 1.0 + spread) / np.sqrt(spread)
        flux, flux_sd = weighted / weight, weight**-0.5
    limit = float(stats.norm.isf(FALSE_ALARM / (2 * n)))
    failed = np.asarray(np.fmax(chi2_z, place_z) > limit)
    at, errors = layout.positions(params), np.sqrt(np.diag(covariance))[first:].reshape(n, 2)
    each = first + 2 * np.arange(n)
    return make_table(
        {
            "id": np.arange(n),
            "x": at[:, 0],
            "y": at[:, 1],
            "x_sd": errors[:, 0],
            "y_sd": errors[:, 1],
            "correlation": covariance[each, each + 1] / errors.prod(axis=1),
            "flux": np.where(flux > 0.0, flux, catalogue),
            "flux_sd": np.where(weight > 0.0, flux_sd, np.nan),
            "frames": frames.astype(int),
            "chi2_z": chi2_z,
            "place_z": place_z,
            "not_normal": misses,
            "failed": failed,
        }
    )


def _add(sums: Floats, members: Ints, table: Mapping[str, Floats]) -> None:
    """Add a frame's table of sources to the sums of all frames.

    These are the flux with weights and the weights, the excess of the deviance and the frames that
    tell it, the squared displacements and their number.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        weight = (table["flux"] * table["flux_ratio_sd"]) ** -2.0
        z = np.stack([table[axis] / table[f"{axis}_sd"] for axis in ("du", "dv")])
    good = np.isfinite(weight) & np.isfinite(table["flux_ratio"])
    sums[0, members[good]] += (weight * table["flux"] * table["flux_ratio"])[good]
    sums[1, members[good]] += weight[good]
    good = np.isfinite(table["chi2_z"])
    sums[2, members[good]] += table["chi2_z"][good]
    sums[3, members[good]] += 1.0
    good = np.asarray(np.isfinite(z).all(axis=0))
    sums[4, members[good]] += (z[:, good] ** 2).sum(axis=0)
    sums[5, members[good]] += 2.0
