"""One reason why a model may not fit, as a record."""

from dataclasses import dataclass

from bayesfred._typing import Ints
from bayesfred.imaging.catalog import SourceCatalog
from bayesfred.model.posterior import Posterior
from bayesfred.optimize.measure_psf import varying_more

RICHER = 0.9  # weight of a hypothesis that contains others
MISSING = "missing terms"
NAMED = 5  # sources listed


@dataclass(frozen=True)
class Cause:
    """What is probably wrong.

    Attributes
    ----------
    name : str
        One of "saturation", "alternating pixels", "rows or columns", "correlated pixels",
        "gain", "read noise", "pedestal", "over-dispersion", "background", "wings", "unmatched",
        "origin", "parity", "shift", "rotation or scale", "missing terms", "wrong sources",
        "positions", "uncatalogued sources", "companions", "fluxes" and "PSF".
    share : float
        Part of the misfit that it explains, from 0 to 1; 1 also where nothing can be judged.
    sentence : str
        What was found, how much of it, and where.
    remedy : str
        What to do.
    """

    name: str
    share: float
    sentence: str
    remedy: str


@dataclass(frozen=True)
class Finding:
    """A hypothesis that was tried.

    Attributes
    ----------
    cause : Cause
        With the share still to be set.
    explained : float
        Sum of squares that it explains.
    family : str
        Hypotheses that share a word of it explain the same squares.
    weight : float
        Factor below 1 of a hypothesis that contains others and has to explain more than they.
    """

    cause: Cause
    explained: float
    family: str
    weight: float = 1.0

    def shares(self, other: "Finding") -> bool:
        """Whether both explain the same squares."""
        return not set(self.family.split()).isdisjoint(other.family.split())


def rows_named(sources: SourceCatalog, rows: Ints) -> str:
    """The first of some rows of the catalogue, with their positions."""
    s, more = sources, ", ..." if rows.size > NAMED else ""
    names = "; ".join(f"{k} at x, y = {s.x[k]:.1f}, {s.y[k]:.1f}" for k in rows[:NAMED])
    return f"rows of the catalogue, from 0: {names}{more}"


def scatter_remedy(posterior: Posterior) -> str:
    """What lets sources lie off their places."""
    fluxes = "" if posterior.nuisances.flux == "free" else 'nuisances.flux = "free" and '
    return f"set {fluxes}nuisances.position_scatter = true"


def terms_remedy(degree: int) -> str:
    """What adds terms up to a degree."""
    terms = f"a polynomial of degree {degree} (distortion.degree)"
    return f"add terms to the distortion, such as {terms}"


def psf_remedy(posterior: Posterior, other: str) -> str:
    """What to do about a wrong PSF: of a measured one, and of any other."""
    return varying_more(posterior) or other
