"""Files that are not what they should be: flipped bits, edits, and files made to do harm."""

import shutil
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from test_model import make_model, make_posterior, make_truth
from test_sampling_chain import reseal, run

from bayesfred.errors import InputError
from bayesfred.io import hdf5_checks, serialize
from bayesfred.optimize.find_map import find_map
from bayesfred.sampling.chain import Chain
from bayesfred.sampling.chainfile import open_chain

STEPS = 20


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Chain:
    rng = np.random.default_rng(70)
    model = make_model(tolerance=1e-8)
    posterior = make_posterior(model, make_truth(model, rng), rng)[0]
    return run(
        posterior,
        find_map(posterior),
        tmp_path_factory.mktemp("whole") / "chain.h5",
        STEPS,
        walkers=16,
    )


@pytest.fixture
def path(whole: Chain, tmp_path: Path) -> Path:
    return Path(shutil.copy(whole.path, tmp_path))


def raw_bytes(path: Path) -> int:
    """Bytes of all arrays in a file."""
    sizes: list[int] = []
    with h5py.File(path, "r") as file:
        file.visititems(
            lambda _, item: sizes.append(item.nbytes) if isinstance(item, h5py.Dataset) else None
        )
    return sum(sizes)


# --- what is written ------------------------------------------------------------------------------


@pytest.mark.parametrize("largest_chunk", [serialize.LARGEST_CHUNK, 40_000])
def test_a_file_is_little_larger_than_its_numbers(
    whole: Chain, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, largest_chunk: int
) -> None:
    monkeypatch.setattr(serialize, "LARGEST_CHUNK", largest_chunk)
    longer = run(whole.posterior(), whole.estimate, tmp_path / "chain.h5", 113, walkers=16)
    assert longer.path.stat().st_size < 1.2 * raw_bytes(longer.path)
    assert np.array_equal(open_chain(longer.path).chain, longer.chain)
    with h5py.File(longer.path, "r") as file:
        assert np.prod(file["ensemble_0/chain"].chunks) * 8 <= largest_chunk
        assert all(
            file[f"ensemble_1/{name}"].fletcher32 for name in ("chain", "log_prob", "accepted")
        )
        assert all(
            file[f"ensemble_1/{name}"].compression is None
            for name in ("chain", "log_prob", "accepted")
        )


def test_the_seal_is_the_sha256_of_what_stands_before_it(whole: Chain) -> None:
    content = whole.path.read_bytes()
    assert content[-hdf5_checks.SEAL_SIZE :] == hdf5_checks.seal(content[: -hdf5_checks.SEAL_SIZE])
    with hdf5_checks.open_with_digest(whole.path) as (_, digest):
        assert content.endswith(f"\nbayesfred sha256 {digest}\n".encode())


# --- flipped bits ---------------------------------------------------------------------------------


def flip(path: Path, bit: int) -> None:
    content = bytearray(path.read_bytes())
    content[bit // 8] ^= 1 << bit % 8
    path.write_bytes(content)


def test_no_flipped_bit_is_silent(whole: Chain, tmp_path: Path) -> None:
    rng, path = np.random.default_rng(71), tmp_path / "chain.h5"
    bits = 8 * whole.path.stat().st_size
    for bit in [*rng.integers(0, bits, 300), 0, bits - 1]:
        shutil.copy(whole.path, path)
        flip(path, int(bit))
        with pytest.raises(InputError, match=r"chain\.h5: "):
            open_chain(path)


def test_a_flipped_bit_that_hdf5_does_not_notice_is_noticed(whole: Chain, path: Path) -> None:
    """An array of which HDF5 keeps no checksum of its own."""
    name = "posterior/model/sources/x"
    with h5py.File(path, "a", libver="v110") as file:
        x = file[name][()]
        put(file, name, data=x)
    reseal(path)
    assert np.array_equal(open_chain(path).posterior().model.sources.x, x)
    with h5py.File(path, "r") as file:
        place = file[name].id.get_offset()
    flip(path, 8 * (place + 8 * 3 + 6))
    with h5py.File(path, "r") as file:
        assert file[name][3] != x[3]
    with pytest.raises(InputError, match="another content than its seal says"):
        open_chain(path)
    reseal(path)
    assert open_chain(path).posterior().model.sources.x[3] != x[3]


# --- files made to do harm ------------------------------------------------------------------------

Harm = Callable[[h5py.File], object]
HARM: dict[str, tuple[Harm, str]] = {}


def harm(words: str) -> Callable[[Harm], Harm]:
    """List what is done to a good file, and what its refusal says."""

    def enlist(do: Harm) -> Harm:
        HARM[do.__name__] = do, words
        return do

    return enlist


def put(file: h5py.File, name: str = "ensemble_0/log_prob", **options: object) -> h5py.Dataset:
    """Replace an array."""
    del file[name]
    return file.create_dataset(name, **options)


@harm("array in another file")
def external_storage(file: h5py.File) -> None:
    put(file, shape=(STEPS, 16), dtype="f8", external=[("/etc/passwd", 0, STEPS * 16 * 8)])


@harm("soft or external link")
def external_link(file: h5py.File) -> None:
    file["versions/other"] = h5py.ExternalLink("/etc/passwd", "/")


@harm("soft or external link")
def soft_link(file: h5py.File) -> None:
    del file["ensemble_0/log_prob"]
    file["ensemble_0/log_prob"] = h5py.SoftLink("/ensemble_1/log_prob")


@harm("soft or external link")
def dangling_link(file: h5py.File) -> None:
    file["posterior/prior/f_zz"] = h5py.SoftLink("/nowhere")


@harm("virtual array")
def virtual_dataset(file: h5py.File) -> None:
    layout = h5py.VirtualLayout(shape=(STEPS, 16), dtype="f8")
    layout[:] = h5py.VirtualSource("/etc/passwd", "x", shape=(STEPS, 16))
    del file["ensemble_0/log_prob"]
    file["ensemble_0"].create_virtual_dataset("log_prob", layout)


@harm("bytes, expected an array that the file holds")
def shape_bomb(file: h5py.File) -> None:
    put(file, shape=(10**9, 10**9), dtype="f8", chunks=(1, 10**6))


@harm("bytes, expected an array that the file holds")
def shape_bomb_in_one_piece(file: h5py.File) -> None:
    put(file, shape=(10**8, 10**4), dtype="f8")


@harm("bytes, expected an array that the file holds")
def chunk_bomb(file: h5py.File) -> None:
    put(file, shape=(1, 16), maxshape=(None, 16), dtype="f8", chunks=(10**7, 16))


@harm("compressed array")
def compression_bomb(file: h5py.File) -> None:
    put(file, shape=(10**6, 16), dtype="f8", chunks=(10**6, 16), compression="gzip", shuffle=True)[
        :
    ] = 0.0


@harm("compressed array")
def scale_offset(file: h5py.File) -> None:
    put(file, data=np.zeros((STEPS, 16), int), scaleoffset=0)


@harm("a second link to one object")
def cycle(file: h5py.File) -> None:
    file["ensemble_0/again"] = file["/"]


@harm("a second link to one object")
def cycle_of_two(file: h5py.File) -> None:
    file["a/b/c"] = file.create_group("a")


@harm("a second link to one object")
def one_array_twice(file: h5py.File) -> None:
    del file["ensemble_0/chain"]
    file["ensemble_0/chain"] = file["ensemble_1/chain"]


@harm("unknown type")
def objects(file: h5py.File) -> None:
    put(file, data=["x"] * 16, dtype=h5py.string_dtype())


@harm("unknown type")
def references(file: h5py.File) -> None:
    put(file, shape=(16,), dtype=h5py.ref_dtype)


@harm("unknown type")
def ragged(file: h5py.File) -> None:
    put(file, shape=(16,), dtype=h5py.vlen_dtype(float))


@harm("unknown type")
def compound(file: h5py.File) -> None:
    put(file, data=np.zeros(16, [("a", "f8"), ("b", "i4")]))


@harm("unknown type")
def opaque(file: h5py.File) -> None:
    put(file, data=np.zeros(16, "V10000"))


@harm("unknown type")
def text_attribute_of_no_length(file: h5py.File) -> None:
    file["estimate"].attrs["message"] = "x" * 10**6


@harm("unknown type")
def reference_attribute(file: h5py.File) -> None:
    file["versions"].attrs["numpy"] = file["/"].ref


@harm(r"/versions/\x1b[31m\nred\x07: got a soft")
def name_that_a_terminal_obeys(file: h5py.File) -> None:
    file["versions/\x1b[31m\nred\x07"] = h5py.SoftLink("/")


@harm("neither a group nor an array")
def named_type(file: h5py.File) -> None:
    file["versions/type"] = np.dtype("f8")


@harm("expected a small one")
def large_attribute(file: h5py.File) -> None:
    file["versions"].attrs.create("numpy", np.zeros(10**6))


@harm("attributes, expected at most 100")
def many_attributes(file: h5py.File) -> None:
    file["versions"].attrs.update({f"package{k}": 1.0 for k in range(193)})


@harm("more than 10000 objects")
def many_objects(file: h5py.File) -> None:
    for k in range(10_001):
        file["versions"].create_group(f"{k}")


@harm("more than 10000 objects")
def objects_with_many_attributes(file: h5py.File) -> None:
    for k in range(200):
        file["versions"].create_group(f"{k}").attrs.update({f"{j}": 1.0 for j in range(60)})


@harm("more than 10000 objects")
def deep_groups(file: h5py.File) -> None:
    group = file["versions"]
    for _ in range(10_001):
        group = group.create_group("g")


@harm(
    "of newer schema 11, expected bayesfred chain of schema 10: read it with the version that "
    "wrote it"
)
def newer_schema(file: h5py.File) -> None:
    file.attrs["schema"] = hdf5_checks.SCHEMA + 1
    file["ensemble_0/unheard_of"] = ["text"]


@harm("of schema 2, expected bayesfred chain of schema 10: remake it")
def older_schema(file: h5py.File) -> None:
    file.attrs["schema"] = 2


@harm("damaged")
def schema_of_numbers(file: h5py.File) -> None:
    file.attrs["schema"] = [3, 3]


@harm("damaged")
def schema_of_text(file: h5py.File) -> None:
    file.attrs["schema"] = np.bytes_("3")


@pytest.mark.parametrize("name", HARM)
def test_harm_is_seen_before_anything_is_read(
    path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    do, words = HARM[name]
    with h5py.File(path, "a", libver="v110") as file:
        do(file)
    reseal(path)
    monkeypatch.setattr(h5py.Dataset, "__getitem__", lambda *_: pytest.fail("an array was read"))
    tracemalloc.start()
    with pytest.raises(InputError) as caught:
        open_chain(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    message = str(caught.value)
    assert message.startswith(f"{path}: ") and words in message and message.isprintable()
    assert peak < 100e6


def test_a_good_file_passes_that_test_only_when_it_is_read(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with h5py.File(path, "a", libver="v110") as file:
        file.attrs["comment"] = np.bytes_("harmless")
    reseal(path)
    open_chain(path)
    monkeypatch.setattr(h5py.Dataset, "__getitem__", lambda *_: pytest.fail("an array was read"))
    with pytest.raises(pytest.fail.Exception, match="was read"):
        open_chain(path)


@pytest.mark.parametrize("kept", [0, 1, 1000, -hdf5_checks.SEAL_SIZE, -1])
def test_cut_files_are_refused(path: Path, kept: int) -> None:
    path.write_bytes(path.read_bytes()[:kept])
    with pytest.raises(InputError, match=r"no seal|another content"):
        open_chain(path)


@pytest.mark.parametrize("content", [b"", b"x" * 5000, b"\x89HDF\r\n\x1a\n" + b"\xff" * 5000])
def test_sealed_nonsense_is_refused(path: Path, content: bytes) -> None:
    path.write_bytes(content)
    reseal(path)
    with pytest.raises(InputError, match=r"chain\.h5: damaged"):
        open_chain(path)


def test_a_sealed_file_whose_inside_is_cut_is_refused(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: -20000 - hdf5_checks.SEAL_SIZE])
    reseal(path)
    with pytest.raises(InputError, match=r"chain\.h5: damaged"):
        open_chain(path)


# --- plain files that make no sense ---------------------------------------------------------------

SENSELESS: dict[str, Harm] = {
    "fewer log-probabilities": lambda file: put(file, data=np.zeros((STEPS - 1, 16))),
    "flat chain": lambda file: put(file, "ensemble_0/chain", data=np.zeros(STEPS)),
    "no steps": lambda file: [
        put(file, f"ensemble_{k}/chain", data=np.zeros((0, 16, 13))) for k in range(2)
    ],
    "a draw that is no number": lambda file: put(
        file, data=np.where(np.arange(13) == 3, np.nan, np.zeros((STEPS, 16, 13)))
    ),
    "more accepted moves than steps": lambda file: put(
        file, "ensemble_1/accepted", data=np.full(16, 1e300)
    ),
    "fewer parameters": lambda file: put(file, "estimate/params", data=np.zeros(12)),
    "covariance": lambda file: put(file, "estimate/covariance", data=np.zeros((13, 12))),
    "group for an array": lambda file: [
        file.__delitem__("estimate/params"),
        file.create_group("estimate/params"),
    ],
    "array for a group": lambda file: [
        file.__delitem__("estimate"),
        file.create_dataset("estimate", data=1.0),
    ],
    "iteration": lambda file: file["ensemble_1"].attrs.update(iteration=STEPS + 1),
    "burn-in": lambda file: file.attrs.update(burn_in=STEPS),
    "negative burn-in": lambda file: file.attrs.update(burn_in=-1),
    "very many ensembles": lambda file: file.attrs.update(ensembles=10**12),
    "no ensembles": lambda file: file.attrs.update(ensembles=0),
    "seed": lambda file: file.attrs.update(seed=np.nan),
    "names": lambda file: file.attrs.update(parameter_names=np.zeros(13)),
    "names of markup": lambda file: file.attrs.update(parameter_names=np.array([b"[/x]"] * 13)),
    "version that a terminal obeys": lambda file: file["versions"].attrs.update(
        numpy=np.bytes_(b"\x1b[31m")
    ),
    "version of markup": lambda file: file["versions"].attrs.update({"[/x]": np.bytes_(b"1")}),
    "message of two lines": lambda file: file["estimate"].attrs.update(message=np.bytes_(b"a\nb")),
    "no target": lambda file: file.attrs.__delitem__("target_ess"),
}


@pytest.mark.parametrize("name", SENSELESS)
def test_nonsense_is_refused(path: Path, name: str) -> None:
    with h5py.File(path, "a", libver="v110") as file:
        SENSELESS[name](file)
    reseal(path)
    with pytest.raises(InputError, match=r"chain\.h5: damaged"):
        open_chain(path)


@pytest.mark.parametrize(
    ("part", "value"), [(1, np.zeros(623, np.uint32)), (1, 5), (2, 10**6), (2, -1), (2, [1, 2])]
)
def test_no_state_of_random_numbers_is_refused(path: Path, part: int, value: object) -> None:
    with h5py.File(path, "a", libver="v110") as file:
        file["ensemble_1"].attrs[f"random_state_{part}"] = value
    reseal(path)
    with pytest.raises(InputError, match=r"chain\.h5: damaged"):
        open_chain(path)


@pytest.mark.parametrize(
    ("place", "name", "value", "words"),
    [
        ("prior/f_ux", "family", np.bytes_("rv_histogram"), "unknown family 'rv_histogram'"),
        ("prior/f_ux", "parameters", np.zeros(1), "damaged"),
        ("nuisances", "flux", np.bytes_("stolen"), "flux: got 'stolen'"),
        ("model/psf", "sigma", -1.0, "sigma"),
        ("model/detector", "binning", 10**9, "binning"),
    ],
)
def test_a_posterior_that_makes_no_sense_is_refused(
    path: Path, place: str, name: str, value: object, words: str
) -> None:
    with h5py.File(path, "a", libver="v110") as file:
        file[f"posterior/{place}"].attrs[name] = value
    reseal(path)
    with pytest.raises(InputError, match=rf"chain\.h5: .*{words}"):
        open_chain(path).posterior()
