"""A chain as arviz takes it: draws, units, the frame, and the log-likelihood source by source.

arviz takes the draws of a chain as one series in time. Its R-hat compares chains, and the first
half of each with the second. Its effective sample sizes sum the correlation of draws that are close
in the series. An ensemble is a chain here, and its draws are in this order: those of the first half
of the steps walker by walker, then those of the second half walker by walker. So

- the halves are the early and the late steps, and arviz's R-hat is the package's;
- next to a draw stands the same walker's next one, and arviz's effective sample sizes count the
  correlation between steps. What is cut off where one walker ends and the next begins makes them
  too large, for steps of correlation 0.9 by 60 % where a run has 48 steps and by 14 % where it has
  160; for independent steps by nothing. In the order of the steps, all walkers after the first,
  then all after the second, they would be 18 times too large.

The package's own numbers, which have no such error, are attributes of every variable.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import arviz_base
import numpy as np
import xarray as xr
from scipy.spatial import KDTree

from bayesfred._typing import Floats, Ints
from bayesfred.model.posterior import Posterior
from bayesfred.sampling.convergence import convergence
from bayesfred.sampling.summary import unit_text

if TYPE_CHECKING:
    from bayesfred.sampling.chain import Chain

__all__ = ["source_of_pixels", "to_datatree"]

LIKELIHOODS = 400  # draws, of all chains together, whose log-likelihoods are computed
NEIGHBOURS = 8  # of a pixel: nearest sources of which one gives it most light
FAINT = 0.01  # of the PSF's peak: pixels with less of every source belong to none


def to_datatree(chain: "Chain", *, log_likelihood: bool = False) -> xr.DataTree:
    """The draws of a chain after burn-in, for arviz.

    Parameters
    ----------
    chain : Chain
    log_likelihood : bool
        Compute the log-likelihood source by source, of at most 400 evenly spaced draws.

    Returns
    -------
    xarray.DataTree
        Groups:

        - `posterior`: a variable for each parameter, dimensions (chain, draw); an ensemble is a
          chain. Attributes `units`, and of a sampled chain `rhat`, `ess_bulk` and `ess_tail`.
        - `sample_stats`: `lp`, the log-posterior density.
        - `observed_data`: `counts`, dimensions (v, u), NaN where a pixel is not used, and `mask`.
        - `constant_data`: `x`, `y`, `flux` of the catalogue, dimension `source`, and `psf_sigma`.
        - `log_likelihood`, if asked for: `counts`, dimensions (chain, draw, source), summed over
          the pixels that get most of their light from a source; the last one, source -1, is of all
          other pixels. Where fluxes are free, it is that of the most likely fluxes.

        A density that is not of a frame has the first two only.

    Notes
    -----
    A pixel belongs to the source that gives it most light at the MAP, where the PSF exceeds a
    hundredth of its peak.

    Examples
    --------
    >>> import bayesfred as bf
    >>> model = bf.ForwardModel(
    ...     bf.Detector((65, 65)), bf.SourceCatalog.grid(3, 20.0, 1e4), bf.GaussianPSF(3.0),
    ...     bf.PolynomialDistortion(f_terms=[(1, 0, 1, 0)], g_terms=[]))
    >>> posterior = bf.Posterior(model, bf.simulate(model, [1e-4], 2.0, seed=1))
    >>> tree = to_datatree(bf.laplace(posterior, seed=1, progress=False), log_likelihood=True)
    >>> sorted(tree.children)
    ['constant_data', 'log_likelihood', 'observed_data', 'posterior', 'sample_stats']
    >>> dict(tree["log_likelihood"].sizes)
    {'chain': 1, 'draw': 334, 'source': 10}
    """
    kept = chain.chain[:, chain.burn_in :]
    order = _order(*kept.shape[1:3])
    draws = chain.draws().reshape(len(kept), -1, kept.shape[3])[:, order]
    log_prob = chain.log_prob[:, chain.burn_in :].reshape(len(kept), -1)[:, order]
    groups: dict[str, Any] = {
        "posterior": {name: draws[..., k] for k, name in enumerate(chain.parameter_names)},
        "sample_stats": {"lp": log_prob},
    }
    tree = arviz_base.from_dict(groups)
    attributes = _attributes(chain)
    for name, known in attributes.items():
        tree["posterior"][name].attrs.update(known)
    tree["posterior"].attrs["method"] = chain.method
    posterior = chain.posterior()
    if not isinstance(posterior, Posterior):
        return tree
    tree["observed_data"] = xr.DataTree(_frame(posterior))
    tree["constant_data"] = xr.DataTree(_catalogue(posterior))
    if log_likelihood:
        every = max(1, -(-draws.shape[0] * draws.shape[1] // LIKELIHOODS))
        thinned = np.arange(0, draws.shape[1], every)
        values = _by_source(posterior, chain.estimate.params, draws[:, thinned])
        tree["log_likelihood"] = xr.DataTree(
            xr.Dataset(
                {"counts": (("chain", "draw", "source"), values)},
                coords={
                    "chain": np.arange(len(draws)),
                    "draw": thinned,
                    "source": [*range(len(posterior.model.sources)), -1],
                },
            )
        )
    return tree


def _order(steps: int, walkers: int) -> Ints:
    """Places of an ensemble's draws, numbered step by step, in the series for arviz."""
    place = np.arange(steps * walkers).reshape(steps, walkers).T
    # of an odd number of steps the middle one is early for half of the walkers
    last = np.where(np.arange(walkers) < walkers // 2, (steps + 1) // 2, steps // 2)
    early = np.arange(steps) < last[:, None]
    return np.concatenate([place[early], place[~early]])


def _attributes(chain: "Chain") -> dict[str, dict[str, Any]]:
    """Unit and quality of every parameter's draws."""
    found: dict[str, dict[str, Any]] = {name: {"units": ""} for name in chain.parameter_names}
    for parameter in getattr(chain.posterior(), "parameters", ()):
        found[parameter.name]["units"] = unit_text(parameter)
    quality: dict[str, Floats] = {}
    if chain.method == "mcmc":
        names = ("rhat", "ess_bulk", "ess_tail")
        quality = dict(zip(names, convergence(chain.chain[:, chain.burn_in :]), strict=True))
    return {
        name: units | {key: float(values[k]) for key, values in quality.items()}
        for k, (name, units) in enumerate(found.items())
    }


def _pixels(posterior: Posterior) -> tuple[Floats, Floats]:
    """Coordinates u of the columns and v of the rows, recorded pixels from the frame's middle."""
    ny, nx = posterior.counts.shape
    return np.arange(nx) - 0.5 * (nx - 1), np.arange(ny) - 0.5 * (ny - 1)


def _frame(posterior: Posterior) -> xr.Dataset:
    u, v = _pixels(posterior)
    used = np.where(posterior.mask, posterior.counts, np.nan)
    return xr.Dataset(
        {
            "counts": (("v", "u"), used, {"units": "count"}),
            "mask": (("v", "u"), posterior.mask),
        },
        coords={"v": ("v", v, {"units": "px"}), "u": ("u", u, {"units": "px"})},
    )


def _catalogue(posterior: Posterior) -> xr.Dataset:
    sources = posterior.model.sources
    columns = {"x": (sources.x, "px"), "y": (sources.y, "px"), "flux": (sources.flux, "count")}
    variables: dict[str, Any] = {
        name: ("source", values, {"units": units}) for name, (values, units) in columns.items()
    }
    variables["psf_sigma"] = ((), posterior.model.psf.sigma, {"units": "px"})
    return xr.Dataset(variables, coords={"source": np.arange(len(sources))})


def source_of_pixels(posterior: Posterior, params: Floats) -> Ints:
    """The source that every pixel of the likelihood gets most light from.

    Parameters
    ----------
    posterior : Posterior
    params : ndarray, shape (d,), parameter units

    Returns
    -------
    ndarray of int, shape (number of pixels in the mask,)
        Index in the catalogue; the number of sources where there is none.
    """
    model = posterior.model
    images = posterior.likelihood.image_positions(params)
    imaged = np.flatnonzero(np.isfinite(images).all(axis=1))
    u, v = _pixels(posterior)
    rows, columns = np.nonzero(posterior.mask)
    pixels = np.stack([u[columns], v[rows]], axis=1) * model.detector.binning
    found = np.full(len(pixels), len(images))
    if not imaged.size:
        return found
    k = min(NEIGHBOURS, imaged.size)
    near = KDTree(images[imaged]).query(pixels, k=k)[1].reshape(-1, k)
    off = pixels[:, None] - images[imaged][near]
    light = model.psf.density(off[..., 0], off[..., 1])
    light = np.where(light > FAINT * model.psf.peak, light, 0.0)
    light *= posterior.fluxes(params)[imaged][near]
    best = np.argmax(light, axis=1)
    every = np.arange(len(pixels))
    lit = light[every, best] > 0.0
    found[lit] = imaged[near[every, best]][lit]
    return found


def _by_source(posterior: Posterior, params: Floats, draws: Floats) -> Floats:
    """Log-likelihood of the pixels of every source, and of the others; (chain, draw, source)."""
    used, n = posterior.mask, len(posterior.model.sources) + 1
    owner, counts = source_of_pixels(posterior, params), posterior.counts[used]
    constant = posterior.parameter_names.index("background")

    def one(draw: Floats) -> Floats:
        expected = posterior.expected_counts(draw)[used]
        noise = posterior.noise_at(draw).at(used)
        each = noise.log_likelihood(counts, expected, draw[constant])
        return np.asarray(np.bincount(owner, each, n), dtype=np.float64)

    along: Callable[..., Floats] = np.apply_along_axis
    return along(one, 2, draws)
