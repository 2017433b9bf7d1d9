"""What a FITS header says of its numbers: unit, gain, read noise, pedestal, saturation.

`conversion` holds it against what the caller says. A keyword is honoured, said not to be used, or
refused in one line; none is dropped without a word. What the caller gives counts more than a header
but for a unit of electrons, which leaves nothing to convert.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bayesfred.errors import InputError, printable

__all__ = ["KEYWORDS", "Conversion", "conversion", "noise_in", "units"]

GAIN = ("EGAIN", "GAIN", "CCDGAIN", "ESO DET OUT1 CONAD")  # e-/adu
READ_NOISE = ("RDNOISE", "READNOIS", "READNOISE", "ENOISE", "ESO DET OUT1 RON")
PEDESTAL = ("PEDESTAL",)
SATURATION = ("SATURATE", "SATLEVEL")

KEYWORDS = ("BUNIT", *GAIN, *READ_NOISE, *PEDESTAL, *SATURATION)

ELECTRONS = ("electron", "e", "el", "photon", "ph", "photoelectron")
NUMBERS = ("", "adu", "dn", "du", "count", "ct", "cnt")
LARGEST_GAIN = 30.0  # e-/adu; a larger GAIN is the setting of a camera, not its gain


@dataclass(frozen=True)
class Conversion:
    """How stored numbers become counts, and what is known of the detector.

    Attributes
    ----------
    gain : float or None, e-/adu
        None where the stored numbers have to be counts already.
    pedestal : float, stored units
    saturation : float or None, stored units
    read_noise : float or None, e-
        As the header has it.
    notes : tuple of str
        What was taken from the header, and what was not.
    """

    gain: float | None
    pedestal: float
    saturation: float | None
    read_noise: float | None
    notes: tuple[str, ...]


def conversion(
    path: Path,
    header: Mapping[str, Any],
    *,
    gain: float | None,
    pedestal: float | None,
    saturation: float | None,
) -> Conversion:
    """Hold a header against what the caller says.

    Parameters
    ----------
    path : Path
        The frame's file, to begin lines with.
    header : mapping
        Keywords with their values; empty for a file that has none.
    gain : float, optional, e-/adu
    pedestal, saturation : float, optional, stored units

    Returns
    -------
    Conversion

    Raises
    ------
    InputError
        The header contradicts the caller, or says what cannot be taken at its word.
    """
    found = _Header(path, header)
    unit = str(header.get("BUNIT", "")).strip()
    kind = units(header)
    if kind == "electrons":
        if gain not in (None, 1.0):
            raise InputError(
                f"{path}: gain: got {gain} for a frame whose BUNIT is {printable(unit)!r}, "
                "expected none, as nothing is left to convert: remove it"
            )
        found.notes.append(f"in {printable(unit)} (BUNIT)")
        gain = 1.0
    elif gain is None:
        if kind != "adu":
            raise InputError(
                f"{path}: BUNIT: got {printable(unit)!r}, expected adu or electrons: give gain "
                f"(electrons per {printable(unit)}) and pedestal"
            )
        gain = found.take(GAIN, "gain", "e-/adu", least=0.0)
        if gain is None and unit.lower().startswith(("adu", "d")):
            raise InputError(
                f"{path}: BUNIT: got {printable(unit)!r} without a GAIN, expected counts; give "
                "gain (e-/adu) and pedestal"
            )
        if gain is not None and gain > LARGEST_GAIN:
            raise InputError(
                f"{path}: {found.key(GAIN)}: got {gain:g} in the header, which looks like a "
                "camera's setting, expected electrons per adu: give gain"
            )
    else:
        if kind != "adu":
            found.notes.append(f"BUNIT {printable(unit)!r} converted by the gain given")
        found.compare(GAIN, gain)
    pedestal = _pedestal(found, pedestal)
    if saturation is None:
        saturation = found.take(SATURATION, "saturation", "stored units")
    else:
        found.compare(SATURATION, saturation)
    read_noise = found.number(READ_NOISE)
    if read_noise is not None and not 0.0 <= read_noise < math.inf:
        found.notes.append(f"{found.key(READ_NOISE)} = {read_noise} not used: no read noise")
        read_noise = None
    return Conversion(gain, pedestal, saturation, read_noise, tuple(found.notes))


def units(header: Mapping[str, Any]) -> str:
    """What the numbers are by BUNIT: "electrons", "adu" or, if it is another, the unit itself."""
    unit = str(header.get("BUNIT", "")).strip()
    plain = unit.lower().removesuffix("s").removesuffix("-").removesuffix("^")
    return "electrons" if plain in ELECTRONS else "adu" if plain in NUMBERS else unit


def noise_in(header: Mapping[str, Any]) -> tuple[str, float | None]:
    """A header's gain, pedestal and read noise in words, and the read noise, if it has one."""
    found = _Header(Path(), header)
    keys = filter(None, map(found.key, (GAIN, PEDESTAL, READ_NOISE)))
    words = ", ".join(f"{key} = {printable(str(header[key]))}" for key in keys)
    read_noise = found.number(READ_NOISE)
    known = read_noise is not None and 0.0 < read_noise < math.inf
    return f"in the header {words}" if words else "", read_noise if known else None


def _pedestal(found: _Header, given: float | None) -> float:
    """The level without light; programs differ in the sign that a header gives it."""
    level = found.number(PEDESTAL)
    if given is not None:
        if level is not None and not math.isclose(abs(level), abs(given), rel_tol=1e-6):
            found.notes.append(f"pedestal {given:g} as given, not PEDESTAL = {level:g}")
        return given
    if level is not None and level != 0.0:
        raise InputError(
            f"{found.path}: PEDESTAL: got {level:g} in the header, of either sign depending on "
            f"the program that wrote it, expected pedestal to be given: {level:g} or {-level:g}, "
            "the level that no light would give"
        )
    return 0.0


class _Header:
    """The numbers of a header, and notes of what becomes of them."""

    def __init__(self, path: Path, header: Mapping[str, Any]) -> None:
        self.path, self.header = path, header
        self.notes: list[str] = []

    def key(self, names: Sequence[str]) -> str:
        """The first of these keywords that the header has with a value; empty without one."""
        present = (name for name in names if str(self.header.get(name, "")).strip())
        return next(present, "")

    def number(self, names: Sequence[str]) -> float | None:
        """The value of that keyword, nan where it is no number; None without one."""
        key = self.key(names)
        if not key:
            return None
        try:
            value = self.header[key]
            return math.nan if isinstance(value, bool) else float(value)
        except (TypeError, ValueError):
            return math.nan

    def take(
        self, names: Sequence[str], label: str, unit: str, least: float = -math.inf
    ) -> float | None:
        """The value to use, with a note; one that cannot be used is refused."""
        value, key = self.number(names), self.key(names)
        if value is None:
            return None
        if not (math.isfinite(value) and value > least):
            got = printable(str(self.header[key]))
            kind = "a positive number" if least == 0.0 else "a number"
            raise InputError(
                f"{self.path}: {key}: got {got!r} in the header, expected {kind} ({unit}): give "
                f"{label}"
            )
        self.notes.append(f"{label} {value:g} ({key})")
        return value

    def compare(self, names: Sequence[str], given: float) -> None:
        """Note where a header differs from the value given."""
        value, key = self.number(names), self.key(names)
        if value is not None and not math.isclose(value, given, rel_tol=0.01):
            got = printable(str(self.header[key]))
            self.notes.append(f"{given:g} as given, not {key} = {got}")
