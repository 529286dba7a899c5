"""A picture of clustered lights: the borders of the clusters over a map, latitude against longitude."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

import relight_formats as formats
from relightcli.adapters.images import read_environment, write_image
from relightcli.core.lights.latlong import lookup_many, make_latlong
from relightcli.core.lights.quadtree import build_tree, leaves_at
from relightcli.errors import StoreError

SIZE = (512, 1024)
BORDER = (1.0, 0.25, 0.05)


def draw_clusters(path: Path, env: Path | None, output: Path) -> None:
    """Writes a picture of SIZE of a store. env None: a grey map. Raises StoreError for a store of another kind."""
    store = formats.open_store(path)
    if "light_clusters/cell" not in store:
        raise StoreError(f"{store.path}: holds no clustered lights to draw, which cluster --light-resolution makes")
    read: Any = store.read
    resolution = int(store.settings["cluster_resolution"])
    tree = build_tree([tuple(c) for c in read("light_clusters/cell").tolist()], resolution)
    height, width = SIZE
    latitude = math.pi * (0.5 - (np.arange(height) + 0.5) / height)[:, None]
    longitude = math.pi * (1.0 - 2.0 * (np.arange(width) + 0.5) / width)[None, :]
    d = np.stack(
        np.broadcast_arrays(
            np.sin(longitude) * np.cos(latitude), np.sin(latitude), np.cos(longitude) * np.cos(latitude)
        ),
        axis=-1,
    )
    leaf = leaves_at(tree, d.reshape(-1, 3)).reshape(height, width)
    if env is None:
        pixels = np.full((height, width, 3), 0.05, np.float32)
    else:
        pixels = lookup_many(make_latlong(read_environment(env)), d)
        pixels *= np.float32(0.2 / max(float(np.median(pixels)), 1e-12))
    border = np.zeros((height, width), bool)
    border[:, 1:] |= leaf[:, 1:] != leaf[:, :-1]
    border[1:] |= leaf[1:] != leaf[:-1]
    pixels[border] = BORDER
    write_image(output, pixels)
