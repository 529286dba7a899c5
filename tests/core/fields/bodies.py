"""Bodies for tests of fields, made of arrays alone."""

from __future__ import annotations

import numpy as np

from relightcli.adapters.rays import Tracer
from relightcli.core.fields.body import make_body
from relightcli.scene.model import Material
from tests.core.transport.scenes import sphere_grid

EVEN = np.sqrt(4.0 * np.pi)  # coefficient 0 of unit radiance from everywhere


def grey(albedo):
    return Material("m", diffuse=(albedo,) * 3)


def body_of(corners, triangles, normals, material, order=4, two_sided=False):
    white = np.ones((len(corners), 3), np.float32)
    corners, triangles = np.asarray(corners, np.float64), np.asarray(triangles, np.int32)
    return make_body(corners, np.asarray(normals, np.float32), triangles, two_sided, white, material, order)


def ball(material, rings=16, radius=1.0, center=(0, 0, 0), order=4):
    corners, triangles = sphere_grid(rings, 2 * rings)
    return body_of(corners * radius + np.array(center), triangles, corners, material, order)


def bowl(material, rings=12, order=4):
    """The inside of the lower half of the unit sphere, open above: its front looks inwards."""
    corners, triangles = sphere_grid(rings, 4 * rings, np.pi / 2, np.pi)
    return body_of(corners, triangles[:, ::-1], -corners, material, order)


def tracer_of(body):
    return Tracer(body.positions, body.faces)
