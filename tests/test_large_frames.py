"""Frames that the memory holds but a few times: mapped files, parts of rows, several bands."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import bayesfred as bf
from bayesfred.optimize import fit_statistics, peaks
from bayesfred.optimize.find_map import find_map
from bayesfred.optimize.fit_statistics import fit_statistics as statistics
from bayesfred.optimize.peaks import find_peaks


def stars(side: int = 200) -> bf.ForwardModel:
    return bf.ForwardModel(
        bf.Detector((side, side)),
        bf.SourceCatalog.grid(7, side / 8.0, 2e4),
        bf.GaussianPSF(1.5),
        bf.PolynomialDistortion.polynomial(2),
    )


def counts() -> np.ndarray:
    return bf.simulate(stars(), [0.0] * stars().distortion.n_terms, 5.0, seed=1)


@pytest.mark.parametrize("kind", ["u2", "f8", ">i4"])
def test_a_mapped_frame_gives_the_posterior_of_the_same_numbers(tmp_path: Path, kind: str) -> None:
    np.save(tmp_path / "frame.npy", counts().astype(kind))
    mapped = bf.Posterior(stars(), np.load(tmp_path / "frame.npy", mmap_mode="r"))
    plain = bf.Posterior(stars(), counts())
    params = plain.start()
    assert mapped.counts.dtype == np.dtype(kind)
    assert isinstance(mapped.counts.base, np.memmap)
    assert mapped.log_prob(params) == plain.log_prob(params)
    found, wanted = find_map(mapped), find_map(plain)
    np.testing.assert_array_equal(found.params, wanted.params)
    assert found.message == wanted.message


def test_a_mapped_frame_in_single_precision_is_copied(tmp_path: Path) -> None:
    np.save(tmp_path / "frame.npy", counts().astype(np.float32))
    mapped = bf.Posterior(stars(), np.load(tmp_path / "frame.npy", mmap_mode="r"))
    assert mapped.counts.dtype == np.float64
    assert mapped.log_prob(mapped.start()) == bf.Posterior(stars(), counts()).log_prob(
        mapped.start()
    )


def test_a_mapped_frame_with_holes_is_filled_as_others_are(tmp_path: Path) -> None:
    holes = counts()
    holes[3, 4] = np.nan
    np.save(tmp_path / "frame.npy", holes)
    mapped = np.load(tmp_path / "frame.npy", mmap_mode="r")
    posterior = bf.Posterior(stars(), mapped, mask=np.isfinite(holes))
    assert posterior.counts[3, 4] == 0.0
    assert not posterior.mask[3, 4]


def test_parts_of_a_frame_give_what_the_whole_gives(monkeypatch: pytest.MonkeyPatch) -> None:
    mask = np.random.default_rng(1).uniform(size=(200, 200)) > 0.05
    posterior = bf.Posterior(stars(), counts(), mask=mask)
    params = find_map(posterior).params
    whole = find_peaks(posterior), statistics(posterior, params)
    monkeypatch.setattr(peaks, "PART", 3000)
    monkeypatch.setattr(fit_statistics, "PART", 3000)
    parts = find_peaks(posterior), statistics(posterior, params)
    np.testing.assert_allclose(parts[0], whole[0], rtol=0.0, atol=1e-10)
    assert parts[1] == pytest.approx(whole[1], rel=1e-10)


MEMORY = """
import re, sys, numpy as np, bayesfred as bf
from pathlib import Path

def peak():
    return 1024 * int(re.search(r"VmHWM:\\s*(\\d+)", Path("/proc/self/status").read_text())[1])

def search(side, path=None):
    sources = bf.SourceCatalog.grid(6, 25.0, 2e4)
    lens, detector = bf.PolynomialDistortion.polynomial(1), bf.Detector((side, side))
    model = bf.ForwardModel(detector, sources, bf.GaussianPSF(1.5), lens)
    if path is None:
        return bf.find_map(bf.Posterior(model, bf.simulate(model, [0.0] * 4, 5.0, seed=1)))
    return bf.find_map(bf.Posterior(model, np.load(path, mmap_mode="r")))

search(200)
before = peak()
assert search(4096, sys.argv[1]).at_maximum
print((peak() - before) / (8 * 4096**2))
"""


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="no VmHWM")
def test_a_search_takes_the_memory_of_few_frames(tmp_path: Path) -> None:
    """Where few pixels are reached: counts, image, masks, and what is gathered at a time."""
    path, rng = tmp_path / "frame.npy", np.random.default_rng(1)
    frame = np.lib.format.open_memmap(path, "w+", np.uint16, (4096, 4096))
    frame[:] = rng.poisson(5.0, frame.shape).astype(np.uint16)
    small = bf.ForwardModel(
        bf.Detector((200, 200)),
        bf.SourceCatalog.grid(6, 25.0, 2e4),
        bf.GaussianPSF(1.5),
        bf.PolynomialDistortion.polynomial(1),
    )
    part = slice(2048 - 100, 2048 + 100)
    frame[part, part] = bf.simulate(small, [0.0] * 4, 5.0, seed=1)
    frame.flush()
    command = [sys.executable, "-c", MEMORY, str(path)]
    said = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    assert float(said) < 4.5
