"""The page, its figures and its tables: what they say, and that nothing a user writes is markup."""

import base64
import re
from dataclasses import replace
from html.parser import HTMLParser
from io import BytesIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from matplotlib.collections import EllipseCollection, LineCollection, PathCollection
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.image import imread
from matplotlib.path import Path as Outline
from matplotlib.quiver import Quiver
from numpy.typing import NDArray
from scipy.stats import norm

import bayesfred as bf
from bayesfred.analysis.diagnostics import Diagnostics, diagnose
from bayesfred.analysis.field import displacement_field
from bayesfred.analysis.residuals import judge_residuals
from bayesfred.errors import InputError
from bayesfred.imaging.catalog import SourceCatalog
from bayesfred.imaging.detector import Detector
from bayesfred.imaging.distortion import PolynomialDistortion
from bayesfred.imaging.forward import ForwardModel
from bayesfred.imaging.psf import GaussianPSF
from bayesfred.io.summary_table import make_table
from bayesfred.model.noise import PoissonNoise
from bayesfred.model.parameters import Nuisances
from bayesfred.model.posterior import Posterior
from bayesfred.optimize.estimate import MapEstimate
from bayesfred.reporting.field import field_plot
from bayesfred.reporting.figures import PageFigure, described_residual, page_figures
from bayesfred.reporting.frames import MASKED, FittedFrame, star_panels
from bayesfred.reporting.html import write_report
from bayesfred.reporting.labels import axis_label, math_symbol
from bayesfred.reporting.pairs import corner_parameters, corner_plot
from bayesfred.reporting.panels import Images, Sheet, round_ticks
from bayesfred.reporting.posteriors import marginal_plot, overview, trace_plot
from bayesfred.reporting.screen import parameter_table
from bayesfred.reporting.style import embedded, png
from bayesfred.sampling.record import RunRecord
from bayesfred.sampling.summary import summary, unit_text

Floats = NDArray[np.float64]

TRUTH = np.array([0.0, -2.0, 3.0, 1.0]) * 1e-6
BACKGROUND = 5.0


def run(names_extra: tuple[str, ...] = ()) -> tuple[Any, Any]:
    """Independent draws around the truth and their posterior, as far as the report reads them."""
    rng = np.random.default_rng(1)
    distortion = PolynomialDistortion(((1, 0, 1, 0), (2, 0, 1, 0)), ((0, 1, 0, 1), (0, 2, 0, 1)))
    model = ForwardModel(
        Detector((61, 81)), SourceCatalog.grid(3, 20.0, 3000.0), GaussianPSF(2.5), distortion
    )
    names = (*distortion.names, "background", *names_extra)
    counts = rng.poisson(model.expected_counts(TRUTH, BACKGROUND)).astype(float)
    centre = np.concatenate([TRUTH, [BACKGROUND], np.zeros(len(names_extra))])
    sd = np.concatenate([np.full(4, 1.234e-7), [0.0321], np.full(len(names_extra), 0.02)])
    chain = centre + sd * rng.standard_normal((4, 12, 32, len(names)))
    mask = np.ones(counts.shape, bool)
    mask[:4] = False
    posterior = SimpleNamespace(
        log_prob=lambda params: 0.0,
        counts=counts,
        mask=mask,
        parameter_names=names,
        n_parameters=len(names),
        noise=PoissonNoise(),
        noise_at=lambda params: PoissonNoise(),
        psf_errors=None,
        prior={name: norm(0.0, 1.0) for name in names},
        nuisances=Nuisances(),
        model=model,
        log_prior=lambda draws: np.zeros(len(draws)),
        expected_counts=lambda params: model.expected_counts(params[:4], params[4]),
        sigma=lambda params: model.expected_counts(params[:4], params[4]) ** 0.5,
    )
    posterior.parameters = described(*names)
    posterior.likelihood = Posterior(model, counts).likelihood
    estimate = MapEstimate(centre, np.eye(len(centre)), 0.0, 9, "gradient <small>")
    fields = {
        "path": Path("chains/a & b.h5"),
        "parameter_names": names,
        "chain": chain,
        "log_prob": np.zeros(chain.shape[:3]),
        "accepted": np.full((4, 32), 10),
        "burn_in": 2,
        "seed": 7,
        "method": "mcmc",
        "estimate": estimate,
        "versions": {"numpy": "2.0", "bayesfred": "0.1"},
        "draws": lambda: chain[:, 2:].reshape(-1, len(names)),
        "posterior": lambda: posterior,
        "version_history": "bayesfred 0.1, numpy 2.0",
        "identity": "0" * 32,
        "record": RunRecord("A frame", made="2026-11-22T04:00:17+00:00"),
    }
    return SimpleNamespace(**fields), posterior


def described(*names: str) -> tuple[Any, ...]:
    """Stand-ins with the fields of a `Parameter` that are shown."""
    shown = {
        "background": {"unit": "counts"},
        "f_ux": {"letter": "f", "powers": (("u", 1), ("x", 1)), "pixels": -1},
        "f_ux2": {"letter": "f", "powers": (("u", 1), ("x", 2)), "pixels": -2},
        "g_vy": {"letter": "g", "powers": (("v", 1), ("y", 1)), "pixels": -1},
        "g_vy2": {"letter": "g", "powers": (("v", 1), ("y", 2)), "pixels": -2},
    }
    plain = {"letter": "", "powers": (), "unit": "", "pixels": 0}
    return tuple(SimpleNamespace(name=name, **(plain | shown.get(name, {}))) for name in names)


def pixels(figure: Figure) -> Floats:
    """The rendered figure, shape (height, width, 4)."""
    buffer = BytesIO()
    figure.savefig(buffer, format="png")
    buffer.seek(0)
    return np.asarray(imread(buffer))


def texts_of(figure: Figure) -> list[str]:
    """What is written on a sheet of panels."""
    return [text.get_text() for text in figure.axes[0].texts]


def heights_of(figure: Figure) -> list[tuple[str, float]]:
    """What is written on a sheet of panels, and how high above its lower edge, inch."""
    return [(text.get_text(), text.get_position()[1]) for text in figure.axes[0].texts]


def boxes_of(figure: Figure) -> list[Floats]:
    """Lower left and upper right corners of a sheet's panels, inch, each of shape (2, 2)."""
    frames: Any = figure.axes[0].collections[-1]
    return [segment[[0, 2]] for segment in frames.get_segments() if len(segment) == 5]


def colour_at(figure: Figure, place: Floats) -> Floats:
    """The colour of a sheet's images at a place in inches."""
    (artist,) = (a for a in figure.axes[0].artists if isinstance(a, Images))
    for (left, bottom, *size), colours in artist.images:
        share = (place - (left, bottom)) / size
        if np.all((share >= 0.0) & (share < 1.0)):
            column, row = (share * colours.shape[1::-1]).astype(int)
            return np.asarray(colours)[row, column] / 255.0
    raise AssertionError(place)


def values(ax: Any) -> Any:
    """The masked array of an axis's image."""
    return ax.images[0].get_array()


class Page(HTMLParser):
    """Tags, images and text of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.links: list[str] = []
        self.alternatives: list[str] = []
        self.text = ""
        self.open: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.links += [value or "" for name, value in attrs if name in ("src", "href")]
        self.alternatives += [value or "" for name, value in attrs if name == "alt"]
        if tag not in ("meta", "img", "br"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag
        self.text += " " if tag in ("td", "th") else ""

    def handle_data(self, data: str) -> None:
        self.text += data


def fitted(posterior: Any, params: Floats) -> FittedFrame:
    return FittedFrame.at(posterior, params)


def figures_of(
    chain: Any, posterior: Any, frame: FittedFrame | None = None, **options: Any
) -> tuple[Diagnostics, list[PageFigure]]:
    """A verdict with residuals, and all figures of a page."""
    params, width = chain.estimate.params, chain.draws().std(axis=0)
    real = Posterior(posterior.model, posterior.counts)
    residuals = judge_residuals(real, params[:5], np.diag(width[:5] ** 2))
    diagnostics = replace(diagnose(chain), residuals=residuals)
    frame = frame or fitted(posterior, params)
    field, _ = field_of(Detector((61, 81)), 0.02)
    picture = png(overview(frame, chain.draws(), posterior.parameters))
    return diagnostics, page_figures(frame, chain, diagnostics, field, picture=picture, **options)


def report(tmp_path: Path, *, truth: Floats | None = None, **changes: Any) -> tuple[str, Page]:
    """A page, without figures unless they are given."""
    chain = changes.get("chain") or run()[0]
    diagnostics = changes.get("diagnostics") or diagnose(chain, target_ess=500.0)
    fields = {
        "chain": chain,
        "summary": summary(chain, truth=truth, columns=diagnostics.columns),
        "diagnostics": diagnostics,
    }
    path = write_report(tmp_path / "report.html", **(fields | changes))
    text = path.read_text(encoding="utf-8")
    return text, Page(text)


def test_page_stands_alone_and_is_well_formed(tmp_path: Path) -> None:
    chain, posterior = run()
    truth = np.append(TRUTH, BACKGROUND)
    _, figures = figures_of(chain, posterior, shown=(0, 1, 3), truth=truth)
    text, page = report(tmp_path, truth=truth, chain=chain, figures=figures)
    assert not page.open
    assert "script" not in page.tags and "link" not in page.tags
    images = [link for link in page.links if link.startswith("data:image/png;base64,")]
    assert len(images) == 7 and all(link[0] == "#" for link in set(page.links) - set(images))
    assert all(f'id="{link[1:]}"' in text for link in page.links if link[0] == "#")
    assert "http:" not in text and "https:" not in text
    assert "url(" not in re.sub(r"data:image/png;base64,[^\"]*", "", text)
    for link in images:
        image = imread(BytesIO(base64.b64decode(link.split(",")[1])))
        assert image.shape[0] > 200 and image.shape[1] > 400 and image.std() > 0.02
    assert [p.name for p in tmp_path.iterdir()] == ["report.html"]


def test_alternative_texts_say_what_is_seen(tmp_path: Path) -> None:
    """The numbers in them are those of the frame and of the draws."""
    chain, posterior = run()
    chain.chain[..., 1] = chain.chain[..., 0] * 2.0  # a correlation of 1
    frame = fitted(posterior, chain.estimate.params)
    _, figures = figures_of(chain, posterior, shown=(0, 1, 3))
    _, page = report(tmp_path, chain=chain, figures=figures)
    residual = frame.residual()[frame.mask]
    field, seen, stars, residuals, pairs, others, trace = page.alternatives
    assert field.startswith("Displacement: rms ")
    assert "Of 9 sources 0 do not fit." in residuals
    assert f"{frame.counts[frame.mask].max():.0f} counts" in seen
    assert f"{residual.max():.1f} standard deviations" in seen
    assert f"{100 * np.mean(np.abs(residual) > 3):.2f} % of {residual.size} pixels" in seen
    assert stars == "Counts, model and residual side by side around 9 sources in the frame."
    assert pairs.endswith("The strongest correlation is +1.00, of f_ux and f_ux2.")
    assert others.startswith("Histograms of 2 parameters with their priors. At most a posterior is")
    assert others.endswith("as its prior, that of background.")
    assert trace.startswith("Traces and rank histograms of 5 parameters: 4 ensembles of 32 walkers")


def test_residual_of_a_frame_without_pixels_is_described() -> None:
    ones = np.ones((2, 2))
    assert described_residual(FittedFrame(ones, ones, ones, ones > 1)) == "No pixel is used."


def test_page_lists_causes(tmp_path: Path) -> None:
    chain, _ = run()
    found = diagnose(chain)
    cause = bf.Cause("PSF", 0.6, "it is too <wide>", "fit its width")
    text, page = report(tmp_path, chain=chain, diagnostics=replace(found, causes=(cause,)))
    assert "PSF (60% of the misfit): it is too <wide>. Remedy: fit its width." in page.text
    assert text.index('class="verdict') < text.index("it is too") < text.index("<table")


def test_page_says_what_it_must(tmp_path: Path) -> None:
    chain, _ = run()
    chain.record = RunRecord(
        "Night 3",
        "sky.fits",
        "[sampling]\nseed = 7",
        ("Seen at dusk.",),
        made="2026-11-22T04:00:17+00:00",
    )
    truth = np.append(TRUTH, BACKGROUND)
    text, page = report(tmp_path, chain=chain, truth=truth, result="The field is curved.")
    for words in (
        "trustworthy: The model fits the counts", "Sampled well: R-hat at most", "truth",
        "ESS bulk", "Pearson", "deviance", "Seen at dusk.", "[sampling]\nseed = 7", "numpy 2.0",
        "4 ensembles of 32 walkers", "chains/a & b.h5", "Prior-dominated: none.",
    ):  # fmt: skip
        assert words in page.text
    assert 'class="verdict good"' in text
    what = (
        "sky.fits, 61 × 81 pixels, 9 sources of fixed flux, Gaussian PSF, distortion of 4 terms, "
        "Poisson noise"
    )
    made = "2026-11-22 04:00 UTC, bayesfred 0.1"
    assert f"<title>Night 3: {what}; {made}</title>" in text
    order = ["Night 3", what, made, "The field is curved.", "trustworthy: ", "Parameters"]
    order += ["Goodness of fit", "Sampling", "Provenance", "Settings", "Notes"]
    body = page.text[page.text.rindex("}") :]  # after the styles
    places = [body.index(words) for words in order]
    assert places == sorted(places)
    # uncertainty to two digits, value to the same place, in one power of ten
    assert re.search(r"10−6 px−1\s+3\.00\s+3\.00\s+(3\.0\d|2\.9\d)\s+0\.12\s", page.text)
    assert re.search(r"background\s+counts\s+5\.000\s+5\.000\s+[45]\.\d{3}\s+0\.03\d\s", page.text)


def test_page_names_what_the_prior_dominates(tmp_path: Path) -> None:
    chain, posterior = run()
    prior = norm(TRUTH[1] - 2e-7, 2e-7)
    posterior.log_prior = lambda draws: prior.logpdf(draws[:, 1])
    diagnostics = diagnose(chain)
    _, page = report(tmp_path, chain=chain, diagnostics=diagnostics)
    assert diagnostics.prior_dominated == (chain.parameter_names[1],)
    assert "Prior-dominated: fux2." in page.text
    assert f"{diagnostics.prior_sensitivity[chain.parameter_names[1]]:.3f}" in page.text


def test_page_without_truth_or_notes(tmp_path: Path) -> None:
    chain, _ = run()
    chain.record = None
    _, page = report(tmp_path, chain=chain)
    assert "truth" not in page.text.split("Parameters")[1]
    assert "Notes" not in page.text and "Settings" not in page.text
    assert "report: frame, 61 × 81 pixels" in page.text and "UTC" not in page.text
    chain.record = RunRecord()  # of a caller who gave nothing
    assert "report: frame, 61 × 81 pixels" in report(tmp_path, chain=chain)[1].text


def test_page_of_a_badly_sampled_chain_says_why(tmp_path: Path) -> None:
    chain, _ = run()
    chain.chain[0] += 1e-7
    text, page = report(tmp_path, chain=chain)
    assert "not trustworthy: The model fits" in page.text and 'class="verdict bad"' in text
    assert "Not sampled well: R-hat" in page.text


def test_page_of_a_misfit_says_so_first(tmp_path: Path) -> None:
    chain, posterior = run()
    posterior.counts[8:12, 6:10] += 30.0
    text, page = report(tmp_path, chain=chain)
    assert "not trustworthy: The model does not fit the counts" in page.text
    assert "Sampled well: R-hat" in page.text and 'class="verdict bad"' in text


def test_everything_a_user_writes_is_escaped(tmp_path: Path) -> None:
    evil = "<script>alert(1)</script>\u202egnp"
    chain, _ = run((evil,))
    chain.version_history = f"{evil} {evil}"
    chain.path = Path(evil)
    chain.record = RunRecord(evil, evil, f"{evil}\n{evil}", (evil,))
    text, page = report(tmp_path, chain=chain, result=evil)
    assert "<script" not in text and "\u202e" not in text
    assert page.text.count(evil.replace("\u202e", r"\u202e")) >= 10
    assert "script" not in page.tags


def test_failed_write_leaves_the_old_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "report.html").write_text("old page")

    def fail(*_: object) -> None:
        raise OSError("disk full")

    monkeypatch.setattr("os.replace", fail)
    with pytest.raises(InputError, match=r"report\.html: cannot be written \(disk full\)"):
        report(tmp_path, result="Another")
    assert (tmp_path / "report.html").read_text() == "old page"
    assert [p.name for p in tmp_path.iterdir()] == ["report.html"]


# --- the table of parameters ----------------------------------------------------------------------


def shown(table: Any) -> list[list[str]]:
    """The cells of a table for the terminal, row by row."""
    return [list(row) for row in zip(*(column.cells for column in table.columns), strict=True)]


def test_screen_page_and_summary_show_the_same_numbers(tmp_path: Path) -> None:
    """Every number of the summary, to the digits that are shown, is on the screen and the page."""
    chain, _ = run()
    truth = np.append(TRUTH, BACKGROUND) + 1e-8
    diagnostics = diagnose(chain)
    table = summary(chain, truth=truth, columns=diagnostics.columns)
    # the numbers themselves
    draws = chain.draws()
    np.testing.assert_array_equal(table["mean"], draws.mean(axis=0))
    np.testing.assert_array_equal(table["sd"], draws.std(axis=0, ddof=1))
    np.testing.assert_allclose(table["z"], (table["mean"] - truth) / table["sd"])
    assert table["name"].tolist() == list(chain.parameter_names)
    assert table["unit"].tolist() == ["px^-1", "px^-2", "px^-1", "px^-2", "counts"]
    # u x, u x^2, v y and v y^2 in the corner of a frame of 61 x 81 pixels; no counts displace
    size = np.array([40.5**2, 40.5**3, 30.5**2, 30.5**3, np.nan])
    np.testing.assert_allclose(table["corner"], size * table["mean"], rtol=1e-12)
    np.testing.assert_allclose(table["corner_sd"], size * table["sd"], rtol=1e-12)

    _, page = report(tmp_path, truth=truth, chain=chain, diagnostics=diagnostics)
    body = page.text.replace("−", "-")
    rows = zip(table, shown(parameter_table(table, 200)), strict=True)
    for values, (name, true, estimate, posterior, z, corner, rhat, ess, prior) in rows:
        assert name == values["name"]
        mean, _, sd, *power = posterior.split()
        scale = float(f"1{power[0]}" if power else 1)
        for cell, key in ((true, "truth"), (estimate, "MAP"), (mean, "mean"), (sd, "sd")):
            number = cell.split()[0]
            assert abs(float(number) * scale - values[key]) <= 0.06 * values["sd"], key
            assert f" {number} " in f" {body} "
        assert float(z) == pytest.approx(values["z"], abs=0.006) and f" {z} " in body
        if name == "background":
            assert corner == ""
        else:
            size, _, error, *power = corner.split()
            scale = float(f"1{power[0]}" if power else 1)
            assert abs(float(size) * scale - values["corner"]) <= 0.06 * values["corner_sd"]
            assert f" {size} ± {error} " in f" {body} "
        assert float(rhat) == pytest.approx(values["rhat"], abs=6e-4)
        assert float(ess) == round(min(values["ess_bulk"], values["ess_tail"])) and ess in body
        assert float(prior) == pytest.approx(values["prior_sensitivity"], abs=6e-4)
        assert f" {prior} " in body


def test_summary_of_a_chain_computes_what_diagnose_says() -> None:
    chain, _ = run()
    diagnostics = diagnose(chain)
    table = summary(chain)
    numbers = ["MAP", "mean", "sd", "corner", "corner_sd", "rhat", "ess_bulk", "ess_tail"]
    assert table.colnames == ["name", "unit", *numbers]
    for key in ("rhat", "ess_bulk", "ess_tail"):
        assert table[key].tolist() == list(getattr(diagnostics, key).values())


def test_a_term_at_the_corner_is_its_largest_displacement_there() -> None:
    """A Zernike term by a naive loop over the corners; a common coefficient; an offset."""
    lens = PolynomialDistortion.radial_tangential(focal_length=100.0)
    for distortion in (PolynomialDistortion.zernike(3, radius=50.0), lens):
        model = ForwardModel(
            Detector((40, 60)), SourceCatalog.grid(3, 15.0, 500.0), GaussianPSF(2.0), distortion
        )
        posterior = Posterior(model, np.ones((40, 60)), nuisances=Nuisances(offset=True))
        draws = np.random.default_rng(1).normal(1.0, 0.1, (4, 9, 32, posterior.n_parameters))
        chain = SimpleNamespace(
            chain=draws, burn_in=0, parameter_names=posterior.parameter_names,
            draws=lambda draws=draws: draws.reshape(-1, draws.shape[-1]),
            posterior=lambda posterior=posterior: posterior, method="mcmc",
            estimate=SimpleNamespace(params=np.ones(posterior.n_parameters)),
        )  # fmt: skip
        table = summary(chain)
        for k in range(distortion.n_terms):
            unit = np.eye(distortion.n_terms)[k]
            largest = max(
                np.hypot(*distortion.displacement(unit, x, y, x, y))
                for x in (-30.0, 30.0) for y in (-20.0, 20.0)
            )  # fmt: skip
            assert table["corner"][k] == pytest.approx(largest * table["mean"][k], rel=1e-9)
        assert np.isnan(table["corner"][distortion.n_terms])  # the background
        np.testing.assert_array_equal(table["corner"][-2:], table["mean"][-2:])


@pytest.mark.parametrize(
    ("name", "label", "unit"),
    [
        ("f_ux2", r"$f_{u x^2}$ [10⁻⁶ px⁻²]", "px^-2"),
        ("g_vy", r"$g_{v y}$ [10⁻⁶ px⁻¹]", "px^-1"),
        ("background", r"background [10⁻⁶ counts]", "counts"),
        ("background_uv", r"$b_{u v}$ [10⁻⁶ counts]", "counts"),
        ("psf_sigma", r"psf sigma [10⁻⁶ px]", "px"),
        ("flux_scale", r"flux scale [10⁻⁶]", ""),
    ],
)
def test_labels_carry_power_and_unit(name: str, label: str, unit: str) -> None:
    by_name = {parameter.name: parameter for parameter in everything().parameters}
    assert axis_label(by_name[name], -6) == label
    assert unit_text(by_name[name]) == unit


def everything() -> Posterior:
    """The posterior of a frame with parameters of every kind."""
    distortion = PolynomialDistortion(((2, 0, 1, 0),), ((0, 1, 0, 1),))
    model = ForwardModel(
        Detector((9, 9)), SourceCatalog.grid(1, 1.0, 50.0), GaussianPSF(1.0), distortion
    )
    nuisances = Nuisances("scale", offset=True, psf_sigma=True, background_order=2)
    return Posterior(model, np.ones((9, 9)), nuisances=nuisances)


def test_intervals_are_quantiles_of_the_draws(tmp_path: Path) -> None:
    """Shown to two digits of the sd; a wrong level would be off by at least a quarter of it."""
    chain, _ = run()
    _, page = report(tmp_path, chain=chain)
    low, high = np.quantile(chain.draws()[:, 4], (0.16, 0.84))
    lowest, highest = np.quantile(chain.draws()[:, 4], (0.025, 0.975))
    assert f"{low:.3f} … {high:.3f} {lowest:.3f} … {highest:.3f} " in page.text


# --- figures --------------------------------------------------------------------------------------


def field_of(detector: Detector, scale: float, n: int = 25) -> tuple[Any, Any]:
    """A field that is scaled, and sources each of which is off by (0.2, -0.1) recorded pixels."""
    distortion = PolynomialDistortion(((1, 0, 0, 0),), ((0, 1, 0, 0),))
    sources = SourceCatalog.grid(round(n**0.5), 12.0, 1e3)
    model = ForwardModel(detector, sources, GaussianPSF(2.5), distortion)
    posterior = Posterior(model, model.expected_counts([scale, scale], 1.0))
    drawn = np.random.default_rng(1).normal([scale, scale, 1.0], 1e-3, (50, 3))
    chain: Any = SimpleNamespace(
        posterior=lambda: posterior, draws=lambda: drawn,
        estimate=SimpleNamespace(params=np.array([scale, scale, 1.0])),
    )  # fmt: skip
    u, v = (p * (1.0 - scale) / detector.binning for p in (sources.x, sources.y))
    ones = np.ones(len(sources))
    columns = {"u": u, "v": v, "du": 0.2 * ones, "dv": -0.1 * ones, "du_sd": ones, "dv_sd": ones}
    return displacement_field(chain), make_table(columns)


@pytest.mark.parametrize("binning", [1, 2])
def test_displacements_are_shown_at_the_stated_scale(binning: int) -> None:
    field, sources = field_of(Detector((61, 81), binning=binning), 0.02)
    above, below = field_plot(field, sources, binning).axes
    unit = "px" if binning == 1 else "fine px"
    assert above.get_xlabel() == f"u / {unit}"
    arrows = next(c for c in above.collections if isinstance(c, Quiver))
    ellipses = [c for c in above.collections if isinstance(c, EllipseCollection)]
    assert arrows.N == 11 * 9
    enlarged = {
        word: float(re.search(rf"{word}.* ([\d,]+) times enlarged", title)[1].replace(",", ""))  # type: ignore[index]
        for title, words in (
            (above.get_title("left"), ("arrows", "ellipses")), (below.get_title("left"), ("off",)),
        )
        for word in words
    }  # fmt: skip
    grid = np.stack([field.points.u, field.points.v], axis=-1)[::2, ::2].reshape(-1, 2)
    shown = field.displacement[::2, ::2].reshape(-1, 2)
    assert pytest.approx(grid) == arrows.XY
    assert np.stack([arrows.U, arrows.V], axis=1) == pytest.approx(enlarged["arrows"] * shown)
    # half of each axis is one standard deviation, enlarged; those of the hull come first, and
    # beyond it those that would cover more than their neighbours are left out
    spacing = grid[1, 0] - grid[0, 0]
    values = np.linalg.eigvalsh(field.covariance[::2, ::2].reshape(-1, 2, 2))
    inside = field.points.inside[::2, ::2].ravel()
    for some, c in zip((inside, ~inside), ellipses, strict=True):
        widths = 2.0 * enlarged["ellipses"] * np.sqrt(np.maximum(values[some], 0.0))
        kept = widths[:, 1] < 1.5 * spacing
        assert c.get_widths() == pytest.approx(widths[kept, 1]) and kept.any()
        assert c.get_heights() == pytest.approx(widths[kept, 0])
    arrows = next(c for c in below.collections if isinstance(c, Quiver))
    assert binning * 0.2 * enlarged["off"] == pytest.approx(arrows.U[0])
    assert "0 of 25 by more than 3" in below.get_title("left")
    assert np.array_equal(arrows.XY[:, 0], binning * np.asarray(sources["u"]))


@pytest.mark.parametrize(("scatter", "noise"), [(0.3, 1e-3), (1e-3, 0.1), (0.1, 0.1)])
def test_sources_off_the_model_are_told_from_positions_that_scatter(
    scatter: float, noise: float
) -> None:
    """By Student's t, as by normal noise, 1.1 % are off: of 4,000 sources 44 +- 6.6.

    Negative control: of a scatter that is not counted eight times as many.
    """
    field, sources = field_of(Detector((401, 401)), 0.0, 400)
    rng, far = np.random.default_rng(3), {scatter: 0, 0.0: 0}
    for _ in range(10):
        moved = scatter * rng.normal(size=(2, 400)) / np.sqrt(rng.chisquare(3, 400) / 3.0)
        moved += noise * rng.normal(size=(2, 400))
        for name, column in zip(("du", "dv"), moved, strict=True):
            sources[name][:], sources[f"{name}_sd"][:] = column, noise
        for told in far:
            title = field_plot(field, sources, 1, told).axes[1].get_title("left")
            assert ("3 sd and their scatter (orange), 4 by" in title) == (told > 0.0)
            far[told] += int(re.search(r"\n(\d+) of 400", title)[1])  # type: ignore[index]
    assert abs(far[scatter] - 44) < 4 * 6.6
    assert scatter < noise or far[0.0] > 8 * 44


@pytest.mark.parametrize("shape", [(1, 1), (1, 200), (150, 10)])
@pytest.mark.parametrize("scale", [0.0, 0.02, 1.0])
def test_any_field_is_shown(shape: tuple[int, int], scale: float) -> None:
    """Nothing displaced, nothing imaged (a scale of 1), one source, frames that are lines."""
    field, sources = field_of(Detector(shape), scale, 1)
    for known in (sources, sources[:0]):
        assert pixels(field_plot(field, known)).std() > 0.02
    sources["du"][0] = np.nan
    assert pixels(field_plot(field, sources)).std() > 0.02


def test_page_begins_with_the_displacement(tmp_path: Path) -> None:
    field, _ = field_of(Detector((61, 81)), 0.02)
    chain, posterior = run()
    _, figures = figures_of(chain, posterior, shown=range(5))
    assert figures[0].heading == "Displacement"
    _, page = report(tmp_path, chain=chain, figures=figures, result=field.message)
    verdict, rest = page.text.split("Parameters")[0], page.text.split("Parameters")[1]
    assert field.message in verdict and field.message not in rest


def test_corner_marks_truth_and_estimate_and_states_its_powers() -> None:
    chain, _ = run()
    truth = np.append(TRUTH, BACKGROUND)
    figure = corner_plot(
        chain.draws(),
        described(*chain.parameter_names),
        truth=truth,
        estimate=chain.estimate.params,
    )
    assert len(boxes_of(figure)) == 15
    texts = texts_of(figure)
    assert {"$f_{u x^2}$\n[10⁻⁶ px⁻²]", "background\n[counts]", "truth", "MAP"} <= set(texts)
    assert "−2.0" in texts and all(len(text) < 30 for text in texts)
    assert pixels(figure).std() > 0.02


def test_a_corner_of_some_shows_the_correlations_of_all() -> None:
    """The cell of a pair that was made correlated is red, that of its opposite blue."""
    draws = np.random.default_rng(4).normal(size=(2000, 12))
    draws[:, 9] += 3.0 * draws[:, 2]
    draws[:, 11] -= 3.0 * draws[:, 0]
    parameters = described(*(f"name {k}" for k in range(12)))
    shown = corner_parameters(draws, [parameter.name for parameter in parameters])
    figure = corner_plot(draws, parameters, shown=shown)
    assert len(shown) == 8 and {0, 2, 9, 11} <= set(shown)
    boxes = boxes_of(figure)
    assert len(boxes) == 36 + 1  # and the scale of the correlations
    assert "correlations of all 12" in texts_of(figure)
    corner = np.array([text.get_position() for text in figure.axes[0].texts[-16:-4]])
    for name, colour in (("name 9", "red"), ("name 11", "blue")):
        k = {"name 9": (9, 2), "name 11": (11, 0)}[name]
        red, _, blue, _ = colour_at(figure, np.array([corner[k[1], 0], corner[k[0], 1]]))
        assert (red > blue + 0.3) if colour == "red" else (blue > red + 0.3)
    everything = corner_plot(draws, parameters)
    assert len(boxes_of(everything)) == 78 and not everything.axes[0].artists


def test_areas_hold_their_shares_of_the_draws() -> None:
    """Of two normal variables, correlated, then of a ring, whose middle is left free."""
    rng = np.random.default_rng(5)
    normal = rng.multivariate_normal([1.0, -2.0], [[1.0, 0.7], [0.7, 2.0]], 20_000)
    angle, radius = rng.uniform(0.0, 2.0 * np.pi, 20_000), rng.normal(5.0, 1.2, 20_000)
    ring = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    for draws in (normal, ring):
        figure = corner_plot(draws, described("name 0", "name 1"))
        place = boxes_of(figure)[1]
        low, high = (np.quantile(draws, q, axis=0) for q in (0.001, 0.999))
        start, size = low - 0.08 * (high - low), 1.16 * (high - low)
        points = place[0] + (draws - start) / size * (place[1] - place[0])
        areas = [c for c in figure.axes[0].collections if isinstance(c, PathCollection)]
        for alpha, share in ((1.0, 1.0 - np.exp(-0.5)), (1 / 3, np.exp(-0.5) - np.exp(-2.0))):
            (area,) = (c for c in areas if c.get_alpha() == pytest.approx(alpha))
            rings = [ring for path in area.get_paths() for ring in path.to_polygons()]
            inside = np.logical_xor.reduce(
                [Outline(ring).contains_points(points) for ring in rings]
            )
            assert np.mean(inside) == pytest.approx(share, abs=0.05)


def test_images_are_put_where_their_boxes_are() -> None:
    """Every pixel of the figure has the colour of the nearest of the image, its first row below."""
    sheet = Sheet(0.5, 0.4)
    colours = np.random.default_rng(3).integers(0, 256, (2, 3, 4)).astype(np.uint8)
    colours[..., 3] = 255
    sheet.image((0.1, 0.2, 0.3, 0.1), colours)
    seen = np.rint(255.0 * pixels(sheet.finish())).astype(int)[::-1]
    np.testing.assert_array_equal(seen[20:30, 10:40], colours.repeat(5, axis=0).repeat(10, axis=1))
    seen[20:30, 10:40] = 255
    assert np.all(seen == 255)


def test_corner_chooses_the_most_correlated_pairs() -> None:
    """Of thirty parameters, four of the six pairs that are correlated; otherwise those named."""
    draws = np.random.default_rng(4).normal(size=(2000, 30))
    for k in range(6):
        draws[:, 29 - k] += 2.0 * draws[:, k]
    draws[:, 10] = 3.0
    names = [f"p{k}" for k in range(30)]
    chosen = corner_parameters(draws, names)
    assert len(chosen) == 8 and set(chosen) <= {*range(6), *range(24, 30)}
    assert chosen[:4] == tuple(29 - k for k in chosen[:3:-1])  # both parameters of every pair
    assert corner_parameters(draws, names, ["p20", "p3"]) == (3, 20)
    assert corner_parameters(draws[:, :8], names[:8]) == tuple(range(8))
    with pytest.raises(InputError, match="corner: got p30, q, expected names among p0, p1"):
        corner_parameters(draws, names, ["p1", "p30", "q"])


@pytest.mark.parametrize("d", [1, 7, 18])
def test_marginals_have_a_panel_and_a_prior_for_each_parameter(d: int) -> None:
    rng = np.random.default_rng(6)
    parameters = described(*(f"name {k}" for k in range(d)))
    priors = {parameter.name: norm(0.0, 1.0) for parameter in parameters}
    draws, middle = rng.normal(size=(800, d)), np.zeros(d)
    draws[:, 0] = 3.0  # never moved
    figure = marginal_plot(draws, parameters, priors, truth=middle, estimate=middle)
    assert len(boxes_of(figure)) == d
    priors_shown = next(
        c.get_segments()
        for c in figure.axes[0].collections
        if isinstance(c, LineCollection) and len(c.get_segments()[0]) == 40
    )
    assert len(priors_shown) == d + 1  # and one in the legend
    posteriors = [
        c.get_segments()
        for c in figure.axes[0].collections
        if isinstance(c, LineCollection) and len(c.get_segments()[0]) == 82
    ]
    for prior, posterior in zip(priors_shown[1:-1], posteriors[0][1:-1], strict=True):
        base = posterior[0, 1]
        # as high as the histogram, which is of the prior's own draws
        assert np.ptp(prior[:, 1]) < np.max(posterior[:, 1]) - base < 2.0 * np.ptp(prior[:, 1])
    assert pixels(figure).std() > 0.02


@pytest.mark.parametrize(
    ("low", "high", "labels"),
    [
        (-3.1, 2.9, ["−2", "0", "2"]),
        (0.99999, 1.00001, ["0.999995", "1.000000", "1.000005"]),
        (0.0, 2e5, ["50000", "100000", "150000"]),
        (4.0, 4.0 + 1e-13, None),
    ],
)
def test_ticks_are_written_with_the_digits_that_they_have(
    low: float, high: float, labels: list[str] | None
) -> None:
    ticks, written = round_ticks(low, high)
    assert labels is None or written == labels
    assert np.all((low < ticks) & (ticks < high)) and len(written) == len(ticks)
    assert [float(text.replace("−", "-")) for text in written] == pytest.approx(
        ticks, abs=1e-3 * (high - low)
    )


def test_corner_of_a_parameter_that_never_moved() -> None:
    draws = np.column_stack([np.random.default_rng(2).normal(size=500), np.full(500, 3.0)])
    assert pixels(corner_plot(draws, described("f_ux", "background"))).std() > 0.01


@pytest.mark.parametrize("d", [1, 2, 3, 13])
def test_trace_has_a_panel_for_every_parameter(d: int) -> None:
    rng = np.random.default_rng(3)
    chain: Any = SimpleNamespace(
        chain=rng.normal(size=(3, 6, 8, d)),
        parameter_names=("f_ux", "f_ux2", "g_vy", "g_vy2", *(f"name {k}" for k in range(9)))[:d],
        burn_in=1,
    )
    figure = trace_plot(chain, described(*chain.parameter_names))
    assert len(boxes_of(figure)) == 2 * d
    labels = {text.split("\n")[0] for text in texts_of(figure)}
    assert "$f_{u x}$" in labels
    assert {math_symbol(parameter) for parameter in described(*chain.parameter_names)} <= labels
    pixels(figure)


@pytest.mark.parametrize("shape", [(505, 505), (768, 1024)])
def test_triptych_axes_count_pixels_from_the_middle(shape: tuple[int, int]) -> None:
    ny, nx = shape
    expected = np.full(shape, 4.0)
    mask, middle = np.zeros(shape, bool), np.zeros(shape, bool)
    mask[ny // 4 - 6 : ny // 4 + 7, nx // 4 - 6 : nx // 4 + 7] = True
    middle[ny // 4 - 3 : ny // 4 + 4, nx // 4 - 3 : nx // 4 + 4] = True
    expected[middle] = 4000.0
    counts = np.random.default_rng(4).poisson(expected).astype(float)
    counts[middle] = 4000.0 + 4.0 * np.sqrt(4000.0)
    # not the root of the counts: the noise model's word is taken
    fitted = FittedFrame(counts, expected, 2.0 * np.sqrt(expected), mask)
    figure = overview(fitted, np.zeros((2, 1)), described("f_ux"))
    boxes = boxes_of(figure)
    frame, model, residual, *_ = boxes
    for box in boxes[:3]:
        width, height = box[1] - box[0]
        assert height / width == pytest.approx(ny / nx)
    bar = next(box for box in boxes[3:] if box[0, 0] > residual[1, 0])
    star = (np.array([nx // 4, ny // 4]) + 0.5) / (nx, ny)
    scale = bar[0] + (0.5, 0.7) * (bar[1] - bar[0])  # two standard deviations
    shown, masked = (residual[0] + at * (residual[1] - residual[0]) for at in (star, 0.5))
    np.testing.assert_allclose(colour_at(figure, shown), colour_at(figure, scale), atol=0.02)
    assert colour_at(figure, masked) == pytest.approx(to_rgba(MASKED), abs=0.01)
    dark, light = (colour_at(figure, model[0] + at * (model[1] - model[0])) for at in (star, 0.5))
    assert dark[0] < 0.1 and light[0] > 0.8  # of one scale
    assert colour_at(figure, frame[0] + star * (frame[1] - frame[0]))[0] < 0.1
    # a tick at 100 pixels to the right of the middle, or 200 in the larger frame
    value = "100" if nx < 600 else "200"
    texts = [text for text in figure.axes[0].texts if text.get_text() == value]
    across = frame[0, 0] + (0.5 + int(value) / nx) * (frame[1, 0] - frame[0, 0])
    assert across in [pytest.approx(text.get_position()[0]) for text in texts]
    pixels(figure)


def test_star_panels_show_the_brightest_inside_the_frame() -> None:
    expected = np.ones((40, 60))
    expected[10, 20], expected[39, 59] = 100.0, 50.0
    u, v = np.array([20, 59, 5, 500, np.nan]) - 29.5, np.array([10, 39, 5, 0, 0]) - 19.5
    everywhere = np.ones(expected.shape, bool)
    frame = FittedFrame(expected + 3.0, expected, expected**0.5, everywhere)
    figure = star_panels(frame, u, v, half_width=3)
    *boxes, scale = boxes_of(figure)
    assert len(boxes) == 9
    places = [text for text in texts_of(figure) if "," in text]
    assert places[:2] == ["−10, −10", "+30, +20"]

    def residual_shown(box: Floats, across: float, up: float) -> float:
        """Where the colour of a place in a panel is on the scale."""
        seen = colour_at(figure, box[0] + [across, up] * (box[1] - box[0]))
        heights = np.linspace(*scale[:, 1], 199)[1:-1]
        middle = scale[:, 0].mean()
        colours = np.array([colour_at(figure, np.array([middle, y])) for y in heights])
        return -5.0 + 10.0 * float(np.argmin(np.abs(colours - seen).sum(axis=1))) / 196.0

    assert residual_shown(boxes[2], 0.5, 0.5) == pytest.approx(0.3, abs=0.1)
    assert residual_shown(boxes[2], 0.05, 0.05) == pytest.approx(3.0, abs=0.1)
    # beyond the frame
    assert colour_at(figure, boxes[3][1] - 0.05) == pytest.approx(to_rgba(MASKED), abs=0.01)
    assert colour_at(figure, boxes[3][0] + 0.05) != pytest.approx(to_rgba(MASKED), abs=0.01)
    pixels(figure)


def test_masked_sources_are_the_last_among_the_brightest() -> None:
    expected = np.ones((40, 60))
    expected[10, 20], expected[30, 40] = 100.0, 50.0
    u, v = np.array([20, 40]) - 29.5, np.array([10, 30]) - 19.5
    mask = np.ones(expected.shape, bool)
    mask[5:16, 15:26] = False
    frame = FittedFrame(expected, expected, expected**0.5, mask)
    places = [text for text in texts_of(star_panels(frame, u, v, half_width=3)) if "," in text]
    assert places == ["+10, +10", "−10, −10"]


def test_star_panels_show_at_most_24_and_survive_none() -> None:
    ones = np.ones((50, 50))
    frame = FittedFrame(ones, ones, ones, ones > 0)
    rng = np.random.default_rng(5)
    u, v = rng.uniform(-20, 20, (2, 40))
    many = star_panels(frame, u, v, half_width=2)
    assert sum("," in text for text in texts_of(many)) == 24
    none = star_panels(frame, u + 100, v, half_width=2)
    assert "no source" in texts_of(none)[0]


@pytest.mark.parametrize("shape", [(1, 4000), (4000, 1), (1, 1)])
def test_strips_of_a_frame_make_pictures_of_a_usual_size(shape: tuple[int, int]) -> None:
    four = np.full(shape, 4.0)
    frame = FittedFrame(four, four, four**0.5, four > 0)
    draws = np.random.default_rng(5).normal(size=(100, 2))
    height, width, _ = pixels(overview(frame, draws, described("f_ux", "background"))).shape
    assert 0.1 < height / width < 1.2


@pytest.mark.parametrize("with_truth", [True, False])
def test_overview_shows_frame_and_marginals(with_truth: bool) -> None:
    chain, posterior = run()
    truth = np.append(TRUTH, BACKGROUND) if with_truth else None
    frame = fitted(posterior, chain.estimate.params)
    figure = overview(frame, chain.draws(), posterior.parameters, truth=truth)
    number = 5 if with_truth else 4
    texts = texts_of(figure)
    assert sum(text.count("±") for text in texts) == number
    assert f"{'(posterior mean − truth)' if with_truth else 'posterior mean'} / sd" in texts
    draws = chain.draws()[:, :number]
    z = (draws.mean(axis=0) - (TRUTH if number == 4 else truth) * with_truth) / draws.std(axis=0)
    (points,) = figure.axes[0].lines
    low, high = boxes_of(figure)[-1][:, 1]
    ticks = {text: height for text, height in heights_of(figure) if low < height < high}
    zero, two = ticks["0"], ticks["10" if "10" in ticks else "2"]
    if with_truth:
        expected = zero + z * (two - zero) / 2.0
    else:  # logarithmic beyond three
        far = np.log10(np.maximum(np.abs(z), 3.0) / 3.0)
        expected = zero + np.sign(z) * (np.minimum(np.abs(z), 3.0) + 2.7 * far) * (
            (two - zero) / (3.0 + 2.7 * np.log10(10.0 / 3.0))
        )
    np.testing.assert_allclose(points.get_ydata(), expected, atol=2e-3)
    pixels(figure)


@pytest.mark.parametrize("size", [(7.0, 3.3), (1.0 / 3.0, 2.7182818), (5.25, 4.9999)])
def test_figures_of_any_size_are_embedded(size: tuple[float, float]) -> None:
    """A size that is no whole number of pixels is rounded as the renderer rounds it."""
    image = embedded(png(Figure(figsize=size)))
    assert abs(image.width - 100 * size[0]) <= 1 and abs(image.height - 100 * size[1]) <= 1
