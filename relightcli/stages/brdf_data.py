"""BRDF models for direct light, built when a scene needs one and kept in a cache between runs.

The cache is a folder of stores of kind "brdf": $RELIGHTCLI_CACHE, else $XDG_CACHE_HOME/relightcli, else
~/.cache/relightcli. A store is named by what decides its content. Where nothing can be written, models are built anew.
"""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

import numpy as np

import relight_formats as formats
from relightcli import __version__
from relightcli.core.brdf.direct_model import (
    ARRAYS,
    RANKS,
    DirectModel,
    build_direct_model,
    default_points,
    from_arrays,
)
from relightcli.core.brdf.disc import RESOLUTION
from relightcli.core.brdf.specular_lobes import LOBES
from relightcli.errors import StoreError

KIND = "brdf"
VERSION = 1  # of how models are built


def direct_model(family: str, ranks: tuple[int, int, int] | None = None) -> DirectModel:
    """The model of a family with its default data set. ranks: for reflectance, view and light; None: the family's."""
    settings = {
        "family": family,
        "resolution": RESOLUTION,
        "ranks": list(ranks or RANKS[family]),
        "lobes": list(LOBES),
        "points": formats.fingerprint_json(default_points(family).tolist()),
        "version": VERSION,
    }
    path = cache_folder() / f"{family}-{formats.fingerprint_json(settings).rpartition(':')[2][:16]}.zarr"
    with contextlib.suppress(StoreError, OSError):  # absent or damaged: it is built
        return read_model(formats.open_store(path, KIND), "")
    model = build_direct_model(family, ranks=ranks)
    with contextlib.suppress(StoreError, OSError):  # no room, or another run is at it
        path.parent.mkdir(parents=True, exist_ok=True)
        writer = formats.begin(
            path, KIND, settings=settings, inputs={}, program=f"relightcli {__version__}", overwrite=True
        )
        if writer is not None:
            with writer:
                put_model(writer, model, "")
                writer.commit({})
    return model


def put_model(writer: formats.Writer, model: DirectModel, group: str) -> None:
    """Writes a model's arrays into a store, `group` (ending in a slash, or empty) before their names."""
    for name, values in model.arrays().items():
        writer.put(f"{group}{name}", values, dims=ARRAYS[name], attrs={"family": model.family})


def read_model(store: formats.Store, group: str) -> DirectModel:
    """What `put_model` wrote."""
    arrays = {name: np.asarray(store.read(f"{group}{name}")) for name in ARRAYS}
    family = str(store.array(f"{group}core").attrs["family"])
    return from_arrays(family, RESOLUTION, arrays)


def cache_folder() -> Path:
    """Where models are kept."""
    if os.environ.get("RELIGHTCLI_CACHE"):
        return Path(os.environ["RELIGHTCLI_CACHE"])
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "relightcli"
