"""Objects and local lights put elsewhere: `--move ball=0,1,2`.

    3 numbers   the new translation: the last column of the object's transform, a light's centre
    6 numbers   the rotation as well, degrees about the fixed x, then y, then z axes: R = Rz Ry Rx
    16 numbers  the whole transform, row by row (objects only)

The rotation that six numbers replace is the one nearest to the transform's linear part A = R P, P its scale (polar
decomposition); P stays. A rectangle's edges are turned from where the scene file has them.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from relightcli.core.affine import is_singular, transform_mesh
from relightcli.errors import InputError
from relightcli.scene.fields import did_you_mean
from relightcli.scene.model import Geometry, ObjectSpec, RectangleLight, Scene, SphereLight

COUNTS = (3, 6, 16)
F64 = NDArray[np.float64]


def parse_move(text: str) -> tuple[str, tuple[float, ...]]:
    """Name and numbers of a text `NAME=NUMBER,...`. Raises InputError."""
    name, equals, values = text.rpartition("=")
    try:
        numbers = tuple(float(part) for part in values.split(","))
    except ValueError:
        numbers = ()
    if not equals or not name.strip() or len(numbers) not in COUNTS or not np.isfinite(numbers).all():
        raise InputError(
            f"--move {text}: expected NAME=x,y,z, NAME=x,y,z,DEGREES,DEGREES,DEGREES, or NAME and the sixteen numbers "
            "of a matrix, row by row."
        )
    return name.strip(), numbers


def apply_moves(scene: Scene, moves: Iterable[str]) -> Scene:
    """The scene with rigid objects, or local lights, put elsewhere; applied in turn. A name means an object first.

    Raises InputError for unknown names, objects that do not move, and transforms that flatten an object.
    """
    objects, lights = dict(scene.objects), dict(scene.lights)
    for text in moves:
        name, numbers = parse_move(text)
        if name in objects:
            objects[name] = _moved_object(text, objects[name], scene.objects[name], numbers)
        elif name in lights:
            lights[name] = _moved_light(text, lights[name], scene.lights[name], numbers)
        else:
            known = [n for n, o in objects.items() if o.motion == "rigid"] + list(lights)
            raise InputError(
                f"--move {text}: no object or light {name!r}; what can be moved: {', '.join(known) or 'nothing'}."
                f"{did_you_mean(name, known)}"
            )
    return replace(scene, objects=objects, lights=lights)


def _moved_object(text: str, now: ObjectSpec, stored: ObjectSpec, numbers: tuple[float, ...]) -> ObjectSpec:
    if now.motion != "rigid":
        raise InputError(
            f"--move {text}: objects.{now.name}.motion is {now.motion!r}; expected 'rigid'. Set it in the scene file "
            "and precompute again."
        )
    matrix = now.transform.copy()
    if len(numbers) == 16:
        matrix = np.array(numbers).reshape(4, 4)
        if not np.array_equal(matrix[3], (0.0, 0.0, 0.0, 1.0)):
            raise InputError(f"--move {text}: expected a last row of 0,0,0,1; found {matrix[3].tolist()}.")
        if is_singular(matrix[:3, :3]):
            raise InputError(f"--move {text}: expected a matrix that does not flatten the object.")
    else:
        matrix[:3, 3] = numbers[:3]
    if len(numbers) == 6:
        matrix[:3, :3] = rotation(numbers[3:]) @ polar(stored.transform[:3, :3])[1]
    return replace(now, transform=matrix)


def _moved_light(
    text: str,
    now: SphereLight | RectangleLight,
    stored: SphereLight | RectangleLight,
    numbers: tuple[float, ...],
) -> SphereLight | RectangleLight:
    from relightcli.adapters.meshes import MAX_COORDINATE

    center = (numbers[0], numbers[1], numbers[2])
    if max(map(abs, center)) > MAX_COORDINATE:
        raise InputError(f"--move {text}: expected a centre within {MAX_COORDINATE:g}.")
    if len(numbers) == 3:
        return replace(now, center=center)
    if len(numbers) == 16 or isinstance(now, SphereLight) or isinstance(stored, SphereLight):
        shape, what = ("sphere", "3") if isinstance(now, SphereLight) else ("rectangle", "3 or 6")
        raise InputError(f"--move {text}: {now.name!r} is a {shape} light; expected {what} numbers.")
    turn = rotation(numbers[3:])
    u, v = (turn @ np.array(edge) for edge in (stored.edge_u, stored.edge_v))
    edge_u, edge_v = (float(u[0]), float(u[1]), float(u[2])), (float(v[0]), float(v[1]), float(v[2]))
    return replace(now, center=center, edge_u=edge_u, edge_v=edge_v)


def move_geometry(geometry: Geometry, before: Scene, after: Scene) -> Geometry:
    """The geometry of `before` with its objects where `after` has them: vertices by M' M^-1.

    Raises InputError where a move takes an object beyond the largest coordinate.
    """
    from relightcli.adapters.meshes import MAX_COORDINATE

    positions, normals, faces = geometry.positions.copy(), geometry.normals.copy(), geometry.faces.copy()
    for k, name in enumerate(geometry.object_names):
        old, new = before.objects[name].transform, after.objects[name].transform
        if np.array_equal(old, new):
            continue
        vertices, own = geometry.vertex_object == k, geometry.face_object == k
        moved, turned, wound = transform_mesh(
            new @ inverse_affine(old), positions[vertices], normals[vertices].astype(np.float64), faces[own]
        )
        if not (np.abs(moved) <= MAX_COORDINATE).all():
            raise InputError(f"--move: objects.{name}: the move takes its mesh beyond {MAX_COORDINATE:g}.")
        positions[vertices], normals[vertices], faces[own] = moved, turned, wound
    return replace(geometry, positions=positions, normals=normals, faces=faces)


def inverse_affine(matrix: F64) -> F64:
    """Inverse (4, 4) of an affine map whose last row is 0 0 0 1, the last row exact."""
    out = np.eye(4)
    out[:3, :3] = np.linalg.inv(matrix[:3, :3])
    out[:3, 3] = -out[:3, :3] @ matrix[:3, 3]
    return out


def polar(linear: F64) -> tuple[F64, F64]:
    """(R, P) with linear = R P: R a proper rotation (3, 3), P symmetric; negative definite if `linear` mirrors."""
    u, s, vt = np.linalg.svd(linear)
    sign = 1.0 if np.linalg.det(u @ vt) > 0.0 else -1.0
    return sign * (u @ vt), sign * (vt.T * s) @ vt


def rotation(degrees: Iterable[float]) -> F64:
    """Rotation (3, 3) about the fixed x, then y, then z axis: Rz Ry Rx. Quarter turns are exact."""
    out = np.eye(3)
    for axis, angle in enumerate(degrees):
        turn = np.remainder(angle, 360.0)
        quarter = {0.0: (0.0, 1.0), 90.0: (1.0, 0.0), 180.0: (0.0, -1.0), 270.0: (-1.0, 0.0)}
        sine, cosine = quarter.get(float(turn), (float(np.sin(np.radians(turn))), float(np.cos(np.radians(turn)))))
        i, j = (axis + 1) % 3, (axis + 2) % 3
        step = np.eye(3)
        step[i, i] = step[j, j] = cosine
        step[i, j], step[j, i] = -sine, sine
        out = step @ out
    return out


def angles(turn: F64) -> tuple[float, float, float]:
    """Degrees of `rotation` that give the rotation (3, 3). Where x and z turn about one axis, x is 0."""
    cosine = math.hypot(turn[0, 0], turn[1, 0])
    y = math.atan2(-turn[2, 0], cosine)  # the arcus sine knows half the digits of a turn by nearly 90 degrees
    x = math.atan2(turn[2, 1], turn[2, 2]) if cosine > 1e-14 else 0.0
    # What is left when x is turned back: near 90 degrees x and z apart are noise, but together they are not.
    s, c = math.sin(x), math.cos(x)
    z = math.atan2(s * turn[0, 2] - c * turn[0, 1], c * turn[1, 1] - s * turn[1, 2])
    return math.degrees(x), math.degrees(y), math.degrees(z)


def between(a: tuple[float, ...], b: tuple[float, ...], t: float) -> tuple[float, ...]:
    """A move between two of equally many numbers, t in 0..1: translation and scale linear, rotation by slerp."""
    mixed = tuple((1.0 - t) * x + t * y for x, y in zip(a, b, strict=True))
    if len(a) == 3:
        return mixed
    if len(a) == 6:
        return (*mixed[:3], *angles(slerp(rotation(a[3:]), rotation(b[3:]), t)))
    (turn_a, scale_a), (turn_b, scale_b) = (polar(np.array(m).reshape(4, 4)[:3, :3]) for m in (a, b))
    matrix = np.array(mixed).reshape(4, 4)
    matrix[:3, :3] = slerp(turn_a, turn_b, t) @ ((1.0 - t) * scale_a + t * scale_b)
    return tuple(matrix.reshape(-1).tolist())


def slerp(a: F64, b: F64, t: float) -> F64:
    """The rotation t of the shorter way from a to b: a turn by t times the angle of a^-1 b about its axis."""
    from scipy.spatial.transform import Rotation

    step = Rotation.from_matrix(a.T @ b).as_rotvec()
    out: F64 = a @ Rotation.from_rotvec(t * step).as_matrix()
    return out
