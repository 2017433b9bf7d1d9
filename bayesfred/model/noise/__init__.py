"""What noise does to expected counts: one module a distribution.

`protocol.py` says what a noise model is.
"""

from bayesfred.model.noise.correlated import (
    CorrelatedNoise,
    correlated_terms,
    correlation_ratio,
    with_model_error,
)
from bayesfred.model.noise.flat_field import FlatFieldNoise
from bayesfred.model.noise.gaussian import BackgroundNoise, GaussianNoise
from bayesfred.model.noise.model_error import ModelErrorNoise, model_error_terms
from bayesfred.model.noise.poisson import PoissonNoise
from bayesfred.model.noise.protocol import Noise
from bayesfred.model.noise.simulation import simulate
from bayesfred.model.noise.subtracted import SubtractedNoise

__all__ = [
    "BackgroundNoise",
    "CorrelatedNoise",
    "FlatFieldNoise",
    "GaussianNoise",
    "ModelErrorNoise",
    "Noise",
    "PoissonNoise",
    "SubtractedNoise",
    "correlated_terms",
    "correlation_ratio",
    "model_error_terms",
    "simulate",
    "with_model_error",
]
