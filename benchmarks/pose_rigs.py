"""Whole characters: what it takes to learn them, and their pictures on a floor against path tracing.

CesiumMan and Fox of the glTF samples move by their own clips, and CesiumMan by motion captured at CMU as well. All are
from the test data (../shared/data or RELIGHT_SHARED_DATA). The sky is a gradient with a broad bright side.
"""

from __future__ import annotations

import json
import math
import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.processes import run_tool
from benchmarks.report import Report, Row, Table, at_most
from benchmarks.scenes import Setting

FLIP_LIMIT = 0.06
SAMPLES = 256  # a pixel of the references
SIDE = 256
SCENE = """format = 1
[objects.subject]
mesh = "subject.glb"
material = "skin"
motion = "skinned"
{motion}
[materials.skin]
diffuse = [0.7, 0.6, 0.5]
"""
FLOOR = """[objects.floor]
mesh = "floor.obj"
material = "grey"
[materials.grey]
diffuse = [0.5, 0.5, 0.5]
"""
SKY = """[environments.sky]
map = "sky.exr"
"""
CAMERA = """[cameras.at{k}]
eye = {eye}
target = {target}
fov = 40
size = [{side}, {side}]
"""
# Which captured joint moves which node of CesiumMan.
JOINTS = {
    2: "Hips", 11: "LowerBack", 12: "Spine1", 19: "Neck", 20: "Head", 16: "LeftArm", 17: "LeftForeArm", 18: "LeftHand",
    13: "RightArm", 14: "RightForeArm", 15: "RightHand", 7: "LeftUpLeg", 8: "LeftLeg", 9: "LeftFoot",
    10: "LeftToeBase", 3: "RightUpLeg", 4: "RightLeg", 5: "RightFoot", 6: "RightToeBase",
}  # fmt: skip
CAPTURED = ("01_01.bvh", "01_03.bvh")


@dataclass(frozen=True)
class Rig:
    """mesh: its file in the test data; captured: motion is added; moments: CLIP@SECONDS of the pictures."""

    name: str
    mesh: str
    captured: bool
    moments: tuple[str, ...]


RIGS = (
    Rig("CesiumMan", "CesiumMan.glb", False, ("clip0@0.7",)),
    Rig("Fox", "Fox.glb", False, ("Walk@0.3", "Run@0.55")),
    Rig("CesiumMan, CMU motion", "CesiumMan.glb", True, ("01_01@3.1", "01_03@12.7")),
)


def measure_rigs(setting: Setting, data: Path, report: Report) -> list[tuple[str, Path]]:
    """Adds rows and a table; returns the rigs' names and transfer stores."""
    from relightcli.adapters.flip import flip_hdr
    from relightcli.adapters.images import read_image
    from relightcli.core.measure.errors import relative_rmse

    options = ("--pose-frames", "spread:6", "--pose-directions", "64", "--light-resolution", "16", "--no-subdivide")
    rows: list[tuple[str | float, ...]] = []
    made = []
    for rig in RIGS[:1] if setting.quick else RIGS:
        folder = setting.work / rig.name.replace(" ", "-").replace(",", "")
        scene = _write(setting, data, rig, folder)
        transfer, store = folder / "transfer.zarr", folder / "pose.zarr"
        _, told = run_tool("precompute", scene, "-o", transfer, "--bounces", "0", *(options if setting.quick else ()))
        training = _training_seconds(transfer)
        _, told = run_tool("fit-pose", transfer, "-o", store)
        about = told["objects"][0]
        held, size = about["held_out"], about["bytes"] / 1e6
        report.rows += [
            at_most(f"{rig.name}: training of {about['frames']} frames, one core", training, "s", 300.0),
            at_most(f"{rig.name}: fit of {about['vertices']} vertices", about["seconds"], "s", 10.0),
            at_most(f"{rig.name}: model", size, "MB", 5.0),
        ]
        for k, moment in enumerate(rig.moments):
            pose = ("--pose", f"subject={moment}", "--camera", f"at{k}")
            ours, truth = folder / f"ours{k}.exr", folder / f"truth{k}.exr"
            _, told = run_tool("relight", store, *pose, "-o", ours)
            spp = 16 if setting.quick else SAMPLES
            run_tool("relight", scene, *pose, "-o", truth, "--reference", "--spp", str(spp))
            a, b = (read_image(path).pixels[..., :3] for path in (ours, truth))
            where = flip_hdr(a, b)
            flip, error = float(where.mean()), relative_rmse(a, b)
            mask = folder / f"mask{k}.exr"
            run_tool("relight", folder / "alone.toml", *pose, "-o", mask, "--reference", "--spp", "4")
            own = float(where[read_image(mask).pixels[..., 3] > 0.5].mean())
            work = f"{rig.name}, {moment}: FLIP"
            report.rows.append(Row(work, flip, "", target=f"<= {FLIP_LIMIT}", met=flip <= FLIP_LIMIT))
            ratio = held["model"] / held["projection"]
            rows.append((rig.name, moment, held["bands"], ratio, 100 * error, flip, own, told["lighting_seconds"]))
        made.append((rig.name, transfer))
    columns = (
        "rig",
        "moment",
        "held-out error",
        "over four bands' error",
        "picture's relative RMS, %",
        "FLIP",
        "on the character",
        "relight, s",
    )
    report.tables.append(Table("rigs, on a floor that they shade", columns, tuple(rows)))
    return made


def _training_seconds(transfer: Path) -> float:
    """Processor time of tracing the poses, of all processes together: what a run on one core takes."""
    import relight_formats as formats

    blocks = formats.open_store(transfer).blocks
    return float(sum(block["cpu_seconds"] for block in blocks if block["id"].startswith("pose/")))


def _write(setting: Setting, data: Path, rig: Rig, folder: Path) -> Path:
    """The scene: the character, a floor under its feet, a sky, a camera for every moment."""
    from relightcli.adapters.images import write_image
    from relightcli.scene.build import build_geometry
    from relightcli.scene.parse import load_scene
    from relightcli.scene.posing import apply_poses

    folder.mkdir(parents=True)
    shutil.copyfile(data / "skinned" / rig.mesh, folder / "subject.glb")
    motion = ""
    if rig.captured:
        for name in CAPTURED:
            shutil.copyfile(data / "skinned" / "bvh" / name, folder / name)
        lines = [f'node{node} = "{joint}"' for node, joint in JOINTS.items()]
        (folder / "map.toml").write_text("\n".join(["[joints]", *lines]) + "\n")
        motion = f'motion_files = {json.dumps(list(CAPTURED))}\njoint_map = "map.toml"'
    path = folder / "scene.toml"
    path.write_text(SCENE.format(motion=motion))
    scene = load_scene(path)
    posed = [apply_poses(scene, build_geometry(scene), [f"subject={m}"])[0].positions for m in rig.moments]
    low, size = min(p[:, 1].min() for p in posed), float(np.ptp(posed[0], axis=0).max())
    text = SKY
    for k, positions in enumerate(posed):
        middle = 0.5 * (positions.min(axis=0) + positions.max(axis=0))
        eye = middle + size * np.array([1.5, 0.6, 1.2])
        side = 48 if setting.quick else SIDE
        text += CAMERA.format(k=k, eye=eye.tolist(), target=middle.tolist(), side=side)
    (folder / "alone.toml").write_text(path.read_text() + text)
    path.write_text(path.read_text() + FLOOR + text)
    middles = np.array([0.5 * (p.min(axis=0) + p.max(axis=0)) for p in posed])
    (x0, _, z0), (x1, _, z1) = middles.min(axis=0) - 3 * size, middles.max(axis=0) + 3 * size
    corners = [(x0, z0), (x0, z1), (x1, z1), (x1, z0)]
    lines = [f"v {x:.9g} {low:.9g} {z:.9g}" for x, z in corners]
    (folder / "floor.obj").write_text("\n".join([*lines, "f 1 2 3", "f 1 3 4"]) + "\n")
    lat = math.pi * (0.5 - (np.arange(32) + 0.5) / 32)[:, None]
    lon = math.pi * (1.0 - 2.0 * (np.arange(64) + 0.5) / 64)[None, :]
    up, front = np.sin(lat) + 0.0 * lon, np.cos(lon) * np.cos(lat)
    bright = np.maximum(0.6 * up + 0.8 * front, 0.0)[..., None] ** 2 * np.array([1.5, 1.2, 0.9])
    write_image(folder / "sky.exr", (0.4 + 0.4 * up[..., None] + bright).astype(np.float32))
    return path
