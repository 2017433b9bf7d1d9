"""Fig. 1 to 3 and Table 1: the object, three frames of it, and eight single terms.

Images without noise, rendered with the kernel as the paper prints it. The paper prints no number
beside these figures; what can be checked is how far the sources move, and what the kernel without
Jacobian determinant makes of their flux.
"""

from pathlib import Path

import numpy as np

import bayesfred as bf

from .common import (
    PRINTED,
    TERMS,
    Floats,
    Row,
    Section,
    bar,
    name_axes,
    panels,
    paper_model,
    save,
    show,
    small,
    truth,
)

LABEL = "expected counts per pixel"


def named(powers: dict[str, float]) -> tuple[list[tuple[int, int, int, int]], list[float]]:
    """Terms and coefficients of one function from names of powers, in x or in y."""
    terms = []
    for name in powers:
        i, j, m, n = TERMS[name.replace("y", "x")]
        terms.append((j, i, m, n) if "y" in name else (i, j, m, n))
    return terms, list(powers.values())


def figure2(kind: str) -> Floats:
    """The frames of Fig. 2: "invariant", "polynomial" or "logarithm"."""
    if kind == "logarithm":
        return paper_model(bf.LogDistortion(PRINTED["figure2"]["logarithm"])).expected_counts([])
    p = PRINTED["figure2"]["polynomial"]
    (f, a), (g, b) = named(p["f"]), named(p["g"])
    theta = np.array([*a, *b]) * (kind == "polynomial")
    return paper_model(bf.PolynomialDistortion(f, g)).expected_counts(theta)


def make(quick: bool, folder: Path) -> Section:
    frames = {kind: figure2(kind) for kind in ("invariant", "polynomial", "logarithm")}
    model = paper_model()
    total, corner = float(model.sources.flux.sum()), 50.0 * 4
    log = bf.LogDistortion(PRINTED["figure2"]["logarithm"])
    u, v = log.image_position([], corner, corner)
    kept = float(paper_model(bf.LogDistortion(1e-5)).expected_counts([]).sum()) / total
    table2 = float(
        np.abs(model.expected_counts(truth("table2")) - frames["polynomial"]).max()
        / frames["polynomial"].max()
    )
    rows = [
        Row(
            "Table 2's true coefficients, read as below, against Fig. 2b: largest difference / "
            "peak",
            "0",
            small(table2),
            table2 < 1e-12,
            "the same functions, so the columns are u x², v x², u x, v x, u² x, v² x and g is in y",
        ),
        Row(
            "Fig. 2c: corner source moves, pixel",
            "",
            f"{float(np.hypot(corner - u, corner - v)):.1f}",
            None,
            "stars are 50 apart",
        ),
        Row(
            "Fig. 2b: sources' flux in the frame / flux emitted",
            "1",
            f"{frames['polynomial'].sum() / total:.3f}",
            False,
            "the paper asks the kernel to keep flux; the kernel it draws lacks the Jacobian "
            "determinant",
        ),
        Row(
            "Fig. 2c: sources' flux in the frame / flux emitted",
            "1",
            f"{kept:.3f}",
            False,
            "the same",
        ),
    ]
    pictures = []
    if not quick:
        pictures = [_figures_1_and_2(frames, folder), _figure_3(folder)]
    text = (
        "The object is 9 x 9 sources of 1e5 photons, 50 pixels apart, origin at the middle pixel; "
        "the PSF a Gaussian of 10 pixels. "
        "Kernel as printed (`conserve_flux=False`)."
    )
    return Section("Fig. 1 to 3, Table 1: frames", text, rows, pictures)


def _figures_1_and_2(frames: dict[str, Floats], folder: Path) -> str:
    figure, axes = panels(1, 4)
    s = paper_model().sources
    axes[0, 0].plot(s.x, s.y, ".", color="black", markersize=3)
    axes[0, 0].set(xlim=(-252.5, 252.5), ylim=(252.5, -252.5), aspect="equal")
    name_axes(axes[0, 0], "Fig. 1: 9 x 9 sources", "x / pixel", "y / pixel")
    top = max(frame.max() for frame in frames.values())
    titles = ("Fig. 2a: shift-invariant", "Fig. 2b: polynomial", "Fig. 2c: logarithmic")
    for axis, frame, title in zip(axes[0, 1:], frames.values(), titles, strict=True):
        drawn = show(axis, frame, title, vmin=0.0, vmax=top)
    bar(drawn, axes[0, 1:], LABEL)
    return save(figure, "figures_1_and_2.png", folder)


def _figure_3(folder: Path) -> str:
    figure, axes = panels(2, 4)
    images = {}
    for name, coefficient in PRINTED["table1"].items():
        images[name, coefficient] = paper_model(
            bf.PolynomialDistortion([TERMS[name]], [])
        ).expected_counts([coefficient])
    top = max(image.max() for image in images.values())
    for axis, letter, ((name, coefficient), image) in zip(
        axes.flat, "abcdefgh", images.items(), strict=True
    ):
        pretty = name.replace("2", "²")
        drawn = show(
            axis, image, f"Fig. 3{letter}: f = {coefficient:g} {pretty}", vmin=0.0, vmax=top
        )
    bar(drawn, axes, LABEL)
    return save(figure, "figure_3.png", folder)
