"""The plots: files that can be opened, the same for the same data, with every point in them."""

import io

import numpy as np
import pytest
from PIL import Image

from relightcli.adapters.plots import Curve, bars, curves, scatter


@pytest.fixture(scope="module")
def plot():
    return _scatter()


def _scatter(y=(5.0, 2.0, 3.0)):
    traced = Curve("path tracing", [1.0, 4.0], [8.0, 4.0])
    return scatter("T", "seconds", "error, %", [1.0, 10.0, 20.0], y, [0, 1], traced, ("tolerance", 2.5))


def test_png_and_svg_show_something_and_repeat(plot):
    picture = np.asarray(Image.open(io.BytesIO(plot["png"])).convert("RGB"))
    assert picture.shape[1] > 500
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 20
    text = plot["svg"].decode()
    assert text.startswith("<?xml")
    assert "<svg" in text
    assert _scatter() == plot
    assert _scatter((5.0, 2.0, 4.0))["svg"] != plot["svg"]


def test_points_of_the_front_are_filled_and_others_are_not(plot):
    # #1f5fa8 is the front's colour; two discs of it against a line's few pixels.
    def blue(data):
        return int((np.asarray(Image.open(io.BytesIO(data)).convert("RGB")) == (0x1F, 0x5F, 0xA8)).all(-1).sum())

    one = scatter("T", "s", "e", [1.0, 10.0, 20.0], [5.0, 2.0, 3.0], [0])
    assert blue(plot["png"]) > 1.5 * blue(one["png"]) > 0


def test_points_that_are_all_one_still_make_a_plot():
    assert set(scatter("T", "s", "e", [1.0], [2.0], [0])) == {"png", "svg"}
    assert set(scatter("T", "s", "e", [3.0, 3.0], [2.0, 2.0], [0, 1])) == {"png", "svg"}


def test_bars():
    found = bars("T", "%", ["#1", "#2"], {"direct": [1.0, 2.0], "specular": [0.0, 0.5]})
    assert set(found) == {"png", "svg"}
    assert found == bars("T", "%", ["#1", "#2"], {"direct": [1.0, 2.0], "specular": [0.0, 0.5]})


def test_curves_and_bars_that_vary():
    lines = {"one": [0.1, 0.3], "two": [0.2, 0.2]}
    found = curves("T", "frame", "error", lines)
    assert found == curves("T", "frame", "error", lines)
    assert found["png"].startswith(b"\x89PNG")
    assert found != curves("T", "frame", "error", {**lines, "two": [0.2, 0.4]})
    spread = {"one": [0.01, 0.02], "two": [0.0, 0.1]}
    assert bars("T", "error", ["a", "b"], lines, spread) != bars("T", "error", ["a", "b"], lines)
