"""The parameters of a posterior: what each is called, and its symbol and unit.

Labels of figures and tables come from here, not from names.
"""

import re
from dataclasses import dataclass
from typing import Any

OTHERS = {"background": ("counts", 0), "flux_scale": ("", 0)}  # all else is in pixels


@dataclass(frozen=True)
class Parameter:
    """One parameter of a posterior.

    Attributes
    ----------
    name : str
        As in `Posterior.parameter_names`.
    letter : str
        The symbol's letter: "f", "g" or "b"; empty where the name itself is the label.
    powers : tuple of (str, int)
        Variables and their powers, the letter's index.
    unit : str
        The unit but for pixels: "", or "counts".
    pixels : int
        Power of a pixel that multiplies the unit.
    """

    name: str
    letter: str = ""
    powers: tuple[tuple[str, int], ...] = ()
    unit: str = ""
    pixels: int = 0


def parameters(posterior: Any) -> tuple[Parameter, ...]:
    """Describe a posterior's parameters, in the order of its `parameter_names`."""
    return tuple(_parameter(name) for name in posterior.parameter_names)


def _parameter(name: str) -> Parameter:
    match = re.fullmatch(r"(f|g|background)_((?:[uvxy]\d*)+)", name)
    if match is None:
        unit, pixels = OTHERS.get(name, ("", 1))
        return Parameter(name, unit=unit, pixels=pixels)
    factors = re.findall(r"([uvxy])(\d*)", match[2])
    powers = tuple((variable, int(power or 1)) for variable, power in factors)
    if match[1] == "background":  # its u and v run from -1 to 1 over the frame
        return Parameter(name, "b", powers, "counts")
    return Parameter(name, match[1], powers, "", 1 - sum(power for _, power in powers))
