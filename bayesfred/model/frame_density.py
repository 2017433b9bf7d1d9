"""What posteriors of frames have in common: parameters with names, independent a priori."""

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import fields
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from bayesfred._typing import Floats, Ints
from bayesfred.errors import InputError
from bayesfred.model import priors
from bayesfred.model.displacement_errors import DisplacementErrors
from bayesfred.model.protocol import TargetDensity
from bayesfred.model.psf_errors import PsfErrors


class FrameDensity(TargetDensity):
    """A prior, by parameter name, times what a class of its own makes the likelihood of frames.

    Parameters that `prior` does not name have flat priors.
    """

    prior: Mapping[str, Any]
    psf_errors: PsfErrors | None
    displacement_errors: DisplacementErrors | None

    @property
    def added_covariance(self) -> Floats | None:
        """What errors that `log_prob` has not add to the parameters' covariance, shape (d, d)."""
        both = (self.psf_errors, self.displacement_errors)
        added = [errors.covariance for errors in both if errors is not None]
        return np.asarray(sum(added)) if added else None

    @property
    def n_parameters(self) -> int:
        """Length of a parameter vector."""
        return len(self.parameter_names)

    @cached_property
    def support(self) -> tuple[Floats, Floats]:
        """The least and the largest value that the prior admits of every parameter, shape (d,)."""
        low, high = np.full((2, self.n_parameters), [[-np.inf], [np.inf]])
        for k, distribution in zip(self._prior_columns, self.prior.values(), strict=True):
            low[k], high[k] = distribution.support()
        return low, high

    def log_prior(self, params: npt.ArrayLike) -> Floats:
        """Log-density of the prior for parameter vectors of shape (n, d), flat ones left out."""
        return np.asarray(self._log_prior(self._vectors(params)[:, self._prior_columns]))

    def prior_gradient(self, params: npt.ArrayLike) -> Floats:
        """Gradient of the prior's log-density, shape (d,); NaN outside its support."""
        vector = self._vector(params)
        if not np.isfinite(self.log_prior(vector)[0]):
            return np.full(vector.size, np.nan)
        out = np.zeros(vector.size)
        for k, distribution in zip(self._prior_columns, self.prior.values(), strict=True):
            out[k] = priors.slope(distribution, vector[k])[0]
        return out

    def prior_curvature(self, params: npt.ArrayLike) -> Floats:
        """Curvature of the parameters' own priors where it is positive, shape (d,)."""
        vector = self._vector(params)
        out = np.zeros(vector.size)
        for k, distribution in zip(self._prior_columns, self.prior.values(), strict=True):
            out[k] = max(priors.slope(distribution, vector[k])[1], 0.0)
        return out

    def prior_information(self, params: npt.ArrayLike) -> Any:
        """Curvature of the prior where it is positive, shape (d, d)."""
        return np.diag(self.prior_curvature(params))

    @abstractmethod
    def fisher(self, params: npt.ArrayLike) -> Any:
        """Fisher information of the frames about the parameters, shape (d, d)."""

    def information(self, params: npt.ArrayLike) -> Floats:
        """Fisher information plus prior curvature, shape (d, d).

        The inverse is the covariance of the Laplace approximation without `added_covariance`.
        """
        return np.asarray(self.fisher(params) + self.prior_information(params))

    @cached_property
    def _prior_columns(self) -> Ints:
        place = {name: k for k, name in enumerate(self.parameter_names)}
        return np.array([place[name] for name in self.prior], dtype=np.int64)

    @cached_property
    def _log_prior(self) -> Any:
        return priors.log_density(self.prior)

    def _set_fields(self, *values: Any) -> None:
        """Set the fields of an instance, which is frozen otherwise."""
        for field, value in zip(fields(self), values, strict=True):  # type: ignore[arg-type]
            object.__setattr__(self, field.name, value)

    def _vectors(self, params: npt.ArrayLike) -> Floats:
        """Parameter vectors, shape (n, d)."""
        vectors = np.atleast_2d(np.asarray(params, dtype=np.float64))
        if vectors.ndim != 2 or vectors.shape[1] != self.n_parameters:
            raise self._wrong_shape(params, f"({self.n_parameters},) or (n, {self.n_parameters})")
        return vectors

    def _vector(self, params: npt.ArrayLike) -> Floats:
        """One parameter vector; several are refused."""
        vector = np.asarray(params, dtype=np.float64)
        if vector.shape != (self.n_parameters,):
            raise self._wrong_shape(params, f"one vector of shape ({self.n_parameters},)")
        return vector

    def _wrong_shape(self, params: npt.ArrayLike, expected: str) -> InputError:
        first = self.parameter_names[:20]
        names = ", ".join(first) + (" ..." if len(first) < self.n_parameters else "")
        return InputError(f"params: got shape {np.shape(params)}, expected {expected} for {names}")

    def __getstate__(self) -> dict[str, Any]:
        return {f.name: getattr(self, f.name) for f in fields(self)}  # type: ignore[arg-type]
