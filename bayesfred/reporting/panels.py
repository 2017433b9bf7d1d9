"""Figures of many small panels, which share one `Axes`.

Every `Axes` of matplotlib costs 10 ms, for its ticks above all, and a chain of 28 parameters has
hundreds of panels. So a `Sheet` has a single one, in inches, and a `Panel` is a rectangle of it
that maps its data there. Lines and areas of one look become one collection, and images are put in
the figure's own pixels.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.collections import LineCollection, PathCollection
from matplotlib.figure import Figure
from matplotlib.path import Path
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from bayesfred._typing import Floats

__all__ = ["Box", "Images", "Panel", "Sheet", "round_ticks"]

DPI = 100
TICK = 0.03  # inch
TICKED = 0.6  # inch from tick to tick, where there is room for more than a few
SMALL = 8.0  # points
CHARACTER = 0.07  # inch, of this size

Span = tuple[float, float]
Box = tuple[float, float, float, float]  # left, bottom, width and height, inch
Colours = NDArray[np.uint8]
Look = tuple[tuple[str, Any], ...]


def round_ticks(low: float, high: float, most: int = 5) -> tuple[Floats, list[str]]:
    """Round numbers within a range, none at its very ends, and how they are written.

    Parameters
    ----------
    low, high : float
    most : int
        Parts that they divide the range into, at most.

    Returns
    -------
    values : ndarray
    labels : list of str

    Examples
    --------
    >>> round_ticks(-3.1, 2.9)[1]
    ['−2', '0', '2']
    """
    edge = 0.06 * (high - low)
    ticks = np.asarray(MaxNLocator(most, steps=[1, 2, 5, 10]).tick_values(low, high))
    ticks = ticks[(ticks > low + edge) & (ticks < high - edge)]
    step = float(np.min(np.diff(ticks), initial=high - low))
    decimals = 0
    while decimals < 15 and np.any(np.abs(np.round(ticks, decimals) - ticks) > 1e-3 * step):
        decimals += 1
    return ticks, [f"{tick + 0.0:.{decimals}f}".replace("-", "−") for tick in ticks]


class Sheet:
    """A figure with one `Axes` in inches, from its lower left corner.

    Parameters
    ----------
    width, height : float, inch
    """

    def __init__(self, width: float, height: float) -> None:
        self.figure = Figure(figsize=(width, height), dpi=DPI)
        self.axes = self.figure.add_axes((0.0, 0.0, 1.0, 1.0))
        self.axes.set(xlim=(0.0, width), ylim=(0.0, height))
        self.axes.axis("off")
        self.width, self.height = width, height
        self.panels: list[Panel] = []
        self._images: list[tuple[Box, Colours]] = []
        self._lines: dict[Look, list[Floats]] = {}
        self._areas: dict[Look, list[Path]] = {}

    def panel(self, box: Box, x: Span, y: Span, size: float = SMALL) -> "Panel":
        """A framed rectangle whose data have the ranges `x` and `y`, its numbers of this size."""
        self.panels.append(Panel(self, box, x, y, size))
        return self.panels[-1]

    def line(self, points: Floats, **look: Any) -> None:
        """A line through points in inches, shape (n, 2)."""
        self._lines.setdefault(tuple(look.items()), []).append(points)

    def area(self, points: Floats, codes: Colours | None = None, **look: Any) -> None:
        """A polygon in inches, shape (n, 2), with the codes of a path if it is of several parts."""
        self._areas.setdefault(tuple(look.items()), []).append(Path(points, codes))

    def image(self, box: Box, colours: Colours) -> None:
        """An image of RGBA values, its first row below, unsmoothed."""
        self._images.append((box, colours))

    def text(self, x: float, y: float, text: str, **look: Any) -> None:
        """A text at a point in inches."""
        self.axes.text(x, y, text, **({"fontsize": SMALL} | look))

    def legend(self, entries: Sequence[tuple[str, dict[str, Any]]]) -> None:
        """Names of lines and areas, in a row that ends in the upper right corner."""
        x, y = self.width - 0.15, self.height - 0.17
        for name, look in entries[::-1]:
            self.text(x, y, name, ha="right", va="center", fontsize=9)
            x -= 0.08 * len(name) + 0.42
            self.sample(x, y, look)
            x -= 0.25

    def sample(self, x: float, y: float, look: dict[str, Any]) -> None:
        """A short line or area that begins at x, for a legend."""
        ends = np.array([[x, y], [x + 0.3, y]])
        if "facecolors" in look:
            across = np.array([0.0, 0.06])
            self.area(np.concatenate([ends - across, ends[::-1] + across]), **look)
        else:
            self.line(ends, **look)

    def finish(self) -> Figure:
        """The figure, with all that was asked for."""
        if self._images:
            self.axes.add_artist(Images(self._images))
        for areas, look in ((areas, dict(key)) for key, areas in self._areas.items()):
            self.axes.add_collection(
                PathCollection(areas, edgecolors="none", **look), autolim=False
            )
        for lines, look in ((lines, dict(key)) for key, lines in self._lines.items()):
            self.axes.add_collection(LineCollection(lines, capstyle="butt", **look), autolim=False)
        boxes = [panel.outline() for panel in self.panels]
        ticks = [tick for panel in self.panels for tick in panel.ticks]
        self.axes.add_collection(
            LineCollection(boxes + ticks, colors="black", linewidths=0.8, zorder=3), autolim=False
        )
        return self.figure


class Images(Artist):
    """Images of RGBA values in boxes, every pixel of the figure with the colour of the nearest."""

    def __init__(self, images: Sequence[tuple[Box, Colours]]) -> None:
        super().__init__()
        self.images = images

    def draw(self, renderer: Any) -> None:
        """Put the images below everything else."""
        context, dots = renderer.new_gc(), renderer.points_to_pixels(72.0)
        for (left, bottom, width, height), colours in self.images:
            ends = ((bottom, height), (left, width))
            sizes = (max(round(dots * (p + size)) - round(dots * p), 1) for p, size in ends)
            rows, columns = (
                ((np.arange(size) + 0.5) * n / size).astype(int)
                for size, n in zip(sizes, colours.shape[:2], strict=True)
            )
            shown = colours[np.ix_(rows, columns)]
            renderer.draw_image(context, round(dots * left), round(dots * bottom), shown)
        context.restore()


class Panel:
    """A rectangle of a sheet with its own ranges; `Sheet.panel` makes it."""

    def __init__(self, sheet: Sheet, box: Box, x: Span, y: Span, size: float) -> None:
        self.sheet, self.box, self.x, self.y, self.size = sheet, box, x, y, size
        self.tick = TICK * size / SMALL
        self.ticks: list[Floats] = []

    def at(self, x: Floats | float, y: Floats | float) -> Floats:
        """Points of the panel in inches, shape (n, 2); what lies beyond it is moved to its edge."""
        left, bottom, width, height = self.box
        (x0, x1), (y0, y1) = self.x, self.y
        across, up = np.broadcast_arrays(
            np.clip((np.asarray(x) - x0) / (x1 - x0), 0.0, 1.0),
            np.clip((np.asarray(y) - y0) / (y1 - y0), 0.0, 1.0),
        )
        return np.stack([left + width * across, bottom + height * up], axis=-1)

    def outline(self) -> Floats:
        """The frame."""
        (x0, x1), (y0, y1) = self.x, self.y
        return self.at(np.array([x0, x1, x1, x0, x0]), np.array([y0, y0, y1, y1, y0]))

    def line(self, x: Floats, y: Floats, **look: Any) -> None:
        """A line through points."""
        self.sheet.line(self.at(x, y), **look)

    def steps(self, heights: Floats, edges: Floats, **look: Any) -> None:
        """The outline of a histogram."""
        ends = np.concatenate([[self.y[0]], np.repeat(heights, 2), [self.y[0]]])
        self.line(np.repeat(edges, 2), ends, **look)

    def filled_steps(self, heights: Floats, edges: Floats, **look: Any) -> None:
        """The bars of a histogram as one area."""
        ends = np.concatenate([[self.y[0]], np.repeat(heights, 2), [self.y[0]]])
        self.sheet.area(self.at(np.repeat(edges, 2), ends), **look)

    def band(self, x: Floats, low: Floats, high: Floats, **look: Any) -> None:
        """The area between two lines."""
        around = np.concatenate([low, high[::-1]])
        self.sheet.area(self.at(np.concatenate([x, x[::-1]]), around), **look)

    def bars(self, x: Floats, low: Floats, high: Floats, *, cap: float, **look: Any) -> None:
        """Error bars, whose ends are twice as wide as `cap`, inch."""
        for ends in zip(self.at(x, low), self.at(x, high), strict=True):
            self.sheet.line(np.array(ends), **look)
            for at, height in ends:
                self.sheet.line(np.array([(at - cap, height), (at + cap, height)]), **look)

    def mark(self, *, x: float | None = None, y: float | None = None, **look: Any) -> None:
        """Straight lines across the panel, of those values that it shows."""
        if x is not None and self.x[0] < x < self.x[1]:
            self.line(np.array([x, x]), np.array(self.y), **look)
        if y is not None and self.y[0] < y < self.y[1]:
            self.line(np.array(self.x), np.array([y, y]), **look)

    def ticks_below(self, *, labelled: bool = True) -> None:
        """Round numbers along the lower edge, as many as there is room for."""
        values, labels = round_ticks(*self.x, max(5, int(self.box[2] / TICKED)))
        needed = sum(len(label) + 1 for label in labels) * CHARACTER * self.size / SMALL
        few = slice(None, None, 1 + int(needed / self.box[2]))
        values, labels = values[few], labels[few]
        for (x, y), label in zip(self.at(values, self.y[0]), labels, strict=True):
            self.ticks.append(np.array([(x, y), (x, y - self.tick)]))
            if labelled:
                self._number(x, y - 1.7 * self.tick, label, va="top", ha="center")

    def ticks_beside(
        self,
        *,
        labelled: bool = True,
        right: bool = False,
        given: tuple[Floats, list[str]] | None = None,
    ) -> float:
        """Round numbers along the left edge, or the right one, or values with these labels.

        Returns about where the longest of them ends.
        """
        values, labels = given or round_ticks(*self.y, max(5, int(self.box[3] / TICKED)))
        few = slice(None, None, 1 + int(len(labels) * self.size / (60.0 * self.box[3])))
        values, labels = values[few], labels[few]
        out = self.tick if right else -self.tick
        for (x, y), label in zip(self.at(self.x[right], values), labels, strict=True):
            self.ticks.append(np.array([(x, y), (x + out, y)]))
            if labelled:
                side = "left" if right else "right"
                self._number(x + 1.7 * out, y, label, ha=side, va="center")
        characters = max((len(label) + 0.4 * label.count("−") for label in labels), default=0.0)
        longest = characters * CHARACTER * self.size / SMALL
        edge = self.box[0] + self.box[2] * right
        return edge + 1.7 * out + (longest if right else -longest)

    def _number(self, x: float, y: float, text: str, **look: Any) -> None:
        self.sheet.text(x, y, text, fontsize=self.size, **look)

    def label_above(self, text: str, **look: Any) -> None:
        """What the panel shows."""
        left, bottom, width, height = self.box
        self.sheet.text(left + 0.5 * width, bottom + height + 0.1, text, ha="center", **look)

    def label_below(self, text: str, distance: float, **look: Any) -> None:
        """What is along the lower edge, this many inches below it."""
        left, bottom, width, _ = self.box
        self.sheet.text(left + 0.5 * width, bottom - distance, text, ha="center", va="top", **look)

    def label_beside(self, text: str, distance: float, **look: Any) -> None:
        """What is along the left edge, its end this many inches away."""
        left, bottom, _, height = self.box
        self.sheet.text(
            left - distance, bottom + 0.5 * height, text, rotation=90, ha="right", va="center",
            ma="center", **look,
        )  # fmt: skip
