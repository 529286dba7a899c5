"""Bodies of what moves, with points that light can reach."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from relightcli.adapters.rays import Tracer
from relightcli.core.fields.body import Body, make_body
from relightcli.core.shade import primary
from relightcli.core.transport.buried import unbury
from relightcli.core.transport.receivers import Receivers
from relightcli.scene.model import Material


def body_of(
    positions: NDArray[np.float64],
    normals: NDArray[np.float32],
    faces: NDArray[np.int32],
    two_sided: bool,
    texture: NDArray[np.float32],
    material: Material,
    order: int,
) -> Body:
    """See `core.fields.body.make_body`; points that lie inside another part of the object are moved along their faces
    to where they do not (`core.transport.buried`): the same points whenever it is made."""
    body = make_body(positions, normals, faces, two_sided, texture, material, order)
    points = Receivers(body.point, body.normal, np.zeros(len(body.point), np.int32), body.vertex, body.side)
    both = np.full(len(faces), two_sided)
    moved, _ = unbury(Tracer(positions, faces), points, positions, faces, primary.face_normals(positions, faces), both)
    return body._replace(point=moved.position)
