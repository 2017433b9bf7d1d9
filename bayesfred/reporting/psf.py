"""The figure of a measured PSF: its shape, its errors, and how it varies over the field."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Normalize, SymLogNorm
from matplotlib.figure import Figure

from bayesfred._typing import Floats
from bayesfred.imaging.psf import FWHM, GaussianPSF, MeasuredPSF
from bayesfred.reporting.style import POSTERIOR_COLOUR, TRUTH_COLOUR

__all__ = ["described_psf", "psf_panels"]

SIDE = 121  # samples along an image's side
WIDTHS = 4.0  # half an image's side in widths of the PSF
PSF_MAP, DIFFERENCE_MAP = "gray_r", "RdBu_r"
LINEAR = 0.01  # share of the peak below which colours are linear
PLACES = (-0.8, 0.0, 0.8)  # of the images on the field, in half sides of the frame


def psf_panels(psf: MeasuredPSF, shape: tuple[int, int]) -> Figure:
    """The PSF in the middle of the field, its profile with errors, and what varies.

    Parameters
    ----------
    psf : MeasuredPSF
    shape : tuple of int, (ny, nx), pixel
        Of the frame.

    Returns
    -------
    Figure
    """
    fig = Figure(figsize=(15, 4.8), dpi=100, layout="constrained")
    axes = fig.subplots(1, 3)
    a = _axis(psf)
    _draw_image(fig, axes[0], psf, a)
    _draw_profile(axes[1], psf)
    if psf.varies:
        _draw_variation(fig, axes[2], psf, shape, a)
    else:
        _draw_difference(fig, axes[2], psf, a)
    return fig


def _axis(psf: MeasuredPSF) -> Floats:
    return WIDTHS * psf.sigma * np.linspace(-1.0, 1.0, SIDE)


def _extent(a: Floats) -> tuple[float, float, float, float]:
    half = float(a[-1] + 0.5 * (a[1] - a[0]))
    return -half, half, -half, half


def _draw_image(fig: Figure, ax: Axes, psf: MeasuredPSF, a: Floats) -> None:
    image = psf.density(a, a[:, None]) / psf.peak
    norm = SymLogNorm(LINEAR, vmin=-LINEAR, vmax=1.0)
    shown = ax.imshow(image, cmap=PSF_MAP, norm=norm, origin="lower", extent=_extent(a))
    ticks = [-0.01, 0.0, 0.01, 0.1, 1.0]
    bar = fig.colorbar(shown, ax=ax, shrink=0.8, ticks=ticks, label="PSF / peak")
    bar.ax.set_yticklabels([f"{tick:g}" for tick in ticks])
    bar.ax.minorticks_off()
    ax.set(xlabel="a / pixel", ylabel="b / pixel", title="Middle of the field")


def _draw_profile(ax: Axes, psf: MeasuredPSF) -> None:
    """Along a and along b, with the middle 95 % of the draws, beside a Gaussian of that width."""
    a = _axis(psf)
    zero = np.zeros_like(a)
    drawn = list(psf.drawn())
    for along, colour in (("a", POSTERIOR_COLOUR), ("b", TRUTH_COLOUR)):
        at = (a, zero) if along == "a" else (zero, a)
        if drawn:
            values = np.array([one.density(*at) for one in drawn]) / psf.peak
            low, high = np.percentile(values, [2.5, 97.5], axis=0)
            ax.fill_between(a, low, high, color=colour, alpha=0.3, lw=0)
        ax.plot(a, psf.density(*at) / psf.peak, color=colour, lw=1.6, label=f"along {along}")
    gaussian = GaussianPSF(psf.sigma)
    ax.plot(
        a, gaussian.density(a, 0.0) / gaussian.peak, color="0.5", lw=1.0, ls="--",
        label="Gaussian of the same FWHM",
    )  # fmt: skip
    ax.set_yscale("symlog", linthresh=LINEAR)
    ax.set_yticks([0.0, 0.01, 0.1, 1.0], ["0", "0.01", "0.1", "1"])
    ax.set(xlabel="distance from the middle / pixel", ylabel="PSF / peak", title="Profile",
           xlim=(a[0], a[-1]))  # fmt: skip
    ax.legend(fontsize=9)


def _less_gaussian(psf: MeasuredPSF, a: Floats) -> Floats:
    """By how much the PSF exceeds the Gaussian of its FWHM and peak, shares of the peak."""
    gaussian = GaussianPSF(psf.sigma)
    shape = gaussian.density(a, a[:, None]) / gaussian.peak
    return np.asarray(psf.density(a, a[:, None]) / psf.peak - shape)


def _draw_difference(fig: Figure, ax: Axes, psf: MeasuredPSF, a: Floats) -> None:
    image = _less_gaussian(psf, a)
    limit = float(np.abs(image).max())
    shown = ax.imshow(
        image, cmap=DIFFERENCE_MAP, norm=Normalize(-limit, limit), origin="lower", extent=_extent(a)
    )
    fig.colorbar(shown, ax=ax, shrink=0.8, label="difference / peak")
    ax.set(xlabel="a / pixel", ylabel="b / pixel", title="Less the Gaussian of its FWHM and peak")


def _draw_variation(
    fig: Figure, ax: Axes, psf: MeasuredPSF, shape: tuple[int, int], a: Floats
) -> None:
    """Images of the PSF at nine places of the field, on one scale."""
    ny, nx = shape
    rows = []
    for v in reversed(PLACES):
        places = [(0.5 * nx * u, 0.5 * ny * v) for u in PLACES]
        # rows of an image begin below, those of the panel above
        rows.append(np.hstack([psf.density(a, a[::-1, None], at=at) for at in places]))
    image = np.vstack(rows) / psf.peak
    shown = ax.imshow(image, cmap=PSF_MAP, norm=Normalize(0.0, float(image.max())))
    fig.colorbar(shown, ax=ax, shrink=0.8, label="PSF / peak in the middle")
    middles = SIDE * (np.arange(3) + 0.5) - 0.5
    for k in (1, 2):
        ax.axhline(SIDE * k - 0.5, color="0.7", lw=0.8)
        ax.axvline(SIDE * k - 0.5, color="0.7", lw=0.8)
    ax.set_xticks(middles, [f"{0.5 * nx * u:.0f}" for u in PLACES])
    ax.set_yticks(middles, [f"{0.5 * ny * v:.0f}" for v in reversed(PLACES)])
    ax.set(xlabel="x / pixel", ylabel="y / pixel", title="Over the field")


def described_psf(psf: MeasuredPSF) -> str:
    """Say what is seen in the figure of a measured PSF.

    Parameters
    ----------
    psf : MeasuredPSF

    Returns
    -------
    str

    Examples
    --------
    >>> x = np.arange(-20, 21) / 4
    >>> described_psf(MeasuredPSF(np.exp(-(x**2 + x[:, None] ** 2) / 2)[None], 4.0, 100.0))
    'A PSF with a FWHM of 2.37 pixels, the same all over the field. It differs from the Gaussian...'
    """
    far = np.abs(_less_gaussian(psf, _axis(psf))).max()
    return (
        f"A PSF with a FWHM of {FWHM * psf.sigma:.2f} pixels, {psf.variation} over the field. It "
        f"differs from the Gaussian of its FWHM and peak by at most {far:.1%} of its peak."
    )
