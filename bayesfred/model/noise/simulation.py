"""Frames drawn from a forward model and a noise model."""

import math

import numpy as np
import numpy.typing as npt

from bayesfred._typing import Floats
from bayesfred.errors import InputError
from bayesfred.imaging.forward import ForwardModel
from bayesfred.model.noise.poisson import PoissonNoise
from bayesfred.model.noise.protocol import Noise


def simulate(
    model: ForwardModel,
    theta: npt.ArrayLike,
    background: float,
    *,
    seed: int | np.random.SeedSequence,
    noise: Noise = PoissonNoise(),
) -> Floats:
    """Draw a frame.

    Parameters
    ----------
    model : ForwardModel
    theta : array_like, shape (n_terms,), pixel^(1 - degree of the term)
    background : float, counts per pixel
        Constant background, >= 0.
    seed : int or SeedSequence
    noise : Noise

    Returns
    -------
    ndarray, shape (ny, nx), counts

    Raises
    ------
    InputError
        If the background is negative or not finite, or `theta` has another shape.

    Examples
    --------
    >>> import bayesfred as bf
    >>> model = bf.ForwardModel(
    ...     bf.Detector((33, 33)), bf.SourceCatalog([0.0], [0.0], [100.0]), bf.GaussianPSF(3.0),
    ...     bf.PolynomialDistortion.mirrored())
    >>> bf.simulate(model, np.zeros(12), 1.0, seed=1).shape
    (33, 33)
    """
    if not (math.isfinite(background) and background >= 0):
        raise InputError(
            f"background: got {background}, expected a number of counts per pixel >= 0"
        )
    return noise.draw(model.expected_counts(theta), background, np.random.default_rng(seed))
