"""Every command that writes something, on scenes so small that it takes about a second, and what it writes."""

from __future__ import annotations

import csv
import hashlib
import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import relight_formats as formats
from relightcli.scene.model import Camera, Material
from tests.core.transport.scenes import lambert, sphere, square
from tests.faults.harness import TIMED
from tests.stages.pose_files import pose_scene
from tests.stages.scene_files import write_scene

OUT = "out"  # folder of what is being written, below the workplace
GOLD = Material("m", "cook-torrance", (0.1, 0.08, 0.05), (0.8, 0.6, 0.4), f0=0.8, roughness=0.3)
FRAMES = "format = 1\nframes = 3\n[[key]]\nframe = 1\nenv_rotate = 0\n[[key]]\nframe = 4\nenv_rotate = 360\n"
_TINY = ("--light-resolution", "16", "--no-subdivide")
_BOUNCE = ("--bounces", "1", "--bounce-resolution", "8")
_FIELDS = ("--field-shells", "2", "--field-resolution", "2", "--field-proxies", "2")
_POSE = ("--bounces", "0", "--pose-directions", "64", "--pose-frames", "spread:6")
_SWEEP = ("--knob", "light-resolution=16", "--knob", "bounces=1,0", "--bounces", "1", "--spp", "32", "--repeats", "1")


@dataclass(frozen=True)
class Station:
    """A command. reads: the file or store it starts from; inputs: files whose change it must notice; writes: what it
    leaves below OUT (a store ends in .zarr)."""

    name: str
    words: tuple[str, ...]
    writes: tuple[str, ...]
    inputs: tuple[str, ...] = ()
    more: tuple[str, ...] = ()

    @property
    def reads(self) -> str:
        return self.words[1]

    @property
    def is_store(self) -> bool:
        return self.writes[0].endswith(".zarr")

    @property
    def resumes(self) -> bool:
        """Whether an interrupted run leaves unfinished work that a rerun takes up."""
        return self.is_store or self.name in ("reference", "tradeoff")

    def command(self, *, workers: int = 1, overwrite: bool = False) -> list[str]:
        if self.name == "diff":
            return [*self.words, *self.more]
        output = "f.##.png" if self.name == "frames" else self.writes[0]
        words = [*self.words, "-o", f"{OUT}/{output}", *self.more, "--workers", str(workers)]
        return [*words, "--overwrite"] if overwrite else words


def _scene(folder: str) -> tuple[str, ...]:
    return (f"{folder}/scene.toml", f"{folder}/ball.obj")


STATIONS = (
    Station("transfer", ("precompute", "shiny/scene.toml"), ("transfer.zarr",), _scene("shiny"), (*_TINY, *_BOUNCE)),
    Station("haar", ("precompute", "plain/scene.toml"), ("haar.zarr",), _scene("plain"), (*_TINY, "--basis", "haar")),
    Station("sh", ("precompute", "plain/scene.toml"), ("sh.zarr",), _scene("plain"), (*_TINY, "--basis", "sh")),
    Station(
        "fields", ("precompute", "moving/scene.toml"), ("fields.zarr",), _scene("moving"), (*_TINY, *_BOUNCE, *_FIELDS)
    ),
    Station(
        "pose",
        ("precompute", "posed/scene.toml"),
        ("poses.zarr",),
        ("posed/scene.toml", "posed/bar.glb"),
        (*_TINY, *_POSE),
    ),
    Station("cluster", ("cluster", "transfer.zarr"), ("clusters.zarr",), (), ("--clusters", "3")),
    Station(
        "light clusters",
        ("cluster", "transfer.zarr"),
        ("lights.zarr",),
        (),
        ("--light-resolution", "16", "--lights", "30"),
    ),
    Station(
        "factorize", ("factorize", "clusters.zarr"), ("asset.zarr",), (), ("--eigenvectors", "4", "--light-rank", "8")
    ),
    Station("fit-pose", ("fit-pose", "poses.zarr"), ("pose.zarr",), (), ("--model", "sh")),
    Station("picture", ("relight", "asset.zarr"), ("picture.exr",)),
    Station("layers", ("relight", "transfer.zarr"), ("layers.exr",), (), ("--layers",)),
    Station("vertices", ("relight", "lights.zarr"), ("vertices.ply",)),
    Station("radiance", ("relight", "transfer.zarr"), ("radiance.zarr",)),
    Station("frames", ("relight", "haar.zarr"), ("f.01.png", "f.02.png", "f.03.png"), (), ("--frames", "frames.toml")),
    Station("moved", ("relight", "fields.zarr"), ("moved.exr",), (), ("--move", "ball=0.2,0.7,0")),
    Station("posed", ("relight", "pose.zarr"), ("posed.tif",), (), ("--pose", "bar=bend@1.3")),
    Station(
        "reference",
        ("relight", "shiny/scene.toml"),
        ("reference.exr",),
        _scene("shiny"),
        ("--reference", "--spp", "16"),
    ),
    Station(
        "diff",
        ("diff", "picture.exr", "reference.exr"),
        ("heat.png", "report.html"),
        (),
        ("--heatmap", f"{OUT}/heat.png", "--report", f"{OUT}/report.html", "--fail", "1"),
    ),
    Station("tradeoff", ("tradeoff", "plain/scene.toml"), ("report",), _scene("plain"), _SWEEP),
)
BY_NAME = {station.name: station for station in STATIONS}


def make_workplace(folder: Path) -> None:
    """The scenes that the stations start from."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    sky = np.random.default_rng(5).random((8, 16, 3))
    cameras = [Camera("main", (0, 1.5, 4), (0, 0.5, 0), size=(24, 16))]
    for name, material in (("shiny", GOLD), ("plain", lambert(0.7)), ("moving", lambert(0.7))):
        parts = {
            "ground": square(3, material=lambert(0.5)),
            "ball": sphere(0.5, (0, 0.6, 0), rings=6, material=material),
        }
        path = write_scene(folder / name, parts, cameras, {"sky": sky}, adjustable=name == "shiny")
        if name == "moving":
            path.write_text(path.read_text().replace("mesh = 'ball.obj'", "mesh = 'ball.obj'\nmotion = 'rigid'"))
    pose_scene(folder / "posed")
    (folder / "frames.toml").write_text(FRAMES)
    (folder / OUT).mkdir()


def clear(folder: Path) -> None:
    """Nothing is left of what a station has written."""
    shutil.rmtree(folder / OUT, ignore_errors=True)
    (folder / OUT).mkdir()


def content(path: Path) -> dict[str, str]:
    """Digests of what a station has written under one name, without what tells times."""
    if path.is_file():
        return {path.name: _digest(path)}
    if path.suffix == ".zarr":
        files = (p for p in sorted(path.rglob("*")) if p.is_file() and p.relative_to(path).as_posix() not in TIMED)
        digests = {p.relative_to(path).as_posix(): _digest(p) for p in files}
        return {**digests, "fingerprint": formats.open_store(path).fingerprint}
    # A report: the pictures that were measured, the names of all records, and the errors, which hang on no clock.
    digests = {p.relative_to(path).as_posix(): _digest(p) for p in sorted(path.rglob("*.exr"))}
    records = {p.relative_to(path).as_posix(): "" for p in path.rglob("record.json")}
    with open(path / "points.csv", newline="") as file:
        errors = {f"error of {row['point']}": row["error"] for row in csv.DictReader(file)}
    return {**digests, **records, **errors}


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()
