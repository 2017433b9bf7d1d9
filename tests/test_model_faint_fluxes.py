"""Free fluxes of faint sources, alone and in pairs one sigma apart, against integrals on grids."""

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import special, stats
from test_model import LIMIT
from test_sampling_chain import reseal

import bayesfred as bf
from bayesfred.errors import InputError
from bayesfred.imaging.catalog import SourceCatalog
from bayesfred.imaging.detector import Detector
from bayesfred.imaging.distortion import PolynomialDistortion
from bayesfred.imaging.forward import ForwardModel
from bayesfred.imaging.psf import GaussianPSF
from bayesfred.model.noise import PoissonNoise
from bayesfred.model.parameters import Nuisances
from bayesfred.model.posterior import Posterior
from bayesfred.sampling.chainfile import open_chain
from bayesfred.sampling.sampler import sample

Floats = NDArray[np.float64]

SIGMA = 1.5
CELL = 12  # pixels between sites, which do not overlap
PHOTONS = PoissonNoise()
MANY = 1000  # sources for which biases are quoted
BOUND = 0.1  # standard deviations
TRUTH = {"f_x": 1e-3, "g_y": -1e-3, "offset_x": 0.2, "offset_y": -0.1, "psf_sigma": SIGMA}


@dataclass(frozen=True)
class Field:
    """A square grid of sites with one source or two, and everything computed naively there."""

    side: int
    group: int  # sources on a site
    flux: float
    background: float
    shape: float = 2.0
    noise: PoissonNoise = PHOTONS

    @property
    def truth(self) -> dict[str, float]:
        return {**TRUTH, "background": self.background}

    @property
    def positions(self) -> Floats:
        """x and y of the sources, shape (sites, group, 2)."""
        axis = (np.arange(self.side) - 0.5 * (self.side - 1)) * CELL
        v, u = np.meshgrid(axis, axis, indexing="ij")
        apart = SIGMA * (np.arange(self.group) - 0.5 * (self.group - 1))
        x = u.ravel()[:, None] + apart
        return np.stack([x, np.broadcast_to(v.ravel()[:, None], x.shape)], axis=-1)

    def posterior(self, counts: Floats) -> Posterior:
        x, y = self.positions.reshape(-1, 2).T
        model = ForwardModel(
            Detector((self.side * CELL,) * 2),
            SourceCatalog(x, y, np.full(x.size, self.flux)),
            GaussianPSF(SIGMA),
            PolynomialDistortion([(1, 0, 0, 0)], [(0, 1, 0, 0)]),
            tolerance=1e-8,
        )
        nuisances = Nuisances("free", offset=True, psf_sigma=True, flux_shape=self.shape)
        return Posterior(model, counts, noise=self.noise, nuisances=nuisances)

    def cells(self, counts: Floats) -> Floats:
        """The pixels of every site, shape (sites, CELL^2)."""
        parts = counts.reshape(self.side, CELL, self.side, CELL).swapaxes(1, 2)
        return np.ascontiguousarray(parts.reshape(self.side**2, CELL**2))

    def templates(self, named: dict[str, float]) -> Floats:
        """Images of unit flux, shape (sites, group, CELL^2)."""
        axis = np.arange(self.side * CELL) - 0.5 * (self.side * CELL - 1)
        v, u = (self.cells(part) for part in np.meshgrid(axis, axis, indexing="ij"))
        x, y = np.moveaxis(self.positions, -1, 0)[..., None]
        a = u[:, None] - x + named["f_x"] * x - named["offset_x"]
        b = v[:, None] - y + named["g_y"] * y - named["offset_y"]
        width = named["psf_sigma"]
        return np.exp(-0.5 * (a**2 + b**2) / width**2) / (2 * math.pi * width**2)

    def draw(self, rng: np.random.Generator, width: float = SIGMA) -> Floats:
        """A frame whose fluxes are drawn from their prior."""
        fluxes = self.flux * rng.gamma(self.shape, 1 / self.shape, (self.side**2, self.group))
        named = {**self.truth, "psf_sigma": width}
        light = np.einsum("sg,sgp->sp", fluxes, self.templates(named))
        frame = light.reshape(self.side, self.side, CELL, CELL).swapaxes(1, 2)
        return self.noise.draw(frame.reshape((self.side * CELL,) * 2), self.background, rng)

    def prior(self, fluxes: Floats) -> Floats:
        """Log-density of the logarithms of fluxes."""
        return stats.gamma(self.shape, scale=self.flux / self.shape).logpdf(fluxes) + np.log(fluxes)

    def exact(self, cells: Floats, named: dict[str, float]) -> Floats:
        """Log of the integral over the fluxes of every site, on a grid of their logarithms."""
        ends = stats.gamma(self.shape, scale=self.flux / self.shape).ppf([1e-7, 1 - 1e-7])
        most = math.log(ends[1] + cells.sum(axis=1).max() - self.background * CELL**2)
        nodes = {1: 90, 2: 55, 3: 28}[self.group]
        w = np.linspace(max(math.log(ends[0]), most - 9.0), most, nodes)
        fluxes = np.stack(np.meshgrid(*[np.exp(w)] * self.group, indexing="ij"), axis=-1)
        fluxes = fluxes.reshape(-1, self.group)
        prior = self.prior(fluxes).sum(axis=1)
        out = []
        for counts, stamp in zip(cells, self.templates(named), strict=True):
            mean = fluxes @ stamp + named["background"]
            if self.noise == PHOTONS:
                terms = np.log(mean) @ counts - mean.sum(axis=1) - special.gammaln(counts + 1).sum()
            else:
                terms = self.noise.log_likelihood(counts, mean, named["background"]).sum(axis=1)
            out.append(special.logsumexp(terms + prior) + self.group * math.log(w[1] - w[0]))
        return np.array(out)

    def laplace(self, cells: Floats, named: dict[str, float]) -> Floats:
        """The plain Laplace marginal of Poisson counts: a Gaussian in the fluxes themselves."""
        stamps, level = self.templates(named), named["background"]
        fluxes, scale = np.full(stamps.shape[:2], self.flux), self.flux / self.shape
        for _ in range(100):
            mean = np.einsum("sg,sgp->sp", fluxes, stamps) + level
            slope = np.einsum("sp,sgp->sg", cells / mean - 1, stamps)
            slope += (self.shape - 1) / fluxes - 1 / scale
            h = np.einsum("sp,sgp,shp->sgh", cells / mean**2, stamps, stamps)
            h += (self.shape - 1) * np.eye(self.group) / fluxes[..., None] ** 2
            step = np.linalg.solve(h, slope[..., None])[..., 0]
            largest = np.abs(step / fluxes).max(axis=1, keepdims=True)
            fluxes = fluxes + step / np.where(largest < 0.5, 1.0, 1.0 + largest)
            if largest.max() < 1e-7:
                break
        value = self.noise.log_likelihood(cells, mean, level).sum(axis=1)
        value += (self.prior(fluxes) - np.log(fluxes)).sum(axis=1)
        return np.asarray(value - 0.5 * np.linalg.slogdet(h / (2 * math.pi))[1])

    def scores(self, integral: Any, cells: Floats) -> Floats:
        """The derivatives of every site's integral, shape (sites, d)."""
        names, out = self.posterior(np.ones((self.side * CELL,) * 2)).parameter_names, []
        for name in names:
            step = 1e-3 * (self.background if name == "background" else 1.0)
            if name in ("f_x", "g_y"):
                step /= 0.5 * self.side * CELL
            ends = [
                integral(cells, {**self.truth, name: self.truth[name] + k * step}) for k in (-1, 1)
            ]
            out.append((ends[1] - ends[0]) / (2 * step))
        return np.array(out).T


def biases(field: Field, frames: int, seed: int, control: bool) -> tuple[Floats, Floats, Floats]:
    """Biases of all parameters with MANY sources, in standard deviations: the package's, the plain
    Laplace marginal's as a control, and the Monte Carlo errors of the former."""
    rng, sites, off, scores = np.random.default_rng(seed), field.side**2, [], []
    for _ in range(frames):
        frame = field.draw(rng)
        cells, posterior = field.cells(frame), field.posterior(frame)
        params = np.array([field.truth[name] for name in posterior.parameter_names])
        exact = field.scores(field.exact, cells)
        plain = field.scores(field.laplace, cells) if control else exact * np.nan
        off.append(
            (posterior.likelihood.gradient(params) - exact.sum(axis=0), (plain - exact).sum(axis=0))
        )
        scores.append(exact)
    covariance = np.linalg.inv(np.cov(np.concatenate(scores).T)) * field.group / MANY
    unit = covariance / np.sqrt(np.diag(covariance))[:, None] * MANY / (field.group * sites)
    drawn = np.array(off) @ unit.T  # (frames, 2, d)
    mean, error = drawn.mean(axis=0), drawn.std(axis=0, ddof=1) / math.sqrt(frames)
    return mean[0], mean[1], error[0]


FIELDS = {
    "3 photons": Field(8, 1, 3.0, 1.0),
    "5 photons": Field(8, 1, 5.0, 1.0),
    "5 photons, dark sky": Field(8, 1, 5.0, 0.05),
    "20 photons": Field(8, 1, 20.0, 1.0),
    "5 photons, a wide prior": Field(8, 1, 5.0, 1.0, shape=1.0),
    "5 photons, a narrow prior": Field(8, 1, 5.0, 1.0, shape=10.0),
    "5 photons, read noise": Field(8, 1, 5.0, 1.0, noise=PoissonNoise(1.0)),
    "3 photons in pairs": Field(5, 2, 3.0, 1.0),
    "5 photons in pairs": Field(5, 2, 5.0, 1.0),
    "5 photons in pairs, dark sky": Field(5, 2, 5.0, 0.05),
    "20 photons in pairs": Field(5, 2, 20.0, 1.0),
    "5 photons in triples": Field(3, 3, 5.0, 1.0),  # of which pairs alone are expanded
}
QUICK = "5 photons"


@pytest.mark.parametrize(
    "case",
    [
        case if case == QUICK else pytest.param(case, marks=pytest.mark.statistics)
        for case in FIELDS
    ],
)
def test_no_parameter_of_a_thousand_faint_sources_is_biased(case: str) -> None:
    field = FIELDS[case]
    control = field.shape == 2.0 and field.noise == PHOTONS and field.flux <= 5.0
    control = control and field.background == 1.0
    frames = 12 if field.group == 3 else 6  # few sources each: the error is that of all
    ours, plain, error = biases(field, frames, 801, control)
    print(case, "ours", ours.round(3), "plain", plain.round(3), "errors", error.round(3))
    bound = BOUND if field.shape >= 2.0 else 2 * BOUND  # the expansion is in 1 / shape, too
    assert np.all(np.abs(ours) < bound + LIMIT * error) and error.max() < 0.05
    assert not control or np.abs(plain).max() > 3 * BOUND  # the plain Laplace marginal is


def moments(axis: Floats, values: Floats) -> tuple[float, float]:
    """Mean and standard deviation of a log-density on a grid."""
    density = np.exp(values - values.max())
    mean = density @ axis / density.sum()
    return float(mean), float(np.sqrt(density @ (axis - mean) ** 2 / density.sum()))


@pytest.mark.parametrize("group", [1, 2], ids=["single", "pairs"])
@pytest.mark.statistics
def test_the_posterior_of_the_width_is_that_of_exact_integrals(group: int) -> None:
    # 1024 single sources of 3 photons on a background of 1, and 512 in pairs one sigma apart
    field, rng = Field(32 // group, group, 3.0, 1.0), np.random.default_rng(802)
    frame = field.draw(rng)
    cells, posterior = field.cells(frame), field.posterior(frame)
    axis = np.linspace(1.0, 2.2, 16)
    at = [{**field.truth, "psf_sigma": width} for width in axis]
    names = posterior.parameter_names
    vectors = np.array([[named[name] for name in names] for named in at])
    ours = posterior.log_prob(vectors) - posterior.log_prior(vectors)
    exact = np.array([field.exact(cells, named).sum() for named in at])
    plain = np.array([field.laplace(cells, named).sum() for named in at])
    mean, sd = moments(axis, exact)
    found = {name: moments(axis, values) for name, values in (("ours", ours), ("plain", plain))}
    shift = {name: (m - mean) / sd for name, (m, _) in found.items()}
    ratio = {name: s / sd for name, (_, s) in found.items()}
    print(group, "shift", shift, "ratio", ratio)
    assert abs(shift["ours"]) < BOUND and abs(ratio["ours"] - 1) < 0.05
    # negative control
    assert abs(shift["plain"]) > 3 * BOUND


FAINT = Field(20, 1, 3.0, 1.0)  # 400 sources
PRIOR = {
    "f_x": stats.norm(0.0, 2e-3),
    "g_y": stats.norm(0.0, 2e-3),
    "background": stats.norm(1.0, 0.03),
    "offset_x": stats.norm(0.0, 0.3),
    "offset_y": stats.norm(0.0, 0.3),
    "psf_sigma": stats.uniform(1.1, 0.9),
}


@pytest.mark.long
def test_posteriors_of_400_faint_sources_are_calibrated(tmp_path: Path) -> None:
    # rejects exact posteriors in 1 of 100 cases; 30 frames notice a mean pull of 0.7
    posterior = replace(FAINT.posterior(np.ones((20 * CELL,) * 2)), prior=PRIOR)
    result = bf.simulation_based_calibration(
        posterior, replicates=30, path=tmp_path / "sbc.ecsv", seed=803, workers=1, progress=False
    )
    print(result.message, result.quantities["quantity"], result.quantities["pull"].round(2))
    assert result.calibrated, result.message


@pytest.mark.long
def test_the_plain_laplace_marginal_of_400_faint_sources_is_not_calibrated() -> None:
    # pulls of psf_sigma, everything else known, on a grid; their mean has the error 1/sqrt(frames)
    rng, axis, pulls = np.random.default_rng(804), np.linspace(1.1, 2.0, 31), []
    for _ in range(24):
        truth = rng.uniform(1.1, 2.0)
        frame = FAINT.draw(rng, truth)
        posterior, cells = FAINT.posterior(frame), FAINT.cells(frame)
        at = [{**FAINT.truth, "psf_sigma": width} for width in axis]
        vectors = np.array([[named[name] for name in posterior.parameter_names] for named in at])
        ours = posterior.log_prob(vectors) - posterior.log_prior(vectors)
        plain = np.array([FAINT.laplace(cells, named).sum() for named in at])
        found = [moments(axis, values) for values in (ours, plain)]
        pulls.append([(mean - truth) / sd for mean, sd in found])
    mean, error = np.mean(pulls, axis=0), 1 / math.sqrt(len(pulls))
    print("mean pulls of the integral and of the plain marginal", mean.round(2), "+-", error)
    assert abs(mean[0]) < LIMIT * error
    assert abs(mean[1]) > LIMIT * error  # negative control


# --- the width of the prior -----------------------------------------------------------------------


def test_frames_are_drawn_with_the_fluxes_that_the_prior_allows() -> None:
    # counts of N sources: variance F + F^2 / shape each
    field, rng = Field(8, 1, 400.0, 1.0, shape=8.0), np.random.default_rng(805)
    posterior = field.posterior(np.ones((8 * CELL,) * 2))
    params = np.array([field.truth[name] for name in posterior.parameter_names])
    frames = [posterior.simulate(params, rng) for _ in range(10)]
    light = np.concatenate(
        [field.cells(frame).sum(axis=1) for frame in frames if frame is not None]
    )
    ratio = light.var(ddof=1) / (CELL**2 + 400.0 + 400.0**2 / 8.0)
    error = math.sqrt((2 + 6 / 8) / light.size)  # a Gamma's excess kurtosis is 6 / shape
    assert abs(ratio - 1) < LIMIT * error
    assert abs(ratio - 4) > LIMIT * error  # negative control: shape 2


@pytest.mark.parametrize("shape", [0.0, 0.9, -1.0, math.nan, math.inf])
def test_shapes_without_an_expansion_are_refused(shape: float) -> None:
    with pytest.raises(InputError, match=r"flux_shape: got .* expected a number >= 1"):
        Nuisances("free", flux_shape=shape)


@pytest.mark.parametrize("flux", ["fixed", "free"])
def test_chains_of_earlier_schemas_are_read_unless_fluxes_are_free(
    flux: Any, tmp_path: Path
) -> None:
    field, path = Field(3, 1, 2e3, 1.0), tmp_path / "chain.h5"
    posterior = field.posterior(field.draw(np.random.default_rng(806)))
    sample(
        replace(posterior, prior={}, nuisances=Nuisances(flux)),
        seed=807,
        path=path,
        steps=4,
        progress=False,
    )
    with h5py.File(path, "r+") as file:
        file.attrs["schema"] = 4
        del file["posterior/nuisances"].attrs["flux_shape"]
    reseal(path)
    if flux == "free":
        with pytest.raises(InputError, match=r"got free fluxes by Laplace's .* sample the frame"):
            open_chain(path)
    else:
        assert open_chain(path).posterior().nuisances == Nuisances()
