"""Sensors against the 2306 patches of a Reinhart sky (MF:4 and the ground), against Radiance's rfluxmtx.

A row holds the irradiance that a sensor gets directly from every patch of radiance 1. rfluxmtx sends 1024 rays a
sensor; ours traces the texels of a cube and shares each among the patches it overlaps. Both are judged twice, against
R = 256 with every texel traced: by the entries of the matrix, and by the irradiance under an overcast sky, whose
radiance depends on the height alone. A comparison is one at equal error where ours is larger in neither.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from benchmarks.processes import cores, meet, run_program, together
from benchmarks.receivers import Traceable, read_traceable, sample, share
from benchmarks.report import Report, Row, Table, faster
from benchmarks.scenes import Setting, main_store, write_scene
from relightcli.core.bits import trailing_zeros

MF = 4
TREGENZA = (30, 30, 24, 24, 18, 12, 6)  # patches in a row, from the horizon up
PATCHES = 2306
RAYS = 1024
RESOLUTION, REFINE = 32, 4  # traces about as many rays
COARSE = 16  # the matrix alone, at equal error of its entries
GROUND = 0.2  # radiance of the ground patch
SKY = """\
#@rfluxmtx h=u u=Y
void glow ground_glow 0 0 4 1 1 1 0
ground_glow source ground 0 0 4 0 0 -1 180

#@rfluxmtx h=r4 u=+Y
void glow sky_glow 0 0 4 1 1 1 0
sky_glow source sky 0 0 4 0 0 1 180
"""
# Of some sensors: which, their irradiance, and the rows of those among them that are to be judged.
Parts = list[tuple[slice, NDArray[np.float64], NDArray[np.float32]]]


@dataclass(frozen=True)
class Found:
    """Seconds until the last process was done, CPU seconds and rays of all, irradiances (N,), and the judged rows of
    the matrix."""

    seconds: float
    cpu_seconds: float
    rays: int
    irradiance: NDArray[np.float64]
    entries: NDArray[np.float32]


BLACK = "void plastic black 0 0 5 0 0 0 0 0\n\n"


def patch_rows() -> tuple[NDArray[np.int64], float]:
    """Patches in each row from the horizon to the zenith, and the rows' height in radians. [reinhart.cal]"""
    counts = np.append(np.repeat(np.array(TREGENZA) * MF, MF), 1)
    return counts, np.radians(90.0 / (MF * 7 + 0.5))


def patch_of(directions: NDArray[np.float64]) -> NDArray[np.int64]:
    """Patch (N,) of unit directions (N, 3), +Y up: 0 the ground, then rows from the horizon up. [reinhart.cal]

    In Radiance's frame (x east, y north, z up) our (x, y, z) is (x, -z, y); azimuth runs from north to east.
    """
    counts, alpha = patch_rows()
    first = 1 + np.concatenate([[0], np.cumsum(counts)[:-1]])
    altitude = np.arcsin(np.clip(directions[:, 1], -1.0, 1.0))
    row = np.clip(np.floor(altitude / alpha).astype(np.int64), 0, len(counts) - 1)
    azimuth = np.mod(np.arctan2(directions[:, 0], -directions[:, 2]), 2.0 * np.pi)
    step = 2.0 * np.pi / counts[row]
    column = np.floor((azimuth + 0.5 * step) / step).astype(np.int64) % counts[row]
    return np.where(altitude < 0, 0, first[row] + column)


def overcast() -> NDArray[np.float64]:
    """Radiance of every patch, (2306,): (1 + 2 sin of the height of the row's middle) / 3, and the ground's."""
    counts, alpha = patch_rows()
    height = np.minimum((np.arange(len(counts)) + 0.5) * alpha, 0.5 * np.pi)
    return np.concatenate([[GROUND], np.repeat((1.0 + 2.0 * np.sin(height)) / 3.0, counts)])


def overlaps(resolution: int, fine: int) -> Any:
    """Sparse rows (texels, 2306): which share of each texel lies in each patch, by fine x fine points in a texel."""
    from scipy.sparse import coo_matrix

    from relightcli.core.sphere import cube

    r = resolution * fine
    texel = np.arange(6 * resolution * resolution).reshape(6, resolution, resolution)
    of_point = np.repeat(np.repeat(texel, fine, axis=1), fine, axis=2).reshape(-1)
    patch = patch_of(cube.texel_directions(r).reshape(-1, 3))
    shape = (6 * resolution * resolution, PATCHES)
    return coo_matrix((np.full(len(patch), 1.0 / fine**2, np.float32), (of_point, patch)), shape).tocsr()


@njit(cache=True)
def _bin(words, normals, directions, solid_angle, start, patch, share_of, out):  # type: ignore[no-untyped-def]
    """out (N, 2306) += cosine times solid angle of every visible texel, shared among its patches."""
    area = len(solid_angle)
    for i in range(len(words)):
        x, y, z = normals[i, 0], normals[i, 1], normals[i, 2]
        for w in range(words.shape[1]):
            word = words[i, w]
            while word != np.uint64(0):
                t = 64 * w + trailing_zeros(word)
                word &= word - np.uint64(1)
                flux = (x * directions[t, 0] + y * directions[t, 1] + z * directions[t, 2]) * solid_angle[t % area]
                for k in range(start[t], start[t + 1]):
                    out[i, patch[k]] += flux * share_of[k]


def our_matrix(
    rank: int, count: int, points: Traceable, resolution: int, refine: int, judged: NDArray[np.intp]
) -> tuple[float, float, int, Parts]:
    """Seconds, CPU seconds and rays of this process's share, and what it found."""
    from relightcli.core.sphere import cube
    from relightcli.core.transport.visibility import trace_visibility

    tracer = points.tracer()
    weights = overlaps(resolution, max(1, 256 // resolution))
    directions = cube.texel_directions(resolution).reshape(-1, 3).astype(np.float32)
    solid_angle = cube.solid_angles(resolution).astype(np.float32).reshape(-1)
    sky = overcast()
    rays = 0

    def rows(part: slice) -> NDArray[np.float32]:
        nonlocal rays
        normal = points.normal[part]
        block = trace_visibility(tracer, points.position[part], normal, resolution, refine, int(part.start))
        rays += block.rays
        words = block.bits.reshape(len(normal), -1).view(np.uint64)
        out = np.zeros((len(normal), PATCHES), np.float32)
        _bin(words, normal, directions, solid_angle, weights.indptr, weights.indices, weights.data, out)
        return out

    rows(slice(0, min(64, len(points.position))))
    rays = 0
    kept = np.zeros(len(points.position), bool)
    kept[judged] = True
    meet()
    clock, cpu = time.perf_counter(), time.process_time()
    done = [(part, rows(part)) for part in share(len(points.position), rank, count, 64)]
    seconds, cpu = time.perf_counter() - clock, time.process_time() - cpu
    return seconds, cpu, rays, [(part, matrix @ sky, matrix[kept[part]]) for part, matrix in done]


def collect(results: list[tuple[float, float, int, Parts]], count: int) -> Found:
    irradiance = np.empty(count)
    entries = []
    for *_, parts in results:
        for rows, values, matrix in parts:
            irradiance[rows] = values
            entries.append((rows.start, matrix))
    matrix = np.concatenate([some for _, some in sorted(entries, key=lambda entry: entry[0])])
    return Found(max(r[0] for r in results), sum(r[1] for r in results), sum(r[2] for r in results), irradiance, matrix)


def radiance_folder() -> Path | None:
    """Where the package `pyradiance` keeps Radiance's programs, None if it is not installed."""
    spec = find_spec("pyradiance")
    if spec is None or not spec.submodule_search_locations:
        return None
    folder = Path(spec.submodule_search_locations[0])
    return folder if (folder / "bin" / "rfluxmtx").exists() else None


def write_radiance(points: Traceable, folder: Path) -> None:
    """The mesh as black polygons, z up."""
    corners = points.mesh[points.faces][:, :, [0, 2, 1]] * np.array([1.0, -1.0, 1.0])
    body = "\n".join(
        f"black polygon p{k} 0 0 9 " + " ".join(f"{x:.9g}" for x in nine)
        for k, nine in enumerate(corners.reshape(-1, 9).tolist())
    )
    (folder / "scene.rad").write_text(BLACK + body + "\n")
    (folder / "sky.rad").write_text(SKY)


def their_matrix(points: Traceable, installed: Path, folder: Path, processes: int) -> Found:
    """rfluxmtx; its seconds beyond its start-up."""
    program = installed / "bin"
    env = {"RAYPATH": str(installed / "lib"), "PATH": f"{program}:/usr/bin:/bin"}
    lift = 1e-5 * float(np.ptp(points.mesh, axis=0).max())
    place, normal = points.position + lift * points.normal, points.normal.astype(np.float64)
    sensors = np.concatenate([place, normal], axis=1)[:, [0, 2, 1, 3, 5, 4]] * np.array([1, -1, 1, 1, -1, 1])
    options = ("-h", "-faf", "-I+", "-V-", "-ab", "1", "-ad", str(RAYS), "-lw", "1e-6", "-c", "1", "-n", str(processes))

    def run(some: NDArray[np.float64]) -> tuple[float, float, NDArray[np.float32]]:
        text = "\n".join(" ".join(f"{x:.9g}" for x in line) for line in some.tolist()) + "\n"
        command = (program / "rfluxmtx", *options, "-y", str(len(some)), "-", folder / "sky.rad", folder / "scene.rad")
        finished = run_program(*command, stdin=text.encode(), env=env)
        return (
            finished.seconds,
            finished.cpu_seconds,
            np.frombuffer(finished.stdout, np.float32).reshape(len(some), PATCHES, 3),
        )

    start_up, start_cpu, _ = run(sensors[:1])
    seconds, cpu, matrix = run(sensors)
    entries = matrix[:, :, 1]  # grey: all colours are equal
    return Found(
        seconds - start_up, cpu - start_cpu, RAYS * len(sensors), entries.astype(np.float64) @ overcast(), entries
    )


def relative(a: NDArray[np.floating], b: NDArray[np.floating]) -> float:
    """Relative RMS error of a, summed in float64."""
    a, b = a.astype(np.float64), b.astype(np.float64)
    return float(np.linalg.norm(a - b) / np.linalg.norm(b))


def measure(setting: Setting) -> Report:
    _, subject = write_scene(setting)
    points = read_traceable(main_store(setting))
    points = points.at(sample(len(points.position), 512 if setting.quick else 8192))
    count = len(points.position)
    report = Report(f"{subject}, {count:,} sensors x {PATCHES} patches, direct")
    rows = sample(count, 128 if setting.quick else 1024)
    every = np.arange(len(rows))
    truth = collect(together(our_matrix, points.at(rows), 64 if setting.quick else 256, 1, every), len(rows))

    def errors(irradiance: NDArray[np.float64], entries: NDArray[np.float32]) -> tuple[float, float]:
        return relative(entries, truth.entries), relative(irradiance, truth.irradiance)

    ours = {}
    for resolution in (RESOLUTION, COARSE):
        found = collect(together(our_matrix, points, resolution, REFINE, rows), count)
        ours[resolution] = (found, errors(found.irradiance[rows], found.entries))
    table: list[tuple[str | int | float, ...]] = [
        (
            f"ours, R = {r}",
            count,
            count / f.seconds,
            1e3 * f.cpu_seconds / count,
            f.rays / count,
            *(100 * e for e in error),
        )
        for r, (f, error) in ours.items()
    ]
    installed = radiance_folder()
    theirs = None
    if installed is None:
        report.skipped.append("rfluxmtx is not installed: pip install 'relightcli[bench]' (package pyradiance)")
    else:
        write_radiance(points, setting.work)
        theirs = their_matrix(points.at(rows), installed, setting.work, cores())
        their_errors, their_rate = errors(theirs.irradiance, theirs.entries), len(rows) / theirs.seconds
        cpu = 1e3 * theirs.cpu_seconds / len(rows)
        table.append((f"rfluxmtx -ad {RAYS}", len(rows), their_rate, cpu, RAYS, *(100 * e for e in their_errors)))
    for resolution, (found, error) in ours.items():
        rate = count / found.seconds
        work = f"sensors, R = {resolution}, {found.rays / count:.0f} rays each, {_told(error)}"
        if theirs is None:
            report.rows.append(Row(work, rate, "sensors/s"))
            continue
        against = f"rfluxmtx, {cores()} processes, {RAYS} rays, {_told(their_errors)}: {their_rate:.3g} sensors/s"
        row = faster(work, rate, "sensors/s", against, rate / their_rate, 20)
        # With more of either error it is no comparison at equal error: no target.
        equal = all(a <= b for a, b in zip(error, their_errors, strict=True))
        report.rows.append(row if equal else replace(row, target="", met=None))
    columns = (
        *("method", "sensors", "sensors/s", "CPU ms a sensor", "rays a sensor"),
        *("error of entries, %", "of irradiance, %"),
    )
    report.tables.append(Table("speed and relative RMS error", columns, tuple(table)))
    return report


def _told(errors: tuple[float, float]) -> str:
    return f"error {errors[0]:.1%} of entries, {errors[1]:.2%} of irradiance"
