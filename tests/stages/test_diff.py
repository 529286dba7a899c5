"""Comparisons: known differences give known numbers, and what cannot be compared is refused."""

import json
import math
import re

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from relightcli.adapters.images import read_image, write_image
from relightcli.core.display import encode_srgb
from relightcli.errors import InputError, StoreError
from relightcli.stages.diff import DiffSettings, diff
from relightcli.stages.diff_result import METRICS, parse_thresholds

SIZE = (6, 8)


@pytest.fixture
def picture():
    return np.random.default_rng(5).random((*SIZE, 3)).astype(np.float32) + np.float32(0.1)


def one(result):
    (item,) = result.comparisons
    return item


# --- pictures ------------------------------------------------------------------------------------------------------


def test_one_percent_more_light_is_one_percent(tmp_path, picture):
    write_image(tmp_path / "a.exr", picture * np.float32(1.01))
    write_image(tmp_path / "b.exr", picture)
    result = diff(tmp_path / "a.exr", tmp_path / "b.exr", DiffSettings(("relrmse", "rmse", "psnr")))
    values = one(result).values
    rms = math.sqrt(np.mean(picture.astype(np.float64) ** 2))
    # float32 rounds the product: 6e-8 of the value is 6e-6 of its hundredth.
    assert_allclose(values["relrmse"], 0.01, rtol=2e-5)
    assert_allclose(values["rmse"], 0.01 * rms, rtol=2e-5)
    assert_allclose(values["psnr"], 20 * math.log10(picture.max() / (0.01 * rms)), rtol=2e-5)
    assert not result.passed


@pytest.mark.parametrize(("threshold", "passed"), [(0.0099, False), (0.0101, True)])
def test_threshold(tmp_path, picture, threshold, passed):
    write_image(tmp_path / "a.exr", picture * np.float32(1.01))
    write_image(tmp_path / "b.exr", picture)
    result = diff(tmp_path / "a.exr", tmp_path / "b.exr", DiffSettings(fail={"relrmse": threshold}))
    assert result.passed is passed


@pytest.mark.parametrize(("threshold", "passed"), [(39, True), (41, False)])
def test_psnr_fails_below(tmp_path, threshold, passed):
    # Display pictures have peak 1: a difference of 1 % of it is 40 dB. The grey levels are those of 8-bit sRGB.
    write_image(tmp_path / "b.exr", np.ones((*SIZE, 3)))
    write_image(tmp_path / "a.exr", np.full((*SIZE, 3), 0.99))
    settings = DiffSettings(("psnr",), {"psnr": threshold})
    assert diff(tmp_path / "a.exr", tmp_path / "b.exr", settings).passed is passed


def test_equal_pictures_pass_whatever_is_measured(tmp_path, picture):
    for name in "ab":
        write_image(tmp_path / f"{name}.exr", picture, layers={"direct": picture})
    result = diff(tmp_path / "a.exr", tmp_path / "b.exr", DiffSettings(METRICS))
    assert result.passed
    assert dict(one(result).values) == {"rmse": 0, "relrmse": 0, "psnr": math.inf, "flip": 0}
    assert set(one(result).percent.values()) == {0}


def test_fail_percent_counts_pixels(tmp_path, picture):
    other = picture.copy()
    other[0, :3] *= 2  # 3 of 48 pixels, 6.25 %
    write_image(tmp_path / "a.exr", other)
    write_image(tmp_path / "b.exr", picture)
    files = tmp_path / "a.exr", tmp_path / "b.exr"
    for metric, threshold in (("rmse", 0.01), ("relrmse", 0.01), ("psnr", 40)):
        kept = diff(*files, DiffSettings((metric,), {metric: threshold}, fail_percent=6.3))
        assert kept.passed
        assert one(kept).percent[metric] == 6.25
        assert not diff(*files, DiffSettings((metric,), {metric: threshold}, fail_percent=6.2)).passed
        assert not diff(*files, DiffSettings((metric,), {metric: threshold})).passed


def test_nan_and_infinity_fail_with_count_and_place(tmp_path, picture):
    write_image(tmp_path / "good.exr", picture)
    for value, shown in ((np.nan, "nan"), (np.inf, "inf")):
        broken = picture.copy()
        broken[2, 3, 1] = broken[4, 0, 2] = value
        write_image(tmp_path / "bad.exr", broken)
        for pair in (("bad", "good"), ("good", "bad"), ("bad", "bad")):
            result = diff(*(tmp_path / f"{name}.exr" for name in pair), DiffSettings(METRICS, {"flip": 1e9}))
            assert not result.passed
            assert (
                f"bad.exr: 2 pixels are NaN or infinite, the first at x=3, y=2 (G is {shown})" in one(result).reasons[0]
            )
            assert len(one(result).reasons) == pair.count("bad")
            assert not one(result).values
            json.dumps(result.to_json(), allow_nan=False)


def test_nan_in_a_shared_layer_fails_too(tmp_path, picture):
    broken = picture.copy()
    broken[0, 0, 0] = np.nan
    write_image(tmp_path / "a.exr", picture, layers={"direct": broken})
    write_image(tmp_path / "b.exr", picture, layers={"direct": picture})
    result = diff(tmp_path / "a.exr", tmp_path / "b.exr", DiffSettings(fail={"relrmse": 1}))
    assert "direct.R is nan" in one(result).reasons[0]


def test_layers_are_reported_and_judged_only_without_a_threshold(tmp_path, picture):
    write_image(tmp_path / "a.exr", picture, layers={"direct": picture * 2, "mine": picture})
    write_image(tmp_path / "b.exr", picture, layers={"direct": picture})
    files = tmp_path / "a.exr", tmp_path / "b.exr"
    result = diff(*files, DiffSettings(fail={"relrmse": 0.1}))
    assert_allclose(one(result).parts["direct"]["relrmse"], 1, rtol=1e-6)
    assert result.passed
    assert "mine is only in a.exr; not compared." in one(result).notes
    exact = diff(*files, DiffSettings())
    assert one(exact).reasons == ("direct differs; expected no difference, because no --fail was given.",)


def test_sizes_and_channels_must_match(tmp_path, picture):
    write_image(tmp_path / "a.exr", picture)
    write_image(tmp_path / "small.exr", picture[:-1])
    write_image(tmp_path / "grey.exr", picture[..., :1])
    clear = np.concatenate([picture, np.zeros((*SIZE, 1), np.float32)], axis=2)
    write_image(tmp_path / "clear.exr", clear)
    opaque = np.concatenate([picture, np.ones((*SIZE, 1), np.float32)], axis=2)
    write_image(tmp_path / "opaque.exr", opaque)
    with pytest.raises(InputError, match=r"8x6 pixels and .*small\.exr 8x5"):
        diff(tmp_path / "a.exr", tmp_path / "small.exr", DiffSettings())
    with pytest.raises(InputError, match=r"R, G, B and .*grey\.exr Y"):
        diff(tmp_path / "a.exr", tmp_path / "grey.exr", DiffSettings())
    with pytest.raises(InputError, match="alpha"):
        diff(tmp_path / "clear.exr", tmp_path / "a.exr", DiffSettings())
    assert diff(tmp_path / "opaque.exr", tmp_path / "a.exr", DiffSettings()).passed


def test_display_pictures_use_ldr_flip_and_peak_one(tmp_path):
    grey = np.full((*SIZE, 3), 0.25)
    write_image(tmp_path / "a.png", grey)
    write_image(tmp_path / "b.png", grey * 0.5)
    result = diff(tmp_path / "a.png", tmp_path / "b.png", DiffSettings(("psnr", "flip")))
    levels = np.rint(encode_srgb(np.array([0.25, 0.125])) * 255) / 255
    linear = ((levels + 0.055) / 1.055) ** 2.4
    assert_allclose(one(result).values["psnr"], -20 * math.log10(linear[0] - linear[1]), rtol=1e-5)
    from relightcli.adapters.flip import flip_ldr

    expected = flip_ldr(*(read_image(tmp_path / f"{name}.png").pixels for name in "ab")).mean()
    assert_allclose(one(result).values["flip"], expected, rtol=1e-6)


def test_heatmap_shows_where(tmp_path, picture):
    other = picture.copy()
    other[4, 6] += 1
    write_image(tmp_path / "a.exr", other)
    write_image(tmp_path / "b.exr", picture)
    diff(tmp_path / "a.exr", tmp_path / "b.exr", DiffSettings(heatmap=tmp_path / "h.png"))
    heat = read_image(tmp_path / "h.png").pixels
    assert heat.shape == (*SIZE, 3)
    brightness = heat.sum(axis=2)
    assert np.unravel_index(np.argmax(brightness), SIZE) == (4, 6)
    assert np.all(np.delete(brightness.ravel(), 4 * 8 + 6) < 0.05 * brightness.max())
    with pytest.raises(InputError, match=r"\.png or \.jpg"):
        diff(tmp_path / "a.exr", tmp_path / "b.exr", DiffSettings(heatmap=tmp_path / "h.exr"))


def test_report_is_one_page_with_three_pictures_and_both_headers(tmp_path, picture):
    write_image(tmp_path / "a.exr", picture * 2, metadata={"relightcli:store": "mine.zarr"})
    write_image(tmp_path / "b.exr", picture, metadata={"relightcli:store": "theirs.zarr"})
    diff(tmp_path / "a.exr", tmp_path / "b.exr", DiffSettings(report=tmp_path / "r.html"))
    text = (tmp_path / "r.html").read_text()
    assert len(re.findall('<img src="data:image/png;base64,', text)) == 3
    assert "mine.zarr" in text
    assert "theirs.zarr" in text
    assert "Beyond tolerance." in text


def test_report_of_broken_pictures(tmp_path, picture):
    broken = picture.copy()
    broken[0, 0] = np.nan
    write_image(tmp_path / "a.exr", broken)
    write_image(tmp_path / "b.exr", np.zeros_like(picture))
    settings = DiffSettings(("flip",), heatmap=tmp_path / "h.png", report=tmp_path / "r.html")
    diff(tmp_path / "a.exr", tmp_path / "b.exr", settings)
    assert "NaN or infinite" in (tmp_path / "r.html").read_text()
    # Cyan marks what is not finite.
    assert_array_equal(read_image(tmp_path / "h.png").pixels[0, 0], [0, 1, 1])


def test_unreadable_files_are_refused(tmp_path, picture):
    write_image(tmp_path / "a.exr", picture)
    with pytest.raises(InputError, match="no such file or folder"):
        diff(tmp_path / "a.exr", tmp_path / "none.exr", DiffSettings())
    (tmp_path / "text.exr").write_text("text")
    with pytest.raises(InputError, match=r"text\.exr: cannot be read"):
        diff(tmp_path / "a.exr", tmp_path / "text.exr", DiffSettings())


# --- sequences -----------------------------------------------------------------------------------------------------


@pytest.fixture
def sequences(tmp_path, picture):
    """Folders a and b of frames 9, 10 and 11; frame 10 differs by a tenth, frame 9 by a hundredth."""
    for folder in "ab":
        (tmp_path / folder).mkdir()
    for frame, factor in ((9, 1.01), (10, 1.1), (11, 1)):
        write_image(tmp_path / "a" / f"out.{frame:04d}.exr", picture * np.float32(factor))
        write_image(tmp_path / "b" / f"out.{frame:04d}.exr", picture)
    return tmp_path


def test_sequences_match_by_frame_or_name(sequences):
    settings = DiffSettings(fail={"relrmse": 0.05}, report=sequences / "r.html", heatmap=sequences / "h.png")
    result = diff(sequences / "a" / "out.####.exr", sequences / "b" / "out.####.exr", settings)
    assert [item.name for item in result.comparisons] == ["0009", "0010", "0011"]
    assert [item.passed for item in result.comparisons] == [True, False, True]
    assert result.worst().name == "0010"
    assert not result.passed
    assert (sequences / "r.html").read_text().count("<img ") == 9
    (sequences / "a" / "notes.txt").write_text("not a picture")
    folders = diff(sequences / "a", sequences / "b", DiffSettings(fail={"relrmse": 0.2}))
    assert [item.name for item in folders.comparisons] == ["out.0009.exr", "out.0010.exr", "out.0011.exr"]
    assert folders.passed


def test_sequences_without_counterpart_are_refused(sequences, picture):
    write_image(sequences / "a" / "out.0012.exr", picture)
    with pytest.raises(InputError, match=r"1 have no counterpart: 0012\."):
        diff(sequences / "a" / "out.####.exr", sequences / "b" / "out.####.exr", DiffSettings())
    with pytest.raises(InputError, match="no pictures found"):
        diff(sequences / "a" / "none.####.exr", sequences / "b" / "out.####.exr", DiffSettings())
    with pytest.raises(InputError, match="expected two of a kind"):
        diff(sequences / "a", sequences / "b" / "out.0009.exr", DiffSettings())


# --- stores --------------------------------------------------------------------------------------------------------


def make_store(path, arrays, *, kind="radiance", settings=None):
    from relight_formats import begin

    writer = begin(path, kind, settings=settings or {}, inputs={}, program="test")
    with writer:
        for name, values in arrays.items():
            writer.put(name, values, dims=[f"{name}{axis}" for axis in range(values.ndim)])
        writer.commit({})
    return path


def test_stores_compare_array_by_array(tmp_path):
    values = np.arange(12, dtype=np.float32).reshape(4, 3)
    a = make_store(tmp_path / "a.zarr", {"x": values * np.float32(1.01), "n": np.arange(5)}, settings={"order": 3})
    b = make_store(tmp_path / "b.zarr", {"x": values, "n": np.arange(5)}, settings={"order": 4})
    result = diff(a, b, DiffSettings(("relrmse", "rmse"), {"relrmse": 0.02, "rmse": 1}, report=tmp_path / "r.html"))
    by_name = {item.name: item for item in result.comparisons}
    assert set(by_name) == {"n", "x"}
    assert_allclose(by_name["x"].values["relrmse"], 0.01, rtol=2e-5)
    assert_allclose(by_name["x"].parts["largest"]["absolute"], 0.11, rtol=2e-5)
    assert by_name["n"].values["rmse"] == 0
    assert result.passed
    assert result.notes == ("setting order: 3 against 4.",)
    assert "setting order" in (tmp_path / "r.html").read_text()
    assert not diff(a, b, DiffSettings()).passed
    assert diff(b, b, DiffSettings()).passed


def test_nan_in_the_same_place_is_no_difference(tmp_path):
    values = np.array([1, np.nan, 3], np.float32)
    a = make_store(tmp_path / "a.zarr", {"uv": values})
    assert diff(a, a, DiffSettings()).passed
    b = make_store(tmp_path / "b.zarr", {"uv": np.array([1, 2, np.nan], np.float32)})
    result = diff(a, b, DiffSettings(fail={"relrmse": 100}))
    assert not result.passed
    assert "2 values are NaN or infinite, the first at (1,)" in one(result).reasons[0]


def test_stores_that_do_not_match_are_refused(tmp_path):
    a = make_store(tmp_path / "a.zarr", {"x": np.ones(3)})
    with pytest.raises(InputError, match=r"kind radiance and .* of kind transfer"):
        diff(a, make_store(tmp_path / "b.zarr", {"x": np.ones(3)}, kind="transfer"), DiffSettings())
    with pytest.raises(InputError, match="only one of them has y"):
        diff(a, make_store(tmp_path / "c.zarr", {"x": np.ones(3), "y": np.ones(3)}), DiffSettings())
    with pytest.raises(InputError, match=r"array x has the shape \(3,\) in A and \(4,\)"):
        diff(a, make_store(tmp_path / "d.zarr", {"x": np.ones(4)}), DiffSettings())
    with pytest.raises(InputError, match="flip compares pictures"):
        diff(a, a, DiffSettings(("flip",)))
    (tmp_path / "empty.zarr").mkdir()
    with pytest.raises(StoreError):
        diff(a, tmp_path / "empty.zarr", DiffSettings())


# --- thresholds ----------------------------------------------------------------------------------------------------


def test_thresholds_are_read():
    assert parse_thresholds(["0.02"], ["relrmse", "flip"]) == {"relrmse": 0.02, "flip": 0.02}
    assert parse_thresholds(["0.1", "flip=0.03"], ["relrmse", "flip"]) == {"relrmse": 0.1, "flip": 0.03}
    assert parse_thresholds([], ["psnr"]) == {}


@pytest.mark.parametrize(
    ("texts", "metrics"),
    [(["x"], ["rmse"]), (["-1"], ["rmse"]), (["nan"], ["rmse"]), (["flip=1"], ["rmse"]), (["1"], ["psnr", "rmse"])],
)
def test_thresholds_that_make_no_sense_are_refused(texts, metrics):
    with pytest.raises(InputError, match="--fail"):
        parse_thresholds(texts, metrics)
