"""Flat fields: the likelihood against dense images, derivatives, refits, run files, chain files.

The recorded counts n of a pixel of response f have the mean f mu, and n / f is what is fitted. The
oracle of the likelihood is that of n itself.
"""

import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from test_cli import invoke
from test_model import background_image, dense_image, make_posterior, make_truth
from test_model_derivatives import STEP, errors, five_point, full_information, touching
from test_model_read_noise import lattice

import bayesfred as bf
from bayesfred.analysis.score_tests import score_tests
from bayesfred.analysis.verify import verify
from bayesfred.errors import InputError
from bayesfred.io.frames import read_frame, read_stored, write_frame
from bayesfred.io.pixel_maps import read_mapped_frame, read_maps
from bayesfred.model.parameters import Nuisances
from bayesfred.optimize.fit_statistics import fit_statistics, misfit
from bayesfred.sampling.chainfile import open_chain

Floats = NDArray[np.float64]

SHAPE = (60, 75)
RNG = np.random.default_rng(900)
FLAT = RNG.uniform(0.5, 1.5, SHAPE)
READ_NOISES: dict[str, Any] = {
    "none": 0.0,
    "0.4": 0.4,
    "2": 2.0,
    "map": RNG.uniform(1.0, 3.0, SHAPE),
}


def frame(case: str, nuisances: Nuisances, flat: Floats = FLAT) -> tuple[bf.Posterior, Floats]:
    """A frame of which a tenth is masked, and the true parameters."""
    rng, model = np.random.default_rng(901), touching()
    mask = rng.random(SHAPE) < 0.9
    noise = bf.FlatFieldNoise(bf.PoissonNoise(READ_NOISES[case]), flat)
    truth = make_truth(model, rng, 3.0)
    return make_posterior(model, truth, rng, nuisances, noise, mask=mask)


@pytest.mark.slow
@pytest.mark.parametrize("case", READ_NOISES)
def test_log_prob_is_that_of_the_recorded_counts(case: str) -> None:
    posterior, params = frame(case, Nuisances("scale", offset=True))
    recorded, plain = posterior.counts * FLAT, bf.PoissonNoise(READ_NOISES[case])
    density = 0.0 if case == "none" else float(np.log(FLAT)[posterior.mask].sum())
    level = posterior.parameter_names.index("background")
    for factor in (1.0, 1.4, 5.0):  # at the last the unreached pixels are summed one by one
        params[level] *= factor
        named = dict(zip(posterior.parameter_names, params, strict=True))
        mean = dense_image(posterior.model, named) + background_image(SHAPE, named)
        terms = plain.log_likelihood(recorded, FLAT * mean, 0.0)[posterior.mask]
        value = posterior.log_prob(params) - posterior.log_prior(params)[0]
        assert value == pytest.approx(float(terms.sum()) + density, rel=1e-11)
        params[level] /= factor
    params[level] = -1.0
    assert posterior.log_prob(params) == -math.inf


@pytest.mark.slow
@pytest.mark.parametrize(
    ("case", "nuisances"),
    [
        ("none", Nuisances("scale", offset=True)),
        ("2", Nuisances(background_order=1)),
        ("map", Nuisances("scale", psf_sigma=True)),
        pytest.param("none", Nuisances("free", offset=True), marks=pytest.mark.long),
        pytest.param("2", Nuisances(model_error=True), marks=pytest.mark.long),
    ],
)
def test_gradient_is_that_of_log_prob(case: str, nuisances: Nuisances) -> None:
    posterior, params = frame(case, nuisances)
    scale = errors(posterior, params)
    params += 0.5 * scale * np.random.default_rng(902).uniform(-1, 1, params.size)
    numerical = [
        five_point(posterior.log_prob, params, k, STEP * scale[k]) for k in range(params.size)
    ]
    assert posterior.gradient(params) * scale == pytest.approx(
        np.array(numerical) * scale, rel=2e-6, abs=2e-6
    )


@pytest.mark.slow
@pytest.mark.parametrize("case", ["none", "2"])
def test_fisher_is_that_of_the_dense_jacobian(case: str) -> None:
    posterior, params = frame(case, Nuisances("scale", offset=True))
    scale = np.outer(errors(posterior, params), errors(posterior, params))
    # of the recorded counts, written out: J^T diag(f^2 I(f mu)) J; for photons f / mu
    expected = full_information(posterior, params, None)
    # the unreached pixels' information is a series to 5e-6
    assert posterior.fisher(params) * scale == pytest.approx(expected * scale, abs=1e-5)
    mean = np.array([0.05, 5.0])
    flat = bf.FlatFieldNoise(bf.PoissonNoise(), [0.5, 1.5])
    assert flat.fisher_weight(mean, 0.0) == pytest.approx([0.5 / 0.05, 1.5 / 5.0])


@pytest.mark.slow
def test_a_constant_response_is_a_longer_exposure() -> None:
    flat = np.full(SHAPE, 0.7)
    posterior, params = frame("none", Nuisances("scale"), flat)
    plain = bf.Posterior(
        posterior.model, posterior.counts * 0.7, mask=posterior.mask, nuisances=Nuisances("scale")
    )
    names = posterior.parameter_names
    dimmer = params.copy()
    for name in ("flux_scale", "background"):
        dimmer[names.index(name)] *= 0.7
    ours, theirs = (
        p.log_prob(x) - p.log_prior(x)[0] for p, x in ((posterior, params), (plain, dimmer))
    )
    assert ours == pytest.approx(theirs, rel=1e-12)


@pytest.mark.slow
def test_what_a_masked_pixel_is_said_to_respond_is_irrelevant() -> None:
    posterior, params = frame("none", Nuisances())
    other = np.where(posterior.mask, FLAT, 77.0)
    noise = bf.FlatFieldNoise(bf.PoissonNoise(), other)
    again = bf.Posterior(posterior.model, posterior.counts, noise=noise, mask=posterior.mask)
    assert again.log_prob(params) == pytest.approx(posterior.log_prob(params), rel=1e-13)
    assert noise == bf.FlatFieldNoise(bf.PoissonNoise(), other.copy()) != posterior.noise
    assert hash(noise) == hash(bf.FlatFieldNoise(bf.PoissonNoise(), other.copy()))


@pytest.mark.parametrize("r", [0.0, 0.3, 3.0])
def test_law_of_the_flat_fielded_counts(r: float) -> None:
    """The density is normalised, with the mean, variance, information and moments stated."""
    f, mu = 0.6, 2.0
    noise = bf.FlatFieldNoise(bf.PoissonNoise(r), [f])
    n, step = (np.arange(60.0), 1.0) if r == 0.0 else lattice(f * mu, r)
    n, step = n / f, step / f if r else step
    law = bf.FlatFieldNoise(bf.PoissonNoise(r), np.full(n.size, f))
    at = np.full(n.size, mu)
    chance = step * np.exp(law.log_likelihood(n, at, 0.0))
    one = np.array([mu])
    assert chance.sum() == pytest.approx(1.0, abs=2e-5)
    assert chance @ n == pytest.approx(mu, abs=1e-4)
    assert chance @ (n - mu) ** 2 == pytest.approx(noise.counts_variance(one, 0.0)[0], rel=1e-4)
    score = law.score(n, at, 0.0)
    assert chance @ score**2 == pytest.approx(noise.fisher_weight(one, 0.0)[0], rel=3e-4)
    deviance = law.deviance(n, at, 0.0)
    mean, variance, slope = (each[0] for each in noise.deviance_moments(one, 0.0))
    assert chance @ deviance == pytest.approx(mean, rel=3e-4)
    assert chance @ (deviance - mean) ** 2 == pytest.approx(variance, rel=1e-3)
    assert chance @ (deviance * score) == pytest.approx(slope, abs=2e-3)
    below, upto = law.cumulative(n, at, 0.0, step)
    assert np.cumsum(chance) == pytest.approx(upto, abs=1e-3)
    assert upto - below == pytest.approx(chance, abs=1e-3)


def test_draws_have_the_right_moments() -> None:
    noise = bf.FlatFieldNoise(bf.PoissonNoise(1.5), np.full(100_000, 0.5))
    counts = noise.draw(np.zeros(100_000), 8.0, np.random.default_rng(903))
    variance = 8.0 / 0.5 + 1.5**2 / 0.25
    assert counts.mean() == pytest.approx(8.0, abs=4.0 * math.sqrt(variance / counts.size))
    assert counts.var() == pytest.approx(variance, rel=4.0 * math.sqrt(2.1 / counts.size))


@pytest.mark.parametrize(
    ("response", "line"),
    [
        (np.zeros(SHAPE), "got 0 in 4500 pixels"),
        (-FLAT, "got -"),
        (np.where(FLAT > 1.0, np.nan, 1.0), "got nan in"),
        (1.0, "got 1 in 1 pixels, expected an array"),
        ("flat", "got no numbers"),
        (np.ones((3, 4)), r"got shape \(3, 4\), expected the frame's shape"),
    ],
)
def test_responses_are_checked(response: Any, line: str) -> None:
    with pytest.raises(InputError, match=f"response: {line}"):
        bf.Posterior(
            touching(), np.ones(SHAPE), noise=bf.FlatFieldNoise(bf.PoissonNoise(), response)
        )


def test_gaussian_noise_under_a_flat_field_is_refused() -> None:
    with pytest.raises(InputError, match="got GaussianNoise under a flat field"):
        bf.FlatFieldNoise(bf.GaussianNoise(1.0), FLAT)  # type: ignore[arg-type]


# --- refits ---------------------------------------------------------------------------------------


def refits(frames: int, *, ignored: bool, scored: int = 0) -> tuple[Floats, Floats, Floats]:
    """Errors in standard deviations, shape (frames, d), every frame's misfit, and the scores of
    what is not fitted in the first frames.

    With the flat field `ignored` the recorded counts are fitted.
    """
    distortion = bf.PolynomialDistortion([(1, 0, 1, 0)], [(0, 1, 0, 1)])
    sources = bf.SourceCatalog.grid(4, 14.0, 2e3)
    model = bf.ForwardModel(bf.Detector(SHAPE), sources, bf.GaussianPSF(2.0), distortion)
    theta, background = [1e-4, -1e-4], 3.0
    law, plain = bf.FlatFieldNoise(bf.PoissonNoise(2.0), FLAT), bf.PoissonNoise(2.0)
    z, off, score = [], [], []
    for k, seed in enumerate(np.random.SeedSequence(904).spawn(frames)):
        counts = bf.simulate(model, theta, background, seed=seed, noise=law)
        if ignored:
            posterior = bf.Posterior(model, counts * FLAT, noise=plain)
        else:
            posterior = bf.Posterior(model, counts, noise=law)
        best = bf.find_map(posterior, np.array([*theta, background]))
        z.append((best.params - [*theta, background]) / np.sqrt(np.diag(best.covariance)))
        off.append(misfit(fit_statistics(posterior, best.params)))
        if k < scored:
            score.append(score_tests(posterior, best.params).z)
    return np.array(z), np.array(off), np.array(score)


def covered(z: Floats) -> float:
    """The largest deviation of a parameter's 68 % interval's coverage, in Monte Carlo errors."""
    share = np.mean(np.abs(z) < 1.0, axis=0)
    return float(np.abs(share - 0.6827).max() / math.sqrt(0.6827 * 0.3173 / len(z)))


@pytest.mark.slow
def test_a_frame_whose_flat_field_is_ignored_does_not_fit() -> None:
    # the negative control of the next test; with the flat field, 5 sd have a probability of 1e-6
    _, off, _ = refits(4, ignored=False)
    _, wrong, _ = refits(4, ignored=True)
    assert np.abs(off).max() < 5.0 and wrong.min() > 20.0


@pytest.mark.statistics
def test_intervals_cover_in_refits_of_simulated_frames() -> None:
    # 3 parameters in 400 frames: 3.5 Monte Carlo errors (8 %) have a probability of 0.14 %
    z, off, score = refits(400, ignored=False, scored=60)
    assert covered(z) < 3.5
    assert np.abs(z.mean(axis=0)).max() < 3.5 / math.sqrt(len(z))
    assert np.sum(off > 3.0) <= 5  # see test_model_read_noise: false alarms at most 1 %
    assert abs(off.mean()) < 4.0 / math.sqrt(off.size)
    assert np.nanmean(score**2, axis=0) == pytest.approx(1.0, abs=4.0 * math.sqrt(2.0 / 60))
    # negative control
    z, off, score = refits(60, ignored=True, scored=20)
    assert covered(z) > 3.5 and off.min() > 20.0
    assert np.nanmean(score**2, axis=0).max() > 1.0 + 4.0 * math.sqrt(2.0 / 20)


# --- files ----------------------------------------------------------------------------------------

RUN = """
[frame]
path = "frame.fits"
gain = 1.0
flat = "flat.fits"
variance = "variance.fits"
[catalogue]
path = "stars.csv"
[psf]
sigma = 2.0
[distortion]
f_terms = [[1, 0, 1, 0]]
g_terms = [[0, 1, 0, 1]]
[simulation]
shape = [60, 75]
theta = {f_ux = 1e-4, g_vy = -1e-4}
background = 3.0
seed = 3
[simulation.grid]
side = 4
spacing = 14.0
flux = 2e4
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with a run file, its maps and its simulated frame."""
    flat = FLAT.copy()
    flat[3, 4:7] = 0.0, -1.0, np.nan
    write_frame(tmp_path / "flat.fits", flat)
    write_frame(tmp_path / "variance.fits", READ_NOISES["map"] ** 2)
    (tmp_path / "run.toml").write_text(RUN)
    assert invoke(tmp_path, "simulate", "run.toml").code == 0
    return tmp_path


@pytest.mark.slow
def test_run_file_with_maps(folder: Path) -> None:
    # what is written is what a camera records: with less light where the response is less
    recorded = read_frame(folder / "frame.fits", gain=1.0).counts
    assert recorded[FLAT < 0.7].mean() < 0.7 * recorded[FLAT > 1.3].mean()
    output = invoke(folder, "fit", "run.toml", "--map-only")
    assert output.code == 0
    assert "flat by flat.fits, 3 pixels masked; variance by variance.fits" in output.stdout
    posterior = open_chain(folder / "chains" / "run.h5").posterior()
    assert isinstance(posterior, bf.Posterior)
    assert posterior.noise == bf.FlatFieldNoise(
        bf.PoissonNoise(READ_NOISES["map"]), np.where(posterior.mask, FLAT, 1.0)
    )
    assert np.flatnonzero(~posterior.mask).tolist() == [229, 230, 231]
    assert all(check.holds for check in verify(folder / "chains" / "run.h5"))
    # an input is never replaced
    (folder / "run.toml").write_text(RUN + '[output]\npath = "flat.fits"\n')
    assert invoke(folder, "fit", "run.toml", "--map-only", "--overwrite").code == 2
    assert np.isnan(read_stored(folder / "flat.fits").stored[3, 6])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("old", "new", "line"),
    [
        ('"flat.fits"', '"none.fits"', "got 'none.fits', expected a file at"),
        ('"flat.fits"', '"variance.fits"', "variance.fits: flat: got a median of [34]"),
        ('"flat.fits"', '"small.fits"', r"variance.fits: variance: got shape .* expected \(3, 4"),
        ('"flat.fits"', '"dead.fits"', "dead.fits: flat: got no such pixel, expected numbers from"),
        ('"flat.fits"', "3", "frame.flat: got 3, expected"),
        ("gain = 1.0", 'gain = 1.0\ngain_map = "flat.fits"', "frame.gain_map: got it with gain"),
        ("[psf]", "[noise]\nread_noise = 2.0\n[psf]", "frame.variance: got it with noise.read_n"),
        ("[psf]", '[noise]\nkind = "background"\n[psf]', "frame.flat: got it with noise.kind ="),
    ],
)
def test_bad_maps_are_one_line(folder: Path, old: str, new: str, line: str) -> None:
    write_frame(folder / "small.fits", np.ones((3, 4)))
    write_frame(folder / "dead.fits", np.zeros(SHAPE))
    (folder / "run.toml").write_text(RUN.replace(old, new))
    output = invoke(folder, "fit", "run.toml", "--map-only")
    assert output.code == 2 and len(output.stderr.splitlines()) == 1
    assert re.search(line, output.stderr)


def test_maps_are_applied_to_a_frame(tmp_path: Path) -> None:
    rng = np.random.default_rng(905)
    gain, adu = rng.uniform(0.8, 2.5, SHAPE), rng.integers(100, 900, SHAPE).astype(float)
    gain[0, 0], flat = np.inf, FLAT.copy()
    flat[1, 1] = 1e-9
    for name, values in (("adu", adu), ("gain", gain), ("flat", flat), ("small", flat[1:])):
        write_frame(tmp_path / f"{name}.npy", values)
    maps = read_maps({name: tmp_path / f"{name}.npy" for name in ("gain", "flat")})
    frame = read_mapped_frame(tmp_path / "adu.npy", maps, pedestal=90.0)
    assert np.flatnonzero(~frame.valid).tolist() == [0, 76] and frame.n_masked == 2
    expected = (adu - 90.0) * gain / flat
    assert frame.counts[frame.valid] == pytest.approx(expected[frame.valid], rel=1e-14)
    assert frame.description.endswith("gain by gain.npy, 1 pixel masked; flat by flat.npy, 1 pixel "
                                      "masked")  # fmt: skip
    small = read_maps({"flat": tmp_path / "small.npy"})
    with pytest.raises(InputError, match=r"adu.npy: got shape .* of flat by small.npy"):
        read_mapped_frame(tmp_path / "adu.npy", small)
    write_frame(tmp_path / "half.npy", np.where(FLAT > 1.0, 1.0, np.nan))
    write_frame(tmp_path / "other.npy", np.where(FLAT > 1.0, np.nan, 1.0))
    with pytest.raises(InputError, match="got every pixel masked by the frame or by flat by other"):
        read_mapped_frame(tmp_path / "half.npy", read_maps({"flat": tmp_path / "other.npy"}))
