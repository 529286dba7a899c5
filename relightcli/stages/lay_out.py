"""A transfer store before rays are traced: its scene and receivers, and the job that fills the rest."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

import relight_formats as formats
from relightcli.core.transport.receivers import Receivers
from relightcli.stages.prepare import Prepared
from relightcli.stages.receiver_setup import PixelReceivers, put_geometry, put_receivers, put_vertex_colours
from relightcli.stages.rig_store import put_rigs
from relightcli.stages.visibility_job import VisibilityJob


def put_scene(
    writer: formats.Writer,
    prepared: Prepared,
    receivers: Receivers | PixelReceivers,
    buried: NDArray[np.bool_] | None,
) -> None:
    """Meshes, textures, rigs, and where light is received."""
    geometry = prepared.geometry
    put_geometry(writer, geometry)
    put_rigs(writer, geometry)
    if geometry is not prepared.source:
        writer.put("source/face", prepared.source.faces, dims=("face", "corner"))
    put_receivers(writer, receivers, buried)
    if prepared.bounce_cells and geometry.textures:
        put_vertex_colours(writer, geometry)


def make_job(
    prepared: Prepared, partial: str, receivers: Receivers | PixelReceivers, starts: tuple[int, ...]
) -> VisibilityJob:
    """What every receiver of the unfinished store `partial` sees. starts: `Prepared.receivers`."""
    config, moving = prepared.config, prepared.moving
    points = receivers.points if isinstance(receivers, PixelReceivers) else receivers
    movers = () if moving is None else moving.movers
    return VisibilityJob(
        partial,
        prepared.resolution,
        config.refine,
        prepared.shadows,
        config.basis,
        config.coefficients,
        config.tolerance or 0.0,
        config.sh_order,
        config.seed,
        tuple(prepared.scene.lights.values()),
        prepared.bounce_cells,
        int(np.count_nonzero(points.vertex < 0)),
        tuple(prepared.geometry.object_names.index(m.mesh.name) for m in movers),
        starts,
        prepared.posed,
    )
