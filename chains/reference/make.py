"""Make the reference posteriors beside this file.

    python chains/reference/make.py [paper] [faint] [free]

Each is the run of a run file, long enough that every parameter has 10,000 effective draws, kept as
means, standard deviations and quantiles with their Monte Carlo errors, and 500 of the draws.
Walkers are independent but for the few steps of differential evolution, so the errors come from the
scatter between the walkers' averages over time, whatever their autocorrelation.
"""

import hashlib
import json
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

import bayesfred as bf
from bayesfred import build, settings
from bayesfred.sampling.convergence import convergence

Floats = npt.NDArray[np.float64]

FOLDER = Path(__file__).parent
NAMES = ("paper", "faint", "free")
QUANTILES = (0.05, 0.16, 0.5, 0.84, 0.95)
DRAWS = 500


def posterior(name: str, **model: Any) -> bf.Posterior:
    """The posterior of a run file's simulated frame, with other settings of [model], if given."""
    path = FOLDER / f"{name}.toml"
    run = settings.read_settings(path)
    assert run.simulation is not None
    made, _ = build.simulated(run, path, run.simulation.seed)
    changed = run.model_copy(update={"model": run.model.model_copy(update=model)})
    sources, shape = made.model.sources, made.model.detector.shape
    model = build.forward_model(changed, shape, sources, made.model.psf)
    return build.posterior_given(changed, model, made.counts, None, made.noise)


def counts_hash(counts: Floats) -> str:
    """SHA-256 of the counts as 64-bit little-endian integers, row by row."""
    return hashlib.sha256(counts.astype("<i8").tobytes()).hexdigest()


def error(values: Floats) -> Floats:
    """Monte Carlo error of the mean of values, shape (ensembles, steps, walkers, d)."""
    averages = values.mean(axis=1).reshape(-1, values.shape[-1])
    return np.asarray(averages.std(axis=0, ddof=1) / np.sqrt(len(averages)))


def summary(chain: bf.Chain) -> dict[str, dict[str, Any]]:
    """Mean, standard deviation and quantiles of every parameter with their Monte Carlo errors."""
    kept = chain.chain[:, chain.burn_in :]
    draws = chain.draws()
    mean, sd = draws.mean(axis=0), draws.std(axis=0)
    numbers = {"mean": (mean, error(kept)), "sd": (sd, error((kept - mean) ** 2) / (2.0 * sd))}
    for p in QUANTILES:
        value = np.quantile(draws, p, axis=0)
        share = error((kept < value).astype(float))
        low, high = (
            np.array([np.quantile(x, q) for x, q in zip(draws.T, p + s * share, strict=True)])
            for s in (-1, 1)
        )
        numbers[f"{p:.0%}"] = value, 0.5 * (high - low)
    return {
        name: {
            what: {"value": value[k], "error": its_error[k]}
            for what, (value, its_error) in numbers.items()
        }
        for k, name in enumerate(chain.parameter_names)
    }


def record(name: str, chain: bf.Chain) -> str:
    """The reference as JSON, a line a draw."""
    draws = chain.draws()
    _, bulk, tail = convergence(chain.chain[:, chain.burn_in :])
    head = {
        "run_file": f"{name}.toml",
        "counts_sha256": counts_hash(chain.posterior().counts),
        "sampling_seed": chain.seed,
        "versions": chain.versions,
        "n_draws": len(draws),
        "effective_draws": {"bulk": round(min(bulk)), "tail": round(min(tail))},
        "parameters": summary(chain),
        "draws_columns": chain.parameter_names,
    }
    rows = draws[np.linspace(0, len(draws) - 1, DRAWS).round().astype(int)].tolist()
    lines = ",\n".join(f"  {json.dumps(row)}" for row in rows)
    return f'{json.dumps(head, indent=1)[:-2]},\n "draws": [\n{lines}\n ]\n}}\n'


def main() -> None:
    """Make the references that are named, or all."""
    for name in sys.argv[1:] or NAMES:
        run = settings.read_settings(FOLDER / f"{name}.toml")
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / f"{name}.h5"
            s = run.sampling
            chain = bf.sample(posterior(name), path=path, seed=s.seed, target_ess=s.target_ess)
            print(bf.diagnose(chain, target_ess=s.target_ess).message)
            (FOLDER / f"{name}.json").write_text(record(name, chain), encoding="utf-8")


if __name__ == "__main__":
    main()
