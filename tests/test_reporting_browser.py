"""Pages in a browser: accessible, silent, light and dark, on a phone, on paper, and not too large.

Chromium shows the pages, axe-core looks for what shuts readers out. Every check is also shown to
fail on a page that was spoilt.
"""

import shutil
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_reporting import BACKGROUND, TRUTH, described, figures_of, report, run

import bayesfred as bf
from bayesfred.analysis.comparison import Comparison, Score
from bayesfred.analysis.diagnostics import Diagnostics
from bayesfred.analysis.extra_parameters import ExtraParameters
from bayesfred.commands.joint_pipeline import write_joint_results
from bayesfred.reporting.comparison import ComparedRun, write_comparison
from bayesfred.reporting.frames import FittedFrame
from bayesfred.sampling.record import RunRecord

sync_api = pytest.importorskip(
    "playwright.sync_api", reason="needs playwright: pip install -e .[browser]"
)
axe_api = pytest.importorskip(
    "axe_playwright_python.sync_playwright", reason="needs axe: pip install -e .[browser]"
)
CHROMIUM = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)
if CHROMIUM is None:
    pytest.skip("needs Chromium: apt-get install chromium", allow_module_level=True)

KINDS = ("green", "red", "thirty", "compared", "joint")
A4 = 703  # CSS pixels between margins of 12 mm
LARGEST = 2_000_000  # bytes
SETTINGS = "\n".join(f'[section_{k}]\nkey = "{"a long value " * 12}"' for k in range(9))


def found_with_causes(found: Diagnostics) -> Diagnostics:
    cause = bf.Cause("PSF", 0.4, "the images are wider than the PSF", "set psf_sigma = true")
    return replace(found, fits_data=False, causes=(cause, cause))


@cache
def contents(d: int) -> tuple[Any, Any, Any, Any]:
    """A chain of d parameters, its diagnostics, truth and figures: by these pages differ."""
    chain, posterior = run(tuple(f"nuisance_{k}" for k in range(d - 5)))
    posterior.parameters = described(*chain.parameter_names)
    notes = ("A note. " * 40, "path/" * 60)
    chain.record = RunRecord("Night 3", "a_frame_of_a_long_name.fits", SETTINGS, notes)
    fitted, truth = FittedFrame.at(posterior, chain.estimate.params), None
    if d == 5:
        truth = np.append(TRUTH, BACKGROUND)
    else:  # a frame that compresses badly: high, and all noise
        noise = np.random.default_rng(1).poisson(50.0, (1200, 600)).astype(float)
        level = np.full(noise.shape, 50.0)
        fitted = FittedFrame(noise, level, level**0.5, noise >= 0.0)
    diagnostics, figures = figures_of(
        chain, posterior, fitted, shown=range(min(d, 12)), truth=truth
    )
    return chain, diagnostics, truth, figures


def page(folder: Path, kind: str) -> Path:
    """A green page with a truth, a red one with causes, one of thirty parameters, a comparison.

    And the page of three frames, of which one shows another lens.
    """
    folder.mkdir()
    if kind == "joint":
        return joint_page(folder)
    chain, diagnostics, truth, figures = contents(30 if kind == "thirty" else 5)
    if kind == "compared":
        found = diagnostics, found_with_causes(diagnostics)
        runs = [ComparedRun(f"chains/{k}.h5", chain, d) for k, d in enumerate(found)]
        parts = np.array([1.0, -2.0, 3.0])
        scores = [Score(run.name, 5, -9e4, 31.4, 6.0, 2.0, 0.5, -9e4, 0.01, 0.3, 0, parts)
                  for run in runs]  # fmt: skip
        extra = {(runs[0].name, runs[1].name): ExtraParameters(("f_x",), 12.2, 1.1, 0.003)}
        ranking = Comparison(tuple(scores), runs[0].name, ((0,), (1, 2), (3, 4)), extra)
        return write_comparison(folder / "report.html", runs, ranking)
    if kind == "red":
        diagnostics = found_with_causes(diagnostics)
    sentence = "Images are displaced by up to 1.234 ± 0.012 pixels."
    report(
        folder, chain=chain, diagnostics=diagnostics, figures=figures, truth=truth, result=sentence
    )
    return folder / "report.html"


def joint_page(folder: Path) -> Path:
    terms = [(1, 0, 0, 0), (2, 0, 0, 0), (1, 1, 0, 0), (0, 2, 0, 0)]
    model = bf.ForwardModel(
        bf.Detector((65, 65)), bf.SourceCatalog.grid(3, 20.0, 1e4), bf.GaussianPSF(2.0),
        bf.PolynomialDistortion(terms, []),
    )  # fmt: skip
    frames = {
        f"exposure_{k}_of_a_night_with_a_long_name": bf.Posterior(
            model, bf.simulate(model, [0.0, 1e-4 + 1e-3 * (k == 2), 0.0, 0.0], 3.0, seed=k)
        )
        for k in range(3)
    }
    path = folder / "run.h5"
    record = RunRecord("Night 3", "3 frames", SETTINGS, ("A note. " * 40, "path/" * 60))
    chain = bf.laplace(bf.JointPosterior(frames), seed=1, path=path, progress=False, record=record)
    return write_joint_results(chain, path, path, target_ess=100, overwrite=False).page


@pytest.fixture(scope="module")
def pages(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("pages")
    return {kind: page(folder / kind, kind) for kind in KINDS}


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with sync_api.sync_playwright() as playwright:
        try:
            started = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        except sync_api.Error as error:
            pytest.skip(f"{CHROMIUM} does not start: {error}")
        yield started
        started.close()


class Tab:
    """A page in a browser, with what it asked of the network and wrote to the console."""

    def __init__(
        self, browser: Any, path: Path, *, width: int = 1280, scheme: str = "light"
    ) -> None:
        self.context = browser.new_context(
            viewport={"width": width, "height": 900}, color_scheme=scheme, bypass_csp=False
        )
        self.page = self.context.new_page()
        self.heard: list[str] = []
        self.page.on("console", lambda message: self.heard.append(message.text))
        self.page.on("pageerror", lambda error: self.heard.append(str(error)))
        self.page.on("request", lambda request: self.heard.append(request.url))
        self.page.goto(path.as_uri())
        self.heard = [
            text for text in self.heard if text != path.as_uri() and not text.startswith("data:")
        ]

    def violations(self) -> list[str]:
        """What axe-core finds, a line each."""
        found = axe_api.Axe().run(self.page).response["violations"]
        return [f"{v['id']}: {v['nodes'][0]['html'][:200]}" for v in found]

    def width(self, what: str) -> list[int]:
        """Widths of what a selector names, with all that sticks out."""
        return list(self.page.eval_on_selector_all(what, "all => all.map(e => e.scrollWidth)"))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("width", "scheme"), [(1280, "light"), (390, "dark")])
def test_page_is_accessible_silent_and_as_wide_as_the_screen(
    kind: str, width: int, scheme: str, pages: dict[str, Path], browser: Any
) -> None:
    tab = Tab(browser, pages[kind], width=width, scheme=scheme)
    assert tab.heard == []
    assert tab.width("html") == [width]
    assert tab.violations() == []
    dark = tab.page.eval_on_selector("body", "e => getComputedStyle(e).backgroundColor")
    assert (dark == "rgb(255, 255, 255)") == (scheme == "light")
    inverted = tab.page.eval_on_selector("img", "e => getComputedStyle(e).filter")
    assert (inverted == "none") == (scheme == "light")
    tab.context.close()


def test_faults_of_a_page_are_seen(pages: dict[str, Path], browser: Any, tmp_path: Path) -> None:
    text = pages["green"].read_text(encoding="utf-8")
    wide = '<div style="width: 500px; color: #999">wide</div><img src="http://localhost:9/a.png">'
    spoilt = tmp_path / "spoilt.html"
    spoilt.write_text(text.replace("<main>", f"<main>{wide}"), encoding="utf-8")
    tab = Tab(browser, spoilt, width=390)
    tab.page.wait_for_timeout(100)
    assert any("Content Security Policy" in heard for heard in tab.heard)
    assert tab.width("html")[0] > 390
    seen = " ".join(tab.violations())
    assert "image-alt" in seen and "color-contrast" in seen
    tab.context.close()


@pytest.mark.parametrize("kind", KINDS)
def test_tables_fit_on_paper(kind: str, pages: dict[str, Path], browser: Any) -> None:
    tab = Tab(browser, pages[kind], width=A4, scheme="dark")
    tab.page.emulate_media(media="print")
    assert tab.width("html") == [A4]
    assert max(tab.width("table, pre, figure, img")) <= A4
    assert tab.page.eval_on_selector("img", "e => getComputedStyle(e).filter") == "none"
    assert tab.page.pdf(format="A4").startswith(b"%PDF")
    tab.page.eval_on_selector("td", "e => { e.textContent = 'wide'.repeat(99) }")
    assert max(tab.width("html")) > A4  # a table that is too wide would show
    tab.context.close()


def test_figures_open_at_full_size(pages: dict[str, Path], browser: Any) -> None:
    tab = Tab(browser, pages["thirty"], width=390)
    page = tab.page
    natural = page.eval_on_selector("#figure-1 img", "e => e.naturalWidth")
    shown = "#figure-1 img"
    assert page.locator(shown).bounding_box()["width"] < 390 < natural
    page.locator(shown).click(force=True)  # the link covers the image
    assert page.locator(shown).bounding_box()["width"] == natural
    assert page.locator("#figure-1").bounding_box()["width"] == 390  # it scrolls inside
    assert tab.violations() == [] and tab.heard == []
    page.locator("#figure-1 .close").click()
    assert page.locator(shown).bounding_box()["width"] < 390
    page.keyboard.press("Tab")  # from the heading of the figure on
    page.keyboard.press("Enter")
    assert page.locator(shown).bounding_box()["width"] == natural
    tab.context.close()


def test_pages_are_small(pages: dict[str, Path]) -> None:
    assert max(path.stat().st_size for path in pages.values()) < LARGEST
