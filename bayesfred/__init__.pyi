from . import commands, show
from .analysis.comparison import Comparison, compare
from .analysis.diagnostics import Diagnostics, diagnose
from .analysis.noise_study import NoiseStudy, noise_study
from .analysis.sbc import PosteriorCalibration, calibrate_posterior
from .errors import InputError
from .imaging.catalog import SourceCatalog
from .imaging.detector import Detector, correct_sampling, sampling_matrix
from .imaging.distortion import PolynomialDistortion
from .imaging.forward import ForwardModel
from .imaging.logarithm import LogDistortion
from .imaging.psf import GaussianPSF, MoffatPSF, SampledPSF
from .model.noise import BackgroundNoise, GaussianNoise, PoissonNoise, simulate
from .model.parameters import Nuisances
from .model.posterior import Posterior
from .optimize.estimate import MapEstimate
from .optimize.find_map import find_map, reject_outliers
from .sampling.chain import Chain
from .sampling.chainfile import open_chain
from .sampling.moves import LaplaceMove
from .sampling.record import RunRecord
from .sampling.sampler import sample

__all__ = [
    "BackgroundNoise",
    "Chain",
    "Comparison",
    "Detector",
    "Diagnostics",
    "ForwardModel",
    "GaussianNoise",
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
    "RunRecord",
    "SampledPSF",
    "SourceCatalog",
    "calibrate_posterior",
    "commands",
    "compare",
    "correct_sampling",
    "diagnose",
    "find_map",
    "noise_study",
    "open_chain",
    "reject_outliers",
    "sample",
    "sampling_matrix",
    "show",
    "simulate",
]
