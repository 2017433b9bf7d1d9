"""What the optimiser and the sampler know of a posterior.

`optimize.newton` and `sampling` use nothing else, so that they maximise and sample any density that
offers this, of frames or not. `model.posterior` is the one that the package is about.
"""

from typing import Protocol, Self

import numpy as np
import numpy.typing as npt

from bayesfred._typing import Floats, Ints


class TargetDensity(Protocol):
    """A log-density of d parameters with its derivatives.

    Attributes
    ----------
    parameter_names : tuple of str, length d
        In the order of every parameter vector.
    support : tuple of ndarray, shape (d,) each, parameter units
        The least and the largest value that the prior admits of every parameter.
    hyperparameters : tuple of str
        Scale parameters, which set the errors of the others: one Gaussian for all their values
        is a poor approximation, so proposals nest the Laplace approximation on them.
    """

    @property
    def parameter_names(self) -> tuple[str, ...]: ...  # noqa: D102

    @property
    def support(self) -> tuple[Floats, Floats]: ...  # noqa: D102

    @property
    def hyperparameters(self) -> tuple[str, ...]:  # noqa: D102
        return ()

    def log_prob(self, params: npt.ArrayLike) -> Floats:
        """Log-density of parameter vectors, shape (d,) or (n, d).

        It is -inf outside the support. NaN and +inf, where the arithmetic gives them, are no
        densities: the sampler counts them and takes them as -inf.
        """
        ...

    def gradient(self, params: npt.ArrayLike) -> Floats:
        """Gradient of `log_prob` at one parameter vector, shape (d,)."""
        ...

    def information(self, params: npt.ArrayLike) -> Floats:
        """Positive definite stand-in for minus the Hessian, shape (d, d): Fisher information."""
        ...

    def observed_information(
        self, params: npt.ArrayLike, covariance: Floats
    ) -> tuple[Ints, Floats]:
        """Some parameters, shape (k,), and minus the Hessian by these, (k, k), where it is known.

        `covariance`, shape (d, d), tells how far around `params` it matters.
        """
        return np.empty(0, np.int64), np.empty((0, 0))

    def near(self, params: Floats, covariance: Floats) -> Self:
        """The same density, prepared to be evaluated often around `params`."""
        return self
