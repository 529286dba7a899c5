"""Small scenes for tests of the reference path tracer, made of arrays alone."""

from dataclasses import dataclass, field

import numpy as np

from relightcli.adapters.rays import Tracer
from relightcli.core.lights.latlong import make_latlong
from relightcli.core.transport.path_tracer import resolve, split_samples, trace_rows
from relightcli.core.transport.shading import shading_scene
from relightcli.scene.model import Camera, Geometry, Material

BLACK = np.zeros((1, 1, 3))


@dataclass
class Part:
    """One object: corners (V, 3), triangles (F, 3); without normals every face is flat and has corners of its own."""

    corners: np.ndarray
    triangles: np.ndarray
    normals: np.ndarray | None = None
    uvs: np.ndarray | None = None
    material: Material = field(default_factory=lambda: Material("m"))
    two_sided: bool = False
    texture: np.ndarray | None = None


def square(size=1.0, height=0.0, **kwargs):
    """A square in the xz plane around the y axis that faces up; uv runs with x and with -z."""
    h = 0.5 * size
    corners = np.array([[-h, height, h], [h, height, h], [h, height, -h], [-h, height, -h]])
    kwargs.setdefault("uvs", np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float))
    normals = np.tile([0.0, 1.0, 0.0], (4, 1))
    return Part(corners, np.array([[0, 1, 2], [0, 2, 3]]), normals, **kwargs)


def sphere_grid(rings, columns, low=0.0, high=np.pi):
    """Unit sphere between two polar angles (0 is +Y) as a grid: corners and outward triangles."""
    theta = np.linspace(low, high, rings + 1)
    phi = np.arange(columns) * 2 * np.pi / columns
    corners = np.stack(
        [
            np.outer(np.sin(theta), np.sin(phi)),
            np.outer(np.cos(theta), np.ones(columns)),
            np.outer(np.sin(theta), np.cos(phi)),
        ],
        -1,
    ).reshape(-1, 3)
    i, j = np.meshgrid(np.arange(rings), np.arange(columns), indexing="ij")
    a, b = i * columns + j, i * columns + (j + 1) % columns
    c, d = a + columns, b + columns
    triangles = np.concatenate([np.stack([a, c, d], -1).reshape(-1, 3), np.stack([a, d, b], -1).reshape(-1, 3)])
    return corners, triangles


def sphere(radius=1.0, center=(0.0, 0.0, 0.0), smooth=True, rings=64, **kwargs):
    corners, triangles = sphere_grid(rings, 2 * rings)
    return Part(corners * radius + np.array(center), triangles, corners if smooth else None, **kwargs)


def build(parts, lights=(), scale=1.0):
    """(ShadingScene, Tracer) of parts, in order; one material per part."""
    positions, normals, uvs, faces, objects, of_face = [], [], [], [], [], []
    start = 0
    for k, part in enumerate(parts):
        corners, triangles, vertex_normals, part_uvs = part.corners, part.triangles, part.normals, part.uvs
        if vertex_normals is None:
            corners = corners[triangles].reshape(-1, 3)
            e1, e2 = corners[1::3] - corners[::3], corners[2::3] - corners[::3]
            cross = np.cross(e1, e2)
            length = np.linalg.norm(cross, axis=1, keepdims=True)
            vertex_normals = np.repeat(cross / np.where(length > 0, length, 1), 3, axis=0)
            triangles = np.arange(len(corners)).reshape(-1, 3)
            part_uvs = None
        positions.append(corners)
        normals.append(vertex_normals)
        uvs.append(np.full((len(corners), 2), np.nan) if part_uvs is None else part_uvs)
        faces.append(triangles + start)
        objects.append(np.full(len(corners), k))
        of_face.append(np.full(len(triangles), k))
        start += len(corners)
    geometry = Geometry(
        tuple(str(k) for k in range(len(parts))),
        np.concatenate(positions) * scale,
        np.concatenate(normals).astype(np.float32),
        np.concatenate(uvs).astype(np.float32),
        np.concatenate(faces).astype(np.int32),
        np.concatenate(objects).astype(np.int32),
        np.concatenate(of_face).astype(np.int32),
        np.arange(len(parts), dtype=np.int32),
        np.array([part.two_sided for part in parts]),
        {k: part.texture.astype(np.float32) for k, part in enumerate(parts) if part.texture is not None},
    )
    return shading_scene(geometry, [part.material for part in parts], lights), Tracer(
        geometry.positions, geometry.faces
    )


def render(
    parts, camera, environment=BLACK, lights=(), spp=256, bounces=0, seed=0, background=False, rotate=0.0, scale=1.0
):
    scene, tracer = build(parts, lights, scale)
    passes, per_pass = split_samples(spp)
    sky = make_latlong(environment, rotate)
    tile = trace_rows(scene, tracer, sky, camera, (0, camera.size[1]), (0, passes), per_pass, bounces, seed, background)
    return resolve(tile)


def looking_down(size=(8, 8), height=2.0, width=1.0):
    """A camera above the origin that sees the square of side `width` in the plane y = 0, exactly."""
    fov = float(np.degrees(2 * np.arctan(0.5 * width / height)))
    return Camera("c", (0.0, height, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, -1.0), fov, size)


def at_point(eye, target, size=(4, 4)):
    """A camera that sees nothing but a spot of 1e-6 radians."""
    up = (0.0, 1.0, 0.0) if abs(eye[0] - target[0]) + abs(eye[2] - target[2]) > 0 else (0.0, 0.0, -1.0)
    return Camera("c", tuple(map(float, eye)), tuple(map(float, target)), up, 1e-4, size)


def mean_and_error(picture):
    """Mean of the beauty over pixels, and its standard error by the picture's own variance, both (3,)."""
    pixels = picture.beauty.shape[0] * picture.beauty.shape[1]
    mean = picture.beauty.astype(np.float64).mean((0, 1))
    return mean, np.sqrt(picture.variance.astype(np.float64).sum((0, 1))) / pixels


def lambert(albedo):
    return Material("m", diffuse=(albedo,) * 3 if np.isscalar(albedo) else tuple(albedo))
