"""A whole sweep of a small scene, killed in its middle and continued; and its page in a real browser."""

from __future__ import annotations

import csv
import fcntl
import html
import io
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from relightcli.adapters.images import read_environment
from relightcli.cli.main import run
from relightcli.core.lights.sky import sky_latlong
from relightcli.errors import StoreError
from relightcli.scene.model import Camera, Material
from relightcli.scene.parse import load_scene
from relightcli.stages.tradeoff_setup import Config, machine, make_views, open_folder
from tests.core.transport.scenes import lambert, sphere, square
from tests.stages.scene_files import write_scene

ROOT = Path(__file__).parents[2]
ENVIRONMENT = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "formats")])}
SWEEP = ("--knob", "light-resolution=32", "--knob", "bounces=1,0")
SWEEP += ("--bounces", "1", "--spp", "128", "--repeats", "1", "--env", "sky", "--workers", "1")


def program(folder, *more, output="report"):
    command = [sys.executable, "-m", "relightcli", "tradeoff", "scene.toml", "-o", output, *SWEEP, *more]
    return subprocess.run(command, cwd=folder, env=ENVIRONMENT, capture_output=True, text=True, timeout=600)


def records(folder):
    return {str(p.relative_to(folder)): p.read_text() for p in folder.glob("report/runs/**/record.json")}


@pytest.fixture(scope="module")
def sweep(tmp_path_factory):
    """Folder of the scene and its report; records of a sweep that was killed once its first command had ended; the
    answer of the same command run again. Test processes that run side by side share one."""
    base = tmp_path_factory.getbasetemp()
    base = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base
    folder = base / "tradeoff-sweep"
    with open(base / "tradeoff-sweep.lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (folder / "told.json").exists():
            (folder / "told.json").write_text(json.dumps(_sweep(folder)))
    killed, answer = json.loads((folder / "told.json").read_text())
    return folder, killed, answer


def _sweep(folder):
    parts = {
        "ground": square(3, material=lambert(0.6)),
        "ball": sphere(0.5, (0, 0.6, 0), rings=16, material=Material("ball", "blinn-phong", specular=(0.3, 0.3, 0.3))),
    }
    maps = {"sky": sky_latlong(45.0, overcast=True), "sun": np.ones((2, 4, 3))}
    write_scene(folder, parts, [Camera("main", (0, 1.5, 3), (0, 0.4, 0), size=(32, 24))], maps)
    command = [sys.executable, "-m", "relightcli", "tradeoff", "scene.toml", "-o", "report", *SWEEP]
    with subprocess.Popen(command, cwd=folder, env=ENVIRONMENT, stderr=subprocess.DEVNULL) as process:
        deadline = time.monotonic() + 240
        while not records(folder) and time.monotonic() < deadline and process.poll() is None:
            time.sleep(0.05)
        process.kill()
    assert process.returncode == -signal.SIGKILL
    killed = records(folder)
    done = program(folder, "--json")
    assert done.returncode == 0, done.stderr
    return killed, json.loads(done.stdout)


@pytest.fixture
def scene(sweep):
    return sweep[0]


@pytest.fixture
def report(sweep):
    return sweep[2]


def test_a_killed_sweep_goes_on_and_runs_nothing_twice(sweep):
    scene, killed, report = sweep
    assert killed
    now = records(scene)
    assert {name: now[name] for name in killed} == killed
    # Two points: precompute, frames and a picture each; four path tracings; the rest had ended. A store whose command
    # has ended is still there, so that nothing is made again.
    assert report["commands_run"] == 2 * 3 + 4 - len(killed)
    assert all(len(json.loads(r)["runs"]) == 1 for r in now.values())
    assert not list(scene.glob("report/runs/**/*.zarr*"))


def test_errors_are_those_of_the_settings(report):
    base, direct = report["points"]
    assert [p["label"] for p in report["points"]] == ["base", "bounces 0"]
    # Overcast sky, a fine mesh: what the texels leave. Without the bounce the error is that layer, all of it.
    assert 0 < base["error"] < 0.03
    assert direct["own"]["one_bounce"] == pytest.approx(1)
    assert direct["error"] == pytest.approx(direct["share"]["one_bounce"], rel=0.3)
    assert direct["error"] > 2 * base["error"]
    assert direct["share"]["direct"] == pytest.approx(base["share"]["direct"], rel=1e-3)
    assert direct["bytes"] < base["bytes"]
    assert 50e6 < base["peak_bytes"] < 2e9
    assert base["seconds"] > base["cpu_seconds"] * 0.3 > 0
    assert base["picture_seconds"] > base["frame_seconds"] > 0
    assert report["reference"] == {"spp": 128, "bounces": 1}


def test_path_tracing_falls_with_the_root_of_samples(report):
    spp, errors = zip(*[(t["spp"], t["error"]) for t in report["path_tracing"]], strict=True)
    assert spp == (8, 32, 64)
    slope = np.polyfit(np.log(spp), np.log(errors), 1)[0]
    # -1/2 for independent samples; the samples of a pass are stratified, which can only make it steeper, to -1 at most
    # for edges and smooth light in two dimensions. The variances are means over 768 pixels: some percent of noise.
    assert -1.0 < slope < -0.45


def test_the_csv_says_what_the_json_says(scene, report):
    rows = list(csv.DictReader(io.StringIO((scene / "report" / "points.csv").read_text())))
    for row, point in zip(rows, report["points"], strict=True):
        assert row["point"] == point["label"]
        for name in ("error", "seconds", "frame_seconds", "bytes", "flip"):
            assert float(row[name]) == point[name]


def test_a_finished_sweep_runs_nothing_and_another_scene_is_refused(scene, report, tmp_path):
    done = program(scene)
    assert done.returncode == 0, done.stderr
    assert "up to date" in done.stderr
    assert re.search(r"^1 +base +\d", done.stderr, re.M)
    other = tmp_path / "other"
    shutil.copytree(scene, other)
    (other / "scene.toml").write_text((other / "scene.toml").read_text().replace("0.6", "0.5", 1))
    refused = program(other)
    assert refused.returncode == 3
    assert "another scene" in refused.stderr
    assert "--overwrite" in refused.stderr


def test_overwrite_starts_a_report_of_something_else_anew(scene, tmp_path):
    folder = tmp_path / "old"
    (folder / "runs" / "precompute-0").mkdir(parents=True)
    (folder / "tradeoff.json").write_text('{"format": 1}')
    loaded = load_scene(scene / "scene.toml")
    config = Config(scene / "scene.toml", folder)
    with pytest.raises(StoreError, match="another program, scene, machine, workers"):
        open_folder(config, loaded)
    assert (folder / "runs" / "precompute-0").exists()
    open_folder(replace(config, overwrite=True), loaded)
    assert not (folder / "runs").exists()
    (folder / "runs").mkdir()
    assert open_folder(config, loaded) == machine()
    assert (folder / "runs").exists()


def test_a_scene_without_skies_gets_one(scene, tmp_path):
    loaded = replace(load_scene(scene / "scene.toml"), environments={})
    (view,) = make_views(Config(scene / "scene.toml", tmp_path), loaded, ["main"])
    assert view.name == "built-in sky, main"
    assert read_environment(view.environment).max() > 0


def test_bad_usage_is_refused_before_anything_runs(scene, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(scene)
    folder = tmp_path / "full"
    folder.mkdir()
    (folder / "file").touch()
    for more, output, words in (
        (("--knob", "refine=3x"), "new", "1, 2, 4 or 8"),
        (("--spp", "33"), "new", "--spp"),
        (("--tolerance", "2"), "new", "--tolerance"),
        (("--camera", "none"), "new", "--camera none"),
        (("--bounces", "0"), "new", "more than the truth has; expected at most --bounces 0"),
        (("--knob", "receivers=pixels:other"), "new", "no other camera"),
        ((), str(folder), "expected an empty folder"),
    ):
        code = run(["tradeoff", "scene.toml", "-o", output, *SWEEP, *more])
        said = capsys.readouterr().err
        assert code == 2, said
        assert words in said
        assert "Traceback" not in said
        assert not (scene / "new").exists()


def test_dry_run_predicts_and_does_nothing(scene, monkeypatch, capsys):
    monkeypatch.chdir(scene)
    assert run(["tradeoff", "scene.toml", "-o", "planned", *SWEEP, "--dry-run", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert [p["label"] for p in found["points"]] == ["base", "bounces 0"]
    assert found["predicted_seconds"] > 0
    assert "--light-resolution 32" in found["points"][0]["commands"][0]
    assert not (scene / "planned").exists()


def test_the_page_holds_everything_in_itself(scene, report):
    page = (scene / "report" / "index.html").read_text()
    assert not re.search(r"https?://|url\(|@import|<link|<script|<iframe", page)
    sources = re.findall(r'src="([^"]{14})', page)
    # Four plots, the pictures of the fronts, the reference.
    fronts = sum(bool(p["front"]) for p in report["points"])
    assert len(sources) == 4 + fronts + 1
    assert all(s.startswith("data:image/") for s in sources)
    for part in (
        *report["remarks"],
        *report["undecided"],
        "relightcli tradeoff scene.toml",
        "--bounces 0",
        "light-resolution=32",
    ):
        assert html.escape(part) in page
    for name in report["files"]:
        assert (scene / "report" / name).stat().st_size > 100


BROWSER = ("--headless", "--no-sandbox", "--disable-gpu", "--virtual-time-budget=5000", "--window-size=1400,1000")
# The page in a frame as wide as a screen, so high that it has no scroll bar; what is found goes into an attribute.
PROBE = """<!doctype html><html><body style="margin:0"><iframe id="f" width="{width}" height="30000" style="border:0"
 srcdoc="{page}"></iframe><script>
addEventListener("load", () => {{ const d = document.getElementById("f").contentDocument, e = d.documentElement;
 const images = [...d.images];
 document.body.dataset.found = JSON.stringify({{ inner: e.clientWidth, wide: e.scrollWidth, images: images.length,
  broken: images.filter(i => !i.complete || i.naturalWidth === 0).length,
  least: Math.min(...images.map(i => i.getBoundingClientRect().width)) }}); }});
</script></body></html>"""


@pytest.mark.parametrize("width", [1280, 390])
def test_a_browser_shows_the_page_without_scrolling_sideways(scene, report, tmp_path, width):
    browser = shutil.which("chromium") or shutil.which("chromium-browser")
    if browser is None:
        pytest.skip("NO BROWSER: install Debian's chromium, or the report page is not looked at")
    page = (scene / "report" / "index.html").read_text()
    probe = tmp_path / "probe.html"
    probe.write_text(PROBE.format(width=width, page=html.escape(page)))
    done = subprocess.run(
        [browser, *BROWSER, f"--user-data-dir={tmp_path / 'profile'}", "--dump-dom", probe.as_uri()],
        capture_output=True,
        text=True,
        timeout=120,
    )
    text = re.search(r'data-found="([^"]*)"', done.stdout)
    assert text, done.stderr[-2000:]
    found = json.loads(html.unescape(text[1]))
    assert found["inner"] == width
    assert found["wide"] <= width
    assert found["images"] >= 6
    assert found["broken"] == 0
    assert found["least"] > 250  # large enough to read at either width
