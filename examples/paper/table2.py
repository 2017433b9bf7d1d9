"""Fig. 7 and Table 2: the polynomial frame with a background of 0, 5, 10 and 50 counts a pixel.

Two kinds of noise: the paper's, where the sources' image is exact and the background alone is
Poisson, and full Poisson counts. How the columns are to be read is judged by the chi-square of the
printed errors against the Cramer-Rao covariance of the paper's noise (the background taken as
known, as in the paper's V; each printed number rounded to 0.01, which adds a variance of 0.01^2 /
12): a fit at the bound has 12 on average.
"""

from pathlib import Path

import numpy as np
from scipy import stats

import bayesfred as bf

from .common import (
    ALTERNATIVE,
    AS_PRINTED,
    COLUMNS,
    DISTORTION,
    PRINTED,
    Floats,
    Row,
    Section,
    background_bound,
    bar,
    fit,
    least_squares,
    listed,
    measured,
    panels,
    paper_model,
    read_as,
    same,
    save,
    show,
    small,
    truth,
)

T = PRINTED["table2"]
NOISY = [row for row in T["row"] if row["background"]]
ROUNDING = 0.01 * T["unit"]
READINGS = {
    "as printed: ux, vx, u²x, v²x, ux², vx², g in x": (AS_PRINTED, "x"),
    "the same, g in y": (AS_PRINTED, "y"),
    "u²x, v²x, ux, vx, ux², vx², g in x": (ALTERNATIVE, "x"),
    "u²x, v²x, ux, vx, ux², vx², g in y": (ALTERNATIVE, "y"),
    "ux², vx², ux, vx, u²x, v²x, g in x": (COLUMNS, "x"),
    "ux², vx², ux, vx, u²x, v²x, g in y: taken here": (COLUMNS, "y"),
}


def chi_square_of_printed_errors(columns: tuple[str, ...], g_in: str) -> list[float]:
    """Chi-square (12 degrees of freedom) of the printed errors at each background."""
    theta = truth("table2")
    bound = background_bound(paper_model(read_as(columns, g_in)), theta, 1.0)
    rounded = np.eye(theta.size) * ROUNDING**2 / 12.0
    found = []
    for row in NOISY:
        error = np.array(row["theta"]) * T["unit"] - theta
        found.append(float(error @ np.linalg.solve(bound * row["background"] + rounded, error)))
    return found


def frame(background: float, noise: bf.BackgroundNoise | bf.PoissonNoise) -> Floats:
    return bf.simulate(
        paper_model(), truth("table2"), background, seed=int(background), noise=noise
    )


def rows_of(row: dict[str, float], kind: str, quick: bool, scales: dict[str, Floats]) -> list[Row]:
    """One row of Table 2, for one kind of noise."""
    noise = bf.BackgroundNoise() if kind == "paper's noise" else bf.PoissonNoise()
    background, theta = row["background"], truth("table2")
    counts = frame(background, noise)
    posterior = bf.Posterior(paper_model(), counts, noise=noise)
    found = fit(posterior, quick, f"table2-{background}-{kind[:5]}")
    bound = np.sqrt(np.diag(background_bound(paper_model(), theta, background)))
    sd, value = found.sd, found.estimate.params
    rows = []
    for k, (name, printed) in enumerate(zip(DISTORTION.names, row["theta"], strict=True)):
        unit, agrees, why = T["unit"], None, ""
        if kind == "paper's noise":
            agrees = same(printed * unit, value[k], sd[k], 0.5 * ROUNDING)
            off = (printed * unit - theta[k]) / bound[k]
            why = (
                f"printed - truth {off:+.1f} bounds"
                if bound[k] > 0.5 * ROUNDING
                else "the bound is below the printed digits"
            )
        digits = f"{printed:.2f}" if kind == "paper's noise" else ""
        rows.append(
            Row(
                f"λ = {background}, {kind}: {name}, 1e-6",
                digits,
                measured(value[k] / unit, sd[k] / unit),
                agrees,
                why,
            )
        )
    level = float(np.mean(counts - (posterior.expected_counts(value) - value[-1])))
    residual = counts - (posterior.expected_counts(value) - value[-1]) - level
    chi2 = float(np.mean(residual**2) / level)
    n = counts.size
    error = np.sqrt(background / n)
    # of the mean of (n - l)^2 / l, where l is the frame's own mean: variance (2 + 1/l - 1/l) / N
    spread = np.sqrt(2.0 / n)
    if kind == "paper's noise":
        z = (row["chi2"] - 1.0) / spread
        rows += [
            Row(
                f"λ = {background}, {kind}: λ estimate",
                f"{row['background_estimate']:.4f}",
                measured(level, error),
                same(row["background_estimate"], level, error),
            ),
            Row(
                f"λ = {background}, {kind}: χ²",
                f"{row['chi2']:.4f}",
                measured(chi2, spread),
                same(row["chi2"], chi2, spread),
                f"printed - 1 is {z:+.1f} of its standard errors",
            ),
        ]
        ratio = found.sd[:12] / bound
        rows.append(
            Row(
                f"λ = {background}, {kind}: posterior sd / Cramér-Rao bound",
                "",
                f"{ratio.min():.2f} to {ratio.max():.2f}",
                None,
                "12 coefficients; above 1 where the background, which is fitted too, costs; the "
                "paper gives no error bars",
            )
        )
    else:
        expected = 1.0 + PRINTED["object"]["flux"] * 81 * kept() / (n * background)
        rows.append(
            Row(
                f"λ = {background}, {kind}: χ² as the paper defines it",
                f"{row['chi2']:.4f}",
                f"{chi2:.2f}",
                False,
                f"{expected:.2f} expected: it leaves the sources' own noise out; the paper's "
                "frames had none",
            )
        )
    scales[f"{background} {kind}"] = sd
    return rows


def kept() -> float:
    """Sources' flux that reaches the frame of Fig. 2b, over the flux emitted."""
    model = paper_model()
    return float(model.expected_counts(truth("table2")).sum() / model.sources.flux.sum())


def make(quick: bool, folder: Path) -> Section:
    readings = {name: chi_square_of_printed_errors(*reading) for name, reading in READINGS.items()}
    wide = ["| reading of the columns | λ = 5 | λ = 10 | λ = 50 |", "|---|---|---|---|"]
    wide += [
        f"| {name} | " + " | ".join(f"{c:.1f}" for c in chi2) + " |"
        for name, chi2 in readings.items()
    ]
    theta, _, value = least_squares(
        paper_model(), paper_model().expected_counts(truth("table2")), np.zeros(12)
    )
    worst = float(np.abs(theta - truth("table2")).max() / T["unit"])
    exact = Row(
        "λ = 0: the 12 coefficients, 1e-6",
        listed(T["row"][0]["theta"], 2),
        listed(theta / T["unit"], 2),
        worst < 0.005,
    )
    rows = [
        exact,
        Row("λ = 0: V", "", small(value), None, f"largest error of a coefficient {small(worst)}"),
    ]
    chosen = readings["ux², vx², ux, vx, u²x, v²x, g in y: taken here"]
    as_printed, more = sum(readings[next(iter(readings))]), stats.chi2.sf(sum(chosen), 36)
    why = f"36 expected at the bound, probability {more:.2f} of more; as printed {as_printed:.0f}"
    rows.append(
        Row("χ² of the printed errors, all three rows", "", f"{sum(chosen):.1f}", None, why)
    )
    scales: dict[str, Floats] = {}
    for kind in ("paper's noise", "Poisson counts"):
        for row in NOISY:
            rows += rows_of(row, kind, quick, scales)
    for row in NOISY:
        ratio = (
            scales[f"{row['background']} Poisson counts"][:12]
            / scales[f"{row['background']} paper's noise"][:12]
        )
        rows.append(
            Row(
                f"λ = {row['background']}: sd with Poisson counts / with the paper's noise",
                "",
                f"{ratio.min():.1f} to {ratio.max():.1f}",
                None,
                "what the sources' own photons add to the errors",
            )
        )
    excess = [(row["chi2"] - 1.0) * np.sqrt(505**2 / 2.0) for row in NOISY]
    text = (
        "Chi-square, 12 degrees of freedom, of the printed errors for each reading of the columns "
        "is in the first table. The last "
        "reading is the only one in which the printed truth is the function of Fig. 2b, and Table "
        "3 requires it (below). With it "
        "the paper's point estimates are at the Cramér-Rao bound of its own noise: what it lacks "
        "is the error bar, and a "
        "likelihood for sources that are Poisson too. The printed χ² exceed 1 by "
        + ", ".join(f"{z:.1f}" for z in excess)
        + " standard errors, which is more than chance: a misfit of "
        + ", ".join(f"{np.sqrt((row['chi2'] - 1.0) * row['background']):.1f}" for row in NOISY)
        + " counts a pixel (rms) would explain it."
        " Errors are posterior standard deviations"
        + (" of the Laplace approximation." if quick else " of at least 1000 effective draws.")
    )
    pictures = [] if quick else [_picture(folder)]
    return Section("Fig. 7, Table 2: noise", text, rows, pictures, "\n".join(wide))


def _picture(folder: Path) -> str:
    figure, axes = panels(3, 3, 2.2)
    for column, row in enumerate(NOISY):
        counts = frame(row["background"], bf.BackgroundNoise())
        posterior = bf.Posterior(paper_model(), counts, noise=bf.BackgroundNoise())
        params = bf.find_map(posterior).params
        mean, sigma = posterior.expected_counts(params), np.sqrt(params[-1])
        for axis, image, what in (
            (axes[0, column], counts, "frame"),
            (axes[1, column], mean, "fit"),
        ):
            drawn = show(axis, image, f"λ = {row['background']}: {what}", vmin=0.0, vmax=250.0)
        residual = show(
            axes[2, column],
            (counts - mean) / sigma,
            "residual",
            colours="RdBu_r",
            vmin=-4.0,
            vmax=4.0,
        )
    bar(drawn, axes[:2], "counts per pixel", extend="max")
    bar(residual, axes[2], "residual / √λ", extend="both")
    return save(figure, "figure_7.png", folder)
