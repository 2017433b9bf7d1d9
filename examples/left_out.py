"""Positions of sources that were left out: by the likelihood with a measured PSF, and by centroids.

    BAYESFRED_DATA=<folder with the frames> python examples/left_out.py examples/startracker.toml

The frame is fitted as the run file says. Then a fifth of the sources at a time is predicted from
the others: by a fit without them, whose PSF is measured without them, and by a polynomial of the
same degree through the others' Gaussian centroids, which stand beside the catalogue in a file
named *_centroids.csv (columns u and v, a row for each of the catalogue's). Both are held against
where the method itself finds the source. What is printed is the rms along u and v, and what
1.48 times the median says it would be without outliers.
"""

import csv
import sys
from pathlib import Path

import numpy as np

from bayesfred import settings
from bayesfred.analysis.folds import fold_sources
from bayesfred.analysis.left_out import Weights, leave_out
from bayesfred.commands import pipeline
from bayesfred.io.paths import resolve

FOLDS, ROUNDS = 20, 5
NORMAL = 1.4826  # standard deviation of a normal distribution over its median deviation
FAR = 4.0  # robust standard deviations beyond which a centroid does not fit the polynomial


def main(run_file: Path) -> dict[str, np.ndarray]:
    """Compare the two on the sources that both found; rms along u and v by method."""
    run = settings.read_settings(run_file)
    posterior, estimate, _ = pipeline.read_frame(run, run_file, print)
    folds = fold_sources(posterior, estimate.params, FOLDS)
    weights = Weights.of(posterior, estimate.params)
    left = leave_out(posterior, estimate, folds, weights, np.random.RandomState(1)).sources
    catalogue = resolve(run.catalogue.path, run_file, must_exist=True)
    u, v = read(catalogue.with_name(f"{catalogue.stem}_centroids.csv"), "u", "v")
    x, y = read(catalogue, "x", "y")
    own = posterior.model.sources
    row = [int(np.argmin(np.hypot(x - a, y - b))) for a, b in zip(own.x, own.y, strict=True)]
    moved = np.column_stack([u - x, v - y])[row]
    ours = np.column_stack([left["du"], left["dv"]])
    kept = folds.sources >= 0
    centroids = np.full_like(ours, np.nan)
    for k in range(ROUNDS):
        of_round = kept & (folds.sources % ROUNDS == k)
        centroids[of_round[kept]] = predicted(
            (own.x, own.y), moved, kept & ~of_round, of_round, run.distortion.degree
        )
    both = np.isfinite(ours + centroids).all(axis=1)
    bright = both & (left["flux"] > np.median(left["flux"][both]))
    found = {}
    for which, some in (("all", both), ("bright half", bright)):
        for method, off in (("likelihood", ours[some]), ("centroids", centroids[some])):
            rms, robust = np.sqrt(np.mean(off**2, axis=0)), NORMAL * np.median(abs(off), axis=0)
            found[f"{which}, {method}"] = rms
            print(
                f"{which:11} {len(off):5} {method:10}  rms {rms[0]:.4f} {rms[1]:.4f}"
                f"   robust {robust[0]:.4f} {robust[1]:.4f} px"
            )
    return found


def predicted(places, moved, others, wanted, degree):
    """How far centroids lie from a polynomial through the others, outliers left out of it."""
    x, y = (np.asarray(each) / max(abs(np.concatenate(places))) for each in places)
    terms = np.stack([x**i * y**j for i in range(degree + 1) for j in range(degree + 1 - i)], 1)
    used = others
    for _ in range(5):
        fit = np.linalg.lstsq(terms[used], moved[used], rcond=None)[0]
        off = np.abs(moved - terms @ fit).max(axis=1)
        used = others & (off < FAR * NORMAL * np.median(off[others]))
    return (moved - terms @ fit)[wanted]


def read(path, *columns):
    """Columns of a CSV file."""
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    return np.array([[float(row[column]) for row in rows] for column in columns])


if __name__ == "__main__":
    main(Path(sys.argv[1]))
