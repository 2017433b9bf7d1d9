"""TIFF and PNG frames: the numbers that are stored come back, or one line says why not."""

from __future__ import annotations

import contextlib
import os
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image, TiffImagePlugin

from bayesfred.errors import InputError
from bayesfred.io.frames import read_frame, require_memory, write_frame
from bayesfred.io.pictures import read_picture

Array = np.ndarray[Any, Any]
BITS = {8: "u1", 16: "u2"}


def numbers(dtype: str, shape: tuple[int, int] = (5, 7)) -> Array:
    """Numbers of every size, no two rows or columns alike, the extremes among them."""
    rng, kind = np.random.default_rng(1), np.dtype(dtype)
    if kind.kind == "f":
        return rng.normal(0.0, 1e3, shape).astype(kind)
    image = np.frombuffer(rng.bytes(kind.itemsize * shape[0] * shape[1]), kind).reshape(shape)
    image = image.copy()
    image.flat[1 % image.size], image.flat[-1] = np.iinfo(kind).min, np.iinfo(kind).max
    return image


def tiff(image: Array, order: str = "<", **changes: Any) -> bytes:
    """A TIFF file with one strip, written here; tags are changed by number, None removes one."""
    packed = image.astype(image.dtype.newbyteorder(order)).tobytes()
    compression = changes.pop("compression", 1)
    data = zlib.compress(packed) if compression == 8 else packed
    kind = {"u": 1, "i": 2, "f": 3}[image.dtype.kind]
    tags = {256: image.shape[1], 257: image.shape[0], 258: 8 * image.dtype.itemsize,
            259: compression, 262: 1, 273: 0, 277: 1, 278: image.shape[0], 279: len(data),
            339: kind}  # fmt: skip
    tags |= {int(key[1:]): value for key, value in changes.items()}
    tags = {key: value for key, value in sorted(tags.items()) if value is not None}
    tags[273] = 8 + 2 + 12 * len(tags) + 4
    entries = b"".join(struct.pack(order + "HHLL", tag, 4, 1, tags[tag]) for tag in tags)
    mark = b"II" if order == "<" else b"MM"
    heading = mark + struct.pack(order + "HLH", 42, 8, len(tags))
    return heading + entries + struct.pack(order + "L", 0) + data


def png(image: Array, depth: int, colour: int = 0, *, chunks: bytes = b"") -> bytes:
    """A PNG file written here; the rows hold what the image's bytes are."""

    def chunk(name: bytes, content: bytes) -> bytes:
        return struct.pack(">L", len(content)) + name + content + struct.pack(
            ">L", zlib.crc32(name + content)
        )  # fmt: skip

    ny, nx = image.shape
    rows = b"".join(b"\0" + row.astype(image.dtype.newbyteorder(">")).tobytes() for row in image)
    heading = struct.pack(">LLBBBBB", nx, ny, depth, colour, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", heading) + chunks
        + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")
    )  # fmt: skip


def read(path: Path) -> Array:
    return read_picture(path, require_memory)


def message(path: Path, content: bytes | None = None) -> str:
    """The one line with which a file is refused."""
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError) as caught:
        read(path)
    text = str(caught.value)
    assert text.startswith(f"{path}: got ") or "damaged" in text
    assert "\n" not in text and len(text) < 500
    return text


def same(path: Path, image: Array) -> None:
    """Read the picture back, bit for bit."""
    found = read(path)
    assert found.dtype.isnative
    assert found.dtype == (np.int32 if image.dtype == np.int16 else image.dtype.newbyteorder("="))
    np.testing.assert_array_equal(found, image)


# What is read


@pytest.mark.parametrize("compression", [1, 8])
@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("dtype", ["u1", "i1", "u2", "i2", "u4", "i4", "f4"])
def test_tiff_bit_for_bit(tmp_path: Path, dtype: str, order: str, compression: int) -> None:
    """Read every type, in both orders of bytes, or refuse it: never with wrong numbers."""
    image, path = numbers(dtype), tmp_path / "frame.tif"
    path.write_bytes(tiff(image, order, compression=compression))
    if order == ">" and dtype == "u4":
        assert "little-endian" in message(path)
    elif order == ">" and compression == 8 and dtype in ("i2", "i4", "f4"):
        assert "compressed big-endian" in message(path)
    else:
        same(path, image)


def test_pillow_swaps_the_bytes_of_what_is_refused(tmp_path: Path) -> None:
    """The negative control: Pillow alone gives other numbers for compressed big-endian int32."""
    image, path = numbers("i4"), tmp_path / "frame.tif"
    path.write_bytes(tiff(image, ">", compression=8))
    with Image.open(path) as picture:
        np.testing.assert_array_equal(np.asarray(picture).byteswap(), image)


@pytest.mark.parametrize(
    "compression",
    ["raw", "packbits", "tiff_lzw", "tiff_adobe_deflate", "tiff_deflate", "zstd", "lzma"],
)
@pytest.mark.parametrize("dtype", ["u1", "u2", "i4", "f4"])
def test_tiff_compressions(tmp_path: Path, dtype: str, compression: str) -> None:
    image, path = numbers(dtype, (90, 40)), tmp_path / "frame.TIFF"
    try:
        Image.fromarray(image).save(path, "TIFF", compression=compression)
    except (OSError, KeyError):
        pytest.skip(f"this Pillow does not write {compression}")
    same(path, image)


def test_tiff_with_a_predictor_in_strips(tmp_path: Path) -> None:
    image, path = numbers("u2", (300, 200)), tmp_path / "frame.tif"
    image = np.sort(image, axis=1)
    tags = {TiffImagePlugin.PREDICTOR: 2, TiffImagePlugin.ROWSPERSTRIP: 7}
    Image.fromarray(image).save(path, compression="tiff_lzw", tiffinfo=tags)
    same(path, image)


def test_tiff_of_12_bits_packed(tmp_path: Path) -> None:
    image, path = numbers("u2", (5, 8)) >> 4, tmp_path / "frame.tif"
    bits = ((image[:, :, None] >> np.arange(11, -1, -1)) & 1).astype(np.uint8)
    packed = np.packbits(bits.reshape(5, -1), axis=1)
    path.write_bytes(tiff(packed, t256=8, t258=12))
    same(path, image)


@pytest.mark.parametrize("compression", [1, 8])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_orientation_is_not_applied(tmp_path: Path, orientation: int, compression: int) -> None:
    image, path = numbers("u2"), tmp_path / "frame.tif"
    path.write_bytes(tiff(image, t274=orientation, compression=compression))
    same(path, image)


@pytest.mark.parametrize("depth", [8, 16])
def test_png_bit_for_bit(tmp_path: Path, depth: int) -> None:
    image, path = numbers(BITS[depth]), tmp_path / "frame.png"
    path.write_bytes(png(image, depth))
    same(path, image)


def test_png_orientation_is_not_applied(tmp_path: Path) -> None:
    image, path = numbers("u2"), tmp_path / "frame.png"
    exif = Image.Exif()
    exif[274] = 6
    Image.fromarray(image).save(path, exif=exif)
    same(path, image)


def test_large_pictures_are_read_without_a_warning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Pillow warns of pictures with more than `MAX_IMAGE_PIXELS`."""
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 20)
    image = numbers("u1")
    for path in (tmp_path / "frame.png", tmp_path / "frame.tif"):
        path.write_bytes(png(image, 8) if path.suffix == ".png" else tiff(image))
        same(path, image)


# What is refused


@pytest.mark.parametrize("suffix", [".png", ".tif"])
@pytest.mark.parametrize("mode", ["RGB", "RGBA", "P", "LA", "CMYK", "LAB", "YCbCr"])
def test_colours(tmp_path: Path, mode: str, suffix: str) -> None:
    path = tmp_path / f"frame{suffix}"
    if suffix == ".png" and mode in ("CMYK", "LAB", "YCbCr"):
        pytest.skip("PNG has no such colours")
    Image.new(mode, (7, 5)).save(path)
    text = message(path)
    assert "colours or transparency" in text and "separate the planes of a colour camera" in text


def test_colours_of_16_bits(tmp_path: Path) -> None:
    rgb = numbers("u2", (5, 21))  # three numbers a pixel
    narrow = png(rgb, 16, 2).replace(struct.pack(">L", 21), struct.pack(">L", 7), 1)
    fixed = narrow[:29] + struct.pack(">L", zlib.crc32(narrow[12:29])) + narrow[33:]
    assert "colours" in message(tmp_path / "frame.png", fixed)


@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_one_bit(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"frame{suffix}"
    Image.new("1", (7, 5)).save(path)
    assert "values of 1 bits, expected 8 or more" in message(path)


@pytest.mark.parametrize("bits", [2, 4])
def test_few_bits_which_pillow_would_scale(tmp_path: Path, bits: int) -> None:
    packed = numbers("u1", (5, 1))
    width = 8 // bits
    narrow = png(packed, bits).replace(struct.pack(">LL", 1, 5), struct.pack(">LL", width, 5), 1)
    fixed = narrow[:29] + struct.pack(">L", zlib.crc32(narrow[12:29])) + narrow[33:]
    assert f"of {bits} bits" in message(tmp_path / "frame.png", fixed)
    content = tiff(packed, t256=width, t258=bits)
    assert f"of {bits} bits" in message(tmp_path / "frame.tif", content)


@pytest.mark.parametrize("dtype", ["u1", "u2", "f4"])
@pytest.mark.parametrize("photometric", [0, None])
def test_white_is_zero(tmp_path: Path, dtype: str, photometric: int | None) -> None:
    content = tiff(numbers(dtype), t262=photometric)
    text = message(tmp_path / "frame.tif", content)
    assert "expected 1 (black is zero)" in text


@pytest.mark.parametrize("dtype", ["f8", "u8", "i8"])
def test_numbers_that_pillow_does_not_read(tmp_path: Path, dtype: str) -> None:
    image = numbers("f8") if dtype == "f8" else numbers(dtype)
    assert "unusual kind" in message(tmp_path / "frame.tif", tiff(image))


def test_transparency(tmp_path: Path) -> None:
    transparent = struct.pack(">L", 2) + b"tRNS\0\3" + struct.pack(">L", zlib.crc32(b"tRNS\0\3"))
    content = png(numbers("u1"), 8, chunks=transparent)
    assert "transparent grey value" in message(tmp_path / "frame.png", content)


@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_pages_are_counted(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"frame{suffix}"
    pages = [Image.fromarray(numbers("u1") // (k + 1)) for k in range(3)]
    pages[0].save(path, save_all=True, append_images=pages[1:])
    assert "got 3 pages, expected one" in message(path)


def test_a_chain_of_pages_that_bites_its_tail(tmp_path: Path) -> None:
    content = bytearray(tiff(numbers("u1")))
    end = 8 + 2 + 12 * 10
    content[end : end + 4] = struct.pack("<L", 8)
    path = tmp_path / "frame.tif"
    path.write_bytes(bytes(content))
    same(path, numbers("u1"))


def _whole(dtype: str, kind: str) -> bytes:
    image = numbers(dtype, (12, 9))
    return png(image, 8 * image.dtype.itemsize) if kind == "png" else tiff(
        image, compression=8 if kind == "deflate" else 1
    )  # fmt: skip


@pytest.mark.parametrize("kind", ["png", "raw", "deflate"])
@pytest.mark.parametrize("dtype", ["u1", "u2"])
def test_truncated_anywhere(tmp_path: Path, dtype: str, kind: str) -> None:
    """A part of a file is refused, or holds all the numbers still."""
    content, image = _whole(dtype, kind), numbers(dtype, (12, 9))
    path = tmp_path / ("frame.png" if kind == "png" else "frame.tif")
    refused = 0
    for size in range(len(content)):
        path.write_bytes(content[:size])
        try:
            found = read(path)
        except InputError:
            refused += 1
        else:
            np.testing.assert_array_equal(found, image)
    assert refused > len(content) - 25  # a PNG file ends with 24 bytes that hold no numbers


@pytest.mark.parametrize("kind", ["png", "raw", "deflate"])
def test_damage_gives_one_line(tmp_path: Path, kind: str) -> None:
    """Whatever byte is wrong, nothing but InputError is raised."""
    content = _whole("u2", kind)
    path = tmp_path / ("frame.png" if kind == "png" else "frame.tif")
    rng = np.random.default_rng(2)
    for position in range(min(len(content), 150)):
        damaged = bytearray(content)
        damaged[position] = int(rng.integers(256))
        path.write_bytes(bytes(damaged))
        with contextlib.suppress(InputError):
            read(path)


@pytest.mark.parametrize("suffix", [".png", ".tif"])
@pytest.mark.parametrize("content", [b"", b"SIMPLE  = T", b"\xff\xd8\xff\xe0 a JPEG", b"II*\0"])
def test_wrong_content(tmp_path: Path, suffix: str, content: bytes) -> None:
    assert "damaged or no" in message(tmp_path / f"frame{suffix}", content)


def test_a_png_called_tif(tmp_path: Path) -> None:
    assert "no TIFF" in message(tmp_path / "frame.tif", png(numbers("u1"), 8))


@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_a_bomb_is_refused_before_memory_is_taken(tmp_path: Path, suffix: str) -> None:
    """A file of 100 bytes claims 10 gigapixels and more."""
    small, path = numbers("u1", (1, 1)), tmp_path / f"frame{suffix}"
    if suffix == ".tif":
        content = tiff(small, t256=2**20, t257=2**20)
    else:
        claim = png(small, 8)
        heading = claim[12:16] + struct.pack(">LL", 2**20, 2**20) + claim[24:29]
        content = claim[:12] + heading + struct.pack(">L", zlib.crc32(heading)) + claim[33:]
    assert "whose fit would need" in message(path, content)


def test_more_pixels_than_pillow_takes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Some versions of Pillow refuse to load a TIFF picture of twice `MAX_IMAGE_PIXELS`."""

    def load(picture: TiffImagePlugin.TiffImageFile) -> None:
        raise Image.DecompressionBombError("too large")

    monkeypatch.setattr(TiffImagePlugin.TiffImageFile, "load", load)
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 10)
    text = message(tmp_path / "frame.tif", tiff(numbers("u1")))
    assert "got 35 pixels, expected at most 20: cut the frame or save it as FITS" in text


@pytest.mark.skipif(not os.path.isdir("/proc/self/fd"), reason="needs Linux")
def test_a_refused_file_leaves_nothing_open(tmp_path: Path) -> None:
    path = tmp_path / "frame.png"
    path.write_bytes(png(numbers("u1"), 8)[:60])
    before = len(os.listdir("/proc/self/fd"))
    for _ in range(5):
        message(path)
    assert len(os.listdir("/proc/self/fd")) == before


def test_a_picture_is_a_frame(tmp_path: Path) -> None:
    """Read as counts; without a gain that is said, and a saturated one is refused."""
    rng = np.random.default_rng(2)
    image = rng.poisson(90.0, (40, 50)).astype(np.uint8)
    Image.fromarray(image).save(tmp_path / "dim.png")
    frame = read_frame(tmp_path / "dim.png")
    assert np.array_equal(frame.counts, image)
    assert "no gain: stored numbers taken as photo-electrons" in frame.description
    assert "no gain" not in read_frame(tmp_path / "dim.png", gain=2.0).description
    Image.fromarray(np.minimum(image.astype(int) * 4, 255).astype(np.uint8)).save(
        tmp_path / "bright.tiff"
    )
    with pytest.raises(InputError, match=r"bright\.tiff: got .*% of the pixels at the maximum"):
        read_frame(tmp_path / "bright.tiff")
    assert read_frame(tmp_path / "bright.tiff", saturation=300.0).n_masked == 0
    with pytest.raises(InputError, match="expected none, as a picture holds one image"):
        read_frame(tmp_path / "dim.png", name="SCI")
    with pytest.raises(InputError, match="expected FITS, HDF5 or NPY"):
        write_frame(tmp_path / "new.png", image)
