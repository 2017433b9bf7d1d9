"""Why a model does not fit the counts: what is probably wrong, and what to do about it.

Every cause is a hypothesis of what the counts hold in place of the model. They are compared in one
unit. With standardised residuals z = (n - mu) / sigma the misfit is the excess sum of squares

    E = sum (z^2 - 1),

near zero for a true model, and a cause explains the part of E that would go with it:

- a variance V in place of sigma^2 explains sum (V / sigma^2 - 1);
- a pattern t in the mean, whose size is fitted, explains (sum t z)^2 / sum t^2, less what noise
  alone gives to the numbers fitted;
- a source that is imaged at a distance e from its light, and is put right, explains (q + q') (1 -
  exp(-e^2 / 4 s^2)), with the PSF's width s and its squared signal to noise: q where the model has
  light that is not there, q' where there is light that the model does not have;
- pixels or sources that are to be left out explain what they hold, less what their like hold;
- a background that is uneven explains what the mean counts of its parts do; wings of the sources do
  in its place where those outside the footprints fall off from the images, as the fluxes have it;
- another PSF explains what all sources have in common, in proportion to their flux, and companions
  that no catalogue has the best peak beside each source in what is left.

So the ranking is by shares of E, not by a list of special cases. Two rules keep it honest. Some
hypotheses contain others: a shift is also an affine map, a factor of all fluxes is also a wrong
PSF. The richer one explains at least as much; it is named only if it explains clearly more. And
what one cause claims is not claimed again: a later cause has to explain a share of its own.

`context` holds what the hypotheses share, `pixels`, `positions`, `search` and `light` the
hypotheses, `find` ranks them. `scores` names what tests find where no sum shows a misfit.

References
----------
P. McCullagh, J. A. Nelder (1989), Generalized Linear Models, chapter 2: analysis of deviance.
"""

from bayesfred.analysis.causes.cause import Cause
from bayesfred.analysis.causes.find import find_causes
from bayesfred.analysis.causes.pixels import correlated_pixels, displaced_alike
from bayesfred.analysis.causes.scores import hidden_causes

__all__ = ["Cause", "correlated_pixels", "displaced_alike", "find_causes", "hidden_causes"]
