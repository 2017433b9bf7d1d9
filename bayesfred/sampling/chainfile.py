"""The chain file: one HDF5 file a run, with everything needed to judge, replay and resume it.

Groups `ensemble_0`, ... are in emcee's own layout. Beside them stand the posterior itself (frame,
mask, model, noise, nuisances, priors), the MAP and other modes, the seed, the versions of what made
it and, where there is one, the record of the run: title, frame, settings, notes and truth. A
checkpoint writes a whole new file from memory and renames it over the old one, so that a reader
finds either the old state or the new one. `io.hdf5_checks` says what a file must be before it is
read, and `io.serialize` stores the objects in it.
"""

import hashlib
import io
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, cast, get_args

import h5py
import numpy as np

from bayesfred._typing import Floats, Ints, PathLike
from bayesfred.errors import InputError
from bayesfred.io import atomic
from bayesfred.io.hdf5_checks import KIND, SCHEMA, open_checked, open_with_digest, seal
from bayesfred.io.sealed import FORMAT
from bayesfred.io.serialize import read, write, write_array
from bayesfred.model.dithered import DitheredPosterior
from bayesfred.model.joint import JointPosterior
from bayesfred.model.posterior import Posterior
from bayesfred.model.protocol import TargetDensity
from bayesfred.optimize.estimate import MapEstimate, Modes
from bayesfred.sampling.chain import Chain, Method
from bayesfred.sampling.record import RunRecord

LARGEST = 1e100  # of a parameter, and of its inverse: their squares are numbers too
ROUNDING = 1e-6  # of a correlation


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


def fingerprint(posterior: TargetDensity) -> dict[str, str]:
    """A hash of each part of a posterior as files hold it.

    Raises
    ------
    InputError
        If no file can hold such a posterior.
    """
    with h5py.File(io.BytesIO(), "w") as file:  # without a name that other threads could use
        write(file, posterior)
        return _digests(file)


class Opened(NamedTuple):
    """A chain file, all of it read from one stream.

    Attributes
    ----------
    chain : Chain
    fingerprint : dict of str to str
        The hashes of the parts of its posterior, as they are stored.
    digest : str
        The SHA-256 of the file.
    """

    chain: Chain
    fingerprint: dict[str, str]
    digest: str


def open_whole(path: PathLike) -> Opened:
    """Read a chain file with what it is known by; see `open_chain`."""
    with open_with_digest(Path(path)) as (file, digest):
        return Opened(_read(Path(path), file), _digests(file["posterior"]), digest)


def changed_parts(before: dict[str, str], after: dict[str, str]) -> list[str]:
    """The parts whose hashes are not those of an earlier fingerprint."""
    return [name for name, digest in after.items() if before.get(name) != digest]


def write_chain(chain: Chain) -> None:
    """Replace the chain's file by one that holds its present state.

    Raises
    ------
    InputError
        If the file cannot be written, or cannot hold such a posterior.
    """
    if chain.path is None:
        raise ValueError("a chain in memory has no file")
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
        file.attrs["method"] = np.bytes_(chain.method)
        _write_versions(file.create_group("versions"), chain.versions)
        for steps, versions in chain.earlier:
            _write_versions(file.create_group(f"versions/until_{steps}"), versions)
        write(file.create_group("posterior"), chain.density)
        write(file.create_group("estimate"), chain.estimate)
        if chain.estimate.modes is not None:
            write(file.create_group("modes"), chain.estimate.modes)
        if chain.record is not None:
            write(file.create_group("record"), chain.record)
        for k, state in enumerate(chain.random_states):
            _write_ensemble(file.create_group(f"ensemble_{k}"), chain, k, state)
    with content.getbuffer() as written:
        try:
            atomic.replace(chain.path, written, seal(written), sole_writer=True)
        except InputError as error:
            raise InputError(
                f"{error}: what was saved before is still there: resume from it"
            ) from None


def _write_versions(group: Any, versions: dict[str, str]) -> None:
    group.attrs.update({name: np.bytes_(version) for name, version in sorted(versions.items())})


def _read_versions(group: Any) -> dict[str, str]:
    versions = {name: version.decode() for name, version in group.attrs.items()}
    if not all(name.isidentifier() for name in versions):
        raise ValueError("names that are none")
    if not all(text.isprintable() for text in versions.values()):
        raise ValueError("texts that cannot be shown")
    return versions


def _earlier(group: Any) -> tuple[tuple[int, dict[str, str]], ...]:
    """See `Chain.earlier`."""
    ends = {int(name.removeprefix("until_")): name for name in group}
    return tuple((steps, _read_versions(group[ends[steps]])) for steps in sorted(ends))


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


def _refuse_other_densities(file: h5py.File) -> None:
    """Raise InputError for a chain whose log-probabilities are not those of what would be read.

    Read noise was a shifted Poisson distribution in schema 3, free fluxes had Laplace's
    approximation alone before schema 5, and positions scattered normally before schema 6.
    """
    schema = file.attrs["schema"]
    if file["posterior"].attrs.get("kind") != b"posterior":  # of schema 8
        return
    if file["posterior/nuisances"].attrs["flux"] == b"free" and schema < 5:
        raise InputError(
            f"nuisances: got free fluxes by Laplace's approximation (schema {schema}), expected "
            "the integral over them that has replaced it: sample the frame again"
        )
    if file["posterior/nuisances"].attrs["position_scatter"] and schema < 6:
        raise InputError(
            f"nuisances: got positions that scatter normally (schema {schema}), expected Student's "
            "t distribution that has replaced it: sample the frame again"
        )
    noise = file["posterior/noise"].attrs
    shifted = noise["kind"] == b"noise.poisson" and noise.get("read_noise", 0.0) > 0.0
    if shifted and schema < 4:
        raise InputError(
            f"noise: got read noise {noise['read_noise']:g} as the shifted Poisson distribution "
            f"(schema {schema}), expected the convolution with a Gaussian that has "
            "replaced it: sample the frame again"
        )


def _read(path: Path, file: h5py.File) -> Chain:
    _refuse_other_densities(file)
    modes = read(file["modes"], Modes) if "modes" in file else None
    groups = [file[f"ensemble_{k}"] for k in range(int(file.attrs["ensembles"]))]
    chain = Chain(
        path=path,
        density=_posterior(file["posterior"]),
        chain=np.stack([g["chain"][()] for g in groups]),
        log_prob=np.stack([g["log_prob"][()] for g in groups]),
        accepted=_accepted(np.stack([g["accepted"][()] for g in groups]), groups[0]),
        random_states=tuple(_random_state(g.attrs) for g in groups),
        burn_in=int(file.attrs["burn_in"]),
        seed=int(file.attrs["seed"]),
        estimate=replace(read(file["estimate"], MapEstimate), modes=modes),
        versions=_read_versions(file["versions"]),
        target_ess=float(file.attrs["target_ess"]),
        n_invalid=int(file.attrs["n_invalid"]),
        method=_method(file.attrs.get("method", b"mcmc")),  # files had none before others came
        record=read(file["record"], RunRecord) if "record" in file else None,
        earlier=_earlier(file["versions"]),
    )
    names = tuple(name.decode() for name in file.attrs["parameter_names"])
    if names != chain.parameter_names:
        raise ValueError("names of parameters that are not the posterior's")
    d, shape = len(names), chain.chain.shape
    expected = {
        "chain": (chain.chain, (*shape[:3], d)),
        "log_prob": (chain.log_prob, shape[:3]),
        "accepted": (chain.accepted, (shape[0], shape[2])),
        "params": (chain.estimate.params, (d,)),
        "covariance": (chain.estimate.covariance, (d, d)),
    }
    if chain.record is not None and chain.record.truth is not None:
        expected["truth"] = chain.record.truth, (d,)
    if modes is not None:
        k = len(modes.weights)
        expected["modes"] = modes.means, (k, d)
        expected["their covariances"] = modes.covariances, (k, d, d)
    wrong = [name for name, (array, right) in expected.items() if array.shape != right]
    if wrong or 0 in shape:
        raise ValueError(f"shapes that do not agree: {', '.join(wrong)}")
    for params in (chain.chain, chain.estimate.params):
        size = np.abs(params)
        if not np.all((size == 0.0) | ((size >= 1.0 / LARGEST) & (size <= LARGEST))):
            raise ValueError("draws or a maximum that are no numbers, or out of all proportion")
    if not _is_covariance(chain.estimate.covariance):
        raise ValueError("a covariance that is none")
    if chain.seed < 0:
        raise ValueError("no seed")
    steps = {int(g.attrs["iteration"]) for g in groups}
    if steps != {shape[1]} or not 0 <= chain.burn_in < shape[1]:
        raise ValueError("numbers of steps that do not agree")
    if "bayesfred" not in chain.versions:
        raise ValueError("no version of bayesfred")
    if not all(0 < steps < shape[1] for steps, _ in chain.earlier):
        raise ValueError("versions of steps that there are not")
    if not chain.estimate.message.isprintable():
        raise ValueError("texts that cannot be shown")
    return chain


def _accepted(stored: Floats, group: Any) -> Ints:
    """Numbers of accepted moves, which are at most those of the steps."""
    if not np.all((stored >= 0.0) & (stored <= len(group["chain"]))):
        raise ValueError("more accepted moves than steps")
    return stored.astype(np.int64)


def _is_covariance(matrix: Floats) -> bool:
    """Whether a matrix is symmetric, but for rounding, and positive definite."""
    sd = np.sqrt(np.maximum(np.diag(matrix), 0.0))
    if not np.all((sd > 0.0) & (sd <= LARGEST)):
        return False
    correlation = matrix / np.outer(sd, sd)
    if not np.allclose(correlation, correlation.T, rtol=0.0, atol=ROUNDING):
        return False
    try:
        np.linalg.cholesky(correlation)
    except np.linalg.LinAlgError:
        return False
    return True


def _posterior(group: Any) -> Posterior | JointPosterior | DitheredPosterior:
    """The posterior of a frame or of several."""
    if group.attrs.get("kind") == b"joint_posterior":
        return read(group, JointPosterior)
    if group.attrs.get("kind") == b"dithered_posterior":
        return read(group, DitheredPosterior)
    return read(group, Posterior)


def _method(stored: bytes) -> Method:
    for method in get_args(Method):
        if stored == method.encode():
            return cast("Method", method)
    raise ValueError("no method of sampling")


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
