"""Fig. 5: the PSF cut out around Fig. 2b's central spot and interpolated, against the true one.

The paper's spots overlap: halfway to its neighbours, 25 pixels away, the central one has fallen to
4 % of its peak, and so have they. The same measurement on a source that stands alone shows what
interpolation itself costs.
"""

from pathlib import Path

import numpy as np

import bayesfred as bf

from .common import Floats, Row, Section, bar, name_axes, panels, paper_model, save, show, small
from .frames import figure2

OVERSAMPLING = 4
HALF_WIDTHS = {"Fig. 2b": 25, "alone": 80}


def measured(frame: Floats, half_width: int) -> tuple[bf.SampledPSF, Floats, Floats]:
    """The PSF measured at the axis, offsets of its samples, and its error over the true peak."""
    psf = bf.SampledPSF.measured(frame, (0.0, 0.0), half_width, oversampling=OVERSAMPLING)
    model = paper_model()
    offsets = (np.arange(len(psf.values)) - len(psf.values) // 2) / OVERSAMPLING
    true = model.sources.flux[0] * model.psf.density(offsets, offsets[:, None])
    return psf, offsets, (psf.values - true) / true.max()


def make(quick: bool, folder: Path) -> Section:
    model = paper_model()
    single = bf.SourceCatalog([0.0], [0.0], model.sources.flux[:1])
    alone = bf.ForwardModel(
        model.detector, single, model.psf, model.distortion, conserve_flux=False, tolerance=0.0
    )
    frames = {"Fig. 2b": figure2("polynomial"), "alone": alone.expected_counts(np.zeros(12))}
    found = {name: measured(frame, HALF_WIDTHS[name]) for name, frame in frames.items()}
    _, offsets, error = found["Fig. 2b"]
    core = np.hypot(offsets, offsets[:, None]) <= 10.0
    rows = [
        Row(
            "central spot of Fig. 2b: largest error / peak",
            "",
            f"{np.abs(error).max():.3f}",
            None,
            f"at the window's border, ±{HALF_WIDTHS['Fig. 2b']} pixels: the neighbours' light is "
            "taken for the PSF's",
        ),
        Row("the same within 10 pixels (one sigma)", "", f"{np.abs(error[core]).max():.1e}", None),
        Row(
            "source alone: largest error / peak",
            "",
            small(float(np.abs(found["alone"][2]).max())),
            None,
            "interpolation of a band-limited spot that is dark at the border is exact but for "
            "rounding",
        ),
    ]
    text = (
        f"`SampledPSF.measured` interpolates to {OVERSAMPLING} samples a pixel. The paper "
        "extracts the spot at the axis, where "
        "there is no distortion, and prints no error. In its own frame neighbours overlap, so "
        "that the measured wings are not the "
        "PSF's: for everything below the true PSF is used, as in the paper's section 4.1."
    )
    pictures = [] if quick else [_picture(frames["Fig. 2b"], found, folder)]
    return Section("Fig. 5: reference PSF", text, rows, pictures)


def _picture(
    frame: Floats, found: dict[str, tuple[bf.SampledPSF, Floats, Floats]], folder: Path
) -> str:
    figure, axes = panels(1, 4)
    middle, half = len(frame) // 2, HALF_WIDTHS["Fig. 2b"]
    psf, _, error = found["Fig. 2b"]
    top = float(psf.values.max())
    show(
        axes[0, 0],
        frame[middle - half : middle + half + 1, middle - half : middle + half + 1],
        "Fig. 5a: cut out",
        vmin=0.0,
        vmax=top,
    )
    drawn = show(
        axes[0, 1],
        psf.values,
        f"Fig. 5b: {OVERSAMPLING} x finer",
        step=1.0 / OVERSAMPLING,
        vmin=0.0,
        vmax=top,
    )
    bar(drawn, axes[0, :2], "counts per pixel")
    drawn = show(
        axes[0, 2], error, "error", step=1.0 / OVERSAMPLING, colours="RdBu_r", vmin=-0.1, vmax=0.1
    )
    bar(drawn, axes[0, 2], "error / peak")
    for name, (_, offsets, each) in found.items():
        row = np.abs(each[len(each) // 2])
        axes[0, 3].semilogy(offsets, np.maximum(row, 1e-18), label=name)
    name_axes(axes[0, 3], "error along v = 0", "u / pixel", "|error| / peak")
    axes[0, 3].yaxis.set_label_position("right")
    axes[0, 3].yaxis.tick_right()
    axes[0, 3].legend(frameon=False, fontsize=7)
    return save(figure, "figure_5.png", folder)
