from . import runs
from .analysis.comparison import Comparison, compare
from .analysis.diagnostics import Diagnostics, diagnose
from .analysis.sbc import PosteriorCalibration, calibrate_posterior
from .analysis.study import NoiseStudy, noise_study
from .errors import InputError
from .imaging.detector import Detector, correct_sampling, sampling_matrix
from .imaging.distortion import PolynomialDistortion
from .imaging.forward import ForwardModel
from .imaging.logarithm import LogDistortion
from .imaging.psf import GaussianPSF, MoffatPSF, SampledPSF
from .imaging.scene import SourceCatalog
from .inference.chainfile import Chain, open_chain
from .inference.estimate import MapEstimate, find_map, sigma_clip
from .inference.moves import LaplaceMove
from .inference.noise import BackgroundNoise, PoissonNoise, simulate
from .inference.posterior import Nuisances, Posterior
from .inference.sampling import sample

__all__ = [
    "BackgroundNoise",
    "Chain",
    "Comparison",
    "Detector",
    "Diagnostics",
    "ForwardModel",
    "GaussianPSF",
    "InputError",
    "LaplaceMove",
    "LogDistortion",
    "MapEstimate",
    "MoffatPSF",
    "NoiseStudy",
    "Nuisances",
    "PoissonNoise",
    "PolynomialDistortion",
    "Posterior",
    "PosteriorCalibration",
    "SampledPSF",
    "SourceCatalog",
    "calibrate_posterior",
    "compare",
    "correct_sampling",
    "diagnose",
    "find_map",
    "noise_study",
    "open_chain",
    "runs",
    "sample",
    "sampling_matrix",
    "sigma_clip",
    "simulate",
]
