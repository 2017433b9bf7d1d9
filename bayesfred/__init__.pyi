from . import commands, show
from .analysis.causes import Cause, find_causes
from .analysis.choose_terms import TermChoice, choose_terms
from .analysis.comparison import Comparison, compare
from .analysis.cross_check import CrossCheck, cross_check
from .analysis.design import Design, design
from .analysis.diagnostics import Diagnostics, diagnose
from .analysis.displacements import marginalize_displacements
from .analysis.evidence import Evidence, log_evidence
from .analysis.field import DisplacementField, displacement_field
from .analysis.noise_study import NoiseStudy, noise_study
from .analysis.photon_transfer import PhotonTransfer, photon_transfer
from .analysis.photons import PhotonsNeeded, photons_needed
from .analysis.prior_predictive import PriorPredictive, prior_predictive
from .analysis.remote_frames import RemoteFrames
from .analysis.sbc import SBCResult, simulation_based_calibration
from .calibration.calibration import Calibration
from .calibration.correct import correct
from .calibration.corrected import CorrectedFrame
from .calibration.self_calibration import SelfCalibration, self_calibrate
from .errors import ExtrapolationWarning, InputError
from .imaging.catalog import SourceCatalog
from .imaging.detector import Detector, correct_sampling, sampling_matrix
from .imaging.distortion import PolynomialDistortion
from .imaging.forward import ForwardModel
from .imaging.logarithm import LogDistortion
from .imaging.psf import GaussianPSF, MeasuredPSF, MoffatPSF, SampledPSF
from .model.drift import Drift
from .model.joint import JointPosterior
from .model.noise import (
    BackgroundNoise,
    CorrelatedNoise,
    FlatFieldNoise,
    GaussianNoise,
    PoissonNoise,
    SubtractedNoise,
    simulate,
)
from .model.parameters import Nuisances
from .model.posterior import Posterior
from .optimize.estimate import MapEstimate
from .optimize.find_map import find_map, reject_outliers
from .optimize.fit_psf import fit_psf
from .optimize.follow import follow_images
from .optimize.grid_marks import invert_dots
from .optimize.grid_target import GridImage, GridTarget, index_grid
from .optimize.local_background import subtract_background
from .optimize.measure_psf import marginalize_psf, measure_psf
from .optimize.uncatalogued import UncataloguedSources, find_uncatalogued
from .sampling.chain import Chain
from .sampling.chainfile import open_chain
from .sampling.laplace import laplace
from .sampling.moves import LaplaceMove
from .sampling.record import RunRecord
from .sampling.sampler import sample

__all__ = [
    "BackgroundNoise",
    "Calibration",
    "Cause",
    "Chain",
    "Comparison",
    "CorrectedFrame",
    "CorrelatedNoise",
    "CrossCheck",
    "Design",
    "Detector",
    "Diagnostics",
    "DisplacementField",
    "Drift",
    "Evidence",
    "ExtrapolationWarning",
    "FlatFieldNoise",
    "ForwardModel",
    "GaussianNoise",
    "GaussianPSF",
    "GridImage",
    "GridTarget",
    "InputError",
    "JointPosterior",
    "LaplaceMove",
    "LogDistortion",
    "MapEstimate",
    "MeasuredPSF",
    "MoffatPSF",
    "NoiseStudy",
    "Nuisances",
    "PhotonTransfer",
    "PhotonsNeeded",
    "PoissonNoise",
    "PolynomialDistortion",
    "Posterior",
    "PriorPredictive",
    "RemoteFrames",
    "RunRecord",
    "SBCResult",
    "SampledPSF",
    "SelfCalibration",
    "SourceCatalog",
    "SubtractedNoise",
    "TermChoice",
    "UncataloguedSources",
    "choose_terms",
    "commands",
    "compare",
    "correct",
    "correct_sampling",
    "cross_check",
    "design",
    "diagnose",
    "displacement_field",
    "find_causes",
    "find_map",
    "find_uncatalogued",
    "fit_psf",
    "follow_images",
    "index_grid",
    "invert_dots",
    "laplace",
    "log_evidence",
    "marginalize_displacements",
    "marginalize_psf",
    "measure_psf",
    "noise_study",
    "open_chain",
    "photon_transfer",
    "photons_needed",
    "prior_predictive",
    "reject_outliers",
    "sample",
    "sampling_matrix",
    "self_calibrate",
    "show",
    "simulate",
    "simulation_based_calibration",
    "subtract_background",
]
