"""Fig. 4: a spot as pixels record it, its correction by R^-1 I R^-1, and the errors of a fit.

The spot has sigma = 3 pixels, in a frame of 101 x 101 at whose border it has vanished. What the
paper does not show: noise that was white becomes correlated. For coverage the spots are narrow
(sigma = 0.8), where it matters most; the ratio of quoted to true error is given for sigma = 3 too.
"""

from pathlib import Path

import numpy as np
from scipy import linalg, stats

import bayesfred as bf

from .common import (
    PRINTED,
    Floats,
    Row,
    Section,
    bar,
    measured,
    name_axes,
    panels,
    save,
    show,
    small,
    symmetric,
)

SIDE = 101
SPOTS = (
    31,
    6.0,
    3000.0,
    20.0,
)  # frame, source at +-x and +-y, photons, background: small, so that it can be fitted often
NARROW = 0.8
TERMS = bf.PolynomialDistortion([(1, 0, 0, 0), (2, 0, 0, 0)], [(0, 1, 0, 0), (0, 2, 0, 0)])
TRIALS = 250


def spot(pixel: str) -> Floats:
    """The paper's spot, peak 1: its values at the pixels' centres, or its integrals over them."""
    sigma = PRINTED["figure4"]["psf_sigma"]
    u = np.arange(SIDE) - SIDE // 2
    if pixel == "impulse":
        along = np.exp(-0.5 * (u / sigma) ** 2)
    else:
        along = (
            sigma
            * np.sqrt(2.0 * np.pi)
            * np.diff(stats.norm.cdf(np.append(u, u[-1] + 1) - 0.5, scale=sigma))
        )
    return np.asarray(np.outer(along, along))


def four_spots(sigma: float, pixel: str) -> bf.ForwardModel:
    side, x, flux, _ = SPOTS
    sources = bf.SourceCatalog([-x, x, -x, x], [-x, -x, x, x], [flux] * 4)
    return bf.ForwardModel(
        bf.Detector((side, side), pixel=pixel), sources, bf.GaussianPSF(sigma), TERMS, tolerance=0.0
    )


def quoted_over_true(sigma: float) -> float:
    """Error that a fit to a corrected frame quotes over the one it has, by linear propagation.

    The fit takes pixels of the corrected frame for independent, each of variance mu (the corrected
    mean); they have the covariance R^-1 diag(recorded mean) R^-1 instead.
    """
    side, _, _, background = SPOTS
    model = four_spots(sigma, "impulse")
    theta = np.zeros(4)
    jacobian = np.concatenate([model.jacobian(theta).reshape(4, -1), np.ones((1, side * side))])
    weighted = jacobian / model.expected_counts(theta, background).ravel()
    quoted = linalg.inv(weighted @ jacobian.T)
    inverse = linalg.inv(bf.sampling_matrix(side))
    gain = quoted @ weighted  # what a change of a pixel does to the parameters
    gain = np.einsum("kvu,vj,ui->kji", gain.reshape(-1, side, side), inverse, inverse).reshape(
        len(gain), -1
    )
    true = (gain * four_spots(sigma, "box").expected_counts(theta, background).ravel()) @ gain.T
    return float(np.mean(np.sqrt(np.diag(quoted) / np.diag(true))[:4]))


def errors_in_units(trials: int) -> tuple[Floats, Floats, Floats, Floats]:
    """Errors over those quoted, shape (trials, 4), and the deviance per pixel, of both ways."""
    background, theta = SPOTS[3], np.zeros(4)
    box, impulse = four_spots(NARROW, "box"), four_spots(NARROW, "impulse")
    z: dict[str, list[Floats]] = {"frame": [], "model": []}
    deviance: dict[str, list[float]] = {"frame": [], "model": []}
    for seed in range(trials):
        counts = bf.simulate(box, theta, background, seed=seed)
        # a few corrected pixels fall below zero, which no Poisson likelihood takes
        for way, model, frame in (
            ("frame", impulse, np.maximum(bf.correct_sampling(counts), 0.0)),
            ("model", box, counts),
        ):
            posterior = bf.Posterior(model, frame)
            found = bf.find_map(posterior, [*theta, background])
            z[way].append(found.params[:4] / np.sqrt(np.diag(found.covariance)[:4]))
            mu = posterior.expected_counts(found.params)
            deviance[way].append(float(np.mean((frame - mu) ** 2 / mu)))
    return (
        np.array(z["frame"]),
        np.array(deviance["frame"]),
        np.array(z["model"]),
        np.array(deviance["model"]),
    )


def coverage_rows(trials: int) -> list[Row]:
    """Share of the 90 % intervals that hold the truth, with its Monte Carlo error, both ways."""
    frame, chi2_frame, model, chi2_model = errors_in_units(trials)
    rows = []
    level = stats.norm.ppf(0.95)
    for way, z, chi2 in (
        ("frame corrected", frame, chi2_frame),
        ("pixel in the model", model, chi2_model),
    ):
        inside = (np.abs(z) < level).mean(axis=1)
        error = float(inside.std(ddof=1) / np.sqrt(len(inside)))
        spread = float(np.sqrt(np.mean(z**2)))
        rows += [
            Row(
                f"{way}: coverage of the 90 % intervals",
                "",
                measured(float(inside.mean()), error),
                None,
                f"sigma {NARROW}, {trials} simulated frames, 4 coefficients; ± is the Monte Carlo "
                "error",
            ),
            Row(
                f"{way}: true error / quoted error",
                "",
                measured(spread, spread / np.sqrt(2.0 * z.size)),
                None,
            ),
            Row(
                f"{way}: Pearson's chi-square per pixel",
                "",
                f"{chi2.mean():.3f}",
                None,
                "1 where the noise is what the fit assumes",
            ),
        ]
    return rows


def make(quick: bool, folder: Path) -> Section:
    ideal, recorded = spot("impulse"), spot("box")
    corrected = bf.correct_sampling(recorded)
    before, after = recorded - ideal, corrected - ideal
    p = PRINTED["figure4"]
    worst = float(np.abs(before).max())
    rows = [
        Row(
            "largest error of a recorded pixel / peak",
            "about 1 %",
            f"{worst:.2%}",
            abs(worst / p["uncorrected"] - 1.0) < 0.5,
        ),
        Row(
            "largest error after correction / peak",
            f"{p['corrected']:g}",
            small(float(np.abs(after).max())),
            bool(np.abs(after).max() <= p["corrected"]),
            "R from the sine integral, solved as Toeplitz matrix: rounding is left",
        ),
        Row(
            "R's inverse: white noise of one pixel grows by",
            "",
            f"{noise_growth(SIDE):.3f}",
            None,
            "in standard deviation, and neighbours become correlated",
        ),
        *(
            Row(
                f"frame corrected, sigma {s}: quoted error / true error",
                "",
                f"{quoted_over_true(s):.3f}",
                None,
                "linear propagation; with the pixel in the model it is 1",
            )
            for s in (p["psf_sigma"], NARROW)
        ),
        *([] if quick else coverage_rows(TRIALS)),
    ]
    text = (
        "The paper corrects the frame, which is exact without noise. With Poisson counts it makes "
        "the noise larger and correlated: "
        "a fit that takes pixels for independent quotes errors that are too small, and its "
        "chi-square rejects the right model. "
        '`Detector(pixel="box")` leaves the counts alone and puts R into the model.'
    )
    pictures = [] if quick else [_picture(ideal, recorded, corrected, before, after, folder)]
    return Section("Fig. 4: sampling effect", text, rows, pictures)


def noise_growth(n: int) -> float:
    """Standard deviation of a middle pixel of R^-1 N R^-1 for white noise N of unit variance."""
    inverse = linalg.inv(bf.sampling_matrix(n))
    return float(np.sum(inverse[n // 2] ** 2))


def _picture(
    ideal: Floats, recorded: Floats, corrected: Floats, before: Floats, after: Floats, folder: Path
) -> str:
    figure, axes = panels(2, 3)
    for axis, letter, image, what in zip(
        axes[0],
        "abc",
        (ideal, recorded, corrected),
        ("ideal", "recorded", "corrected"),
        strict=True,
    ):
        middle = image[SIDE // 2 - 15 : SIDE // 2 + 16, SIDE // 2 - 15 : SIDE // 2 + 16]
        drawn = show(axis, middle, f"Fig. 4{letter}: {what}", vmin=0.0, vmax=1.0)
    bar(drawn, axes[0], "value / peak")
    for axis, letter, image, what in zip(
        axes[1], "de", (before, after), ("recorded", "corrected"), strict=False
    ):
        middle = image[SIDE // 2 - 15 : SIDE // 2 + 16, SIDE // 2 - 15 : SIDE // 2 + 16]
        drawn = show(
            axis, middle, f"Fig. 4{letter}: {what} - ideal", colours="RdBu_r", **symmetric(middle)
        )
        bar(drawn, axis, "error / peak")
    r = bf.sampling_matrix(21)
    drawn = axes[1, 2].imshow(r, cmap="viridis")
    name_axes(axes[1, 2], "Fig. 4f: R, 21 of its rows", "pixel m", "pixel i")
    bar(drawn, axes[1, 2], "R")
    return save(figure, "figure_4.png", folder)
