r"""Whether errors are right, asked of the frames themselves: two halves, fitted apart.

The sources are split into halves that each cover the field (`folds`). Each half's likelihood l_i
has pixels of its own, so its estimate t_i has the covariance I_i^-1, I_i the Fisher information,
and is independent of the other half's. If the errors are right, d = t_1 - t_2 has mean zero and the
information

    C = (I_1^-1 + I_2^-1)^-1 = I_1 (I_1 + I_2)^-1 I_2,

and d^T C d is chi-square. Errors that are too small make it too large, and the reverse.

The prior. Both halves are fitted with the same prior, which draws both estimates to the same place.
Its pull is taken out exactly: t_i is one Newton step of the likelihood alone from half i's maximum
p_i, so with the gradient of the likelihood there

    I_i t_i = I_i p_i + grad l_i(p_i),      C d = I_2 (I_1 + I_2)^-1 I_1 t_1 - the same with 1 and 2
                                                  exchanged,

which needs no inverse of I_i. Were l_i quadratic, d would not depend on the prior at all. With a
normal prior of information P the estimates themselves, J_i^-1 (I_i t_i + P m) with J_i = I_i + P,
differ with the covariance J_1^-1 + J_2^-1 - J_1^-1 P J_2^-1 - J_2^-1 P J_1^-1 if the truth is drawn
from that prior; d needs no such truth.

Nuisances (background, PSF's width, a common flux) are each half's own. The marginal information of
the coefficients is the Schur complement of C. Free fluxes are profiled out of I_i already. The
scatter of the sources' positions, which sets the errors that are on trial, is held at the whole
frame's value: the root of one over the mean of 1 / tau^2 under its nested Laplace approximation,
which makes the mean of d^T C d right where the scatter is estimated from the same sources.

Directions. In coordinates where C + P is the identity, C has eigenvalues between 0 and 1: the share
of what is known that the frame says. Directions below 1/2 are decided by the prior and dropped; the
degrees of freedom are the number of the others. The displacement field is a linear map of the
coefficients. Of its principal components, the ones that make up 99 % of the mean square difference
expected over the field are kept.

Several frames. Each half has half of the sources of every frame (`joint_folds`), and t_i has the
parameters of all frames. A source that several frames show is in one half. The frames are taken as
independent, and where they are not, because they have the errors of one catalogue in common, the
halves differ by more than the errors of what the frames share. So the coefficients that are
compared are the shared ones, among which a single frame's would be lost. The displacement field is
that of all frames, with their own coefficients.

References
----------
B. Efron & C. Stein (1981), Annals of Statistics 9, 586: variance from halves.
A. Gelman, X.-L. Meng, H. Stern (1996), Statistica Sinica 6, 733: checks of a model on its own data.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from bayesfred._typing import Floats, Ints
from bayesfred.analysis.agreement import Agreement, Verdict
from bayesfred.analysis.displacements import displaced_neighbours
from bayesfred.analysis.halves import (
    coefficients,
    difference,
    displacements,
    fit_half,
    predicted,
)
from bayesfred.analysis.held_scatter import hold_scatter
from bayesfred.analysis.joint_folds import (
    AnyPosterior,
    fold_frames,
    frame_views,
    require_visible,
)
from bayesfred.analysis.neighbours import Neighbours
from bayesfred.analysis.sources import fit_sources, tabulate
from bayesfred.errors import InputError
from bayesfred.model.joint import JointPosterior
from bayesfred.model.threads import one_blas_thread
from bayesfred.optimize.estimate import MapEstimate
from bayesfred.optimize.find_map import find_map

__all__ = ["CrossCheck", "FrameCheck", "cross_check"]

MOST_NAMED = 5


@dataclass(frozen=True, eq=False)
class FrameCheck:
    """What the halves of several frames say about the errors in one of them.

    Attributes
    ----------
    displacement : Agreement
        Of the displacement field over the frame.
    positions : tuple of Agreement
        Of the image positions found in each half with the predicted ones.
    """

    displacement: Agreement
    positions: tuple[Agreement, Agreement]


@dataclass(frozen=True, eq=False)
class CrossCheck:
    """What two halves of the sources, fitted apart, say about the errors.

    Attributes
    ----------
    displacement : Agreement
        Of the displacement field over the frame, or over all frames.
    coefficients : Agreement
        Of the distortion's coefficients and the pointing; of several frames, of those they share.
    positions : tuple of Agreement
        Of the image positions found in each half with those that the other half's fit predicts;
        `factor` is the weighted root mean square of the differences in standard deviations.
    displacement_rms, displacement_expected : float, pixel
        Root mean square difference of the halves' displacements over the field along each axis, and
        what it is expected to be if the errors are right.
    sources : ndarray of int, shape (n,)
        Half of each source, 0 or 1; -1 where the frame does not hold its image. The sources of
        several frames stand one frame after the other.
    params : ndarray, shape (2, d)
        Maximum of each half.
    frames : mapping of str to FrameCheck
        What the halves say of each of several frames.
    neighbours : Neighbours or None
        How far neighbouring sources are displaced alike, which halves do not see: in the frame in
        which it is most certain. None where sources are too few.
    """

    displacement: Agreement
    coefficients: Agreement
    positions: tuple[Agreement, Agreement]
    displacement_rms: float
    displacement_expected: float
    sources: Ints
    params: Floats
    frames: Mapping[str, FrameCheck] = field(default_factory=dict)
    neighbours: Neighbours | None = None

    @property
    def displacement_p(self) -> float:
        """Probability of a larger chi-square of the displacement if the errors are right."""
        return self.displacement.p

    @property
    def coefficients_p(self) -> float:
        """Probability of a larger chi-square of the coefficients if the errors are right."""
        return self.coefficients.p

    @property
    def deciding(self) -> Agreement:
        """The agreement that the verdict is about: too small comes before too large.

        The displacement's, unless the coefficients alone are not right.
        """
        both = self.displacement, self.coefficients
        for verdict in ("too small", "too large"):
            for each in both:
                if each.verdict == verdict:
                    return each
        return self.displacement

    @property
    def verdict(self) -> Verdict:
        """Whether the errors are too small, right or too large."""
        return "too small" if self._alike else self.deciding.verdict

    @property
    def holds(self) -> bool:
        """Whether the errors are right."""
        return self.verdict == "right"

    @property
    def message(self) -> str:
        """The verdict in a sentence, with the power of the check."""
        a = self.deciding
        of = "displacement" if a is self.displacement else "coefficients"
        low, high = a.factor_interval
        scaling = f"multiply them by {a.factor:.2f} ({low:.2f} to {high:.2f})"
        power = f"errors too small by a factor {a.detectable:.2f} would be found in 90 % of cases"
        found = f"{of}: chi-square {a.chi2:.1f} for {a.dof} degrees of freedom, p = {a.p:.2g}"
        if self._alike and self.neighbours is not None:
            return (
                f"the errors are too small: multiply them by some {self.neighbours.factor:.2g}; "
                "neighbouring sources are displaced alike (correlation "
                f"{self.neighbours.correlation:.2f}), which both halves have in common ({found})"
            )
        if self.holds:
            return f"the errors are right: the halves agree ({found}); {power}"
        return f"the errors are {self.verdict}: {scaling}; {found}{self._by_frame}; {power}"

    @property
    def _alike(self) -> bool:
        """Whether the halves have something in common, unless they disagree even so."""
        alike = self.neighbours is not None and self.neighbours.alike
        return alike and self.deciding.verdict != "too small"

    @property
    def _by_frame(self) -> str:
        """Which frames show it alone."""
        alike = [k for k, own in self.frames.items() if own.displacement.verdict == self.verdict]
        if not alike:
            return "; no frame shows it alone" if self.frames else ""
        named = ", ".join(alike[:MOST_NAMED]) + (", ..." if len(alike) > MOST_NAMED else "")
        return f"; {len(alike)} of {len(self.frames)} frames show it alone ({named})"

    def record(self) -> dict[str, Any]:
        """The findings as numbers and texts by name, as `bayesfred crosscheck --json` prints them.

        Each agreement has `p`, `chi2`, `dof`, `factor`, `factor_low`, `factor_high` and
        `detectable`; of the positions in each half there is the root mean square in standard
        deviations. `neighbours_correlation` and `neighbours_factor` are of the displacements of
        neighbouring sources. Of several frames, `frames` has by name `displacement_p`,
        `displacement_factor` and `positions_rms_z`.
        """
        record: dict[str, Any] = {"verdict": self.verdict, "message": self.message}
        for name, a in (("displacement", self.displacement), ("coefficients", self.coefficients)):
            low, high = a.factor_interval
            numbers = {
                "p": a.p, "chi2": a.chi2, "dof": a.dof, "factor": a.factor, "factor_low": low,
                "factor_high": high, "detectable": a.detectable,
            }  # fmt: skip
            record |= {f"{name}_{key}": value for key, value in numbers.items()}
        record["positions_rms_z"] = [a.factor for a in self.positions]
        record["displacement_rms"] = self.displacement_rms
        record["displacement_expected"] = self.displacement_expected
        if self.neighbours is not None:
            record["neighbours_correlation"] = self.neighbours.correlation
            record["neighbours_factor"] = self.neighbours.factor
        if self.frames:
            record["frames"] = {
                name: {
                    "displacement_p": own.displacement.p,
                    "displacement_factor": own.displacement.factor,
                    "positions_rms_z": [a.factor for a in own.positions],
                }
                for name, own in self.frames.items()
            }
        return record


def cross_check(posterior: AnyPosterior, *, estimate: MapEstimate | None = None) -> CrossCheck:
    """Fit two halves of the sources apart and ask whether they agree within their errors.

    The halves are a checkerboard over the field. Each has the pixels of its own sources, so that
    their counts are independent; every source stays in both models, as its light reaches the
    other half's pixels. Of several frames each half has one half of every frame.

    Parameters
    ----------
    posterior : Posterior or JointPosterior
    estimate : MapEstimate, optional
        Its maximum; found if not given.

    Returns
    -------
    CrossCheck

    Raises
    ------
    InputError
        If fewer than two sources have their image in a frame, no coefficient is known by both
        halves, or a half's maximum is not found.

    Notes
    -----
    Halves alternate over the field, and what displaces neighbouring sources alike they have in
    common. Where displacements show such a thing the verdict is "too small" for that, unless
    `marginalize_displacements` has put it into the errors.

    What else both have in common, such as a wrong PSF that moves all images alike, a wrong plate
    scale of the catalogue, a field that no term describes or a frame of another instrument, they do
    not show: `diagnose` tells whether frames agree about what they share. Errors of the linear
    approximation are neglected. The verdict is "right" where both probabilities lie between 0.01
    and 0.99. With `position_scatter` the scatter is estimated from the same sources: with n sources
    and k degrees of freedom chi-square varies less, by a factor of about 1 - k / 2n in the
    variance.

    Examples
    --------
    >>> import bayesfred as bf
    >>> model = bf.ForwardModel(
    ...     bf.Detector((65, 65)), bf.SourceCatalog.grid(3, 20.0, 1e4), bf.GaussianPSF(3.0),
    ...     bf.PolynomialDistortion.polynomial(1))
    >>> posterior = bf.Posterior(model, bf.simulate(model, np.zeros(4), 2.0, seed=1))
    >>> found = bf.cross_check(posterior)
    >>> found.verdict, found.displacement.dof
    ('right', 4)
    """
    with one_blas_thread():
        whole = estimate or find_map(posterior)
        folds = fold_frames(posterior, whole.params, 2)
        require_visible(folds, 2, "to make halves of")
        fixed, start = hold_scatter(posterior, whole)
        one, two = (fit_half(fixed, folds, k, start) for k in (0, 1))
        moving = coefficients(fixed)
        z, directions = difference(fixed, folds, (one, two), start, moving)
        if not z.size:
            raise InputError(
                f"catalogue: got {np.sum(folds.sources >= 0)} sources, half of which determine no "
                "coefficient, expected more: fit fewer terms"
            )
        lens = z
        if isinstance(posterior, JointPosterior) and moving[: posterior.n_shared].any():
            moving[posterior.n_shared :] = False
            lens = difference(fixed, folds, (one, two), start, moving)[0]
        whole_field, fields = displacements(posterior, whole.params, folds, z, directions)
        positions = [predicted(fixed, folds, k, other) for k, other in enumerate((two, one))]
        frames = {
            name: FrameCheck(own.agreement, (positions[0][1][name], positions[1][1][name]))
            for name, own in fields.items()
            if name
        }
        return CrossCheck(
            displacement=whole_field.agreement,
            coefficients=Agreement.of(lens if lens.size else z),
            positions=(positions[0][0], positions[1][0]),
            displacement_rms=whole_field.rms,
            displacement_expected=whole_field.expected,
            sources=folds.sources,
            params=np.array([one.params, two.params]),
            frames=frames,
            neighbours=_most_alike(posterior, whole.params),
        )


def _most_alike(posterior: AnyPosterior, params: Floats) -> Neighbours | None:
    """Of the neighbours of each frame those that are most certain to be displaced alike."""
    found = []
    for view in frame_views(posterior):
        own = view.to_frame @ params
        fits = fit_sources(view.posterior, own)
        table = tabulate(view.posterior, fits)
        found.append(displaced_neighbours(view.posterior, own, fits, table))
    known = [each for each in found if each is not None]
    return max(known, key=lambda each: each.z, default=None)
