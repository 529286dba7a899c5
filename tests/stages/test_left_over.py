"""One tolerance over precompute, cluster and factorize: what each takes of it, and the error of all together."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest

import relight_formats as formats
from relightcli.errors import InputError, NumericalError
from relightcli.stages.cluster import Config as ClusterConfig
from relightcli.stages.cluster import cluster
from relightcli.stages.factorize import Config as AssetConfig
from relightcli.stages.factorize import factorize
from relightcli.stages.left_over import LEAST, basis_tolerance, left_over, spend
from relightcli.stages.measured_error import check_skies
from relightcli.stages.precompute import precompute
from relightcli.stages.precompute_config import Config
from tests.core.transport.scenes import lambert, sphere
from tests.stages.scene_files import write_scene
from tests.stages.test_promise import CAMERA, grid, true_error

TOLERANCE = 0.12


@pytest.fixture(scope="module")
def clusters(tmp_path_factory):
    parts = {"ground": grid(3, 32, lambert((0.7, 0.6, 0.5))), "ball": sphere(0.4, (0, 0.42, 0), rings=20)}
    parts["ball"].material = lambert((0.8, 0.7, 0.3))
    scene = write_scene(tmp_path_factory.mktemp("chain"), parts, [CAMERA], {}, adjustable=True)
    store, out = scene.parent / "t.zarr", scene.parent / "c.zarr"
    precompute(Config(scene, store, tolerance=TOLERANCE, subdivide=False, effects="auto", workers=1, quiet=True))
    cluster(ClusterConfig(store, out, workers=1, quiet=True))
    return out


@pytest.fixture(scope="module")
def asset(clusters):
    out = clusters.parent / "a.zarr"
    factorize(AssetConfig(clusters, out, workers=1, quiet=True))
    return out


def test_the_chain_keeps_the_tolerance(clusters, asset):
    kept, before = formats.open_store(asset), formats.open_store(clusters)
    # What cluster took is a share of what precompute had left, and is told.
    left = left_over(formats.open_store(clusters.parent / "t.zarr"))
    assert left is not None
    assert [one["stage"] for one in before.attrs["spent"]] == ["cluster"]
    assert before.settings["cluster_tolerance"] == basis_tolerance(formats.open_store(clusters.parent / "t.zarr"))
    measured = kept.attrs["measured_error"]
    assert measured["share"] <= measured["tolerance"] == TOLERANCE
    assert set(kept.attrs["ranks"]) == {"eigenvectors", "light_rank", "coefficients"}
    # Another view (the scene's own) and other pixels of it, against path tracing of many interreflections.
    transfer = clusters.parent / "t.zarr"
    found = [true_error(asset, name.replace(" ", "-"), sky, transfer) for name, sky in check_skies().items()]
    assert max(found) <= TOLERANCE


def test_a_smaller_tolerance_takes_more_and_a_miss_is_told(clusters, asset):
    out = clusters.parent / "b.zarr"
    with pytest.raises(NumericalError, match=r"more than the tolerance of 2\.00%.*What would help: .*--allow-miss"):
        factorize(AssetConfig(clusters, out, tolerance=0.02, workers=1, quiet=True))
    assert not out.exists()
    done = factorize(AssetConfig(clusters, out, tolerance=0.02, allow_miss=True, workers=1, quiet=True))
    assert done["status"] == "resumed"
    ranks = formats.open_store(out).attrs["ranks"]
    least = formats.open_store(asset).attrs["ranks"]
    assert all(least[name] <= ranks[name] for name in least)
    assert least["coefficients"] < ranks["coefficients"]
    with pytest.raises(InputError, match="--tolerance"):
        factorize(AssetConfig(clusters, out, tolerance=2.0))


def test_errors_add_up_in_squares():
    def store(attrs):
        return SimpleNamespace(attrs=attrs)

    assert left_over(store({})) is None
    attrs = {
        "measured_error": {"tolerance": 0.1, "share": 0.06},
        "plan": [{"effect": "one-bounce", "simulate": True, "evidence": "", "bound": 0.2}],
    }
    left = left_over(store(attrs))
    assert (left.left, left.bounced) == (pytest.approx(0.08, rel=1e-12), 0.2)
    attrs["spent"] = spend(store(attrs), "cluster", 0.05)
    assert left_over(store(attrs)).left == pytest.approx(math.sqrt(0.08**2 - 0.05**2), rel=1e-12)
    # What has been spent already leaves little, and never nothing.
    attrs["spent"] = spend(store(attrs), "cluster", 0.5)
    assert left_over(store(attrs)).left == pytest.approx(LEAST * 0.1)
    shares = np.array([left_over(store(attrs)).part(s) for s in (0.2, 0.5)])
    assert np.allclose(shares**2, np.array([0.2, 0.5]) * (LEAST * 0.1) ** 2)
