"""The field by other means: `python -m benchmarks.rivals [FRAMES]`, also run by `benchmarks.peers`.

On the same simulated frames, this package beside what people would pick instead: centroids and a
polynomial or SIP, OpenCV's calibration of a grid of dots, least squares on the full image.
`rival_frames` says what is simulated, `rival_methods` how each is used. Printed are, over 12 frames
a row, the root mean square error of the field in units of its Cramer-Rao bound; how often intervals
of one quoted standard deviation hold the truth; and the processor's time in units of this package's
with fluxes and PSF given, as medians over frames, which leaves compilation out. No method reaches
less than 1 but by chance, or because it is given fluxes that the bound takes as unknown. A line a
case tells how far it is.
"""

import sys
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from typing import NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks import rival_methods as by
from benchmarks.rival_frames import Case, Frame, simulate

FRAMES = 12
WIDTH = 170

STARS = (
    Case("200 photons", 2.0, 200.0),
    Case("2,000", 2.0, 2e3),
    Case("20,000", 2.0, 2e4),
    Case("100,000", 2.0, 1e5),
    Case("200", 1.2, 200.0),
    Case("100,000", 1.2, 1e5),
    Case("200", 4.0, 200.0),
    Case("200, background 50", 4.0, 200.0, background=50.0),
    Case("100,000", 4.0, 1e5),
    Case("200, blended", 2.0, 200.0, blended=True),
    Case("2,000, blended", 2.0, 2e3, blended=True),
    Case("100,000, blended", 2.0, 1e5, blended=True),
    Case("20,000, blended", 1.2, 2e4, blended=True),
    Case("20,000, blended", 4.0, 2e4, blended=True),
    Case("20,000, catalogue's fluxes off", 2.0, 2e4, flux_error=0.3),
    Case("20,000, PSF wrong", 2.0, 2e4, wings=True, remedied=True),
    Case("20,000, PSF wrong, blended", 2.0, 2e4, wings=True, blended=True, remedied=True),
    Case("20,000, companions unknown", 2.0, 2e4, uncatalogued=True, remedied=True),
)
DOTS = tuple(Case(f"{n:,.0f} photons", 5.0, n, dots=True) for n in (2e3, 2e4, 1e5))


class Method(NamedTuple):
    """What is compared: a name, what it does, and the packages that it needs, if any."""

    name: str
    field: Callable[[Frame], by.Found]
    needs: tuple[str, ...] = ()
    remedy: bool = False  # where a case has one

    @property
    def missing(self) -> list[str]:
        """Of those, what is not installed."""
        return [package for package in self.needs if not find_spec(package)]


def _on(centroids: Callable[[Frame], by.Centroids], fit: Callable[..., by.Found]) -> partial:
    return partial(_both, centroids, fit)


def _both(
    centroids: Callable[[Frame], by.Centroids], fit: Callable[..., by.Found], frame: Frame
) -> by.Found:
    return fit(frame, centroids(frame))


OWN = (
    Method("bayesfred, all given", by.fit_given),
    Method("fluxes, width free", by.fit_free),
)
ON_STARS = (
    *OWN,
    Method("given places", by.fit_from_places),
    Method("remedy", by.fit_remedied, remedy=True),
    Method("PSF fits", _on(by.psf_photometry, by.polynomial), ("photutils",)),
    Method("PSF fits, SIP", _on(by.psf_photometry, by.sip), ("photutils",)),
    Method("ePSF fits", _on(by.epsf_photometry, by.polynomial), ("photutils",), remedy=True),
    Method("2-D Gaussians", _on(by.gaussian_centroids, by.polynomial), ("photutils",)),
    Method("windowed", _on(by.windowed_centroids, by.polynomial), ("sep",)),
    Method("scipy, image", by.least_squares),
)
ON_DOTS = (
    *OWN,
    Method("OpenCV, its circles", _on(by.circles, by.camera), ("cv2",)),
    Method("OpenCV, windowed", _on(by.windowed_centroids, by.camera), ("cv2", "sep")),
    Method("OpenCV, 2-D Gaussians", _on(by.gaussian_centroids, by.camera), ("cv2", "photutils")),
)


@dataclass(frozen=True)
class Score:
    """Of a method in a case.

    Attributes
    ----------
    error : float
        Of the field, in units of the bound.
    error_sd : float
        Its Monte Carlo error.
    coverage : float
        Of intervals of one standard deviation; nan without.
    coverage_sd : float
    seconds : float
        Of the processor, a frame.
    failed : int
        Frames without an answer.
    refused : bool
        The method said of most frames that its model does not fit.
    """

    error: float
    error_sd: float
    coverage: float
    coverage_sd: float
    seconds: float
    failed: int
    refused: bool

    def __str__(self) -> str:
        digits = 2 if self.error < 10.0 else 1 if self.error < 100.0 else 0
        text = f"{self.error:.{digits}f}({self.error_sd * 10**digits:.0f})"
        text += "" if np.isnan(self.coverage) else f" {self.coverage:.0%}"
        return text + "!" * self.refused + (f" {self.failed} failed" if self.failed else "")


def score(method: Method, frames: Sequence[Frame]) -> Score | None:
    """How well a method does on frames of one case; nothing if it has no answer for any."""
    squares, held, seconds, fits = [], [], [], []
    for frame in frames:
        start = time.process_time()
        try:
            with warnings.catch_warnings(), np.errstate(all="ignore"):
                warnings.simplefilter("ignore")
                found = method.field(frame)
        except Exception:  # whatever a package raises, the frame has no answer
            continue
        seconds.append(time.process_time() - start)
        off = found.field - frame.field
        if not np.isfinite(off).all():
            continue
        squares.append(np.mean(off**2))
        fits.append(found.fits is not False)
        if found.sd is not None:
            held.append(np.mean(np.abs(off) < found.sd))
    if not squares:
        return None
    n, square = len(squares), float(np.mean(squares))
    error = np.sqrt(square / np.mean([frame.variance for frame in frames]))
    return Score(
        error, error * np.std(squares) / square / 2.0 / np.sqrt(n),
        float(np.mean(held)) if held else np.nan, float(np.std(held) / np.sqrt(n)) if held else 0.0,
        float(np.median(seconds)), len(frames) - n, bool(np.mean(fits) < 0.5),
    )  # fmt: skip


def compare(
    title: str, cases: Sequence[Case], methods: Sequence[Method], frames: int
) -> tuple[Table, Table, list[list[Score | None]]]:
    """Two tables, of errors with coverage and of times, and the scores."""
    present = [method for method in methods if not method.missing]
    rows: list[list[Score | None]] = []
    for k, case in enumerate(cases):
        print(f"{title}: {k + 1} of {len(cases)}, {case.fwhm} px, {case.name}", file=sys.stderr)
        simulated = [simulate(case, [k, seed]) for seed in range(frames)]
        rows.append(
            [
                score(method, simulated) if case.remedied or not method.remedy else None
                for method in present
            ]
        )
    heads = ("FWHM", "stars of", *(method.name for method in present))
    errors, times = (
        Table(*heads, title=f"{title}: {what}")
        for what in (
            "error / bound, coverage of 68 % intervals",
            "processor's time, in units of the first",
        )
    )
    for case, row in zip(cases, rows, strict=True):
        errors.add_row(f"{case.fwhm}", case.name, *("" if s is None else str(s) for s in row))
        unit = row[0].seconds if row[0] else np.nan
        times.add_row(
            f"{case.fwhm}",
            case.name,
            f"{unit:.2f} s",
            *("" if s is None else f"{s.seconds / unit:.2g}" for s in row[1:]),
        )
    return errors, times, rows


def main(frames: int = FRAMES) -> int:
    console = Console(width=None if sys.stdout.isatty() else WIDTH)
    for package in ("photutils", "sep", "cv2"):
        if not find_spec(package):
            console.print(f"{package}: not installed, see the extra `benchmarks`")
    for title, cases, methods in (
        ("100 stars on 257 x 257 pixels", STARS, ON_STARS),
        ("10 x 10 dots, OpenCV's lens", DOTS, ON_DOTS),
    ):
        errors, times, rows = compare(title, cases, methods, frames)
        console.print(errors, times)
        doubt = max(s.coverage_sd for row in rows for s in row if s is not None)
        console.print(f"Coverages: Monte Carlo errors of at most {doubt:.0%}.", highlight=False)
    console.print("1.05(4): 1.05 with a Monte Carlo error of 0.04. !: says that it does not fit.")
    return 0


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]) if len(sys.argv) > 1 else FRAMES))
