"""Parameters and numbers as text: symbols and units for matplotlib and HTML, values with errors.

What a parameter is comes from `bayesfred.model.parameters`, never from its name.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup

from bayesfred._typing import Floats
from bayesfred.errors import printable
from bayesfred.model.parameters import Parameter

__all__ = [
    "Scale",
    "axis_label",
    "html_symbol",
    "html_symbols",
    "html_unit",
    "math_symbol",
    "power_of_ten",
    "raised",
    "scale_of",
    "with_error",
]

_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


@dataclass(frozen=True)
class Scale:
    """How the numbers of one parameter are printed.

    Attributes
    ----------
    exponent : int
        They are divided by this power of ten.
    decimals : int
        Digits after the point.

    Examples
    --------
    >>> scale_of(-2.0123e-6, 1.23e-8).number(-2.0123e-6)
    '-2.012'
    """

    exponent: int
    decimals: int

    def number(self, value: float) -> str:
        """The value in this power of ten, without the power."""
        return f"{value / 10.0**self.exponent:.{self.decimals}f}"


def power_of_ten(values: Floats) -> int:
    """Exponent k for which values / 10^k print well; 0 where they do so unscaled.

    Parameters
    ----------
    values : ndarray, any shape and unit

    Returns
    -------
    int

    Examples
    --------
    >>> power_of_ten(np.array([-2e-6, 1e-8])), power_of_ten(np.array([5.0]))
    (-6, 0)
    """
    largest = float(np.max(np.abs(values), initial=0.0))
    if not 0.0 < largest < math.inf:
        return 0
    exponent = math.floor(math.log10(largest))
    return 0 if -2 <= exponent <= 3 else exponent


def scale_of(value: float, sd: float) -> Scale:
    """The power of ten of a value and its error, and the decimals that give the error two digits.

    Parameters
    ----------
    value, sd : float
        In one unit.

    Returns
    -------
    Scale

    Examples
    --------
    >>> scale_of(3.0, 0.0996)
    Scale(exponent=0, decimals=2)
    """
    exponent = power_of_ten(np.array([value, sd]))
    if not 0.0 < sd < math.inf:
        return Scale(exponent, 6)
    digits = math.floor(math.log10(sd) + 1e-12)
    if round(sd / 10.0 ** (digits - 1)) == 100:  # 0.0996 would round to 0.100: three digits
        digits += 1
    return Scale(exponent, max(0, 1 - digits + exponent))


def with_error(value: float, sd: float) -> str:
    """A value with its standard deviation, to two digits of the latter.

    Parameters
    ----------
    value, sd : float
        In one unit.

    Returns
    -------
    str
        Empty where the value is not finite.

    Examples
    --------
    >>> with_error(-5.1234, 0.0213), with_error(1.234e-5, 2e-7)
    ('-5.123 +- 0.021', '1.234 +- 0.020 e-05')
    """
    if not math.isfinite(value):
        return ""
    scale = scale_of(value, sd)
    power = f" e{scale.exponent:+03d}" if scale.exponent else ""
    return f"{scale.number(value)} +- {scale.number(sd)}{power}"


def math_symbol(parameter: Parameter) -> str:
    """A parameter's symbol as mathematics, for matplotlib.

    Parameters
    ----------
    parameter : Parameter

    Returns
    -------
    str

    Examples
    --------
    >>> from types import SimpleNamespace
    >>> math_symbol(SimpleNamespace(letter="f", powers=(("u", 1), ("x", 2))))
    '$f_{u x^2}$'
    """
    if not parameter.letter:
        return parameter.name.replace("_", " ")
    powers = " ".join(
        variable if power == 1 else f"{variable}^{power}" for variable, power in parameter.powers
    )
    return f"${parameter.letter}_{{{powers}}}$"


def axis_label(parameter: Parameter, exponent: int, separator: str = " ") -> str:
    """Symbol, power of ten and unit of an axis, for matplotlib.

    Parameters
    ----------
    parameter : Parameter
    exponent : int
        The power of ten that the axis leaves out.
    separator : str
        Stands between the symbol and the unit.

    Returns
    -------
    str

    Examples
    --------
    >>> from types import SimpleNamespace
    >>> axis_label(SimpleNamespace(name="psf_sigma", letter="", unit="", pixels=1), -2)
    'psf sigma [10⁻² px]'
    """
    pixel = raised("px", parameter.pixels) if parameter.pixels else ""
    power = raised("10", exponent) if exponent else ""
    unit = " ".join(part for part in (power, parameter.unit, pixel) if part)
    return math_symbol(parameter) + (f"{separator}[{unit}]" if unit else "")


def raised(base: str, power: int) -> str:
    """A power in the characters that Unicode has for it, which take no typesetting.

    Parameters
    ----------
    base : str
    power : int

    Returns
    -------
    str

    Examples
    --------
    >>> raised("px", -2), raised("px", 1)
    ('px⁻²', 'px')
    """
    return base if power == 1 else base + str(power).translate(_SUPERSCRIPTS)


def html_symbol(parameter: Parameter) -> Markup:
    """A parameter's symbol with its powers raised, for the page.

    Parameters
    ----------
    parameter : Parameter

    Returns
    -------
    Markup

    Examples
    --------
    >>> from types import SimpleNamespace
    >>> print(html_symbol(SimpleNamespace(letter="f", powers=(("u", 1), ("x", 2)))))
    <i>f</i><sub>ux<sup>2</sup></sub>
    """
    if not parameter.letter:
        return Markup("{}").format(printable(parameter.name.replace("_", " ")))
    powers = Markup("").join(_raised(variable, power) for variable, power in parameter.powers)
    return Markup("<i>{}</i><sub>{}</sub>").format(parameter.letter, powers)


def html_symbols(names: Sequence[str], parameters: Sequence[Parameter]) -> Markup:
    """The symbols of those of the parameters that are named, for the page.

    Parameters
    ----------
    names : sequence of str
    parameters : sequence of Parameter

    Returns
    -------
    Markup
    """
    return Markup(", ").join(html_symbol(p) for p in parameters if p.name in names)


def html_unit(parameter: Parameter, exponent: int) -> Markup:
    """Power of ten and unit of a row, for the page.

    Parameters
    ----------
    parameter : Parameter
    exponent : int
        The power of ten that the row leaves out.

    Returns
    -------
    Markup

    Examples
    --------
    >>> from types import SimpleNamespace
    >>> print(html_unit(SimpleNamespace(unit="", pixels=-2), -6))
    10<sup>−6</sup> px<sup>−2</sup>
    """
    parts = [_raised("10", exponent)] if exponent else []
    parts += [Markup("{}").format(parameter.unit)] if parameter.unit else []
    parts += [_raised("px", parameter.pixels)] if parameter.pixels else []
    return Markup(" ").join(parts)


def _raised(base: str, power: int) -> Markup:
    if power == 1:
        return Markup("{}").format(base)
    return Markup("{}<sup>{}</sup>").format(base, str(power).replace("-", "−"))
