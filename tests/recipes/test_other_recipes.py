import re
import shutil

import pytest

pytestmark = pytest.mark.slow


def test_ci_image_diff_passes_and_catches_a_changed_material(make, tmp_path):
    done = make("ci-image-diff", OUT=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    unchanged, _, changed = done.stdout.partition("now with another red")
    assert "passed" in unchanged
    assert "FAILED" not in unchanged
    assert "FAILED" in changed
    assert (tmp_path / "report.html").is_file()


def test_many_skies_makes_one_more_picture_for_one_more_map_and_fails_beyond_its_limit(make, tmp_path):
    done = make("many-skies", OUT=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "\npassed\n" in done.stdout
    first = {f.name: f.stat().st_mtime_ns for f in (tmp_path / "pictures").iterdir()}
    assert sorted(first) == ["sun-15.exr", "sun-35.exr", "sun-60.exr"]
    shutil.copy(tmp_path / "maps" / "sun-35.exr", tmp_path / "maps" / "again.exr")
    more = make("many-skies", OUT=tmp_path)
    assert more.returncode == 0, more.stdout + more.stderr
    second = {f.name: f.stat().st_mtime_ns for f in (tmp_path / "pictures").iterdir()}
    assert second.pop("again.exr")
    assert second == first
    strict = make("many-skies", OUT=tmp_path, LIMIT=0)
    assert strict.returncode != 0
    assert "failed: 4 of 4" in strict.stdout


def test_light_painting_changes_some_clusters_a_stroke_and_ends_where_a_full_relighting_does(make, tmp_path):
    done = make("light-painting", OUT=tmp_path)
    assert done.returncode == 0, done.stderr
    changed = [int(n) for n in re.findall(r"(\d+) clusters changed", done.stdout)]
    assert len(changed) == 6
    assert 0 < max(changed[1:]) < 0.3 * changed[0]
    assert "passed" in done.stderr + done.stdout
    assert {p.name for p in (tmp_path / "pictures").iterdir()} == {f"{k:02d}.png" for k in range(6)}
    assert (tmp_path / "clusters.png").stat().st_size > 10_000


def test_pieces_are_simulated_once_and_stand_where_they_are_put(make, tmp_path):
    done = make("pieces", OUT=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    assert (done.stdout + done.stderr).count("passed") == 3
    assert len(list((tmp_path / "library").glob("*.zarr"))) == 3
    strict = make("pieces", "check", OUT=tmp_path, LIMIT=0.001)
    assert strict.returncode != 0
