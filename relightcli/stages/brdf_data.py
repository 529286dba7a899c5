"""Factorised sets of materials, made once per user and kept as stores of kind `brdf` in a cache folder.

The folder is $RELIGHTCLI_CACHE, else $XDG_CACHE_HOME/relightcli, else ~/.cache/relightcli. A store is named after what
it was made from, so that nothing in the folder is ever out of date; all of it can be deleted at any time. Where the
folder cannot be written the model is made anew every time.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import uuid
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import relight_formats as formats
from relightcli import __version__
from relightcli.core.brdf import direct_model as model
from relightcli.core.brdf.disc import RESOLUTION
from relightcli.errors import StoreError

KIND = "brdf"
# Where factors cost no bytes they can be many: three times those of an asset hold broad lobes without others' help.
BROAD_RANKS = (8, 32, 24)


def direct_model(
    family: str,
    ranks: tuple[int, int, int] | None = None,
    degrees: Sequence[float] = model.DEGREES,
    measured: bool = False,
    resolution: int = RESOLUTION,
) -> model.DirectModel:
    """The model of a family, "cook-torrance" or "blinn-phong", from the cache or made now.

    ranks, degrees, resolution: as in `build_direct_model`; measured: the set of measured materials, which are all
    Cook-Torrance, in place of the family's own. Raises InputError for an unknown family.
    """
    points = model.measured_points() if measured else model.default_points(family)
    return _known(family, points, ranks or model.RANKS.get(family), degrees, resolution)


def broad_model(family: str, least: float) -> model.DirectModel:
    """The model without lobes of a family's broad BRDFs, from a roughness of about `least` on. BROAD_RANKS keeps
    pairs of factors whole, as all ranks do."""
    points = model.default_points(family)
    if family == "blinn-phong":
        broad = points[:, 0] <= points[points[:, 0] >= 2.0 / least**2 - 2.0, 0].min()
    else:
        broad = points[:, 1] >= points[points[:, 1] <= least, 1].max()
    return _known(family, points[broad], BROAD_RANKS, (), RESOLUTION)


def _known(
    family: str,
    points: NDArray[np.float64],
    ranks: tuple[int, int, int] | None,
    degrees: Sequence[float],
    resolution: int,
) -> model.DirectModel:
    """The model of a set, from the cache or made now."""
    settings = {
        "family": family,
        "points": points.tolist(),
        "ranks": ranks,
        "degrees": [float(degree) for degree in degrees],
        "resolution": resolution,
        "version": model.VERSION,
    }
    path = cache_folder() / f"{family}-{formats.fingerprint_json(settings).removeprefix('sha256:')[:20]}.zarr"
    found = _load(path, settings)
    if found is None:
        found = model.build_direct_model(family, points, ranks, degrees, resolution)
        # A cache that is full, read-only or busy is no reason to fail.
        with contextlib.suppress(OSError, StoreError):
            _save(path, settings, found)
    return found


def cache_folder() -> Path:
    """Where models are kept; it need not exist."""
    own, base = os.environ.get("RELIGHTCLI_CACHE"), os.environ.get("XDG_CACHE_HOME")
    if own:
        return Path(own)
    return (Path(base) if base else Path.home() / ".cache") / "relightcli"


def _load(path: Path, settings: dict[str, Any]) -> model.DirectModel | None:
    """None where there is no store, or one that is damaged."""
    try:
        store = formats.open_store(path, KIND)
        arrays = {name: store.read(name) for name in model.ARRAYS}
    except (OSError, StoreError):
        return None
    return model.from_arrays(settings["family"], settings["resolution"], arrays)


def _save(path: Path, settings: dict[str, Any], made: model.DirectModel) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.exists():
        if _load(path, settings) is not None:  # another process was faster
            return
        _remove(path)
    program = f"relightcli {__version__}"
    writer = formats.begin(path, KIND, settings=settings, inputs={}, program=program, overwrite=True)
    if writer is None:
        return
    with writer:
        for name, values in made.arrays().items():
            writer.put(name, values, dims=model.ARRAYS[name])
        writer.commit({"error": float(made.error.max())})


def _remove(path: Path) -> None:
    """Out of the way first, by one rename: nobody reads half a store."""
    away = path.with_name(f"{path.name}.{uuid.uuid4().hex}.damaged")
    os.rename(path, away)
    if away.is_dir():
        shutil.rmtree(away)
    else:
        away.unlink()
