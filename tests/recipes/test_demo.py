import re

import pytest

from relightcli.adapters.images import read_image

pytestmark = pytest.mark.slow

SHOTS = """\
format = 1
frames = 3
[[key]]
frame = 1
env = "sky-morning"
env_rotate = 0
[[key]]
frame = 4
env_rotate = 360
"""
# So few samples and texels that errors of tens of percent are right; the demo itself checks the real ones.
LOOSE = "--fail relrmse=0.6 --fail flip=0.6"


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    folder = tmp_path_factory.mktemp("demo")
    (folder / "shots.toml").write_text(SHOTS)
    return {
        "OUT": folder / "out",
        "SHOTS": folder / "shots.toml",
        "LIGHT_RESOLUTION": 16,
        "CAMERA": "small",
        "SPP": 4,
        "LIMITS_noon": LOOSE,
        "LIMITS_overcast": LOOSE,
    }


@pytest.fixture(scope="module")
def demo(make, small):
    done = make("demo", **small)
    assert done.returncode == 0, done.stdout + done.stderr
    return small["OUT"], done


def test_it_leaves_pictures_of_the_same_view_under_different_skies(demo):
    out, _ = demo
    pictures = {s: read_image(out / f"{s}.exr").pixels for s in ("noon", "morning", "overcast")}
    assert {p.shape[:2] for p in pictures.values()} == {(240, 320)}
    means = [p[..., :3].mean(axis=(0, 1)) for p in pictures.values()]
    # The sun at 58 degrees against 20: 2.5 times the light on the ground, less for what stands upright.
    assert (means[0] > 1.5 * means[1]).all()
    assert all((out / f"{s}.png").is_file() for s in pictures)
    frames = sorted(f.name for f in (out / "turntable").iterdir())
    assert frames == ["0001.png", "0002.png", "0003.png"]
    turns = {(out / "turntable" / f).read_bytes() for f in frames}
    assert len(turns) == 3


def test_it_ends_in_two_checks_and_says_where_the_page_is(demo):
    out, done = demo
    assert done.stdout.count("passed\n") == 2
    assert f"The page is {out}/index.html" in done.stdout


def test_the_page_holds_everything_in_itself(demo):
    out, _ = demo
    page = (out / "index.html").read_text()
    sources = re.findall(r'src="([^"]{12})', page)
    # Three skies, the animation, and A, B and heat map of two checks.
    assert len(sources) == 10
    assert sum(s.startswith("data:image/p") for s in sources) == 9
    assert sum(s.startswith("data:image/w") for s in sources) == 1
    assert "http" not in re.sub(r'"data:[^"]*"', "", page)  # letters of a picture may spell anything
    for part in ("relightcli precompute scene/scene.toml", "--frames turntable.toml", "--reference --spp 4", "relrmse"):
        assert part in page


def test_a_second_run_only_checks(make, demo, small):
    again = make("demo", **small)
    assert again.returncode == 0
    assert "precompute" not in again.stdout
    assert "relight transfer.zarr" not in again.stdout
    assert again.stdout.count("passed\n") == 2


def test_it_fails_when_the_error_is_beyond_the_limits(make, demo, small):
    strict = make("demo", **{**small, "LIMITS_noon": "--fail relrmse=0"})
    assert strict.returncode != 0
    assert "FAILED" in strict.stdout
