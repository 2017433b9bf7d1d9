"""The chain file: one HDF5 file a run, with everything needed to judge, replay and resume it.

Groups `ensemble_0`, ... are in emcee's own layout. Beside them stand the posterior itself (frame,
mask, model, noise, nuisances, priors), the MAP, the seed and the versions of what made it. A
checkpoint writes a whole new file from memory and renames it over the old one, so that a reader
finds either the old state or the new one. `io.hdf5_checks` says what a file must be before it is
read, and `io.serialize` stores the objects in it.
"""

import hashlib
import io
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import arviz_base
import h5py
import numpy as np
import xarray as xr

from bayesfred._typing import Floats, Ints, PathLike
from bayesfred.errors import InputError
from bayesfred.io.atomic import replace
from bayesfred.io.hdf5_checks import KIND, SCHEMA, open_checked, seal
from bayesfred.io.serialize import read, write, write_array
from bayesfred.io.summary_table import Table
from bayesfred.model.posterior import Posterior
from bayesfred.optimize.estimate import MapEstimate
from bayesfred.sampling.summary import summary

# The oldest format that keeps small files small; every HDF5 since 1.10 (2016) reads it.
FORMAT = ("v110", "v110")


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
        Steps that `draws` leaves out; half of all, or more, while the run goes on.
    seed : int
    estimate : MapEstimate
        The maximum that the proposals are centred on.
    versions : dict of str to str
        Packages that the run was made with.
    target_ess : float
        Effective draws that were asked for.
    n_invalid : int
        Log-probabilities that came out as NaN or +inf and were taken as -inf.
    """

    path: Path
    parameter_names: tuple[str, ...]
    chain: Floats
    log_prob: Floats
    accepted: Ints
    burn_in: int
    seed: int
    estimate: MapEstimate
    versions: dict[str, str]
    target_ess: float = 1000.0
    n_invalid: int = 0

    def draws(self) -> Floats:
        """All draws after burn-in, shape (n, d)."""
        return self.chain[:, self.burn_in :].reshape(-1, len(self.parameter_names))

    def summary(self) -> Table:
        """What the draws say of every parameter, a row each, see `summary.summary`."""
        return summary(self)

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
        with open_checked(self.path) as file:
            return read(file["posterior"], Posterior)


def open_chain(path: PathLike) -> Chain:
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
        If the file is missing, is no chain file, was changed or damaged since it was written, or is
        of another schema.

    Examples
    --------
    >>> open_chain("absent.h5")
    Traceback (most recent call last):
    ...
    bayesfred.errors.InputError: absent.h5: no such file, expected a chain written by ...
    """
    with open_checked(Path(path)) as file:
        return _read(Path(path), file)


def random_states(path: Path) -> list[tuple[Any, ...]]:
    """The state of every ensemble's random numbers after its last step."""
    with open_checked(path) as file:
        return [
            _random_state(file[f"ensemble_{k}"].attrs) for k in range(int(file.attrs["ensembles"]))
        ]


def fingerprint(posterior: Posterior) -> dict[str, str]:
    """A hash of each part of a posterior, to tell whether a chain belongs to it."""
    with h5py.File("fingerprint", "w", driver="core", backing_store=False) as file:
        write(file, posterior)
        return _digests(file)


def changed_parts(path: Path, posterior: Posterior) -> list[str]:
    """Which parts of a posterior are not those that a chain file holds."""
    with open_checked(path) as file:
        stored = _digests(file["posterior"])
    return [name for name, digest in fingerprint(posterior).items() if stored.get(name) != digest]


def check_same_posterior(path: Path, posterior: Posterior) -> None:
    """Refuse a chain file whose frame, model, noise or priors are not those of the posterior."""
    changed = changed_parts(path, posterior)
    if changed:
        raise InputError(
            f"{path}: the run was made with other {', '.join(changed)}, expected the same to "
            "resume: write to another file or "
            "start over with overwrite"
        )


def write_chain(chain: Chain, posterior: Posterior, states: Sequence[tuple[Any, ...]]) -> None:
    """Replace the chain's file by one that holds its present state.

    Parameters
    ----------
    chain : Chain
    posterior : Posterior
        What was sampled.
    states : sequence of tuple
        The state of every ensemble's random numbers.

    Raises
    ------
    InputError
        The file cannot be written.
    """
    content = io.BytesIO()  # so that a full disk meets plain writing, not HDF5 halfway through
    with h5py.File(content, "w", libver=FORMAT) as file:
        file.attrs.update(
            kind=np.bytes_(KIND),
            schema=SCHEMA,
            seed=chain.seed,
            burn_in=chain.burn_in,
            ensembles=len(chain.chain),
        )
        file.attrs["parameter_names"] = np.array(chain.parameter_names, dtype=np.bytes_)
        file.attrs.update(target_ess=chain.target_ess, n_invalid=chain.n_invalid)
        versions = file.create_group("versions")
        versions.attrs.update(
            {name: np.bytes_(version) for name, version in chain.versions.items()}
        )
        write(file.create_group("posterior"), posterior)
        write(file.create_group("estimate"), chain.estimate)
        for k, state in enumerate(states):
            _write_ensemble(file.create_group(f"ensemble_{k}"), chain, k, state)
    with content.getbuffer() as written:
        try:
            replace(chain.path, written, seal(written), sole_writer=True)
        except InputError as error:
            raise InputError(
                f"{error}: what was saved before is still there: resume from it"
            ) from None


def _write_ensemble(group: Any, chain: Chain, k: int, state: tuple[Any, ...]) -> None:
    """One ensemble as emcee's own backend lays it out."""
    _, steps, walkers, d = chain.chain.shape
    version = np.bytes_(chain.versions["emcee"])
    group.attrs.update(version=version, nwalkers=walkers, ndim=d, has_blobs=False, iteration=steps)
    for i, part in enumerate(state):
        group.attrs[f"random_state_{i}"] = part
    for name, values in (
        ("chain", chain.chain[k]),
        ("log_prob", chain.log_prob[k]),
        ("accepted", chain.accepted[k].astype(float)),
    ):
        write_array(group, name, values)


def _read(path: Path, file: h5py.File) -> Chain:
    groups = [file[f"ensemble_{k}"] for k in range(int(file.attrs["ensembles"]))]
    chain = Chain(
        path,
        tuple(name.decode() for name in file.attrs["parameter_names"]),
        np.stack([g["chain"][()] for g in groups]),
        np.stack([g["log_prob"][()] for g in groups]),
        np.stack([g["accepted"][()] for g in groups]).astype(np.int64),
        int(file.attrs["burn_in"]),
        int(file.attrs["seed"]),
        read(file["estimate"], MapEstimate),
        {name: version.decode() for name, version in file["versions"].attrs.items()},
        float(file.attrs["target_ess"]),
        int(file.attrs["n_invalid"]),
    )
    d, shape = len(chain.parameter_names), chain.chain.shape
    arrays = (
        chain.chain,
        chain.log_prob,
        chain.accepted,
        chain.estimate.params,
        chain.estimate.covariance,
    )
    if [a.shape for a in arrays] != [
        (*shape[:3], d),
        shape[:3],
        (shape[0], shape[2]),
        (d,),
        (d, d),
    ] or 0 in shape:
        raise ValueError("shapes that do not agree")
    if {int(g.attrs["iteration"]) for g in groups} != {shape[1]} or not 0 <= chain.burn_in < shape[
        1
    ]:
        raise ValueError("numbers of steps that do not agree")
    if not all(name.isidentifier() for name in (*chain.parameter_names, *chain.versions)):
        raise ValueError("names that are none")
    if not all(text.isprintable() for text in (chain.estimate.message, *chain.versions.values())):
        raise ValueError("texts that cannot be shown")
    return chain


def _random_state(attributes: Any) -> tuple[Any, ...]:
    """The state of a Mersenne twister, the one kind there is."""
    key, position, has_gauss, gauss = (attributes[f"random_state_{i}"] for i in range(1, 5))
    if key.shape != (624,) or not 0 <= position <= 624:
        raise ValueError("no state of random numbers")
    return "MT19937", key.astype(np.uint32), int(position), int(has_gauss), float(gauss)


def _digests(group: Any) -> dict[str, str]:
    """A SHA-256 of each part of a stored object: names, attributes and data of all it holds."""
    values = {name: value for name, value in group.attrs.items() if name != "kind"}
    return {name: _digest(part) for name, part in {**values, **group}.items()}


def _digest(item: Any) -> str:
    digest = hashlib.sha256()

    def put(name: str, value: Any) -> None:
        array = np.asarray(() if isinstance(value, h5py.Empty) else value)
        digest.update(f"{name} {array.dtype} {array.shape} ".encode() + array.tobytes())

    def add(name: str, node: Any) -> None:
        for key in sorted(node.attrs):
            put(f"{name}@{key}", node.attrs[key])
        put(name, node[()] if isinstance(node, h5py.Dataset) else ())

    if isinstance(item, h5py.Group | h5py.Dataset):
        add("", item)
    else:
        put("", item)
    if isinstance(item, h5py.Group):
        item.visititems(add)
    return digest.hexdigest()
