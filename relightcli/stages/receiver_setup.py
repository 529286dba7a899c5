"""What precompute knows before any ray: the receivers, and how they and the scene are laid down in the store."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

import relight_formats as formats
from relightcli.adapters.rays import Tracer
from relightcli.core.shade import picture, primary
from relightcli.core.transport.buried import unbury
from relightcli.core.transport.camera import make_film
from relightcli.core.transport.hits import Surfaces
from relightcli.core.transport.receivers import (
    Receivers,
    join_receivers,
    receivers_of_vertices,
    spatial_order,
    vertex_receivers,
)
from relightcli.core.transport.shading import vertex_colours
from relightcli.errors import InputError
from relightcli.scene.model import Geometry, Scene

PIXEL_EDGE_GRID = 3  # the least samples along a pixel's side at the edges of a picture, for pixel receivers
MOST_PIXEL_GRID = 8


@dataclass(frozen=True)
class PixelReceivers:
    """Receivers at what a camera sees, with the picture they belong to; `texture` (P, 3) is the texture's colour.

    `points` holds the P receivers of pixels, and after them those of the vertices, if light bounces off these.
    """

    points: Receivers
    pixel: NDArray[np.int32]
    weight: NDArray[np.float32]
    view: NDArray[np.float32]
    texture: NDArray[np.float32]
    coverage: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.points)


def check_receivers(asked: str, scene: Scene, geometry: Geometry) -> None:
    """Refuse what `make_receivers` cannot make. Raises InputError."""
    if asked == "vertices":
        return
    kind, _, name = asked.partition(":")
    if kind != "pixels" or not name:
        raise InputError(f"--receivers: expected vertices or pixels:CAMERA; found {asked!r}")
    if name not in scene.cameras:
        known = ", ".join(scene.cameras) or "none"
        raise InputError(f"--receivers: {scene.path} has no camera {name!r}; it has: {known}")
    materials = list(scene.materials.values())
    if any(materials[m].model == "translucent" for m in geometry.material):
        raise InputError(
            "--receivers pixels: translucent materials need light from the side that the camera does not see; "
            "use --receivers vertices"
        )


def make_receivers(
    asked: str, scene: Scene, geometry: Geometry, both: NDArray[np.bool_], grid: int = 1, fine: bool = False
) -> Receivers | PixelReceivers:
    """The receivers that `--receivers` asks for, once checked.

    both (O,): objects lit from both sides; grid: receivers along a pixel's side; fine: outlines and textures of pixels
    as finely as vertices have them.
    """
    if asked == "vertices":
        return on_vertices(geometry, both)
    return _pixel_receivers(scene, asked.partition(":")[2], geometry, grid, fine)


def on_vertices(geometry: Geometry, both: NDArray[np.bool_]) -> Receivers:
    """The receivers of the mesh's vertices. `both` (O,): objects lit from both sides."""
    return vertex_receivers(geometry.positions, geometry.normals, geometry.faces, geometry.vertex_object, both)


def with_vertices(pixels: PixelReceivers, vertices: Receivers) -> PixelReceivers:
    """Pixels' receivers, followed by the vertices that light reaches them from."""
    return replace(pixels, points=join_receivers(pixels.points, vertices))


def _pixel_receivers(scene: Scene, name: str, geometry: Geometry, grid: int, fine: bool) -> PixelReceivers:
    film = make_film(scene.cameras[name])
    tracer = Tracer(geometry.positions, geometry.faces)
    normals = primary.face_normals(geometry.positions, geometry.faces)
    samples = primary.see(tracer, film, geometry.face_object, normals, grid, max(grid, PIXEL_EDGE_GRID))
    seen = picture.lit_surface(geometry, samples)
    order = spatial_order(seen.position)
    sample = seen.path[order]
    position, normal = seen.position[order], seen.shading[order].astype(np.float32)
    face = samples.face[sample]
    facing = np.einsum("nx,nx->n", normals[face], samples.direction[sample]) < 0
    points = Receivers(
        position,
        normal,
        geometry.face_object[face].astype(np.int32),
        np.full(len(sample), -1, np.int32),
        np.where(facing, 1, -1).astype(np.int8),
    )
    pixel, weight, texture = samples.pixel[sample], samples.weight[sample], seen.albedo[order].astype(np.float32)
    coverage = samples.coverage
    if fine:
        base = grid * (primary.TEXTURE_GRID if geometry.textures else primary.BASE_GRID)  # a sample per receiver
        samples = primary.see(tracer, film, geometry.face_object, normals, base)
        finer = picture.lit_surface(geometry, samples)
        of_sample = geometry.face_object[samples.face]
        weight, texture, coverage = picture.share_out(
            samples, finer, of_sample, pixel, position, points.object, texture
        )
    return PixelReceivers(points, pixel, weight, seen.viewer[order].astype(np.float32), texture, coverage)


def surfaces_of(geometry: Geometry, points: Receivers, buried: NDArray[np.bool_]) -> Surfaces:
    """Mesh and receivers as `core.transport.hits` wants them."""
    front, back = receivers_of_vertices(points.vertex, points.side, len(geometry.positions))
    two_sided = geometry.two_sided[geometry.face_object]
    return Surfaces(geometry.positions, geometry.normals, geometry.faces, two_sided, front, back, buried)


def hidden(faces: NDArray[np.int32], owner: NDArray[np.int32], objects: tuple[int, ...]) -> NDArray[np.int32]:
    """Faces (F, 3) of owners (F,), in which those of some objects have no area: they block nothing, indices stay."""
    out = faces.copy()
    own = np.isin(owner, objects)
    out[own] = faces[own][:, :1]
    return out


def unburied(geometry: Geometry, points: Receivers, posed: tuple[int, ...] = ()) -> tuple[Receivers, NDArray[np.bool_]]:
    """Vertex receivers, those that nothing can see moved to where something can; and which are left, (N,) bool.

    posed: objects that are not there for the receivers of the others.
    """
    position, buried = points.position.copy(), np.zeros(len(points), bool)
    normals = primary.face_normals(geometry.positions, geometry.faces)
    two_sided = geometry.two_sided[geometry.face_object]
    of_posed = np.isin(points.object, posed)
    for own, absent in ((~of_posed, posed), (of_posed, ())):
        if not own.any():
            continue
        some = Receivers(*(getattr(points, field.name)[own] for field in fields(Receivers)))
        tracer = Tracer(geometry.positions, hidden(geometry.faces, geometry.face_object, absent))
        moved, buried[own] = unbury(tracer, some, geometry.positions, geometry.faces, normals, two_sided)
        position[own] = moved.position
    return replace(points, position=position), buried


def put_geometry(writer: formats.Writer, geometry: Geometry) -> None:
    put = writer.put
    put("mesh/position", geometry.positions, dims=("vertex", "axis"), units="m")
    put("mesh/normal", geometry.normals, dims=("vertex", "axis"))
    put("mesh/uv", geometry.uvs, dims=("vertex", "coordinate"))
    put("mesh/face", geometry.faces, dims=("face", "corner"))
    put("mesh/vertex_object", geometry.vertex_object, dims=("vertex",))
    put("mesh/face_object", geometry.face_object, dims=("face",))
    put("objects/material", geometry.material, dims=("object",))
    put("objects/two_sided", geometry.two_sided, dims=("object",))
    for material, texture in geometry.textures.items():
        put(f"textures/{material}/radiance", texture, dims=("row", "column", "colour"))


def put_vertex_colours(writer: formats.Writer, geometry: Geometry) -> None:
    """The mean of the texture around every vertex, for light that bounces off it."""
    writer.put("bounce/texture", vertex_colours(geometry), dims=("vertex", "colour"))


def put_receivers(
    writer: formats.Writer, receivers: Receivers | PixelReceivers, buried: NDArray[np.bool_] | None
) -> None:
    """`buried` (N,), where there are receivers on vertices."""
    points = receivers.points if isinstance(receivers, PixelReceivers) else receivers
    put = writer.put
    put("receivers/position", points.position, dims=("receiver", "axis"), units="m")
    put("receivers/normal", points.normal, dims=("receiver", "axis"))
    put("receivers/object", points.object, dims=("receiver",))
    put("receivers/side", points.side, dims=("receiver",))
    if isinstance(receivers, PixelReceivers):
        dim = "receiver" if buried is None else "pixel_receiver"  # the first of all receivers
        put("receivers/pixel", receivers.pixel, dims=(dim,))
        put("receivers/weight", receivers.weight, dims=(dim,))
        put("receivers/view", receivers.view, dims=(dim, "axis"))
        put("receivers/texture", receivers.texture, dims=(dim, "colour"))
        put("picture/coverage", receivers.coverage, dims=("row", "column"))
    if buried is not None:
        put("receivers/vertex", points.vertex, dims=("receiver",))
        put("receivers/buried", buried, dims=("receiver",))
