"""The paper's numbers: the quick part of `examples/paper` against its README, and known answers.

Where a number has an error, tolerances are in units of it: the row's own posterior standard
deviation.
"""

import importlib
import re
import sys
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))
paper: Any = importlib.import_module("examples.paper.__main__")
common: Any = importlib.import_module("examples.paper.common")
README = (ROOT / "examples" / "paper" / "README.md").read_text(encoding="utf-8")
NUMBER = r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?"


def room(name: str) -> Any:
    return importlib.import_module(f"examples.paper.{name}")


@cache
def quick(name: str) -> Any:
    return room(name).make(True, Path())


def rows(name: str) -> dict[str, Any]:
    return {row.quantity: row for row in quick(name).rows}


def value(row: Any) -> float:
    return float(re.findall(NUMBER, row.ours)[0])


# --------------------------------------------------------------------------------------------------


def committed(text: str) -> dict[str, tuple[str, str]]:
    """Our number and the verdict of every row, by section and quantity."""
    found, title = {}, ""
    for line in text.splitlines():
        title = line[3:] if line.startswith("## ") else title
        cells = [cell.strip() for cell in line.strip("|").split(" |")]
        if line.startswith("| ") and len(cells) == 5:
            found[f"{title}: {cells[0]}"] = cells[2], cells[3]
    return found


def close(one: str, other: str) -> bool:
    """Whether two cells agree: to a tenth of the error stated, or a hundredth where none is.

    An error itself may differ by 15 %, those of the Laplace approximation from those of a thousand
    draws. "about" is the size of a rounding error, which is up to the machine.
    """
    if "about" in one and "about" in other:
        return True
    a, b = ([float(number) for number in re.findall(NUMBER, cell)] for cell in (one, other))
    if re.sub(NUMBER, "", one) != re.sub(NUMBER, "", other) or len(a) != len(b):
        return False
    if "±" in one:
        return abs(a[0] - b[0]) <= 0.1 * a[1] + last_digit(one) and abs(a[1] / b[1] - 1.0) < 0.15
    slack = 0.15 if " to " in one else 0.01
    return all(abs(p - q) <= slack * abs(p) + last_digit(one) for p, q in zip(a, b, strict=True))


def last_digit(cell: str) -> float:
    """One unit of the last digit that the first number has."""
    mantissa, _, power = (
        re.findall(NUMBER, cell)[0].partition("e") if re.findall(NUMBER, cell) else ("0", "", "")
    )
    return float(10.0 ** (int(power or 0) - len(mantissa.partition(".")[2])))


def differences(section: Any, text: str) -> list[str]:
    """Rows of a section that the README lacks or states otherwise."""
    known = committed(text)
    wrong = []
    for row in section.rows:
        ours, agrees = known.get(f"{section.title}: {row.quantity}", ("nothing", ""))
        if not close(row.ours, ours) or agrees != paper.verdict(row):
            wrong.append(f"{row.quantity}: {row.ours}, README {ours}")
    return wrong


# 3175 x 3175 pixels take longest
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.long if name == "table3" else ())
        for name in paper.MODULES
    ],
)
def test_readme_says_what_comes_out(name: str) -> None:
    assert differences(quick(name), README) == []


def test_readme_that_says_something_else_is_noticed() -> None:
    """Negative control: a coefficient half an sd off, another verdict, a row that is not there."""
    line = next(
        line for line in README.splitlines() if line.startswith("| λ = 10, paper's noise: f_vx,")
    )
    number, sd = (float(n) for n in re.findall(NUMBER, line.split("|")[3]))
    for edited in (
        line.replace(line.split("|")[3], f" {number + 0.5 * sd:.3f} ± {sd} "),
        line.replace("| yes |", "| no |"),
        line.replace("f_vx", "f_vz"),
    ):
        assert edited != line
        assert len(differences(quick("table2"), README.replace(line, edited))) == 1


def test_readme_lists_every_printed_number() -> None:
    """All rows of Table 2, and of Table 3: 12 coefficients in a cell without noise, 24 with it."""
    known = committed(README)
    assert sum("paper's noise: " in key and ", 1e-6" in key for key in known) == 36
    assert (
        sum("Table 3" in key and re.search(r": [fg]_\w+, 1e-8$", key) is not None for key in known)
        == 24
    )
    assert sum(re.search(r": k\d, 1e-5", key) is not None for key in known) == 16
    assert all(
        f"pictures/{picture.name}" in README
        for picture in (ROOT / "examples" / "paper" / "pictures").glob("*.png")
    )


# --------------------------------------------------------------------------------------------------


def test_printed_errors_tell_how_columns_are_read() -> None:
    table2 = room("table2")
    known = {
        (common.AS_PRINTED, "x"): (816, 5017, 9219),
        (common.ALTERNATIVE, "x"): (18, 35, 3),
        (common.ALTERNATIVE, "y"): (14.1, 12.2, 2.8),
    }
    for reading, expected in known.items():
        assert table2.chi_square_of_printed_errors(*reading) == pytest.approx(
            expected, rel=0.001, abs=0.5
        )
    taken = table2.chi_square_of_printed_errors(common.COLUMNS, "y")
    assert sum(taken) < 36 + 3 * np.sqrt(72)  # 36 degrees of freedom


def test_columns_are_those_of_figure_2_and_of_the_pinhole() -> None:
    """The printed truth is the function of Fig. 2b, and the pinhole sees what the paper's saw."""
    powers = dict(zip(common.DISTORTION.names, common.truth("table2"), strict=True))
    printed = common.PRINTED["figure2"]["polynomial"]
    assert {
        name[2:]: value for name, value in powers.items() if name[0] == "f" and value
    } == printed["f"]
    assert {
        name[2:]: value for name, value in powers.items() if name[0] == "g" and value
    } == pytest.approx(printed["g"])
    table3 = room("table3")
    k = np.array(table3.T["polynomial"]["k"])
    off = {
        c: np.abs(table3.seen_by_pinhole(c) * table3.K_SCALE - k).max()
        for c in (common.COLUMNS, common.ALTERNATIVE, common.AS_PRINTED)
    }
    assert off[common.COLUMNS] < 0.15 < 1.0 < min(off[common.ALTERNATIVE], off[common.AS_PRINTED])


def test_correction_of_the_sampling_effect() -> None:
    sampling = room("sampling")
    ideal, recorded = sampling.spot("impulse"), sampling.spot("box")
    assert np.abs(recorded - ideal).max() == pytest.approx(0.01, rel=0.1)
    assert np.abs(sampling.bf.correct_sampling(recorded) - ideal).max() < 1e-13
    # negative control: a matrix whose pixel is one per cent wider leaves a hundred millionfold more
    wide = ideal + 1.01 * (recorded - ideal)
    assert np.abs(sampling.bf.correct_sampling(wide) - ideal).max() > 1e-5


def test_noise_that_correction_correlates() -> None:
    """Errors quoted by a fit to the corrected frame are too small, more so for narrow spots."""
    quoted = room("sampling").quoted_over_true
    assert quoted(0.8) < 0.95 < 0.98 < quoted(3.0) < 1.0


def test_reference_psf_of_a_lone_spot_is_exact() -> None:
    found = rows("figure5")
    assert value(found["source alone: largest error / peak"]) < 1e-12
    assert value(found["central spot of Fig. 2b: largest error / peak"]) > 0.01


def test_reconstruction_without_noise_leaves_rounding() -> None:
    assert value(rows("figure6")["polynomial: V"]) < 1e-28


@pytest.mark.long
def test_reconstruction_of_binned_pixels_without_noise_leaves_rounding() -> None:
    # coordinates u, x of 1500 pixels are rounded to 1e-13, a spot's values to 1e-14 and less: 324
    # pixels make some 1e-27
    assert value(rows("table3")["polynomial: V, Fredholm"]) < 1e-25
    assert value(rows("table3")["polynomial: V, Fredholm, as mean over the pixels"]) <= 1e-28
    assert value(rows("table3")["polynomial: V, pinhole"]) > 0.1


@pytest.mark.parametrize("kind", ["paper's noise", "Poisson counts"])
def test_coefficients_lie_within_their_errors(kind: str) -> None:
    """36 of each kind: none is 4 sd off, and their mean square is 1 within 4 of its own sd."""
    table = rows("table2")
    z = deviations(
        table, kind, dict(zip(common.DISTORTION.names, common.truth("table2") / 1e-6, strict=True))
    )
    assert z.size == 36 and np.abs(z).max() < 4.0
    # negative control: the truth in the other order of columns
    other = dict(
        zip(common.read_as(common.ALTERNATIVE).names, common.truth("table2") / 1e-6, strict=True)
    )
    assert np.abs(deviations(table, kind, other)).max() > 40.0


def deviations(table: dict[str, Any], kind: str, truth: dict[str, float]) -> Any:
    z = []
    for quantity, row in table.items():
        name = re.search(rf"{kind}: ([fg]_\w+),", quantity)
        if name:
            found, sd = (float(number) for number in re.findall(NUMBER, row.ours))
            z.append((found - truth[name[1]]) / sd)
    return np.array(z)


def test_background_and_chi_square_lie_within_their_errors() -> None:
    for background in (5, 10, 50):
        for what, expected in (("λ estimate", background), ("χ²", 1.0)):
            found, sd = (
                float(n)
                for n in re.findall(
                    NUMBER, rows("table2")[f"λ = {background}, paper's noise: {what}"].ours
                )
            )
            assert abs(found - expected) < 4.0 * sd


# --------------------------------------------------------------------------------------------------


@pytest.mark.statistics
def test_coverage_with_the_pixel_in_the_model_and_in_the_frame() -> None:
    """200 frames, 4 coefficients each: the scatter of errors is known to 1 / sqrt(1600) = 2.5 %."""
    sampling = room("sampling")
    frame, chi2_frame, model, chi2_model = sampling.errors_in_units(200)
    assert np.sqrt(np.mean(model**2)) == pytest.approx(1.0, abs=4 * 0.025)
    assert np.sqrt(np.mean(frame**2)) == pytest.approx(
        1.0 / sampling.quoted_over_true(sampling.NARROW), rel=4 * 0.025
    )
    assert np.mean(frame**2) > np.mean(model**2)  # of the same frames
    assert chi2_model.mean() == pytest.approx(1.0, abs=0.02) and chi2_frame.mean() > 1.5


@pytest.mark.long
@pytest.mark.parametrize("name", paper.MODULES)
def test_everything_comes_out_as_committed(name: str, tmp_path: Path) -> None:
    section = room(name).make(False, tmp_path)
    assert differences(section, README) == []
    assert {picture.name for picture in tmp_path.glob("*.png")} == set(section.pictures)
    chosen = {row.quantity: row for row in section.rows}
    if name == "table3":
        assert chosen["noise: model that leave-one-out prefers"].ours == "Fredholm"
    if name == "figure6":
        assert any("predictive accuracy chooses" in quantity for quantity in chosen)
