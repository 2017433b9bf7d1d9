"""What all figures share: colours, and how a figure becomes a file's content."""

import base64
import io
from typing import NamedTuple

from matplotlib.figure import Figure
from PIL import Image

__all__ = [
    "ENSEMBLE_COLOURS",
    "ESTIMATE_COLOUR",
    "POSTERIOR_COLOUR",
    "TRUTH_COLOUR",
    "Embedded",
    "embedded",
    "png",
]

POSTERIOR_COLOUR = "#0072b2"
TRUTH_COLOUR = "#d55e00"
ESTIMATE_COLOUR = "#009e73"
ENSEMBLE_COLOURS = (
    POSTERIOR_COLOUR,
    TRUTH_COLOUR,
    ESTIMATE_COLOUR,
    "#cc79a7",
    "#e69f00",
    "#56b4e9",
    "#7f7f7f",
    "#000000",
)


def png(figure: Figure, dpi: int = 150) -> bytes:
    """Render a figure as a PNG file's content.

    Parameters
    ----------
    figure : Figure
    dpi : int
        Dots an inch.

    Returns
    -------
    bytes

    Examples
    --------
    >>> png(Figure(figsize=(1, 1)))[1:4]
    b'PNG'
    """
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=dpi, facecolor="white")
    return buffer.getvalue()


class Embedded(NamedTuple):
    """An image within a page: its data as a URI, and its size in pixels."""

    uri: str
    width: int
    height: int


def embedded(figure: Figure) -> Embedded:
    """Render a figure as an image within a page.

    It has 256 colours, which makes it a third as large as one of all colours.

    Parameters
    ----------
    figure : Figure

    Returns
    -------
    Embedded

    Examples
    --------
    >>> embedded(Figure(figsize=(2, 1), dpi=100))[1:]
    (200, 100)
    """
    buffer = io.BytesIO()
    figure.savefig(buffer, dpi="figure", facecolor="white")
    image = Image.open(buffer)
    # of Pillow's methods the one that keeps rare colours, such as those at a scale's ends
    few = image.convert("RGB").quantize(256, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    buffer = io.BytesIO()
    few.save(buffer, "png", optimize=True)
    uri = "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode("ascii")
    return Embedded(uri, *image.size)
