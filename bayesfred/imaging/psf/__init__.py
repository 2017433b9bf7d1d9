"""Reference point spread functions: the p of the Fredholm model, normalised to unit volume.

One module a family; `protocol.py` says what a family is, `forward.py` samples them through the
compiled loops.
"""

from bayesfred.imaging.psf.gaussian import GaussianPSF
from bayesfred.imaging.psf.moffat import MoffatPSF
from bayesfred.imaging.psf.protocol import FWHM, PSF
from bayesfred.imaging.psf.sampled import SampledPSF

__all__ = ["FWHM", "PSF", "GaussianPSF", "MoffatPSF", "SampledPSF"]
