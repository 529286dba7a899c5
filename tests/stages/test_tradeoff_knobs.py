"""Points from knobs: the base, one point a value, and what values need."""

import pytest

from relightcli.cli.precompute import command as precompute
from relightcli.errors import InputError
from relightcli.stages.tradeoff import steps_of
from relightcli.stages.tradeoff_knobs import KNOBS, default_knobs, expand, parse_knobs


def labels(knobs, bounces=2, camera="main"):
    return [p.label for p in expand(knobs, bounces, camera)]


def settings(knobs, label, bounces=2, camera="main"):
    (point,) = (p for p in expand(knobs, bounces, camera) if p.label == label)
    return dict(point.settings)


def test_the_first_values_make_the_base_and_every_other_value_a_point():
    knobs = parse_knobs(["light-resolution=32,16,64", "refine=4,8", "subdivide=no"])
    points = expand(knobs, 1, "main")
    assert [p.label for p in points] == ["base", "light-resolution 16", "light-resolution 64", "refine 8"]
    assert dict(points[0].settings) == {"light-resolution": "32", "refine": "4", "subdivide": "no", "bounces": "1"}
    words = "--light-resolution 16 --refine 4 --no-subdivide --bounces 1"
    assert points[1].words("precompute") == tuple(words.split())


def test_a_value_brings_what_it_needs():
    assert settings({"coefficients": ["64", "128"]}, "basis haar, coefficients 64")["basis"] == "haar"
    assert labels({"coefficients": ["64", "128"]}) == ["base", *(f"basis haar, coefficients {n}" for n in (64, 128))]
    assert labels({"basis": ["haar"], "coefficients": ["64", "128"]}) == ["base", "coefficients 128"]
    found = settings({"pixel-grid": ["2"]}, "receivers pixels:main, pixel-grid 2")
    assert found == {"receivers": "pixels:main", "pixel-grid": "2", "bounces": "2"}
    assert settings({"epsilon": ["0.1"]}, "bounces 0, store lights, epsilon 0.1")["store"] == "lights"


def test_what_has_lost_its_meaning_goes():
    knobs = {"receivers": ["pixels:main", "vertices"], "pixel-grid": ["2"], "bounces": ["1", "0"]}
    knobs["bounce-resolution"] = ["16", "8"]
    assert "pixel-grid" not in settings(knobs, "receivers vertices")
    assert "bounce-resolution" not in settings(knobs, "bounces 0")
    assets = {"store": ["asset"], "eigenvectors": ["16", "8"], "bounces": ["2", "0"]}
    assert settings(assets, "bounces 0, store transfer") == {"bounces": "0"}
    (point,) = (p for p in expand(assets, 2, "main") if p.label == "eigenvectors 8")
    assert point.stages == ("precompute", "cluster", "factorize")
    assert point.words("factorize") == ("--eigenvectors", "8")


def test_points_share_the_steps_that_they_have_in_common():
    assets = expand({"store": ["asset"], "eigenvectors": ["16", "8"]}, 1, "main")
    one, other = (steps_of(p, "main") for p in assets)
    assert [s.name for s in one[:2]] == [s.name for s in other[:2]]
    assert one[2].name != other[2].name
    assert " ".join(other[2].command("s.toml")) == "relightcli factorize clusters.zarr -o asset.zarr --eigenvectors 8"
    (lights,) = (steps_of(p, "main") for p in expand({"epsilon": ["0.1"]}, 0, "main")[1:])
    assert lights[1].words == ("--epsilon", "0.1", "--camera", "main")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("speed=1", "expected one of light-resolution"),
        ("refine", "expected refine=VALUE"),
        ("refine=", "expected refine=VALUE"),
        ("light-resolution=64,100", "16 to 256, by 8; found '100'"),
        ("light-resolution=64,", "16 to 256, by 8; found ''"),
        ("epsilon=nan", "a number above 0; found 'nan'"),
        ("basis=fourier", "visibility, haar, sh or dense; found 'fourier'"),
        ("receivers=pixels:", "vertices or pixels:CAMERA"),
    ],
)
def test_bad_knobs_are_named(text, words):
    with pytest.raises(InputError, match="--knob") as caught:
        expand(parse_knobs([text]), 1, "main")
    assert words in str(caught.value)


def test_knobs_given_twice_and_pixels_of_two_cameras_are_refused():
    with pytest.raises(InputError, match="twice"):
        parse_knobs(["refine=4", "refine=8"])
    with pytest.raises(InputError, match="one camera"):
        expand({"pixel-grid": ["2"]}, 1, None)


def test_the_default_sweep_is_valid_and_small():
    for bounces in (0, 1, 2):
        for camera in (None, "main"):
            points = expand(default_knobs(bounces), bounces, camera)
            assert points[0].label == "base"
            assert len(points) == 4 + bounces


def test_every_knob_of_precompute_is_an_option_of_it():
    known = {o for p in precompute.params for o in (*p.opts, *p.secondary_opts)}
    sample = {"subdivide": "yes", "receivers": "vertices", "basis": "haar"}
    for knob in KNOBS.values():
        if knob.stage == "precompute":
            assert knob.words(sample.get(knob.name, "16"))[0] in known, knob.name
