"""Fig. 6: both frames reconstructed, their residuals, V, and how many terms the logarithm needs.

V is the sum over pixels of squared residuals in units of a source's flux, for frames without noise
as in the paper. What is left of the logarithm with the paper's 12 terms has structure. More terms
are tried on a frame of Poisson counts (background 5): f = x times, g = y times every u^2a v^2b up
to a + b = K, which is the logarithm's own series with free coefficients. Leave-one-out says how
many are worth having.
"""

from pathlib import Path

import numpy as np

import bayesfred as bf

from .common import (
    PRINTED,
    Floats,
    Row,
    Section,
    bar,
    fit,
    least_squares,
    panels,
    paper_model,
    save,
    show,
    small,
    symmetric,
    truth,
)
from .frames import figure2

BACKGROUND = 5.0
ORDERS = (2, 3, 4, 5)


def series(order: int) -> bf.PolynomialDistortion:
    """Every x u^2a v^2b of f and y u^2a v^2b of g with 1 <= a + b <= order."""
    powers = [(2 * (n - b), 2 * b) for n in range(1, order + 1) for b in range(n + 1)]
    return bf.PolynomialDistortion([(1, 0, *p) for p in powers], [(0, 1, *p) for p in powers])


def structure(residual: Floats, sigma: Floats) -> float:
    """Largest mean residual of 10 x 10 pixels, in standard errors of such a mean."""
    z = residual / sigma
    n = z.shape[0] // 10 * 10
    blocks = z[:n, :n].reshape(n // 10, 10, n // 10, 10).mean(axis=(1, 3)) * 10.0
    return float(np.abs(blocks).max())


def logarithmic_counts() -> Floats:
    """The logarithmic frame as Poisson counts."""
    model = paper_model(bf.LogDistortion(PRINTED["figure2"]["logarithm"]))
    return bf.simulate(model, [], BACKGROUND, seed=6)


def make(quick: bool, folder: Path) -> Section:
    polynomial = figure2("polynomial")
    model = paper_model()
    theta, left, value = least_squares(model, polynomial, np.zeros(12))
    rows = [
        Row("polynomial: V", "no visible structure", small(value), value < 1e-20, "rounding"),
        Row(
            "polynomial: largest error of a coefficient, 1e-6",
            "0.00",
            small(float(np.abs(theta - truth("table2")).max() / 1e-6)),
            bool(np.abs(theta - truth("table2")).max() < 5e-9),
        ),
    ]
    if quick:
        return Section("Fig. 6: reconstructions", "", rows)
    logarithm = figure2("logarithm")
    counts = logarithmic_counts()
    fits = {"12 terms": fit(bf.Posterior(model, counts), quick, "log12", target_ess=400)}
    _, left_12, value_12 = least_squares(model, logarithm, fits["12 terms"].estimate.params[:12])
    names: dict[int, str] = {}
    for order in ORDERS:
        distortion = series(order)
        near = fits[names[order - 1]] if order > ORDERS[0] else None
        names[order] = f"{distortion.n_terms} terms (K = {order})"
        posterior = bf.Posterior(paper_model(distortion), counts)
        fits[names[order]] = fit(posterior, quick, f"log{order}", near, target_ess=400)
    compared = bf.compare({name: f.chain for name, f in fits.items() if f.chain})
    scores = {s.name: s for s in compared.scores}
    rows += [
        Row(
            "logarithm, 12 terms: V",
            "structure",
            f"{value_12:.2e}",
            True,
            "the paper prints no V for this frame",
        )
    ]
    residuals = {}
    for name, f in fits.items():
        assert f.chain
        posterior = f.chain.posterior()
        residuals[name] = (
            counts - posterior.expected_counts(f.estimate.params),
            posterior.sigma(f.estimate.params),
        )
        s = scores[name]
        behind = f"{s.difference:.0f} ± {s.difference_se:.0f}" if s.difference else "best"
        rows.append(
            Row(
                f"logarithm, Poisson counts, {name}: elpd behind the best",
                "",
                behind,
                None,
                f"largest mean residual of 10 x 10 pixels: {structure(*residuals[name]):.1f} "
                "standard errors",
            )
        )
    chosen = compared.chosen
    d = (
        paper_model(series(ORDERS[[names[k] for k in ORDERS].index(chosen)]))
        if chosen in names.values()
        else model
    )
    _, left_chosen, value_chosen = least_squares(
        d, logarithm, fits[chosen].estimate.params[: d.distortion.n_terms]
    )
    rows.append(
        Row(
            f"logarithm, {chosen}, which predictive accuracy chooses: V",
            "",
            f"{value_chosen:.2e}",
            None,
            "without noise",
        )
    )
    pictures = [
        _reconstructions(polynomial, left, logarithm, left_12, chosen, left_chosen, folder),
        _terms(residuals, folder),
    ]
    text = (
        "Frames without noise for V, in units of the source flux squared. The last rows add "
        "Poisson counts and ask how many terms "
        "the logarithm deserves: `bf.compare` of models with every x u^2a v^2b, y u^2a v^2b up to "
        "a + b = K. 10 x 10 pixels' mean "
        "residuals of 2500 blocks reach 3.6 standard errors by chance."
    )
    return Section("Fig. 6: reconstructions", text, rows, pictures)


def _reconstructions(
    polynomial: Floats,
    left: Floats,
    logarithm: Floats,
    left_12: Floats,
    chosen: str,
    left_chosen: Floats,
    folder: Path,
) -> str:
    figure, axes = panels(2, 3)
    for axis, image, title in (
        (axes[0, 0], polynomial - left, "Fig. 6a: polynomial, reconstructed"),
        (axes[1, 0], logarithm - left_12, "Fig. 6c: logarithm, reconstructed"),
    ):
        drawn = show(
            axis, image, title, vmin=0.0, vmax=float(max(polynomial.max(), logarithm.max()))
        )
        bar(drawn, axis, "counts per pixel")
    for axis, image, title in (
        (axes[0, 1], left, "Fig. 6b: residual, polynomial"),
        (axes[1, 1], left_12, "Fig. 6d: residual, 12 terms"),
        (axes[1, 2], left_chosen, f"residual, {chosen}"),
    ):
        scale = symmetric(image) if axis is axes[0, 1] else symmetric(left_12, left_chosen)
        drawn = show(axis, image, title, colours="RdBu_r", **scale)
        bar(drawn, axis, "counts per pixel")
    axes[0, 2].set_axis_off()
    return save(figure, "figure_6.png", folder)


def _terms(residuals: dict[str, tuple[Floats, Floats]], folder: Path) -> str:
    figure, axes = panels(1, len(residuals), 2.2)
    for axis, (name, (residual, sigma)) in zip(axes.flat, residuals.items(), strict=True):
        smooth = (residual / sigma)[:500, :500].reshape(100, 5, 100, 5).mean(axis=(1, 3)) * 5.0
        drawn = show(axis, smooth, name, step=5.0, colours="RdBu_r", vmin=-5.0, vmax=5.0)
    bar(drawn, axes, "residual / its sd, 5 x 5 pixels", extend="both")
    return save(figure, "figure_6_terms.png", folder)
