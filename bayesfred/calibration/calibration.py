"""The calibration of an instrument: positions in both directions, with their covariance.

A chain holds a frame, its draws and everything needed to replay them. A `Calibration` holds what
others need to use them: the distortion, the mean, covariance and draws of its coefficients, the
detector, the PSF and where the object plane is on the sky. `positions` does the
computing, `maps` evaluates a calibration over the field, `difference` compares two of one camera,
`wcs`, `generalized_wcs`, `opencv` and `regions` write it for other tools, and `correct` resamples
frames with it.
"""

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
import numpy.typing as npt
from astropy import units
from astropy.coordinates import SkyCoord
from astropy.wcs import WCS

from bayesfred._typing import Flags, Floats, PathLike
from bayesfred.analysis.diagnostics import diagnose
from bayesfred.analysis.field import hull_of, images_of, inside_hull
from bayesfred.calibration.difference import CalibrationDifference, difference
from bayesfred.calibration.generalized_wcs import generalized_wcs
from bayesfred.calibration.maps import DisplacementMap, PSFMap, displacement_map, psf_map
from bayesfred.calibration.opencv import opencv_camera
from bayesfred.calibration.plate import known_sky
from bayesfred.calibration.positions import Method, Positions, broadcast_points
from bayesfred.calibration.wcs import sip
from bayesfred.errors import ExtrapolationWarning, InputError
from bayesfred.imaging.detector import Detector
from bayesfred.imaging.distortion import PolynomialDistortion
from bayesfred.imaging.psf.protocol import PSF
from bayesfred.io.hdf5_checks import CALIBRATION
from bayesfred.io.paths import may_write
from bayesfred.io.sealed import read_sealed, write_sealed
from bayesfred.io.serialize import serializable
from bayesfred.io.sky import icrs
from bayesfred.io.tangent_plane import TangentPlane
from bayesfred.model.parameters import displacing
from bayesfred.sampling.chain import Chain
from bayesfred.sampling.displacement import frame_posterior, spread_draws

__all__ = ["Calibration"]


@serializable("calibration")
@dataclass(frozen=True, eq=False)
class Calibration:
    """Where a pixel points, and where an object is imaged, with errors.

    Points of both planes are in pixels of the fine grid from the middle of the frame: u and x along
    columns, v and y along rows. The array index of a recorded pixel is u / binning + (columns - 1)
    / 2; `index` and `from_index` convert. Points beyond the sources, where only the terms of the
    distortion say what happens, are warned of: `ExtrapolationWarning`.

    Parameters
    ----------
    distortion : PolynomialDistortion
    draws : array_like, shape (n, n_terms + 2)
        Draws of its coefficients and of the offset (pixel) along x and y, n > 1.
    detector : Detector
    psf : PSF
    psf_sigma : float, pixel
        The width that it was found to have: the PSF widens as a whole.
    sources : array_like, shape (k, 2), pixel of the fine grid
        u and v of the images from which the distortion is known. Outside their convex hull only
        its terms say what happens.
    sky : TangentPlane, optional
        Where the object plane is on the sky.
    title, message : str
        What was calibrated, and what was said of the fit.
    trustworthy : bool
        Whether the fit can be trusted.

    Raises
    ------
    InputError
        If the draws are not finite, or not one value for each coefficient and the offset.

    Examples
    --------
    >>> import bayesfred as bf
    >>> model = bf.ForwardModel(
    ...     bf.Detector((65, 65)), bf.SourceCatalog.grid(3, 20.0, 1e4), bf.GaussianPSF(3.0),
    ...     bf.PolynomialDistortion([(1, 0, 0, 0)], [(0, 1, 0, 0)]))
    >>> posterior = bf.Posterior(model, bf.simulate(model, [0.02, 0.02], 2.0, seed=1))
    >>> calibration = Calibration.from_chain(bf.laplace(posterior, seed=1))
    >>> x, y, covariance = calibration.to_object([10.0], [5.0])
    >>> print(x.round(1), y.round(1), (covariance[0, 0, 0] ** 0.5).round(3))
    [10.2] [5.1] 0.007
    """

    distortion: PolynomialDistortion
    draws: Floats
    detector: Detector
    psf: PSF
    psf_sigma: float
    sources: Floats
    sky: TangentPlane | None = None
    title: str = ""
    message: str = ""
    trustworthy: bool = True

    def __post_init__(self) -> None:
        for name in ("draws", "sources"):
            values = np.array(getattr(self, name), dtype=np.float64)
            values.setflags(write=False)
            object.__setattr__(self, name, values)
        width = self.distortion.n_terms + 2
        if self.draws.ndim != 2 or self.draws.shape[1] != width or len(self.draws) < 2:
            raise InputError(
                f"draws: got shape {self.draws.shape}, expected (n, {width}) with n > 1: one value "
                "for each coefficient and two for the offset"
            )
        if self.sources.ndim != 2 or self.sources.shape[1] != 2:
            raise InputError(f"sources: got shape {self.sources.shape}, expected (k, 2)")
        if not (np.isfinite(self.draws).all() and np.isfinite(self.sources).all()):
            raise InputError("draws, sources: got values that are not finite, expected numbers")

    @classmethod
    def from_chain(cls, chain: Chain) -> Self:
        """The calibration that a chain tells.

        Parameters
        ----------
        chain : Chain
            Of a frame.

        Returns
        -------
        Calibration
            With at most 1,000 of the chain's draws.

        Raises
        ------
        InputError
            If the chain is of a density that is no frame's.
        """
        posterior, draws = frame_posterior(chain), spread_draws(chain)
        theta, offset = displacing(posterior.parameters, draws)
        psf, names = posterior.model.psf, chain.parameter_names
        free = "psf_sigma" in names
        width = float(draws[:, names.index("psf_sigma")].mean()) if free else psf.sigma
        diagnostics = diagnose(chain, target_ess=chain.target_ess)
        return cls(
            posterior.model.polynomial,
            np.hstack([theta, offset]),
            posterior.model.detector,
            psf,
            width,
            images_of(posterior, chain.estimate.params),
            posterior.model.sources.sky,
            chain.record.title if chain.record else "",
            diagnostics.message,
            diagnostics.trustworthy,
        )

    @classmethod
    def read(cls, path: PathLike) -> "Calibration":
        """Read a calibration that `write` wrote.

        Parameters
        ----------
        path : path-like

        Returns
        -------
        Calibration

        Raises
        ------
        InputError
            If the file is missing, is no calibration, or was changed or damaged since.
        """
        return read_sealed(Path(path), CALIBRATION, Calibration)

    def write(self, path: PathLike, *, overwrite: bool = False) -> None:
        """Write the calibration as one HDF5 file, which needs no frame to be used.

        Parameters
        ----------
        path : path-like
        overwrite : bool
            Replace a file that exists.

        Raises
        ------
        InputError
            If the file exists or cannot be written, or cannot hold such a PSF.
        """
        may_write(path, overwrite=overwrite)
        write_sealed(Path(path), CALIBRATION, self)

    @property
    def positions(self) -> Positions:
        """The map between both planes, with its errors."""
        return Positions(self.distortion, self.draws)

    def to_image(
        self, x: npt.ArrayLike, y: npt.ArrayLike, *, method: Method = "delta"
    ) -> tuple[Floats, Floats, Floats]:
        """Where object points are imaged.

        Parameters
        ----------
        x, y : array_like, pixel of the fine grid
            Broadcast against each other.
        method : {"delta", "draws"}
            The delta method about the posterior mean; or mean and covariance of the positions of
            all draws, which is slower by their number.

        Returns
        -------
        u, v : ndarray, the broadcast shape, pixel
            NaN where no image is found.
        covariance : ndarray, shape (..., 2, 2), pixel^2
            Of the calibration alone, not of the object's position.
        """
        found = self.positions.image(*broadcast_points(x, y), method)
        self._warn(*found[:2])
        return found

    def to_object(
        self, u: npt.ArrayLike, v: npt.ArrayLike, *, method: Method = "delta"
    ) -> tuple[Floats, Floats, Floats]:
        """Which object points are imaged at (u, v).

        Parameters
        ----------
        u, v : array_like, pixel of the fine grid
            Broadcast against each other.
        method : {"delta", "draws"}
            As for `to_image`.

        Returns
        -------
        x, y : ndarray, the broadcast shape, pixel
            NaN where no object is imaged.
        covariance : ndarray, shape (..., 2, 2), pixel^2
            Of the calibration alone, not of a measured (u, v).
        """
        u, v = broadcast_points(u, v)
        self._warn(u, v)
        return self.positions.object(u, v, method)

    def to_sky(
        self, u: npt.ArrayLike, v: npt.ArrayLike, *, method: Method = "delta"
    ) -> tuple[SkyCoord, Floats]:
        """Where pixels point on the sky.

        Parameters
        ----------
        u, v : array_like, pixel of the fine grid
            Broadcast against each other.
        method : {"delta", "draws"}
            As for `to_image`.

        Returns
        -------
        coordinates : SkyCoord, the broadcast shape
            ICRS.
        covariance : ndarray, shape (..., 2, 2), arcsec^2
            Along east and north.

        Raises
        ------
        InputError
            If the object plane has no place on the sky.
        """
        sky = known_sky(self)
        u, v = broadcast_points(u, v)
        self._warn(u, v)
        x, y, covariance = self.positions.object(u, v, method)
        jacobian = sky.jacobian(x, y)
        at = SkyCoord(*(angle * units.deg for angle in sky.to_sky(x, y)))
        return at, jacobian @ covariance @ np.swapaxes(jacobian, -1, -2)

    def to_pixel(
        self, coordinates: SkyCoord, *, method: Method = "delta"
    ) -> tuple[Floats, Floats, Floats]:
        """Where directions on the sky are imaged.

        Parameters
        ----------
        coordinates : SkyCoord
        method : {"delta", "draws"}
            As for `to_image`.

        Returns
        -------
        u, v : ndarray, the shape of the coordinates, pixel of the fine grid
            NaN where no image is found.
        covariance : ndarray, shape (..., 2, 2), pixel^2

        Raises
        ------
        InputError
            If the object plane has no place on the sky.
        """
        found = self.positions.image(*known_sky(self).to_plane(*icrs(coordinates)), method)
        self._warn(*found[:2])
        return found

    def index(self, u: npt.ArrayLike, v: npt.ArrayLike) -> tuple[Floats, Floats]:
        """Array indices (column, row) of image points, counted from 0 at a pixel's centre."""
        ny, nx = self.detector.shape
        column, row = (np.asarray(p, np.float64) / self.detector.binning for p in (u, v))
        return column + 0.5 * (nx - 1), row + 0.5 * (ny - 1)

    def from_index(self, column: npt.ArrayLike, row: npt.ArrayLike) -> tuple[Floats, Floats]:
        """Image points (u, v) of array indices: the inverse of `index`."""
        ny, nx = self.detector.shape
        u, v = np.asarray(column, np.float64), np.asarray(row, np.float64)
        binning = self.detector.binning
        return (u - 0.5 * (nx - 1)) * binning, (v - 0.5 * (ny - 1)) * binning

    def displacement_map(self, step: float) -> DisplacementMap:
        """The displacement and its covariance, every `step` pixels of the fine grid."""
        return displacement_map(self, step)

    def psf_map(self, step: float) -> PSFMap:
        """Size and ellipticity of images, every `step` pixels of the fine grid."""
        return psf_map(self, step)

    def to_wcs(self, sip_degree: int = 3) -> WCS:
        """The calibration as a TAN-SIP coordinate system, see `wcs.sip`.

        Parameters
        ----------
        sip_degree : int
            2 to 9.

        Returns
        -------
        astropy.wcs.WCS
            Of array indices; `wcs.sip` has its truncation error and its draws too.
        """
        return sip(self, sip_degree).wcs

    def to_gwcs(self, degree: int = 3) -> Any:
        """The calibration as a `gwcs.WCS`, see `generalized_wcs`; needs the package gwcs."""
        return generalized_wcs(self, degree).wcs

    def to_opencv(self, *, focal_length: float | None = None) -> dict[str, Any]:
        """The calibration as OpenCV's camera, see `opencv.opencv_camera`.

        Parameters
        ----------
        focal_length : float, optional, recorded pixel
            Needed where the object plane has no place on the sky.

        Returns
        -------
        dict
            Camera matrix, distortion coefficients, rotation, truncation error and draws.
        """
        return opencv_camera(self, focal_length=focal_length)

    def difference(self, other: "Calibration") -> CalibrationDifference:
        """Whether the camera has changed between two calibrations.

        Parameters
        ----------
        other : Calibration
            Of another frame, so that its errors are independent.

        Returns
        -------
        CalibrationDifference
            Of `other` less this one.

        Raises
        ------
        InputError
            If the frames have different sizes, one alone has a place on the sky, or the sources of
            both have too little of the field in common.
        """
        return difference(self, other)

    def inside(self, u: npt.ArrayLike, v: npt.ArrayLike) -> Flags:
        """Whether image points lie within the convex hull of the sources' images."""
        return inside_hull(hull_of(self.sources), *broadcast_points(u, v))

    def _warn(self, u: Floats, v: Floats) -> None:
        """Say how many points are beyond the sources."""
        beyond = int(np.sum(~self.inside(u, v)))
        if beyond:
            warnings.warn(
                f"{beyond} of {u.size} points are beyond the sources, where only the terms of the "
                "distortion say what happens",
                ExtrapolationWarning,
                stacklevel=3,
            )
