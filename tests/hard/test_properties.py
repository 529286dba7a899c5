"""Anything goes in: meshes, maps, materials, edits, tensors. Out comes a sane picture or an error that says what."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from relightcli.adapters.images import write_image
from relightcli.cli.main import run
from relightcli.core.compress.cpca import cpca
from relightcli.core.compress.tucker import hooi, reconstruct
from relightcli.errors import RelightError
from relightcli.scene.model import Camera, Material
from relightcli.stages.relight import Config, relight
from tests.core.transport.scenes import Part, lambert, sphere, square
from tests.stages.scene_files import make_store, read_layers, write_scene

CAMERA = Camera("main", (0.0, 1.2, 3.0), (0.0, 0.4, 0.0), fov=35, size=(8, 6))
MODELS = ("lambert", "blinn-phong", "cook-torrance", "phong", "translucent")
# Few examples, always the same ones, and none made smaller after a failure: each is a run of a stage.
FEW = {
    "derandomize": True,
    "deadline": None,
    "suppress_health_check": [HealthCheck.function_scoped_fixture],
    "phases": [Phase.explicit, Phase.generate],
}


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    parts = {"floor": square(4, material=lambert(0.5))}
    for k, model in enumerate(MODELS):
        material = Material("m", model, diffuse=(0.3, 0.3, 0.3), specular=(0.5, 0.5, 0.5))
        parts[model] = sphere(0.25, (0.5 * (k - 2), 0.4, 0), rings=5, material=material)
    folder = tmp_path_factory.mktemp("properties")
    scene = write_scene(folder, parts, [CAMERA], {"sky": np.random.default_rng(1).random((4, 8, 3))}, adjustable=True)
    return make_store(scene, light_resolution=16, bounce_resolution=8, bounces=1, subdivide=False)


def picture_or_error(store, **config):
    """RGB, or None and an error that has words."""
    output = store.parent / "out.exr"
    try:
        relight(Config(store=store, output=str(output), workers=1, quiet=True, **config))
    except RelightError as error:
        assert len(str(error)) > 10  # noqa: PT017
        assert "Traceback" not in str(error)  # noqa: PT017
        return None
    rgb = read_layers(output)[""]
    assert np.isfinite(rgb).all()
    assert rgb.min() >= 0.0
    return rgb.astype(np.float64)


TEXEL = st.one_of(
    st.sampled_from([0.0, -0.0, 1e-45, 1e-30, 1e6, 1e20, 3e38, -1.0, np.nan, np.inf, -np.inf]), st.floats(0.0, 4.0)
)


@settings(max_examples=12, **FEW)
@given(data=st.data(), all_light=st.booleans())
def test_maps(store, data, all_light):
    """Of values that are light, the picture is no brighter than the brightest texel times what the materials give back
    at most: 2, as in test_light. Others are refused, but negative ones, which are black."""
    height, width = data.draw(st.integers(1, 6)), data.draw(st.integers(1, 9))
    texel = TEXEL.filter(lambda x: 0.0 <= x < np.inf) if all_light else TEXEL
    texels = np.array(data.draw(st.lists(texel, min_size=3, max_size=height * width * 3)))
    pixels = np.resize(texels, (height, width, 3)).astype(np.float32)
    path = store.parent / "any.exr"
    write_image(path, pixels)
    rgb = picture_or_error(store, env=str(path))
    if np.isfinite(pixels).all():
        # A sum of light may be beyond float32, and is refused then.
        if rgb is None:
            assert pixels.max() > 1e36
        else:
            assert rgb.max() <= 2.0 * max(float(pixels.max()), 0.0) * (1 + 1e-6)
    else:
        assert rgb is None


WILD = st.one_of(
    st.sampled_from(["0", "-1", "1e300", "nan", "inf", "", "one", "0,0,0", "1,1", "2"]), st.floats(-0.1, 1.1).map(repr)
)
KEYS = ("diffuse", "specular", "transmittance", "f0", "roughness", "shininess", "model", "")
SHARE = st.one_of(st.sampled_from([0.0, 1.0, 1e-45, 1e-9]), st.floats(0.0, 1.0))
COLOUR = st.tuples(SHARE, SHARE, SHARE).map(lambda c: ",".join(map(repr, c)))
HALF = st.tuples(SHARE, SHARE, SHARE).map(lambda c: ",".join(repr(0.5 * x) for x in c))
EXPONENT = st.sampled_from([0.0, 1e-9, 0.5, 30.0, 1e6]).map(repr)
# What a material has, over all that a scene file allows.
OWN = {
    "lambert": {"diffuse": COLOUR},
    "blinn-phong": {"diffuse": COLOUR, "specular": COLOUR, "shininess": EXPONENT},
    "cook-torrance": {
        "diffuse": COLOUR,
        "specular": COLOUR,
        "f0": SHARE.map(repr),
        "roughness": st.sampled_from([1e-6, 1e-3, 0.05, 0.3, 1.0, 10.0]).map(repr),
    },
    "phong": {"diffuse": COLOUR, "specular": COLOUR, "shininess": EXPONENT},
    "translucent": {"diffuse": HALF, "transmittance": HALF},
}
RIGHT = st.sampled_from(sorted(OWN)).flatmap(
    lambda name: st.sampled_from(sorted(OWN[name])).flatmap(
        lambda key: st.tuples(st.just(name), st.just(key), OWN[name][key], st.just(True))
    )
)
WRONG = st.tuples(st.sampled_from([*MODELS, "floor", "nobody"]), st.sampled_from(KEYS), WILD, st.just(False))


@settings(max_examples=15, **FEW)
@given(edits=st.lists(RIGHT, min_size=1, max_size=3), rotate=st.sampled_from(["0", "-720.5", "1e9"]))
def test_edits(store, edits, rotate):
    """`--set` of what a material has, over all of its range: a sane picture. Diffuse and specular 1 together reflect 2,
    and Blinn-Phong and Phong gain towards grazing views: as much again."""
    assert edited(store, edits, rotate) == 0
    assert read_layers(store.parent / "edited.exr")[""].max() < 4.0


@settings(max_examples=25, **FEW)
@given(edits=st.lists(st.one_of(RIGHT, WRONG), min_size=1, max_size=3), rotate=st.sampled_from(["0", "nan", "x"]))
def test_edits_that_make_no_sense(store, edits, rotate):
    """`--set` of anything: a sane picture, or code 2 and no file; never a traceback."""
    code = edited(store, edits, rotate)
    assert code == 0 or not (store.parent / "edited.exr").exists()
    if rotate != "0":
        assert code == 2


def edited(store, edits, rotate):
    """The exit code, 0 or 2; a picture is finite and not negative."""
    output = store.parent / "edited.exr"
    output.unlink(missing_ok=True)
    arguments = ["relight", str(store), "-o", str(output), "-q", "--workers", "1", "--env-rotate", rotate]
    for name, key, value, _ in edits:
        arguments += ["--set", f"{name}.{key}={value}"]
    code = run(arguments)
    assert code in (0, 2), (code, arguments)
    if code == 0:
        rgb = read_layers(output)[""]
        assert np.isfinite(rgb).all()
        assert rgb.min() >= 0.0
    return code


PLACE = st.one_of(
    st.sampled_from([0.0, 1.0, -1.0, 1e-30, 1e-7, 1.0 + 2**-23, 1e6, -1e12, 1e30]), st.floats(-2.0, 2.0, width=32)
)


@settings(max_examples=12, **FEW)
@given(
    corners=st.lists(st.tuples(PLACE, PLACE, PLACE), min_size=3, max_size=8),
    faces=st.lists(st.tuples(st.integers(0, 7), st.integers(0, 7), st.integers(0, 7)), min_size=1, max_size=10),
)
def test_meshes(tmp_path_factory, corners, faces):
    """Any soup of triangles: refused, or lit by a white sky to no more than its albedo (quadrature of 16 texels a side:
    1 %)."""
    points = np.array(corners)
    part = Part(
        points, np.array(faces) % len(points), np.tile([0.0, 1.0, 0.0], (len(points), 1)), material=lambert(0.5)
    )
    folder = tmp_path_factory.mktemp("soup")
    scene = write_scene(folder, {"soup": part}, [CAMERA], {"white": np.ones((4, 8, 3))})
    try:
        store = make_store(scene, light_resolution=16, bounce_resolution=8, bounces=1, subdivide=False)
    except RelightError as error:
        assert "soup" in str(error)  # noqa: PT017
        return
    rgb = picture_or_error(store)
    assert rgb is not None
    assert rgb.max() <= 0.5 * 1.5 * 1.01  # one reflection of 0.5 on top


VALUES = st.sampled_from(["random", "constant", "zero", "twice", "graded", "one"])


@settings(max_examples=40, deadline=None, derandomize=True)
@given(
    shape=st.tuples(*[st.integers(1, 6)] * 3),
    ranks=st.tuples(*[st.integers(1, 9)] * 3),
    kind=VALUES,
    seed=st.integers(0, 9),
)
def test_ranks_of_tensors(shape, ranks, kind, seed):
    """The reported error is that of the reconstruction, to the round-off of a difference of squares; no rank beyond the
    data's, singular values across 1e-12 included."""
    x = _values(kind, (shape[0], shape[1] * shape[2]), seed).reshape(shape)
    found = hooi(x, ranks)
    norm2 = float((x**2).sum())
    assert abs(found.error2 - float(((x - reconstruct(found)) ** 2).sum())) <= 1e-13 * norm2
    for size, rank, factor in zip(shape, ranks, found.factors, strict=True):
        assert factor.shape[1] <= min(size, rank)
        np.testing.assert_allclose(factor.T @ factor, np.eye(factor.shape[1]), atol=1e-12)


@settings(max_examples=40, deadline=None, derandomize=True)
@given(
    rows=st.integers(1, 20), clusters=st.integers(1, 30), terms=st.integers(0, 9), kind=VALUES, seed=st.integers(0, 9)
)
def test_clusters_of_rows(rows, clusters, terms, kind, seed):
    """More clusters than rows, all rows alike, rows that differ by 1e-12: labels of non-empty clusters, residuals that
    do not rise and are at most those about the mean."""
    x = _values(kind, (rows, 5), seed)
    found = cpca(x, clusters, terms)
    assert 1 <= found.count <= min(rows, clusters)
    assert set(found.label.tolist()) == set(range(found.count))
    norm2 = float((x**2).sum())
    about = float(((x - x.mean(0)) ** 2).sum())
    assert 0.0 <= found.residuals[-1] <= about + 1e-12 * norm2


def _values(kind, shape, seed):
    rng = np.random.default_rng(seed)
    x = rng.standard_normal(shape)
    if kind == "constant":
        return np.full(shape, 3.7)
    if kind == "zero":
        return np.zeros(shape)
    if kind == "twice":
        return np.repeat(x[: (shape[0] + 1) // 2], 2, axis=0)[: shape[0]]
    if kind == "graded":
        return x * 10.0 ** -np.arange(0.0, 4.0 * shape[0], 4.0)[:, None]
    if kind == "one":
        return np.outer(rng.random(shape[0]), rng.random(shape[1]))
    return x
