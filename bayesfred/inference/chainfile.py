"""The chain file: one HDF5 file a run, which holds everything needed to judge, replay and go on with it.

Groups `ensemble_0`, ... are in emcee's own layout. Beside them stand the posterior itself (frame, mask, model, noise,
nuisances, priors), the MAP, the seed and the versions of what made it. A checkpoint writes the whole file anew and
renames it over the old one, so that a reader finds either the old state or the new one.
"""

import hashlib
import os
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import arviz_base
import h5py
import numpy as np
import numpy.typing as npt
import xarray as xr

from bayesfred.errors import InputError
from bayesfred.inference.estimate import MapEstimate
from bayesfred.inference.posterior import Posterior

Floats = npt.NDArray[np.float64]

Read = TypeVar("Read")

KIND = "bayesfred chain"
SCHEMA = 2


@dataclass(frozen=True, eq=False)
class Chain:
    """A run's draws and where they came from.

    Attributes
    ----------
    path : Path
        The chain file.
    parameter_names : tuple of str, length d
    chain : ndarray, shape (n_ensembles, n_steps, n_walkers, d)
        Positions after every step, burn-in included.
    log_prob : ndarray, shape (n_ensembles, n_steps, n_walkers)
    accepted : ndarray, shape (n_ensembles, n_walkers)
        Moves accepted so far.
    burn_in : int
        Steps that `draws` leaves out.
    seed : int
    estimate : MapEstimate
        The maximum that the proposals are centred on.
    versions : dict of str to str
        Packages that the run was made with.
    target_ess : float
        Effective draws that were asked for.
    """

    path: Path
    parameter_names: tuple[str, ...]
    chain: Floats
    log_prob: Floats
    accepted: npt.NDArray[np.int64]
    burn_in: int
    seed: int
    estimate: MapEstimate
    versions: dict[str, str]
    target_ess: float = 1000.0

    def draws(self) -> Floats:
        """All draws after burn-in, shape (n, d)."""
        return self.chain[:, self.burn_in :].reshape(-1, len(self.parameter_names))

    def to_datatree(self) -> xr.DataTree:
        """The draws after burn-in for arviz: every walker of every ensemble is a chain."""
        kept = self.chain[:, self.burn_in :].swapaxes(1, 2)
        kept = kept.reshape(-1, *kept.shape[2:])
        log_prob = self.log_prob[:, self.burn_in :].swapaxes(1, 2).reshape(kept.shape[:2])
        posterior = {name: kept[..., k] for k, name in enumerate(self.parameter_names)}
        with warnings.catch_warnings():  # many short chains are what an ensemble is
            warnings.filterwarnings("ignore", message="Found chain dimension to be longer")
            return arviz_base.from_dict({"posterior": posterior, "sample_stats": {"lp": log_prob}})

    def posterior(self) -> Posterior:
        """The posterior that was sampled, rebuilt from the file."""
        return _reading(self.path, lambda file: Posterior.read(file["posterior"]))


def open_chain(path: str | os.PathLike[str]) -> Chain:
    """Read a chain file.

    Parameters
    ----------
    path : path-like

    Returns
    -------
    Chain

    Raises
    ------
    InputError
        If the file is missing, is no chain file, or was written in another schema.

    Examples
    --------
    >>> open_chain("absent.h5")
    Traceback (most recent call last):
    ...
    bayesfred.errors.InputError: absent.h5: no such file, expected a chain written by `bayesfred fit`: check the path
    """
    return _reading(Path(path), lambda file: _read(Path(path), file))


def random_states(path: Path) -> list[tuple[Any, ...]]:
    """The state of every ensemble's random numbers after its last step."""

    def read(file: h5py.File) -> list[tuple[Any, ...]]:
        groups = [file[f"ensemble_{k}"] for k in range(int(file.attrs["ensembles"]))]
        return [tuple(group.attrs[f"random_state_{i}"] for i in range(5)) for group in groups]

    return _reading(path, read)


def fingerprint(posterior: Posterior) -> dict[str, str]:
    """A hash of each part of a posterior, to tell whether a chain belongs to it."""
    with h5py.File("fingerprint", "w", driver="core", backing_store=False) as file:
        posterior.write(file)
        return {name: _digest(file[name]) for name in file}


def check_same_posterior(path: Path, posterior: Posterior) -> None:
    """Refuse a chain file whose frame, model, noise or priors are not those of the posterior."""
    stored = _reading(path, lambda file: {name: _digest(file["posterior"][name]) for name in file["posterior"]})
    changed = [name for name, digest in fingerprint(posterior).items() if stored.get(name) != digest]
    if changed:
        raise InputError(
            f"{path}: the run was made with other {', '.join(changed)}, expected the same to resume: write to another file or "
            "start over with overwrite"
        )


def write_chain(chain: Chain, posterior: Posterior, states: Sequence[tuple[Any, ...]]) -> None:
    """Replace the chain's file by one that holds its present state."""

    def fill(file: h5py.File) -> None:
        file.attrs.update(kind=KIND, schema=SCHEMA, seed=chain.seed, burn_in=chain.burn_in, ensembles=len(chain.chain))
        file.attrs["parameter_names"] = list(chain.parameter_names)
        file.attrs["target_ess"] = chain.target_ess
        versions = file.create_group("versions")
        versions.attrs.update(chain.versions)
        posterior.write(file.create_group("posterior"))
        chain.estimate.write(file.create_group("estimate"))
        for k, state in enumerate(states):
            _write_ensemble(file.create_group(f"ensemble_{k}"), chain, k, state)

    _replace(chain.path, fill)


def _write_ensemble(group: Any, chain: Chain, k: int, state: tuple[Any, ...]) -> None:
    """One ensemble as emcee's own backend lays it out."""
    _, steps, walkers, d = chain.chain.shape
    group.attrs.update(version=chain.versions["emcee"], nwalkers=walkers, ndim=d, has_blobs=False, iteration=steps)
    for i, part in enumerate(state):
        group.attrs[f"random_state_{i}"] = part
    group.create_dataset("chain", data=chain.chain[k], fletcher32=True)
    group.create_dataset("log_prob", data=chain.log_prob[k], fletcher32=True)
    group.create_dataset("accepted", data=chain.accepted[k].astype(np.float64), fletcher32=True)


def _replace(path: Path, fill: Any) -> None:
    """Write a file under a temporary name, flush it to the disk, and rename it over `path`."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with h5py.File(temporary, "w") as file:
            fill(file)
        with open(temporary, "rb+") as stream:
            os.fsync(stream.fileno())
        os.replace(temporary, path)
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def _open(path: Path) -> h5py.File:
    if not path.is_file():
        raise InputError(f"{path}: no such file, expected a chain written by `bayesfred fit`: check the path")
    try:
        file = h5py.File(path, "r", locking=False)
    except OSError as error:
        raise InputError(f"{path}: not a readable HDF5 file ({error}), expected a chain written by `bayesfred fit`") from None
    if file.attrs.get("kind") != KIND or file.attrs.get("schema") != SCHEMA:
        got = f"{file.attrs.get('kind')!r} of schema {file.attrs.get('schema')}"
        file.close()
        raise InputError(f"{path}: got {got}, expected {KIND!r} of schema {SCHEMA}: remake it with this version")
    return file


def _reading(path: Path, read: Callable[[h5py.File], Read]) -> Read:
    """What `read` makes of a chain file; a file that lacks something, or whose checksums do not hold, is refused."""
    with _open(path) as file:
        try:
            return read(file)
        except (KeyError, OSError, ValueError) as error:
            raise InputError(f"{path}: damaged ({error}), expected a whole chain file: restore a copy, or run again") from None


def _read(path: Path, file: h5py.File) -> Chain:
    groups = [file[f"ensemble_{k}"] for k in range(int(file.attrs["ensembles"]))]
    return Chain(
        path,
        tuple(str(name) for name in file.attrs["parameter_names"]),
        np.stack([g["chain"][()] for g in groups]),
        np.stack([g["log_prob"][()] for g in groups]),
        np.stack([g["accepted"][()] for g in groups]).astype(np.int64),
        int(file.attrs["burn_in"]),
        int(file.attrs["seed"]),
        MapEstimate.read(file["estimate"]),
        {str(k): str(v) for k, v in file["versions"].attrs.items()},
        float(file.attrs["target_ess"]),
    )


def _digest(item: Any) -> str:
    """SHA-256 over names, attributes and data of an HDF5 item and all it holds."""
    digest = hashlib.sha256()

    def add(name: str, node: Any) -> None:
        digest.update(name.encode())
        for key in sorted(node.attrs):
            value = np.asarray(node.attrs[key])
            digest.update(key.encode() + (value.tobytes() if value.dtype != object else repr(value.tolist()).encode()))
        if isinstance(node, h5py.Dataset):
            digest.update(node[()].tobytes())

    add("", item)
    if isinstance(item, h5py.Group):
        item.visititems(add)
    return digest.hexdigest()
