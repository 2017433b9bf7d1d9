"""Fits, studies and reports for an hour, ended at random: `python -m benchmarks.soak [MINUTES]`.

All are in one folder, a disk of 200 MB of its own where root starts it, which is filled now and
then. After each, what was there before must be there still: steps and draws of chains, rows of
studies, a user's files. It prints what was done how often, and ends at the first loss.
"""

import contextlib
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np

import bayesfred as bf
from bayesfred.errors import InputError

MINUTES = 60.0
SIZE = 200  # MB
RUN = """
frame = {{path = "frame.npy"}}
catalogue = {{path = "stars.csv"}}
psf = {{sigma = 1.5}}
distortion = {{f_terms = [[1, 0, 1, 0]], g_terms = [[0, 1, 0, 1]]}}
sampling = {{steps = {steps}, ensembles = 2, walkers = 32}}
output = {{path = "{name}.h5"}}
simulation = {{shape = [24, 24], background = 3.0, theta = {{f_ux = 1e-3}}}}
study = {{replicates = {rows}, path = "{name}.ecsv", background = [3.0]}}
"""
NAMES = ("a", "b")
ENDINGS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGKILL)
WORDS = re.compile(r"bayesfred: [^\n]+\n?")


class LossError(Exception):
    """Something is gone."""


@contextlib.contextmanager
def disk() -> Iterator[Path]:
    """A folder, which is a small disk where that can be made."""
    with tempfile.TemporaryDirectory() as name:
        mount = ["mount", "-t", "tmpfs", "-o", f"size={SIZE}m", "tmpfs", name]
        small = os.geteuid() == 0 and not subprocess.run(mount, check=False).returncode
        print(f"{name}: {'a disk of its own' if small else 'no disk of its own'}", flush=True)
        try:
            yield Path(name)
        finally:
            if small:
                subprocess.run(["umount", name], check=True)


def prepare(folder: Path) -> None:
    """A frame, its catalogue, and a file of a user's own for every name that is written."""
    stars = bf.SourceCatalog([-5.0, -5.0, 5.0, 5.0], [-5.5, 4.5, -5.5, 4.5], np.full(4, 5e3))
    terms = bf.PolynomialDistortion([(1, 0, 1, 0)], [(0, 1, 0, 1)])
    model = bf.ForwardModel(bf.Detector((24, 24)), stars, bf.GaussianPSF(1.5), terms)
    np.save(folder / "frame.npy", bf.simulate(model, [1e-3, -1e-3], 3.0, seed=1))
    rows = (f"{x},{y},5000\n" for x, y in zip(stars.x, stars.y, strict=True))
    (folder / "stars.csv").write_text("x,y,flux\n" + "".join(rows))
    (folder / "mine.h5").write_bytes(b"mine")
    (folder / "mine.html").write_bytes(b"mine")


def state(folder: Path) -> dict[str, object]:
    """What must not be lost: the draws of every chain, the rows of every study, other files."""
    found: dict[str, object] = {}
    for path in sorted(folder.iterdir()):
        if path.name.startswith(".") or path.name == "ballast":
            continue
        if path.stem in NAMES and path.suffix == ".h5":
            found[path.name] = bf.open_chain(path).chain
        elif path.stem in NAMES and path.suffix == ".ecsv":
            lines = path.read_bytes().splitlines()
            found[path.name] = [line for line in lines if line[:1].isdigit()]
        elif path.stem not in NAMES and not path.name.startswith(NAMES):
            found[path.name] = path.read_bytes()
    return found


def compare(before: dict[str, object], after: dict[str, object], replaced: str) -> None:
    """Raise where something is gone, but for a file that was to be replaced."""
    for name, old in before.items():
        new = after.get(name)
        if name == replaced and new is not None:
            continue
        if isinstance(old, np.ndarray) and isinstance(new, np.ndarray):
            if not np.array_equal(new[:, : old.shape[1]], old):
                raise LossError(f"{name}: {old.shape[1]} steps, now {new.shape[1]}, others")
        elif isinstance(old, list) and isinstance(new, list):
            if new[: len(old)] != old:
                raise LossError(f"{name}: {len(old)} rows, now {len(new)}, others")
        elif old != new:
            raise LossError(f"{name}: changed or gone")


def act(folder: Path, chance: random.Random, done: Counter[str]) -> None:
    """Run a command, end it or let it end, and look at what it left."""
    name = chance.choice(NAMES)
    text = RUN.format(name=name, steps=chance.randint(2, 400), rows=chance.randint(2, 30))
    (folder / "run.toml").write_text(text)
    more = chance.choice(["", "--resume", "--resume", "--overwrite"])
    command = chance.choice(["fit", "fit", "study", "report", "verify"])
    words = {
        "fit": ["fit", "run.toml", more],
        "study": ["study", "run.toml", "--workers", "1", more],
        "report": ["report", f"{name}.h5", more.replace("--resume", "")],
        "verify": ["verify", f"{name}.h5"],
    }[command]
    before = state(folder)
    free = shutil.disk_usage(folder).free
    fills = chance.random() < 0.1 and free < 2 * SIZE * 1e6
    if fills:
        with contextlib.suppress(OSError):
            (folder / "ballast").write_bytes(bytes(max(0, free - chance.randint(0, 200_000))))
    process = subprocess.Popen(
        [sys.executable, "-m", "bayesfred", *filter(None, words)], cwd=folder, text=True,
        stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
    )  # fmt: skip
    number = chance.choice(ENDINGS) if chance.random() < 0.6 else None
    if number is not None:
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(chance.uniform(0.1, 12.0))
        process.send_signal(number)
    _, said = process.communicate(timeout=600)
    (folder / "ballast").unlink(missing_ok=True)
    code = process.returncode
    done[f"{command} {code}"] += 1
    done["disk full"] += fills
    if "Traceback" in said:
        raise LossError(f"{words}: a traceback: {said}")
    if code in (2, 130) and not WORDS.fullmatch(said.splitlines()[-1]):
        raise LossError(f"{words}: {said}")
    # an interrupt inside `exec` makes Python end by SIGINT, which a shell calls 130, too
    ended = (130, -signal.SIGINT, -signal.SIGKILL, -number) if number else ()
    if code not in (0, 2, 3, *ended):
        raise LossError(f"{words}: exit code {code}: {said}")
    replaced = f"{name}.{'h5' if command == 'fit' else 'ecsv'}" if more == "--overwrite" else ""
    try:
        compare(before, state(folder), replaced)
    except InputError as error:
        raise LossError(f"{words}, signal {number}: {error}") from error
    left = [path.name for path in folder.glob(".*.tmp")]
    if len(left) > 20:
        raise LossError(f"temporary files: {left}")
    done["most temporary files"] = max(done["most temporary files"], len(left))


def main() -> int:
    minutes = float(sys.argv[1]) if len(sys.argv) > 1 else MINUTES
    seed = int.from_bytes(os.urandom(4))
    print(f"seed {seed}", flush=True)
    chance, done = random.Random(seed), Counter[str]()
    end = time.monotonic() + 60.0 * minutes
    with disk() as folder:
        prepare(folder)
        while time.monotonic() < end:
            act(folder, chance, done)
            if sum(done.values()) % 50 == 0:
                print(dict(sorted(done.items())), flush=True)
    print(dict(sorted(done.items())), "nothing lost")
    return 0


if __name__ == "__main__":
    sys.exit(main())
