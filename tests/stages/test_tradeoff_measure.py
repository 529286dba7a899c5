"""Errors by layer of made-up pictures, whose values follow by hand."""

import numpy as np
import pytest

from relightcli.adapters.images import write_image
from relightcli.errors import InputError, NumericalError, StoreError
from relightcli.stages.tradeoff_measure import Truth, compare, measure, read_layers, read_truth
from relightcli.stages.tradeoff_runs import Runs, Step

SIZE = (6, 8, 3)


def flat(value):
    return np.full(SIZE, value, np.float32)


@pytest.fixture
def truth():
    """2 everywhere: 1.5 direct, 0.5 bounced, no lobes; references without noise."""
    layers = {"": flat(2), "direct": flat(1.5), "one_bounce": flat(0.5), "specular": flat(0), "variance": flat(0)}
    return Truth("sky, main", layers, layers)


def test_a_layer_that_is_missing_counts_as_black_and_a_black_one_is_left_out(truth):
    ours = {"": flat(1.65), "direct": flat(1.65), "specular": flat(0)}
    found = compare(ours, truth)
    assert found.squared == pytest.approx(0.35**2 / 4)
    assert found.noise == 0
    # 0.15 too much and 0.5 too little cancel in the picture, and not in the budget.
    assert found.share == pytest.approx({"direct": 0.15**2 / 4, "one_bounce": 0.25 / 4, "specular": 0})
    assert found.own == pytest.approx({"direct": 0.01, "one_bounce": 1})
    assert found.flip > 0


def test_the_truth_itself_has_no_error(truth):
    found = compare(truth.a, truth)
    assert (found.squared, found.flip) == (0, 0)
    assert set(found.own.values()) == set(found.share.values()) == {0}


def test_a_measured_picture_is_not_measured_again(truth, tmp_path):
    layers = {k: v for k, v in truth.a.items() if k}
    write_image(tmp_path / "p.exr", flat(2.2), layers=layers)
    first = measure(tmp_path / "p.exr", truth, tmp_path / "kept.json")
    assert first.squared == pytest.approx(0.01, rel=1e-5)
    (tmp_path / "p.exr").unlink()
    assert measure(tmp_path / "p.exr", truth, tmp_path / "kept.json") == first


def test_black_references_and_broken_pictures_are_refused(tmp_path):
    write_image(tmp_path / "black.exr", flat(0), layers={"variance": flat(0)})
    with pytest.raises(InputError, match="black"):
        read_truth("night, main", tmp_path / "black.exr", tmp_path / "black.exr")
    broken = flat(1)
    broken[2, 3] = np.nan
    write_image(tmp_path / "nan.exr", broken)
    with pytest.raises(NumericalError, match=r"nan\.exr.*not finite"):
        read_layers(tmp_path / "nan.exr")


def test_a_damaged_record_is_named(tmp_path):
    step = Step("precompute", ("--refine", "4"))
    runs = Runs(tmp_path, tmp_path / "scene.toml", 1)
    assert runs.record(step.name) == []
    folder = tmp_path / "runs" / step.name
    folder.mkdir(parents=True)
    (folder / "record.json").write_text('{"runs": [')
    with pytest.raises(StoreError, match=r"record\.json: is damaged; delete it"):
        runs.record(step.name)


def test_a_command_that_fails_gives_its_own_error_and_message(tmp_path):
    runs = Runs(tmp_path, tmp_path / "none.toml", 1)
    with pytest.raises(InputError, match=r"relightcli precompute: .*none\.toml"):
        runs.make(Step("precompute", ()), 1)
    assert not list(tmp_path.glob("runs/*/record.json"))


def test_a_damaged_picture_is_named_with_what_to_do(tmp_path):
    path = tmp_path / "run" / "picture.exr"
    path.parent.mkdir()
    write_image(path, np.ones((8, 8, 3), np.float32))
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(StoreError, match=r"picture\.exr: .*Delete .*run and give the same command again"):
        read_layers(path)
