"""What a ray finds: a scene as the arrays that kernels read, and the surface point behind every hit."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from relightcli.core.brdf.models import DIFFUSE, Triple, pack_materials
from relightcli.core.sphere.lattice import r2_point
from relightcli.core.transport.local_lights import LocalLights, pack_lights
from relightcli.scene.model import Geometry, Material, RectangleLight, SphereLight

TEXTURE_POINTS = 32  # of every textured face


class ShadingScene(NamedTuple):
    """Axes: V vertices, F faces, M materials.

    positions (V, 3) float64, normals (V, 3) float32, uvs (V, 2) float32 (NaN: none), faces (F, 3) int32
    face_material (F,) int32, face_two_sided (F,) bool
    model (M,) int32, parameters (M, PARAMETERS) float64: see `brdf.models.MaterialTable`
    texture (M, 3) int64: first texel (-1: none), height, width; texels (T, 3) float32 linear RGB
    lights: local lights
    """

    positions: NDArray[np.float64]
    normals: NDArray[np.float32]
    uvs: NDArray[np.float32]
    faces: NDArray[np.int32]
    face_material: NDArray[np.int32]
    face_two_sided: NDArray[np.bool_]
    model: NDArray[np.int32]
    parameters: NDArray[np.float64]
    texture: NDArray[np.int64]
    texels: NDArray[np.float32]
    lights: LocalLights


class Surface(NamedTuple):
    """Points of the front of surfaces, N of them, as structure of arrays, float64.

    position, shading (unit, interpolated), geometric (unit, the face's, on the viewer's side), viewer (unit, towards
    it), albedo (diffuse times texture), throughput: (N, 3); material (N,) int32; path (N,) int64, the path that each
    belongs to.
    """

    position: NDArray[np.float64]
    shading: NDArray[np.float64]
    geometric: NDArray[np.float64]
    viewer: NDArray[np.float64]
    albedo: NDArray[np.float64]
    throughput: NDArray[np.float64]
    material: NDArray[np.int32]
    path: NDArray[np.int64]


def shading_scene(
    geometry: Geometry, materials: Sequence[Material], lights: Iterable[SphereLight | RectangleLight] = ()
) -> ShadingScene:
    """Bundle a scene for the path tracer. `materials` in the order that `geometry.material` counts in."""
    table = pack_materials(materials)
    texture = np.full((len(materials), 3), -1, np.int64)
    texels: list[NDArray[np.float32]] = [np.zeros((0, 3), np.float32)]
    start = 0
    for index, image in sorted(geometry.textures.items()):
        height, width = image.shape[:2]
        texture[index] = start, height, width
        texels.append(np.ascontiguousarray(image, np.float32).reshape(-1, 3))
        start += height * width
    return ShadingScene(
        np.ascontiguousarray(geometry.positions, np.float64),
        np.ascontiguousarray(geometry.normals, np.float32),
        np.ascontiguousarray(geometry.uvs, np.float32),
        np.ascontiguousarray(geometry.faces, np.int32),
        geometry.material[geometry.face_object].astype(np.int32),
        geometry.two_sided[geometry.face_object],
        table.model,
        table.parameters,
        texture,
        np.concatenate(texels),
        pack_lights(lights),
    )


def white_scene(geometry: Geometry) -> ShadingScene:
    """The scene in white: what comes back as albedo is the texture alone."""
    return shading_scene(geometry, [Material("", diffuse=(1.0, 1.0, 1.0))] * (int(geometry.material.max()) + 1))


def vertex_colours(geometry: Geometry) -> NDArray[np.float32]:
    """Mean texture around every vertex, (V, 3) float32, 1 where there is none.

    The mean is over the faces at the vertex, weighted by its barycentric coordinate: interpolating the vertices'
    colours keeps the texture's integral over every object.
    """
    out = np.zeros((len(geometry.positions), 4))
    _add_texture(white_scene(geometry), TEXTURE_POINTS, out)
    weight = out[:, 3:]
    colours: NDArray[np.float64] = np.divide(out[:, :3], weight, out=np.ones((len(out), 3)), where=weight > 0)
    return colours.astype(np.float32)


@njit(cache=True, error_model="numpy")
def _add_texture(scene: ShadingScene, points: int, out: Any) -> None:
    """Adds texture times weight and weight of evenly spread points of every textured face to its corners."""
    p = scene.positions
    for f in range(len(scene.faces)):
        material = scene.face_material[f]
        first, height, width = scene.texture[material]
        if first < 0:
            continue
        a, b, c = scene.faces[f]
        e1, e2 = p[b] - p[a], p[c] - p[a]
        area = math.sqrt(
            (e1[1] * e2[2] - e1[2] * e2[1]) ** 2
            + (e1[2] * e2[0] - e1[0] * e2[2]) ** 2
            + (e1[0] * e2[1] - e1[1] * e2[0]) ** 2
        )
        for k in range(points):
            u, v = r2_point(k)
            if u + v > 1.0:
                u, v = 1.0 - u, 1.0 - v
            w = 1.0 - u - v
            s = w * scene.uvs[a, 0] + u * scene.uvs[b, 0] + v * scene.uvs[c, 0]
            t = w * scene.uvs[a, 1] + u * scene.uvs[b, 1] + v * scene.uvs[c, 1]
            if not (math.isfinite(s) and math.isfinite(t)):
                continue
            colour = bilinear(scene.texels, first, height, width, s, t)
            for corner, share in ((a, w * area), (b, u * area), (c, v * area)):
                for x in range(3):
                    out[corner, x] += share * colour[x]
                out[corner, 3] += share


@njit(cache=True, error_model="numpy")
def bilinear(texels: Any, first: int, height: int, width: int, u: float, v: float) -> Triple:
    """Texture at (u, v): bilinear between texel centres, repeating; (0, 0) is the bottom left corner of the image."""
    x = (u - math.floor(u)) * width - 0.5
    y = (1.0 - (v - math.floor(v))) * height - 0.5
    column, row = math.floor(x), math.floor(y)
    fx, fy = x - column, y - row
    left, right = int(column) % width, (int(column) + 1) % width
    top, bottom = first + (int(row) % height) * width, first + ((int(row) + 1) % height) * width
    a, b, c, d = texels[top + left], texels[top + right], texels[bottom + left], texels[bottom + right]
    wa, wb, wc, wd = (1.0 - fx) * (1.0 - fy), fx * (1.0 - fy), (1.0 - fx) * fy, fx * fy
    return (
        wa * a[0] + wb * b[0] + wc * c[0] + wd * d[0],
        wa * a[1] + wb * b[1] + wc * c[1] + wd * d[1],
        wa * a[2] + wb * b[2] + wc * c[2] + wd * d[2],
    )


def surface_at(
    scene: ShadingScene,
    face: NDArray[np.int32],
    u: NDArray[np.float32],
    v: NDArray[np.float32],
    direction: NDArray[np.float64],
    throughput: NDArray[np.float64],
    path: NDArray[np.int64],
) -> Surface:
    """Surface points of the rays that hit the front of a face (or any side of a two-sided one).

    face (N,), -1 for a miss; u, v (N,) barycentric weights of the face's second and third corner; direction (N, 3)
    unit, of the ray; throughput (N, 3) and path (N,) are passed through. Back faces, and points whose shading normal
    looks away from the viewer, send nothing and are left out, as are paths without throughput. Order is kept.
    """
    n = len(face)
    vectors = np.empty((6, n, 3))
    material, paths = np.empty(n, np.int32), np.empty(n, np.int64)
    position, shading, geometric, viewer, albedo, gain = vectors
    out = Surface(position, shading, geometric, viewer, albedo, gain, material, paths)
    m = _fill_surface(scene, face, u, v, direction, throughput, path, out)
    return Surface._make(x[:m] for x in out)


@njit(cache=True, error_model="numpy")
def _fill_surface(
    scene: ShadingScene, face: Any, bu: Any, bv: Any, direction: Any, throughput: Any, path: Any, out: Surface
) -> int:
    m = 0
    for i in range(len(face)):
        f = face[i]
        if f < 0 or (throughput[i, 0] == 0.0 and throughput[i, 1] == 0.0 and throughput[i, 2] == 0.0):
            continue
        a, b, c = scene.faces[f, 0], scene.faces[f, 1], scene.faces[f, 2]
        u, v = float(bu[i]), float(bv[i])
        w = 1.0 - u - v
        p = scene.positions
        e1 = (p[b, 0] - p[a, 0], p[b, 1] - p[a, 1], p[b, 2] - p[a, 2])
        e2 = (p[c, 0] - p[a, 0], p[c, 1] - p[a, 1], p[c, 2] - p[a, 2])
        gx = e1[1] * e2[2] - e1[2] * e2[1]
        gy = e1[2] * e2[0] - e1[0] * e2[2]
        gz = e1[0] * e2[1] - e1[1] * e2[0]
        facing = -(gx * direction[i, 0] + gy * direction[i, 1] + gz * direction[i, 2])
        side = 1.0
        if not facing > 0.0:
            if not (scene.face_two_sided[f] and facing < 0.0):
                continue
            side = -1.0
        g_length = side * math.sqrt(gx * gx + gy * gy + gz * gz)
        q = scene.normals
        nx = w * q[a, 0] + u * q[b, 0] + v * q[c, 0]
        ny = w * q[a, 1] + u * q[b, 1] + v * q[c, 1]
        nz = w * q[a, 2] + u * q[b, 2] + v * q[c, 2]
        n_length = side * math.sqrt(nx * nx + ny * ny + nz * nz)
        if n_length == 0.0:
            # Opposite vertex normals can cancel: the face's own is all that is left.
            nx, ny, nz, n_length = gx, gy, gz, g_length
        if not -(nx * direction[i, 0] + ny * direction[i, 1] + nz * direction[i, 2]) / n_length > 0.0:
            continue
        for k in range(3):
            out.position[m, k] = p[a, k] + u * e1[k] + v * e2[k]
            out.viewer[m, k] = -direction[i, k]
            out.throughput[m, k] = throughput[i, k]
        out.geometric[m, 0], out.geometric[m, 1], out.geometric[m, 2] = gx / g_length, gy / g_length, gz / g_length
        out.shading[m, 0], out.shading[m, 1], out.shading[m, 2] = nx / n_length, ny / n_length, nz / n_length
        material = scene.face_material[f]
        row = scene.parameters[material]
        r, g, bl = row[DIFFUSE], row[DIFFUSE + 1], row[DIFFUSE + 2]
        first = scene.texture[material, 0]
        if first >= 0:
            s = w * scene.uvs[a, 0] + u * scene.uvs[b, 0] + v * scene.uvs[c, 0]
            t = w * scene.uvs[a, 1] + u * scene.uvs[b, 1] + v * scene.uvs[c, 1]
            if math.isfinite(s) and math.isfinite(t):
                colour = bilinear(scene.texels, first, scene.texture[material, 1], scene.texture[material, 2], s, t)
                r, g, bl = r * colour[0], g * colour[1], bl * colour[2]
        out.albedo[m, 0], out.albedo[m, 1], out.albedo[m, 2] = r, g, bl
        out.material[m] = material
        out.path[m] = path[i]
        m += 1
    return m
