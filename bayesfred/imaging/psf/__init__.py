"""Reference point spread functions: the p of the Fredholm model, normalised to unit volume.

One module a family; `protocol.py` says what a family is, `forward.py` samples them through the
compiled loops.
"""

from bayesfred.imaging.psf.gaussian import GaussianPSF
from bayesfred.imaging.psf.measured import MeasuredPSF, PSFFile, PSFToMeasure
from bayesfred.imaging.psf.moffat import MoffatPSF
from bayesfred.imaging.psf.protocol import FWHM, PSF, density_at, has_pixel, profile_of
from bayesfred.imaging.psf.sampled import SampledPSF

__all__ = [
    "FWHM",
    "PSF",
    "GaussianPSF",
    "MeasuredPSF",
    "MoffatPSF",
    "PSFFile",
    "PSFToMeasure",
    "SampledPSF",
    "density_at",
    "has_pixel",
    "profile_of",
]
