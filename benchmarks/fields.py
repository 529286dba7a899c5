"""Fields of moving objects: pictures a second of eight objects that all move."""

from __future__ import annotations

import time

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from benchmarks.processes import cores
from benchmarks.report import Report, Table, at_most
from benchmarks.scenes import Setting
from relightcli.adapters.rays import Tracer
from relightcli.core.fields.body import Body, make_body
from relightcli.core.fields.bounce import settle
from relightcli.core.fields.build import build_field
from relightcli.core.fields.chain import EVEN, incident
from relightcli.core.fields.compression import CompressedTransfer, compress
from relightcli.core.fields.entities import Entity, Surroundings, of_object
from relightcli.core.fields.shade import diffuse, make_receivers, never_negative
from relightcli.scene.model import Material

OBJECTS, VERTICES = 8, 40_000
MATERIALS = {
    "diffuse": Material("clay", diffuse=(0.7, 0.7, 0.7)),
    "glossy": Material("metal", "cook-torrance", (0.2, 0.2, 0.2), (0.6, 0.6, 0.6), f0=0.6, roughness=0.3),
}
FRAMES = 20


def lump(subdivisions: int) -> trimesh.Trimesh:
    """A ball with waves, about a sixth deep: it shades itself and reflects on itself."""
    mesh = trimesh.creation.icosphere(subdivisions)
    x, y, z = mesh.vertices.T
    return trimesh.Trimesh(mesh.vertices * (1 + 0.15 * np.sin(4 * x + z) * np.cos(5 * y))[:, None], mesh.faces)


def body_of(mesh: trimesh.Trimesh, material: Material) -> Body:
    normals = np.asarray(mesh.vertex_normals, np.float32)
    texture = np.ones((len(normals), 3), np.float32)
    vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int32)
    return make_body(vertices, normals, faces, False, texture, material, 4)


def sky() -> NDArray[np.float64]:
    """Light from above, bluish, and a little from everywhere."""
    out = np.zeros((3, 16))
    out[:, 0] = EVEN * np.array([0.9, 1.0, 1.2])
    out[:, 1] = 0.8
    return out


def measure(setting: Setting) -> Report:
    report = Report(
        "fields of moving objects, compressed to 1 % error: 16 shells of 6 x 16 x 16 samples, 8 proxies, order 4"
    )
    shells, resolution, rays, proxies = (6, 4, 64, 2) if setting.quick else (16, 16, 256, 8)
    mesh = lump(2 if setting.quick else 4)
    body = body_of(mesh, MATERIALS["diffuse"])
    field, own = build_field(Tracer(body.positions, body.faces), body, shells, resolution, proxies, rays=rays)
    made = compress(field.transfer.reshape(-1, *field.transfer.shape[2:]), tolerance=0.01)
    pictures(report, setting, body, of_object(field, _box(body), made), own.transfer, made)
    return report


def _box(body: Body) -> NDArray[np.float64]:
    return np.stack([body.positions.min(0), body.positions.max(0)])


def pictures(
    report: Report,
    setting: Setting,
    body: Body,
    own: Surroundings,
    transfer: NDArray[np.float32],
    made: CompressedTransfer,
) -> None:
    """Vertex colours of eight of the objects that all move and turn."""
    each = (800 if setting.quick else VERTICES) // OBJECTS
    chosen = np.arange(each) % len(body.point)
    receivers = make_receivers(body.normal[chosen], body.albedo[chosen], 4, transfer[chosen])
    skip = np.repeat(np.arange(OBJECTS, dtype=np.int32), each)
    threads, light = cores(), sky()
    rng = np.random.default_rng(1)
    home, turns = rng.normal(size=(OBJECTS, 3)) * 3.0, Rotation.random(OBJECTS, random_state=2)
    lights = None
    seconds, parts, passes, least, spent = [], [], [], 0.0, []
    hits = 0.0
    for frame in range(FRAMES + 2):
        places = home + 0.05 * frame * np.sin(np.arange(3 * OBJECTS).reshape(OBJECTS, 3))
        rotations = (Rotation.from_rotvec([0, 0.05 * frame, 0]) * turns).as_matrix()
        entities = [Entity(own, r, p) for r, p in zip(rotations, places, strict=True)]
        points = np.concatenate([body.point[chosen] @ e.rotation.T + e.translation for e in entities])
        clock, work = time.perf_counter(), time.process_time()
        settled = settle(entities, light, start=lights, threads=threads)
        middle = time.perf_counter()
        arriving = incident(entities, points, skip, light, settled.lights, threads=threads)
        shaded = time.perf_counter()
        for e, entity in enumerate(entities):
            part = slice(e * each, (e + 1) * each)
            _, low = never_negative(diffuse(receivers, arriving[part], entity.turn(4), threads))
            least = min(least, low)
        end, worked = time.perf_counter(), time.process_time()
        lights = settled.lights
        if frame >= 2:  # the first ones compile
            seconds.append(end - clock)
            spent.append(worked - work)
            parts.append((middle - clock, shaded - middle, end - shaded))
            passes.append(settled.bounces)
            hits = 1.0 - settled.samples_read / max(settled.reads, 1)
    median = float(np.median(seconds))
    report.rows.append(at_most(f"{OBJECTS * each} vertices, 8 objects that all move", 1e3 * median, "ms", 1e3 / 15))
    bounce, look, shade = 1e3 * np.median(parts, axis=0)
    rows = (
        ("all, ms of processor time", 1e3 * float(np.median(spent))),
        ("bouncing step, ms", float(bounce)),
        ("light at vertices, ms", float(look)),
        ("shading, ms", float(shade)),
        ("reflections to converge", float(np.mean(passes))),
        ("proxies: reads of a sample that another has made, %", 100 * hits),
        ("least radiance before it is cut to 0", least),
        ("MB of the field's transfer in memory", (made.component.nbytes + made.coefficient.nbytes) / 1e6),
    )
    report.tables.append(Table("one picture", ("what", "value"), rows))
