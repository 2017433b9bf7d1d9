"""What all figures share: colours, and how a figure becomes a file's content."""

import base64
import io
import struct
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
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


def png(figure: Figure, dpi: int = 100, *, shades: bool = True) -> bytes:
    """Render a figure as a PNG file's content.

    It has 256 colours, which makes it a third as large as one of all colours.

    Parameters
    ----------
    figure : Figure
    dpi : int
        Dots an inch.
    shades : bool
        Whether its colours are chosen for the shades of images and scales; those of lines and areas
        alone are found five times as fast.

    Returns
    -------
    bytes

    Examples
    --------
    >>> png(Figure(figsize=(1, 1)))[1:4]
    b'PNG'
    """
    figure.set(dpi=dpi, facecolor="white")
    canvas: Any = FigureCanvasAgg(figure)  # whose methods have no types
    canvas.get_renderer().mathtext_parser = _mathematics()
    canvas.draw()
    image = Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3])
    # the former of Pillow's methods keeps rare colours, such as those at a scale's ends
    method = Image.Quantize.MAXCOVERAGE if shades else Image.Quantize.FASTOCTREE
    few = image.quantize(256, method, dither=Image.Dither.NONE)
    buffer = io.BytesIO()
    few.save(buffer, "png")
    return buffer.getvalue()


@cache
def _mathematics() -> Any:
    """What sets symbols, for all figures: it keeps those of before."""
    canvas: Any = FigureCanvasAgg(Figure())
    return canvas.get_renderer().mathtext_parser


class Embedded(NamedTuple):
    """An image within a page: its data as a URI, and its size in pixels."""

    uri: str
    width: int
    height: int


def embedded(content: bytes) -> Embedded:
    """The content of a PNG file as an image within a page.

    Parameters
    ----------
    content : bytes

    Returns
    -------
    Embedded

    Examples
    --------
    >>> embedded(png(Figure(figsize=(2, 1))))[1:]
    (200, 100)
    """
    width, height = struct.unpack(">LL", content[16:24])  # of the file's first chunk
    uri = "data:image/png;base64," + base64.b64encode(content).decode("ascii")
    return Embedded(uri, width, height)
