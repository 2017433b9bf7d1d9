"""The page and its figures: what they say, that they stand alone, that nothing a user writes is markup."""

import base64
import re
from html.parser import HTMLParser
from io import BytesIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.image import imread
from numpy.typing import NDArray
from scipy.stats import norm

from bayesfred.analysis.diagnostics import diagnose
from bayesfred.imaging.catalog import SourceCatalog
from bayesfred.imaging.detector import Detector
from bayesfred.imaging.distortion import PolynomialDistortion
from bayesfred.imaging.forward import ForwardModel
from bayesfred.imaging.psf import GaussianPSF
from bayesfred.model.noise import PoissonNoise
from bayesfred.model.posterior import Nuisances
from bayesfred.reporting import plots
from bayesfred.reporting.html import write_report

Floats = NDArray[np.float64]

TRUTH = np.array([0.0, -2.0, 3.0, 1.0]) * 1e-6
BACKGROUND = 5.0


def run(names_extra: tuple[str, ...] = ()) -> tuple[Any, Any]:
    """A chain of independent draws around the truth and its posterior: the attributes the report reads."""
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
        counts=counts,
        mask=mask,
        parameter_names=names,
        n_parameters=len(names),
        noise=PoissonNoise(),
        nuisances=Nuisances(),
        model=model,
        log_prior=lambda draws: np.zeros(len(draws)),
        expected_counts=lambda params: model.expected_counts(params[:4], params[4]),
        sigma=lambda params: model.expected_counts(params[:4], params[4]) ** 0.5,
    )
    estimate = SimpleNamespace(
        params=centre, at_maximum=True, message="gradient <small>", n_evaluations=9
    )
    fields = {
        "path": Path("chains/a & b.h5"),
        "parameter_names": names,
        "chain": chain,
        "log_prob": np.zeros(chain.shape[:3]),
        "accepted": np.full((4, 32), 10),
        "burn_in": 2,
        "seed": 7,
        "estimate": estimate,
        "versions": {"numpy": "2.0", "bayesfred": "0.1"},
        "draws": lambda: chain[:, 2:].reshape(-1, len(names)),
        "posterior": lambda: posterior,
    }
    return SimpleNamespace(**fields), posterior


def pixels(figure: Figure) -> Floats:
    """The rendered figure, shape (height, width, 4)."""
    buffer = BytesIO()
    figure.savefig(buffer, format="png")
    buffer.seek(0)
    return np.asarray(imread(buffer))


def values(ax: Any) -> Any:
    """The masked array of an axis's image."""
    return ax.images[0].get_array()


class Page(HTMLParser):
    """Tags, images and text of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.links: list[str] = []
        self.text = ""
        self.open: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.links += [value or "" for name, value in attrs if name in ("src", "href")]
        if tag not in ("meta", "img", "br"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag
        self.text += " " if tag == "td" else ""

    def handle_data(self, data: str) -> None:
        self.text += data


def report(tmp_path: Path, **changes: Any) -> tuple[str, Page]:
    chain, posterior = run()
    fields = {
        "title": "A frame",
        "chain": chain,
        "diagnostics": diagnose(chain, target_ess=500.0),
        "posterior": posterior,
    }
    path = write_report(tmp_path / "report.html", **(fields | changes))
    text = path.read_text(encoding="utf-8")
    return text, Page(text)


def test_page_stands_alone_and_is_well_formed(tmp_path: Path) -> None:
    text, page = report(tmp_path, truth=np.append(TRUTH, BACKGROUND))
    assert not page.open
    assert "script" not in page.tags and "link" not in page.tags
    assert len(page.links) == 4 and all(
        link.startswith("data:image/png;base64,") for link in page.links
    )
    assert "http" not in re.sub(r"data:image/png;base64,[^\"]*", "", text)
    for link in page.links:
        image = imread(BytesIO(base64.b64decode(link.split(",")[1])))
        assert image.shape[0] > 200 and image.shape[1] > 400 and image.std() > 0.02
    assert [p.name for p in tmp_path.iterdir()] == ["report.html"]


def test_page_says_what_it_must(tmp_path: Path) -> None:
    _, page = report(
        tmp_path,
        truth=np.append(TRUTH, BACKGROUND),
        notes=["Seen at dusk."],
        settings='{"seed": 7}',
    )
    for words in ("converged: R-hat at "
                  "most", "truth", "ESS bulk", "Pearson", "Deviance", "Seen at dusk.",
                  '{"seed": 7}', "numpy 2.0", "4 ensembles of 32 walkers", "chains/a & b.h5",
                  "Prior-dominated: none."):  # fmt: skip
        assert words in page.text
    # uncertainty to two digits, value to the same place, in one power of ten
    assert re.search(r"10−6 px−1\s+3\.00\s+3\.00\s+(3\.0\d|2\.9\d)\s+0\.12\s", page.text)
    assert re.search(r"background\s+counts\s+5\.000\s+5\.000\s+[45]\.\d{3}\s+0\.03\d\s", page.text)


def test_page_names_what_the_prior_dominates(tmp_path: Path) -> None:
    chain, posterior = run()
    prior = norm(TRUTH[1] - 2e-7, 2e-7)
    posterior.log_prior = lambda draws: prior.logpdf(draws[:, 1])
    diagnostics = diagnose(chain)
    _, page = report(tmp_path, diagnostics=diagnostics)
    assert diagnostics.prior_dominated == (chain.parameter_names[1],)
    assert "Prior-dominated: fux2." in page.text
    assert f"{diagnostics.prior_sensitivity[chain.parameter_names[1]]:.3f}" in page.text


def test_page_without_truth_or_notes(tmp_path: Path) -> None:
    _, page = report(tmp_path)
    assert "truth" not in page.text and "Notes" not in page.text and "Settings" not in page.text


def test_page_of_an_unconverged_chain_says_why(tmp_path: Path) -> None:
    chain, _ = run()
    chain.chain[0] += 1e-7
    text, page = report(tmp_path, chain=chain, diagnostics=diagnose(chain))
    assert "not converged: R-hat" in page.text and 'class="verdict bad"' in text


def test_everything_a_user_writes_is_escaped(tmp_path: Path) -> None:
    evil = "<script>alert(1)</script>"
    chain, posterior = run((evil,))
    chain.versions[evil] = evil
    chain.path = Path(evil)
    text, page = report(
        tmp_path,
        title=evil,
        chain=chain,
        posterior=posterior,
        diagnostics=diagnose(chain),
        notes=[evil],
        settings=evil,
    )
    assert "<script" not in text
    assert page.text.count(evil) >= 6
    assert "script" not in page.tags


def test_failed_write_leaves_the_old_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "report.html").write_text("old page")

    def fail(*_: object) -> None:
        raise OSError("disk full")

    monkeypatch.setattr("os.replace", fail)
    with pytest.raises(OSError, match="disk full"):
        report(tmp_path, title="Another")
    assert (tmp_path / "report.html").read_text() == "old page"
    assert [p.name for p in tmp_path.iterdir()] == ["report.html"]


@pytest.mark.parametrize(
    ("name", "label"),
    [
        ("f_ux2", r"$f_{u x^2}$ [$10^{-6}$ px$^{-2}$]"),
        ("g_vy", r"$g_{v y}$ [$10^{-6}$ px$^{-1}$]"),
        ("background", r"background [$10^{-6}$ counts]"),
        ("background_uv", r"$b_{u v}$ [$10^{-6}$ counts]"),
        ("psf_sigma", r"psf sigma [$10^{-6}$ px]"),
        ("flux_scale", r"flux scale [$10^{-6}$]"),
    ],
)
def test_labels_carry_power_and_unit(name: str, label: str) -> None:
    assert plots._label(name, -6) == label


def test_corner_marks_truth_and_estimate_and_states_its_powers() -> None:
    chain, _ = run()
    truth = np.append(TRUTH, BACKGROUND)
    figure = plots.corner_plot(
        chain.draws(), chain.parameter_names, truth=truth, estimate=chain.estimate.params
    )
    assert len(figure.axes) == 25
    assert "10^{-6}" in figure.axes[-4].get_xlabel()
    assert "background" in figure.axes[-1].get_xlabel()
    low, high = figure.axes[-4].get_xlim()
    assert low < -2.0 < high and high - low < 2.0
    assert all(len(axis.get_ticklocs()) <= 4 for ax in figure.axes for axis in (ax.xaxis, ax.yaxis))
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["truth", "MAP"]
    assert pixels(figure).std() > 0.02


def test_corner_of_a_parameter_that_never_moved() -> None:
    draws = np.column_stack([np.random.default_rng(2).normal(size=500), np.full(500, 3.0)])
    assert pixels(plots.corner_plot(draws, ("f_ux", "background"))).std() > 0.01


@pytest.mark.parametrize("d", [1, 2, 3, 13])
def test_trace_has_a_panel_for_every_parameter(d: int) -> None:
    rng = np.random.default_rng(3)
    chain: Any = SimpleNamespace(
        chain=rng.normal(size=(3, 6, 8, d)),
        parameter_names=tuple(f"f_u{k + 1}x" for k in range(d)),
        burn_in=1,
    )
    figure = plots.trace_plot(chain)
    shown = [ax for ax in figure.axes if ax.get_visible()]
    assert len(shown) == 2 * d
    assert sum("f_{" in ax.get_ylabel() for ax in shown) == d
    pixels(figure)


@pytest.mark.parametrize("shape", [(505, 505), (768, 1024)])
def test_triptych_axes_count_pixels_from_the_middle(shape: tuple[int, int]) -> None:
    ny, nx = shape
    expected = np.full(shape, 4.0)
    expected[ny // 4, nx // 4] = 4000.0
    counts = np.random.default_rng(4).poisson(expected).astype(float)
    mask = np.zeros(shape, bool)
    mask[ny // 4 - 3 : ny // 4 + 4, nx // 4 - 3 : nx // 4 + 4] = True
    # not the root of the counts: the noise model's word is taken
    figure = plots.frame_triptych(counts, expected, 2.0 * np.sqrt(expected), mask)
    frame, model, residual = figure.axes[:3]
    for ax in (frame, model, residual):
        assert ax.get_xlim() == (-nx / 2, nx / 2) and ax.get_ylim() == (-ny / 2, ny / 2)
        assert ax.get_aspect() == 1.0
    assert frame.images[0].norm is model.images[0].norm
    assert residual.images[0].get_clim() == (-5.0, 5.0)
    shown = values(residual)
    assert np.ma.count(shown) == mask.sum()
    assert float(shown[ny // 4, nx // 4]) == pytest.approx(
        float((counts - expected)[ny // 4, nx // 4] / 4000.0**0.5 / 2.0)
    )
    pixels(figure)


def test_star_panels_show_the_brightest_inside_the_frame() -> None:
    expected = np.ones((40, 60))
    expected[10, 20], expected[39, 59] = 100.0, 50.0
    u, v = np.array([20, 59, 5, 500, np.nan]) - 29.5, np.array([10, 39, 5, 0, 0]) - 19.5
    figure = plots.star_panels(
        expected + 3.0, expected, expected**0.5, np.ones(expected.shape, bool), u, v, half_width=3
    )
    stamps = [
        ax for ax in figure.axes if ax.images and ax.get_xlabel() == "" and len(values(ax)) == 7
    ]
    assert len(stamps) == 9
    brightest, difference = values(stamps[0]), values(stamps[2])
    assert float(brightest[3, 3]) == 103.0
    assert float(difference[3, 3]) == pytest.approx(0.3) and float(
        difference[0, 0]
    ) == pytest.approx(3.0)
    corner = values(stamps[3])
    assert float(corner[3, 3]) == 53.0 and np.ma.count(corner) == 16
    pixels(figure)


def test_star_panels_show_at_most_24_and_survive_none() -> None:
    frame = np.ones((50, 50))
    rng = np.random.default_rng(5)
    u, v = rng.uniform(-20, 20, (2, 40))
    many = plots.star_panels(frame, frame, frame, frame > 0, u, v, half_width=2)
    assert sum(len(ax.texts) for ax in many.axes) == 24
    none = plots.star_panels(frame, frame, frame, frame > 0, u + 100, v, half_width=2)
    assert "no source" in none.texts[0].get_text()


@pytest.mark.parametrize("shape", [(1, 4000), (4000, 1), (1, 1)])
def test_strips_of_a_frame_make_pictures_of_a_usual_size(shape: tuple[int, int]) -> None:
    frame = np.full(shape, 4.0)
    draws = np.random.default_rng(5).normal(size=(100, 2))
    for figure in (
        plots.frame_triptych(frame, frame, frame**0.5, frame > 0),
        plots.overview(frame, frame, frame**0.5, frame > 0, draws, ("f_ux", "background")),
    ):
        height, width, _ = pixels(figure).shape
        assert 0.1 < height / width < 1.2


@pytest.mark.parametrize("with_truth", [True, False])
def test_overview_shows_frame_and_marginals(with_truth: bool) -> None:
    chain, posterior = run()
    truth = np.append(TRUTH, BACKGROUND) if with_truth else None
    expected = posterior.expected_counts(chain.estimate.params)
    figure = plots.overview(
        posterior.counts,
        expected,
        expected**0.5,
        posterior.mask,
        chain.draws(),
        chain.parameter_names,
        truth=truth,
    )
    marginals = next(ax for ax in figure.axes if "posterior mean" in ax.get_ylabel())
    assert len(marginals.get_xticks()) == (5 if with_truth else 4)
    pixels(figure)
