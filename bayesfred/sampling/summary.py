"""What the draws of a chain say of every parameter, as one table.

The terminal, the page and `Chain.summary` show this table: `bayesfred.reporting` only formats it.
"""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from bayesfred._typing import Floats
from bayesfred.imaging.forward import ForwardModel
from bayesfred.io.summary_table import Table, make_table
from bayesfred.model.parameters import Parameter
from bayesfred.sampling.convergence import convergence

if TYPE_CHECKING:
    from bayesfred.sampling.chain import Chain

__all__ = ["summary", "unit_text"]


def summary(
    chain: "Chain",
    *,
    truth: Floats | None = None,
    columns: Mapping[str, Mapping[str, float]] | None = None,
) -> Table:
    """Tabulate the posterior of every parameter.

    Parameters
    ----------
    chain : Chain
        Its draws after burn-in are used.
    truth : ndarray, shape (d,), parameter units, optional
        Values that a simulation used.
    columns : mapping of str to mapping of str to float, optional
        Further columns, values by parameter name, such as `Diagnostics.columns`; with `rhat` among
        them nothing is computed twice. By default `rhat`, `ess_bulk` and `ess_tail` of a sampled
        chain, none of a Laplace approximation.

    Returns
    -------
    astropy.table.Table
        A row for each of the d parameters. Columns: `name`, `unit`; `truth`, if given; `MAP`,
        `mean` and `sd`, the standard deviation with n - 1 in the denominator, all in the
        parameter's unit; `z`, (mean - truth) / sd, where there is a truth; for a frame `corner` and
        `corner_sd`, pixel: mean and sd times the displacement that a unit of the parameter makes in
        that corner of the frame where it makes the largest (u = x, v = y there), nan for what
        displaces nothing; then `columns`. The sd holds for the stated model and noise: it omits
        errors of catalogue, PSF and model.

    Examples
    --------
    >>> import numpy as np
    >>> from types import SimpleNamespace
    >>> draws = np.random.default_rng(1).normal(5.0, 0.1, (4, 50, 32, 1))
    >>> chain = SimpleNamespace(
    ...     chain=draws, burn_in=0, draws=lambda: draws.reshape(-1, 1), posterior=lambda: None,
    ...     method="mcmc", parameter_names=("level",),
    ...     estimate=SimpleNamespace(params=np.array([5.0])))
    >>> table = summary(chain)
    >>> table.colnames
    ['name', 'unit', 'MAP', 'mean', 'sd', 'rhat', 'ess_bulk', 'ess_tail']
    >>> round(float(table["sd"][0]), 2)
    0.1
    """
    names = chain.parameter_names
    draws = chain.draws()
    mean, sd = draws.mean(axis=0), draws.std(axis=0, ddof=1)
    # a density that is no frame's has no units
    units = {p.name: unit_text(p) for p in getattr(chain.posterior(), "parameters", ())}
    model = getattr(chain.posterior(), "model", None)
    corner = _corner(model, names) if model else np.empty(0)
    given = {} if truth is None else {"truth": np.asarray(truth, dtype=np.float64)}
    with np.errstate(divide="ignore", invalid="ignore"):
        z = {key: (mean - value) / sd for key, value in given.items()}
    if columns is None and chain.method == "laplace":
        more = {}  # independent draws: nothing to converge
    elif columns is None:
        found = convergence(chain.chain[:, chain.burn_in :])
        more = dict(zip(("rhat", "ess_bulk", "ess_tail"), found, strict=True))
    else:
        more = {key: np.array([by[name] for name in names]) for key, by in columns.items()}
    return make_table(
        {
            "name": list(names),
            "unit": [units.get(name, "") for name in names],
            **given,
            "MAP": chain.estimate.params,
            "mean": mean,
            "sd": sd,
            **({"z": z["truth"]} if z else {}),
            **({"corner": corner * mean, "corner_sd": corner * sd} if model else {}),
            **more,
        }
    )


def _corner(model: ForwardModel, names: Sequence[str]) -> Floats:
    """The displacement that a unit of each parameter makes in a corner of the frame, shape (d,).

    It is the length of (f, g) in the corner where that is largest, pixel.
    """
    x, y = (0.5 * n * np.array([-1.0, 1.0]) for n in model.detector.fine_shape[::-1])
    x, y = np.meshgrid(x, y)
    size = np.linalg.norm(model.polynomial.design_matrix(x, y, x, y), axis=0).max(axis=(0, 1))
    by_name = dict(zip(model.distortion.names, size, strict=True))
    return np.array([by_name.get(n, 1.0 if n.startswith("offset_") else np.nan) for n in names])


def unit_text(parameter: Parameter) -> str:
    """Write a parameter's unit in plain characters.

    Parameters
    ----------
    parameter : Parameter

    Returns
    -------
    str
        Such as "px^-2"; empty for a pure number.

    Examples
    --------
    >>> from types import SimpleNamespace
    >>> unit_text(SimpleNamespace(unit="", pixels=-2))
    'px^-2'
    """
    power = parameter.pixels
    pixel = "" if power == 0 else "px" if power == 1 else f"px^{power}"
    return " ".join(part for part in (parameter.unit, pixel) if part)
