"""A new picture under a new sky against Mitsuba 3, at equal error.

Mitsuba's error at n samples a pixel comes from pairs of independent pictures, |a - b|^2 / 2, and is carried to other n
by the slope -1/2 of Monte Carlo integration; ours comes from two independent long runs of Mitsuba as
(ours - A)(ours - B), in which the noise of A and of B averages to nothing. Neither side counts loading or compiling.
"""

from __future__ import annotations

import json
import math
import statistics
import sys
import time
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.processes import cores, run_program
from benchmarks.report import Report, Row, Table, faster
from benchmarks.scenes import Setting, main_store, two_skies, write_scene

VARIANTS = ("llvm_ad_rgb", "scalar_rgb")  # the first that works; an unsuitable libLLVM ends the process
CAMERA = "square"
TARGET_ERROR, TARGET_RATIO = 0.02, 100.0


def our_pictures(store: Path, sky: Path) -> tuple[NDArray[np.float32], float, float]:
    """Our picture (H, W, 3); seconds for it with the store and the view at hand; seconds to open those."""
    from relightcli.adapters.images import read_environment
    from relightcli.adapters.rays import Tracer
    from relightcli.core.shade import picture, primary
    from relightcli.core.transport.camera import make_film
    from relightcli.stages.lighting import LightingStore

    clock = time.perf_counter()
    lighting = LightingStore(store, cores())
    geometry, materials = lighting.geometry, lighting.scene.materials
    camera = lighting.scene.cameras[CAMERA]
    width, height = camera.size
    normals = primary.face_normals(geometry.positions, geometry.faces)
    tracer = Tracer(geometry.positions, geometry.faces)
    samples = primary.see(tracer, make_film(camera), geometry.face_object, normals)
    front, back = lighting.receiver_of_vertex()
    matrix = picture.vertex_matrix(geometry, samples, normals, front, back, lighting.buried(), width * height)
    active = matrix.used(len(lighting))
    environment = read_environment(sky)

    def frame(rotate: float) -> NDArray[np.float32]:
        radiance = lighting.exit_radiance(environment, rotate, materials, None, active)[0]
        out: NDArray[np.float32] = picture.assemble(matrix, radiance.diffuse, None, cores())
        return out.reshape(height, width, 3)

    frame(30.0)  # reads the bits, compiles
    opened = time.perf_counter() - clock
    seconds = []
    for rotate in (60.0, 120.0, 180.0, 240.0, 0.0):
        clock = time.perf_counter()
        image = frame(rotate)
        seconds.append(time.perf_counter() - clock)
    return image, statistics.median(seconds), opened


def export(store: Path, sky: Path, out: Path) -> None:
    """What Mitsuba needs, as one file of arrays: the scene before faces were cut, its normals, the sky."""
    import relight_formats as formats
    from relightcli.adapters.images import read_environment
    from relightcli.stages.lighting import read_scene

    opened = formats.open_store(store)
    scene, geometry = read_scene(opened)
    faces = opened.read("source/face") if "source/face" in opened else geometry.faces
    materials = list(scene.materials.values())
    arrays: dict[str, Any] = {"sky": bilinear_map(read_environment(sky))}
    for k, _ in enumerate(geometry.object_names):
        own = faces[geometry.vertex_object[faces[:, 0]] == k]
        used, index = np.unique(own, return_inverse=True)
        arrays[f"position{k}"] = geometry.positions[used].astype(np.float32)
        arrays[f"normal{k}"] = geometry.normals[used]
        arrays[f"face{k}"] = index.reshape(-1, 3).astype(np.int32)
        arrays[f"albedo{k}"] = np.array(materials[geometry.material[k]].diffuse)
    camera = scene.cameras[CAMERA]
    arrays["camera"] = np.array([*camera.eye, *camera.target, *camera.up, camera.fov, *camera.size])
    np.savez(out, **arrays)


def bilinear_map(sky: NDArray[np.float32]) -> NDArray[np.float32]:
    """A map that is nearly constant over each pixel of ours where Mitsuba interpolates it: every pixel twice each way,
    rows at the borders and middles of ours, because Mitsuba's first and last row lie at the poles."""
    wide = np.repeat(sky, 2, axis=1)
    rows = np.empty((2 * len(sky) + 1, *wide.shape[1:]), np.float32)
    rows[1::2] = wide
    rows[0], rows[-1] = wide[0], wide[-1]
    rows[2:-1:2] = 0.5 * (wide[1:] + wide[:-1])
    return rows


def render(exported: Path, out: Path, variant: str, quick: bool) -> tuple[dict[str, Any] | None, str]:
    """Mitsuba in a process of its own; what it measured, or None and why not."""
    command = (sys.executable, "-m", "benchmarks.mitsuba_peer", exported, out, variant, "quick" if quick else "full")
    try:
        return json.loads(run_program(*command).stdout), ""
    except RuntimeError as error:
        return None, str(error).strip().split("\n")[-1]


def measure(setting: Setting) -> Report:
    _, subject = write_scene(setting)
    report = Report(f"{subject}, {setting.side}x{setting.side}, direct light, a new sky")
    if find_spec("mitsuba") is None:
        report.skipped.append("mitsuba is not installed: pip install 'relightcli[bench]'")
        return report
    store = main_store(setting)
    precompute = json_seconds(store)
    variants = list(VARIANTS)
    rows: list[tuple[str | int | float, ...]] = []
    for name, sky in two_skies(setting).items():
        exported, out = setting.work / "mitsuba-in.npz", setting.work / "mitsuba-out.npz"
        export(store, sky, exported)
        found = None
        while found is None and variants:
            found, why = render(exported, out, variants[0], setting.quick)
            if found is None:
                report.skipped.append(f"Mitsuba's variant {variants.pop(0)} does not run here: {why}")
        if found is None:
            return report
        ours, seconds, opened = our_pictures(store, sky)
        halves = np.load(out)
        a, b = halves["a"].astype(np.float64), halves["b"].astype(np.float64)
        power = float(np.mean(a * b))
        error = math.sqrt(max(0.0, float(np.mean((ours - a) * (ours - b)))) / power)
        theirs = found["error_at_one"] / math.sqrt(found["spp"])
        # Where ours is better than asked, the peer need not be.
        asked = max(error, TARGET_ERROR)
        at_asked, at_equal = seconds_at(found, asked), seconds_at(found, max(error, 1e-6))
        peer = f"Mitsuba ({variants[0]})"
        report.rows += [
            against_mitsuba(
                f"{name}: a frame, error {error:.2%}",
                seconds,
                f"{peer}, error {asked:.2%}: {at_asked:.3g} s",
                at_asked / seconds,
                variants[0],
            ),
            Row(f"{name}: the same, equal error", seconds, "s", f"{peer}: {at_equal:.3g} s", at_equal / seconds),
            Row(
                f"{name}: precomputation ({precompute:.1f} s) has paid for itself after",
                precompute / max(at_asked - seconds, 1e-9),
                "pictures",
            ),
        ]
        rows += [
            (name, f"Mitsuba {variants[0]}", found["spp"], found["seconds"], 100 * theirs),
            (name, "relight, store open", "", seconds, 100 * error),
            (name, "relight, opening store and view", "", opened, ""),
        ]
    report.tables.append(
        Table("as measured", ("sky", "program", "samples a pixel", "seconds", "error, %"), tuple(rows))
    )
    return report


def against_mitsuba(work: str, seconds: float, against: str, ratio: float, variant: str) -> Row:
    """The row with the target; against the slow variant nothing is claimed."""
    if variant == VARIANTS[0]:
        return faster(work, seconds, "s", against, ratio, TARGET_RATIO)
    return Row(work, seconds, "s", against, ratio, f">= {TARGET_RATIO:g}x of {VARIANTS[0]}")


def seconds_at(found: dict[str, Any], error: float) -> float:
    """Mitsuba's time to a relative error: n = (c / error)^2 samples a pixel at t0 + n t1 seconds."""
    samples: float = max(1.0, (found["error_at_one"] / error) ** 2)
    return float(found["seconds_fixed"] + samples * found["seconds_per_sample"])


def json_seconds(store: Path) -> float:
    """What making the store took."""
    import relight_formats as formats

    return float(formats.open_store(store).summary["seconds"])
