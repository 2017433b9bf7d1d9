"""Several frames in one posterior: `python -m benchmarks.joint`.

Frames are 201 x 201 pixels with 64 stars and share the 14 terms of degree 2 and 3; each has 8
parameters of its own. The log-posterior of 20 of them is compared with 20 times that of one, and
one of 100 is maximised and sampled. `--memory` does so with 100 frames of 1024 x 1024 pixels.
"""

import resource
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

import bayesfred as bf
from bayesfred.sampling.convergence import effective_sizes
from benchmarks.__main__ import ratio, with_threads

LENS = bf.PolynomialDistortion.polynomial(3)
NUISANCES = bf.Nuisances(flux="free", offset=True, psf_sigma=True)
MEMORY = 4.0  # GiB


def frames(k: int, n: int = 201, side: int = 8, flux: float = 2e4) -> dict[str, bf.Posterior]:
    """k frames of one lens, each with its own scale."""
    sources = bf.SourceCatalog.grid(side, 0.88 * n / side, flux)
    model = bf.ForwardModel(bf.Detector((n, n)), sources, bf.GaussianPSF(2.0), LENS)
    random = np.random.default_rng(1)
    found = {}
    for i in range(k):
        theta = np.zeros(LENS.n_terms)
        theta[LENS.names.index("f_x3")] = 0.1 / (0.5 * n) ** 2
        theta[LENS.names.index("g_y")] = 1e-3 * random.standard_normal()
        counts = bf.simulate(model, theta, 2.0 + random.random(), seed=i)
        found[f"f{i}"] = bf.Posterior(model, counts, nuisances=NUISANCES)
    return found


@dataclass
class Counting:
    """Counts the likelihoods of all frames that are evaluated."""

    inner: Any
    number: list[float]

    def log_likelihood(self, vectors: Sequence[Any], wanted: Any) -> Any:
        """As `FrameEvaluator` says."""
        self.number[0] += wanted.sum() / len(wanted)
        return self.inner.log_likelihood(vectors, wanted)

    def derivatives(self, vectors: Sequence[Any]) -> Any:
        """As `FrameEvaluator` says."""
        return self.inner.derivatives(vectors)

    def near(self, params: Sequence[Any], covariances: Sequence[Any]) -> "Counting":
        """As `FrameEvaluator` says."""
        return Counting(self.inner.near(params, covariances), self.number)


def cost(k: int = 20, walkers: int = 32) -> float:
    """The log-posterior of k frames over k times that of one."""
    joint = bf.JointPosterior(frames(k))
    estimate = bf.find_map(joint)
    near = joint.near(estimate.params, estimate.covariance)
    x = bf.laplace(joint, estimate, seed=1, draws=walkers, progress=False).chain[0, :, 0]
    own = joint.frame_params("f0", x)
    one = joint.frames["f0"].near(
        joint.frame_params("f0", estimate.params), joint.frame_covariance("f0", estimate.covariance)
    )
    together = with_threads(1, lambda: near.log_prob(x))
    return ratio(together, with_threads(1, lambda: [one.log_prob(own) for _ in range(k)]), 9)


def draws(k: int = 100, target: float = 4000.0, **how: float) -> dict[str, float]:
    """What the maximum of k frames takes, and an effective draw.

    So many draws that the noise of the least of 1,600 effective sample sizes counts little.
    """
    joint, number = bf.JointPosterior(frames(k, **how)), [0.0]  # type: ignore[arg-type]
    joint = joint.with_evaluator(Counting(joint.evaluator, number))
    estimate = bf.find_map(joint)
    number[0] = 0.0
    chain = bf.sample(joint, estimate, seed=1, target_ess=target, progress=False)
    kept = chain.chain[:, chain.burn_in :]
    sizes = np.min(effective_sizes(kept), axis=0)
    share = number[0] / chain.chain[..., 0].size  # likelihoods for each draw
    return {
        "evaluations": float(estimate.n_evaluations),
        "least": share * kept[..., 0].size / float(sizes.min()),
        "median": share * kept[..., 0].size / float(np.median(sizes)),
        "acceptance": float(chain.accepted.mean()) / chain.chain.shape[1],
    }


def memory() -> float:
    """Peak memory of 100 frames of 1024 x 1024, their maximum and some steps in a file, GiB."""
    joint = bf.JointPosterior(frames(100, 1024, 20))
    estimate = bf.find_map(joint)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "joint.h5"
        bf.sample(joint, estimate, seed=1, steps=2, path=path, progress=False)
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


def main() -> int:
    if "--memory" in sys.argv[1:]:
        rows = [("peak memory, 100 frames of 1024 x 1024, GiB", memory(), MEMORY)]
    else:
        found = draws()
        rows = [
            ("log-posterior of 20 frames / 20 times that of one", cost(), 1.1),
            ("maximum of 100 frames, evaluations", found["evaluations"], 15.0),
            ("100 frames, likelihoods per effective draw, least of all", found["least"], 2.0),
            ("... median of all parameters", found["median"], 2.0),
            ("... share of accepted moves", -found["acceptance"], 0.0),
        ]
    table = Table("measure", "value", "bound")
    for name, value, bound in rows:
        table.add_row(name, f"{abs(value):.3g}", f"{bound:g}" if bound else "")
    Console(width=None if sys.stdout.isatty() else 110).print(table)
    return 0 if all(value <= bound for _, value, bound in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
