"""What a sweep concludes, from made-up measurements whose conclusions follow by hand."""

import csv
import io
import json
import math

import pytest

from relightcli.stages.tradeoff_measure import PictureError, PointError, together
from relightcli.stages.tradeoff_result import Measured, Result, Traced, ahead, fit_tracer
from relightcli.stages.tradeoff_tables import points_csv, table_text, traced_csv


def point(label, error, seconds, frame=0.1, size=1_000_000, spread=0.0, noise=0.0):
    return Measured(
        label=label,
        settings={"bounces": "1"},
        commands=(("relightcli", "precompute", "s.toml", "-o", "transfer.zarr"),),
        error=PointError(error, noise, 0.01, error, "sky, main", {"direct": 0.1}, {"direct": error / 3}),
        seconds=seconds,
        seconds_spread=spread,
        cpu_seconds=seconds,
        picture_seconds=1.0 + frame,
        frame_seconds=frame,
        frame_spread=0.0,
        bytes=size,
        peak_bytes=200_000_000,
        repeats=2,
    )


# Noise 0.4 / sqrt(spp), 0.05 s a sample and 1 s to start.
TRACED = tuple(Traced(n, 1 + 0.05 * n, 0.4 / math.sqrt(n)) for n in (4, 16, 64))


def result(*points, **more):
    known = {"tolerance": 0.02, "machine": "m", "workers": 1, "traced": TRACED, "impossible": {}}
    return Result("s.toml", ("sky, main",), 128, 1, points=points, **(known | more))


def test_dominated_points_and_fronts():
    found = result(
        point("base", 0.02, 10), point("finer", 0.01, 30), point("worse", 0.03, 20), point("small", 0.05, 40, size=10)
    )
    assert found.dominated_by() == [None, None, 0, None]
    fronts = found.fronts()
    assert fronts["seconds"] == [0, 1]
    assert fronts["bytes"] == [3, 1]
    assert found.on_front() == [1, 0, 3]
    assert "worse is dominated by base: nowhere better, somewhere worse." in found.remarks()


def test_the_cheapest_point_within_the_tolerance():
    points = (point("base", 0.015, 20), point("fast", 0.0199, 10), point("bad", 0.021, 1))
    assert result(*points).cheapest() == 1
    assert "is: fast (1.99%, 10.0 s, 1.0 MB)" in result(*points).remarks()[0]
    # The noise of the fast one's error could take it past the tolerance.
    vague = (points[0], point("fast", 0.0199, 10, noise=0.0002), points[2])
    assert result(*vague).cheapest() == 0
    assert "is not known: that of fast is 1.99% or up to 0.02% more" in result(vague[1]).remarks()[0]
    none = result(*points, tolerance=0.001)
    assert none.cheapest() is None
    assert "No point keeps the error under 0.10%; the least is 1.50%: base." in none.remarks()


def test_path_tracing_at_equal_error():
    tracer = fit_tracer(TRACED)
    assert tracer.noise == pytest.approx(0.4)
    assert tracer.per_sample == pytest.approx(0.05)
    # (0.4 / 0.02)^2 = 400 samples, 20 s. 100 + 1.1 + 0.1 (n - 1) < 20 n from n = 101 / 19.9 = 5.08 on: 6.
    gain = ahead(point("p", 0.02, 100), tracer)
    assert gain.traced_seconds == pytest.approx(20)
    assert gain.pictures == 6
    n = gain.pictures
    assert 100 + 1.1 + 0.1 * (n - 1) < 20 * n
    assert 100 + 1.1 + 0.1 * (n - 2) >= 20 * (n - 1)
    # The error's own noise counts for path tracing: 0.04 needs a quarter of the samples.
    assert ahead(point("p", 0.02, 100, noise=0.02), tracer).traced_seconds == pytest.approx(5)
    assert ahead(point("p", 0.4, 100, frame=1.0), tracer).pictures is None
    assert ahead(point("p", 0.0, 100), tracer).pictures == 1


def test_differences_below_the_spread_of_repeats_are_not_told_apart():
    apart = "which is faster is not known"
    # The two points are neighbours on the front; 3 s between them.
    told = result(point("a", 0.02, 10, spread=1), point("b", 0.01, 13, spread=1)).undecided()
    assert not any(apart in line for line in told)
    vague = result(point("a", 0.02, 10, spread=5), point("b", 0.01, 13, spread=1)).undecided()
    assert (
        "a and b: the seconds of simulation differ by 3, those of repeats by 5; which is faster is not known." in vague
    )


def test_errors_below_the_noise_are_not_told_apart():
    pair = (point("a", 0.0101, 10), point("b", 0.01, 13))
    apart = "which is more exact is not known"
    # 0.0101^2 - 0.01^2 = 2.01e-6.
    assert any(apart in line for line in result(*pair, pair_noise={(0, 1): 3e-6}).undecided())
    assert not any(apart in line for line in result(*pair, pair_noise={(0, 1): 1e-6}).undecided())


def test_pictures_become_one_error():
    pictures = [
        PictureError(0.0004, 3e-5, 0.02, {"direct": 0.01, "specular": 0.04}, {"direct": 0.0004, "specular": 0.0}),
        PictureError(-0.0002, 4e-5, 0.04, {"direct": 0.03}, {"direct": 0.0002, "specular": 0.0}),
    ]
    found = together(["one", "two"], pictures)
    # Means of squares, signed; a layer that is black in one picture counts in the other alone.
    assert found.error == pytest.approx(0.01)
    assert found.noise == pytest.approx(math.sqrt(1e-4 + 2.5e-5) - 0.01)
    assert (found.worst, found.worst_view) == (pytest.approx(0.02), "one")
    assert found.own == {"direct": pytest.approx(math.sqrt(0.02)), "specular": pytest.approx(0.2)}
    assert found.share["direct"] == pytest.approx(math.sqrt(0.0003))
    assert together(["one"], [pictures[1]]).error == 0


def test_the_csv_holds_every_digit():
    third = point("third, of all", 1 / 3, 0.1 + 0.2)
    found = result(third, point("b", 1e-9, 1e6), traced=(*TRACED, Traced(7, 0.1 + 0.2, 1 / 3)))
    rows = list(csv.DictReader(io.StringIO(points_csv(found))))
    assert [r["point"] for r in rows] == ["third, of all", "b"]
    data = found.to_json()["points"]
    for row, p in zip(rows, data, strict=True):
        for column, key in (("error", "error"), ("seconds", "seconds"), ("bytes", "bytes"), ("error_noise", "noise")):
            assert float(row[column]) == p[key]
        assert float(row["share_direct"]) == p["share"]["direct"]
        assert row["front"] == " ".join(p["front"])
    assert rows[0]["seconds"] == "0.30000000000000004"
    traced = list(csv.DictReader(io.StringIO(traced_csv(found))))
    assert [float(t["error"]) for t in traced] == [t.error for t in found.traced]


def test_no_error_at_all_is_no_json_that_is_none():
    text = json.dumps(result(point("exact", 0.0, 1)).to_json(), allow_nan=False)
    assert json.loads(text)["points"][0]["traced_seconds"] is None


def test_the_table_lines_up():
    lines = table_text(result(point("base", 0.02, 10), point("a long name", 0.5, 12345))).splitlines()
    assert lines[0].index("error %") + len("error %") == lines[1].index("2.00") + 4 == lines[2].index("50.00") + 5
    assert lines[2].split()[-1] == "#1"
