"""Pictures: what goes in comes out, the stated rules hold, and files that lie or break are refused by name."""

import errno
import os
import resource

import numpy as np
import OpenImageIO as oiio
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from relightcli.adapters import images
from relightcli.adapters import oiio as limits
from relightcli.adapters.images import encode_image, read_environment, read_image, read_texture, write_image
from relightcli.core.display import decode_srgb, encode_srgb, to_display
from relightcli.errors import InputError


@pytest.fixture
def picture():
    """RGBA with associated alpha, values far outside 0..1."""
    rng = np.random.default_rng(1)
    rgba = np.exp(rng.normal(0, 4, (12, 20, 4))).astype(np.float32)
    rgba[..., 3] = rng.random((12, 20))
    rgba[..., :3] *= rgba[..., 3:]
    return rgba


def write_raw(path, pixels, fmt, *, names=None, attributes=(), window=None, planes="openexr"):
    """A file straight from OpenImageIO, to make what this project's writer would never write."""
    height, width, count = pixels.shape
    spec = oiio.ImageSpec(width, height, count, fmt)
    if names:
        spec.channelnames = tuple(names)
    if window:
        spec.x, spec.y, spec.full_x, spec.full_y, spec.full_width, spec.full_height = window
    for key, value in attributes:
        spec.attribute(key, value)
    out = oiio.ImageOutput.create(str(path))
    assert out.open(str(path), spec)
    assert out.write_image(np.ascontiguousarray(pixels))
    assert out.close()
    return path


# --- round trips ---------------------------------------------------------------------------------------------------


def test_exr_keeps_every_bit_layer_and_key(tmp_path, picture):
    layers = {"direct": picture[..., :3] * 2, "variance": picture[..., 0]}
    file = tmp_path / "a.exr"
    write_image(file, picture, layers=layers, metadata={"relightcli:store": "t.zarr", "relightcli:rotate": 1.5})
    image = read_image(file)
    assert set(image.names) == {"R", "G", "B", "A", "direct.R", "direct.G", "direct.B", "variance.Y"}
    assert_array_equal(image.pixels[..., [image.names.index(c) for c in "RGBA"]], picture)
    assert_array_equal(image.pixels[..., image.layers()["direct"]], layers["direct"])
    assert_array_equal(image.pixels[..., image.names.index("variance.Y")], layers["variance"])
    assert image.metadata["relightcli:store"] == "t.zarr"
    assert image.metadata["relightcli:rotate"] == 1.5
    assert image.metadata["colorInteropID"] == "lin_rec709_scene"
    assert image.notes == ()


def test_exr_keeps_nan_infinity_and_large_values(tmp_path):
    values = np.array([[[np.nan, np.inf, -np.inf], [1e6, -1.0, 3e38]]], np.float32)
    write_image(tmp_path / "a.exr", values)
    assert_array_equal(read_image(tmp_path / "a.exr").pixels, values)


def test_tif_keeps_every_bit(tmp_path, picture):
    write_image(tmp_path / "a.tif", picture)
    assert_array_equal(read_image(tmp_path / "a.tif").pixels, picture)


def test_hdr_keeps_8_bits_of_the_largest_channel(tmp_path, picture):
    rgb = picture[..., :3]
    write_image(tmp_path / "a.hdr", rgb)
    error = np.abs(read_image(tmp_path / "a.hdr").pixels - rgb)
    # One step is 2^-8 of the next power of two above the largest channel, hence at most 2^-7 of that channel. Rounding
    # costs half a step; a carry into the next exponent can cost another half.
    assert np.all(error <= rgb.max(axis=2, keepdims=True) * 2.0**-7)


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_display_files_hold_srgb_after_exposure(tmp_path, suffix):
    grey = np.full((16, 16, 3), 0.25, np.float32)
    write_image(tmp_path / f"a{suffix}", grey, exposure=1.0)
    # 8 bits of sRGB at linear 0.5 are 0.0034 apart in linear light; half of it, and as much again for JPEG's own.
    assert_allclose(read_image(tmp_path / f"a{suffix}").pixels, 0.5, atol=0.0034)


def test_png_alpha_survives(tmp_path):
    rgba = np.zeros((4, 4, 4), np.float32)
    rgba[...] = [0.2, 0.1, 0.05, 0.5]
    write_image(tmp_path / "a.png", rgba)
    # Half a step of 8-bit sRGB at the unassociated 0.4 is 0.0015, of alpha 0.002.
    assert_allclose(read_image(tmp_path / "a.png").pixels, rgba, atol=0.0025)


@pytest.mark.parametrize("suffix", images.WRITE_SUFFIXES)
def test_equal_pictures_have_equal_bytes(suffix, picture):
    first = encode_image(suffix, picture, metadata={"relightcli:b": 1, "relightcli:a": "x"})
    assert encode_image(suffix, picture.copy(), metadata={"relightcli:a": "x", "relightcli:b": 1}) == first


def test_srgb_reference_values():
    # IEC 61966-2-1: the two branches, their joint, and the usual 18 % grey (encoded 0.4614).
    assert_allclose(encode_srgb(np.array([0.0, 0.001, 0.18, 1.0])), [0, 0.01292, 0.46136, 1], atol=1e-5)
    levels = np.arange(256) / 255
    assert_array_equal(to_display(decode_srgb(levels)), np.arange(256))
    assert_allclose(encode_srgb(np.array([np.nan, np.inf, -np.inf, -1.0])), [0, 1, 0, 0], atol=1e-7)


# --- rules for what comes in ---------------------------------------------------------------------------------------


def test_integers_are_srgb_and_floats_linear(tmp_path):
    half = np.full((2, 4, 3), 32768, np.uint16)
    write_raw(tmp_path / "a.png", half, oiio.UINT16)
    assert_allclose(read_environment(tmp_path / "a.png"), decode_srgb(np.array(32768 / 65535)), rtol=1e-6)
    write_raw(tmp_path / "a.exr", np.full((2, 4, 3), 0.5, np.float32), oiio.HALF)
    assert_array_equal(read_environment(tmp_path / "a.exr"), np.float32(0.5))


def test_integers_marked_linear_are_taken_at_their_word(tmp_path):
    half = np.full((2, 4, 3), 128, np.uint8)
    write_raw(tmp_path / "a.png", half, oiio.UINT8, attributes=[("oiio:ColorSpace", "lin_rec709_scene")])
    assert_allclose(read_texture(tmp_path / "a.png"), 128 / 255, rtol=1e-6)


def test_grey_becomes_rgb_and_alpha_is_dropped(tmp_path):
    grey = np.arange(8, dtype=np.float32).reshape(2, 4, 1)
    write_raw(tmp_path / "y.exr", grey, oiio.FLOAT, names=["Y"])
    assert_array_equal(read_environment(tmp_path / "y.exr"), np.repeat(grey, 3, axis=2))
    straight = np.zeros((2, 4, 4), np.uint8)
    straight[..., 0] = 255  # red, alpha 0: a texture keeps its colour under a transparent texel
    write_raw(tmp_path / "t.png", straight, oiio.UINT8, attributes=[("oiio:UnassociatedAlpha", 1)])
    assert_array_equal(read_texture(tmp_path / "t.png")[0, 0], [1, 0, 0])
    assert_array_equal(read_image(tmp_path / "t.png").pixels[0, 0], [0, 0, 0, 0])


def test_channel_order_does_not_matter(tmp_path):
    # The reader orders R, G, B first; a layer before them in the alphabet must not slip in.
    pixels = np.arange(1, 7, dtype=np.float32).reshape(1, 1, 6)
    write_raw(tmp_path / "a.exr", pixels, oiio.FLOAT, names=["B", "G", "R", "0.B", "0.G", "0.R"])
    assert_array_equal(read_environment(tmp_path / "a.exr")[0, 0], [3, 2, 1])


def test_negative_values_become_zero_and_are_told(tmp_path):
    pixels = np.ones((2, 4, 3), np.float32)
    pixels[1, 2, 0] = -0.25
    write_image(tmp_path / "a.exr", pixels)
    environment, notes = images.read_environment_with_notes(tmp_path / "a.exr")
    assert environment.min() == 0
    assert notes == ("a.exr: 1 pixels had negative values (down to -0.25); set to 0.",)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("read", [read_environment, read_texture])
def test_not_finite_is_refused_with_count_and_place(tmp_path, read, value):
    pixels = np.ones((4, 8, 3), np.float32)
    pixels[2, 5, 1] = value
    pixels[3, 0] = value
    write_image(tmp_path / "a.exr", pixels)
    with pytest.raises(InputError, match=r"a\.exr: 2 pixels .* x=5, y=2"):
        read(tmp_path / "a.exr")


def test_odd_shape_is_told_and_one_pixel_is_fine(tmp_path):
    write_image(tmp_path / "square.exr", np.ones((4, 4, 3)))
    assert "not 2:1" in images.read_environment_with_notes(tmp_path / "square.exr")[1][0]
    write_image(tmp_path / "one.exr", np.ones((1, 1, 3)))
    pixels, notes = images.read_environment_with_notes(tmp_path / "one.exr")
    assert pixels.shape == (1, 1, 3)
    assert notes == ()


def test_data_window_lands_in_the_display_window(tmp_path):
    pixels = np.arange(1, 13, dtype=np.float32).reshape(2, 2, 3)
    # Data window at (3, 1) to (4, 2) inside a display window of 4x2: one column and one row hang over.
    write_raw(tmp_path / "a.exr", pixels, oiio.FLOAT, window=(3, 1, 0, 0, 4, 2))
    expected = np.zeros((2, 4, 3), np.float32)
    expected[1, 3] = pixels[0, 0]
    assert_array_equal(read_image(tmp_path / "a.exr").pixels, expected)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_orientation_agrees_with_openimageio(tmp_path, orientation):
    pixels = np.arange(18, dtype=np.float32).reshape(2, 3, 3)
    file = write_raw(tmp_path / "a.tif", pixels, oiio.FLOAT, attributes=[("Orientation", orientation)])
    upright = oiio.ImageBufAlgo.reorient(oiio.ImageBuf(str(file)))
    assert_array_equal(read_image(file).pixels, upright.get_pixels(oiio.FLOAT))


def test_other_primaries_are_told(tmp_path):
    pixels = np.ones((2, 4, 3), np.float32)
    spec = oiio.ImageSpec(4, 2, 3, oiio.FLOAT)
    spec.attribute("chromaticities", "float[8]", (0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.077, 0.32168, 0.33767))
    out = oiio.ImageOutput.create("openexr")
    assert out.open(str(tmp_path / "aces.exr"), spec)
    assert out.write_image(pixels)
    assert out.close()
    assert "not Rec.709" in read_image(tmp_path / "aces.exr").notes[0]


# --- files that break or lie ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", images.WRITE_SUFFIXES)
@pytest.mark.parametrize("keep", [0.0, 0.02, 0.5, 0.9])
def test_cut_files_are_refused_by_name(tmp_path, suffix, keep):
    pixels = np.random.default_rng(2).random((64, 64, 3))
    data = encode_image(suffix, pixels)
    (tmp_path / f"cut{suffix}").write_bytes(data[: int(len(data) * keep)])
    with pytest.raises(InputError, match=f"cut{suffix}: (cannot be read|is damaged)"):
        read_image(tmp_path / f"cut{suffix}")


def test_missing_foreign_and_folders_are_refused(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        read_image(tmp_path / "nothing.exr")
    with pytest.raises(InputError, match="not a regular file"):
        read_image(tmp_path)
    (tmp_path / "text.exr").write_text("This is no picture.")
    with pytest.raises(InputError, match=r"text\.exr: cannot be read"):
        read_image(tmp_path / "text.exr")


def test_limits_hold_before_pixels_are_allocated(tmp_path, monkeypatch):
    # A Radiance header may claim any size in a few bytes.
    (tmp_path / "wide.hdr").write_bytes(b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 8 +X 32767\n")
    with pytest.raises(InputError, match=r"wide\.hdr"):
        read_image(tmp_path / "wide.hdr")
    monkeypatch.setattr(images, "MAX_BYTES", 1 << 20)
    write_image(tmp_path / "big.tif", np.zeros((512, 512, 3)))
    with pytest.raises(InputError, match=r"big\.tif: would take 3 MiB in memory; expected at most 1 MiB"):
        read_image(tmp_path / "big.tif")


def test_too_many_channels_are_refused(tmp_path):
    pixels = np.zeros((2, 2, limits.MAX_CHANNELS + 1), np.float32)
    write_raw(tmp_path / "deep.exr", pixels, oiio.FLOAT, names=[f"l.{i:03d}" for i in range(pixels.shape[2])])
    with pytest.raises(InputError, match=r"deep\.exr.*channels"):
        read_image(tmp_path / "deep.exr")


def test_pictures_without_rgb_are_refused_as_environment(tmp_path):
    write_raw(tmp_path / "uv.exr", np.zeros((2, 4, 2), np.float32), oiio.FLOAT, names=["u", "v"])
    with pytest.raises(InputError, match=r"channels u, v; expected R, G, B"):
        read_environment(tmp_path / "uv.exr")


# --- files that come out -------------------------------------------------------------------------------------------


def test_wrong_requests_are_refused(tmp_path):
    with pytest.raises(InputError, match=r"\.gif; expected one of \.exr"):
        write_image(tmp_path / "a.gif", np.ones((2, 2, 3)))
    with pytest.raises(InputError, match=r"layers can only be kept in \.exr"):
        write_image(tmp_path / "a.png", np.ones((2, 2, 3)), layers={"direct": np.ones((2, 2, 3))})
    with pytest.raises(InputError, match="layer direct is 3x2; expected 2x2"):
        write_image(tmp_path / "a.exr", np.ones((2, 2, 3)), layers={"direct": np.ones((2, 3, 3))})
    with pytest.raises(InputError, match="shape"):
        write_image(tmp_path / "a.exr", np.ones((2, 2, 2)))
    with pytest.raises(InputError, match="does not exist; create it"):
        write_image(tmp_path / "no" / "a.exr", np.ones((2, 2, 3)))
    assert os.listdir(tmp_path) == []


def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch):
    file = tmp_path / "a.exr"
    write_image(file, np.ones((2, 2, 3)))
    before = file.read_bytes()

    def full(descriptor):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left"):
        write_image(file, np.zeros((2, 2, 3)))
    assert file.read_bytes() == before
    assert os.listdir(tmp_path) == ["a.exr"]


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs /dev/full, a disk without space")
@pytest.mark.parametrize("suffix", images.WRITE_SUFFIXES)
def test_a_full_disk_is_an_os_error(tmp_path, suffix):
    (tmp_path / f"a{suffix}").symlink_to("/dev/full")
    with pytest.raises(OSError, match="No space left"):
        write_image(tmp_path / f"a{suffix}", np.ones((64, 64, 3)))


def test_without_memory_files_the_bytes_are_the_same(picture, monkeypatch):
    expected = encode_image(".exr", picture)
    monkeypatch.delattr(os, "memfd_create")
    assert encode_image(".exr", picture) == expected


def test_a_link_keeps_pointing_at_its_target(tmp_path):
    (tmp_path / "link.exr").symlink_to(tmp_path / "real.exr")
    write_image(tmp_path / "link.exr", np.ones((2, 2, 3)))
    assert (tmp_path / "link.exr").is_symlink()
    assert read_image(tmp_path / "real.exr").pixels.shape == (2, 2, 3)


def test_primaries_of_another_kind(tmp_path):
    """Eight numbers are expected; a header may hold anything under that name."""
    spec = oiio.ImageSpec(4, 2, 3, oiio.FLOAT)
    spec.attribute("chromaticities", oiio.TypeDesc("float[3]"), (1.0, 2.0, 3.0))
    buffer = oiio.ImageBuf(spec)
    assert buffer.write(str(tmp_path / "a.exr"))
    assert "primaries are not Rec.709" in read_image(tmp_path / "a.exr").notes[0]


@pytest.mark.parametrize("suffix", [".exr", ".tif", ".hdr", ".png"])
@pytest.mark.parametrize("short", [1, 2, 3, 100, 3000, 30_000, None], ids=lambda s: "all" if s is None else str(s))
def test_a_limit_on_file_sizes_is_told_as_such(tmp_path, suffix, short):
    """Files in memory, in which pictures are made, are under it too: some libraries say no more than that they failed,
    and some do not notice that the last bytes are missing."""
    noise = np.random.default_rng(2).random((64, 64, 3)).astype(np.float32)
    whole = encode_image(suffix, noise)
    path = tmp_path / f"out{suffix}"
    old = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (max(0, len(whole) - short) if short else 0, old[1]))
    try:
        with pytest.raises(OSError, match="File too large") as caught:
            write_image(path, noise)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, old)
    assert caught.value.errno == errno.EFBIG
    assert caught.value.filename == str(path)
    assert not list(tmp_path.iterdir())
    write_image(path, noise)
    assert path.read_bytes() == whole
