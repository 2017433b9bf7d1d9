"""What all figures share: colours, and how a figure becomes a file's content."""

import io

from matplotlib.figure import Figure

__all__ = ["ENSEMBLE_COLOURS", "ESTIMATE_COLOUR", "POSTERIOR_COLOUR", "TRUTH_COLOUR", "png"]

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
