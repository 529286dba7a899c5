"""Receivers of one family of BRDFs with a tensor: what a store keeps of them however their incident light is made, and
what they send towards a view. [Sun 2007, Eq. 3, sec. 4.1]

A store keeps the family's model, and the visible shares of its lobes. Where the light of the factors comes from is the
business of assets (`direct_tensors`) and of clustered lights (`light_factors`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

import relight_formats as formats
from relightcli.core.brdf.direct_model import ARRAYS, FAMILIES, DirectModel, MaterialSetting, from_arrays, setting
from relightcli.core.brdf.disc import RESOLUTION
from relightcli.core.brdf.models import F0, MODEL_CODES, ROUGHNESS, SHININESS, MaterialTable
from relightcli.core.brdf.models import SPECULAR as SPECULAR_COLUMN
from relightcli.core.lights.environment import SkyCube
from relightcli.core.lights.prefiltered import prefiltered_sky
from relightcli.core.shade.bright import Bright, add_highlights
from relightcli.core.transport.direct_tensor import shade_direct
from relightcli.core.transport.lobe_visibility import add_lobes, table_side
from relightcli.stages.brdf_data import direct_model
from relightcli.stages.lighting import LightingStore

BLOCK = 2048  # receivers


def families_of(lighting: LightingStore) -> dict[str, NDArray[np.int64]]:
    """Receivers (n,) of every family that has any which shine, or may be made to."""
    materials = list(lighting.scene.materials.values())
    models = np.array([m.model for m in materials])
    may_shine = np.array([m.adjustable or any(c > 0.0 for c in m.specular) for m in materials], bool)
    family = np.where(may_shine, models, "")[lighting.geometry.material[lighting.object]]
    return {name: np.flatnonzero(family == name) for name in FAMILIES if (family == name).any()}


def put_model(writer: formats.Writer, place: str, name: str, ranks: tuple[int, int, int] | None = None) -> DirectModel:
    """Makes the model of a family, and writes it into the group `place`. ranks: see `brdf_data.direct_model`."""
    model = direct_model(name, ranks)
    for leaf, values in model.arrays().items():
        writer.put(f"{place}/{name}/brdf/{leaf}", values, dims=ARRAYS[leaf])
    return model


def put_receivers(writer: formats.Writer, place: str, name: str, receivers: NDArray[np.int64]) -> None:
    """Writes which receivers (n,) are of the family."""
    writer.put(f"{place}/{name}/receiver", receivers.astype(np.int32), dims=(f"{name}_receiver",))


def receiver_array(
    writer: formats.Writer, place: str, name: str, leaf: str, shape: tuple[int, ...], dtype: str, dims: tuple[str, ...]
) -> Any:
    """A new array of values of the receivers, in chunks of BLOCK."""
    return writer.array(
        f"{place}/{name}/{leaf}",
        shape=shape,
        dtype=dtype,
        chunks=(BLOCK, *shape[1:]),
        dims=(f"{name}_receiver", *dims),
        codec="zstd",
    )


def lobe_arrays(writer: formats.Writer, place: str, name: str, count: int, degrees: Sequence[float]) -> list[Any]:
    """New arrays for what `lobe_visibility` gives of `count` receivers."""
    return [
        receiver_array(
            writer,
            place,
            name,
            f"lobe_{d:g}",
            (count, table_side(d), table_side(d)),
            "uint8",
            (f"row_{d:g}", f"column_{d:g}"),
        )
        for d in degrees
        if d > 0.0
    ]


class Family:
    """n receivers of a family in memory, under a light.

    receiver (n,) rising; normal (n, 3); incident (n, K+1, 3): I0, radiance times sr sr^-1, the last that of the diffuse
    factor: to be set for every light; skies: of the lobes.
    """

    def __init__(self, lighting: LightingStore, place: str, name: str) -> None:
        self.name, self.code = name, MODEL_CODES[name]
        read: Any = lighting.store.read
        group = f"{place}/{name}"
        self.receiver: NDArray[np.int32] = read(f"{group}/receiver")
        self.normal = np.ascontiguousarray(lighting.normal[self.receiver])
        material = lighting.geometry.material[lighting.object[self.receiver]]
        self.rows = {int(m): np.flatnonzero(material == m) for m in np.unique(material)}
        self.model = from_arrays(name, RESOLUTION, {leaf: read(f"{group}/brdf/{leaf}") for leaf in ARRAYS})
        self.degrees: list[float] = self.model.degrees.tolist()
        self.bits = lighting.bits_of(self.receiver)
        self.tables = tuple(read(f"{group}/lobe_{d:g}") for d in self.degrees if d > 0.0)
        self.incident = np.zeros((len(self.receiver), self.model.light.shape[1] + 1, 3), np.float32)
        self.skies: tuple[NDArray[np.float32], ...] = ()
        self.out = np.empty((len(self.receiver), 3), np.float32)
        self._settings: dict[tuple[float, ...], MaterialSetting] = {}

    def set_sky(self, sky: SkyCube, threads: int) -> None:
        """The sky that the lobes mirror."""
        self.skies = prefiltered_sky(sky, self.degrees, threads=threads)

    def specular(
        self,
        table: MaterialTable,
        wide: MaterialTable,
        bright: Bright | None,
        view: NDArray[np.float32],
        active: NDArray[np.bool_] | None,
        threads: int,
    ) -> NDArray[np.float32]:
        """Specular exit radiance (n, 3) towards view (N, 3) of `active` receivers (N,), 0 of others and of materials
        that are of another model now.

        wide: the table as highlights of `bright` have it, texels whose light is not in that of the factors.
        """
        towards = np.take(view, self.receiver, axis=0)
        black = np.zeros(3, np.float32)
        if active is not None:
            self.out[:] = 0.0
        for m, all_rows in self.rows.items():
            rows = all_rows if active is None else all_rows[active[self.receiver[all_rows]]]
            row = table.parameters[m]
            colour = row[SPECULAR_COLUMN : SPECULAR_COLUMN + 3].astype(np.float32)
            if table.model[m] != self.code or not colour.any():
                self.out[rows] = 0.0
                continue
            values = (row[SHININESS],) if self.name == "blinn-phong" else (row[F0], row[ROUGHNESS])
            if values not in self._settings:
                self._settings = {values: setting(self.model, *(float(v) for v in values))}
            tables = self._settings[values]
            shade_direct(self.incident, towards, self.normal, rows, tables.view_table, colour, black, self.out, threads)
            add_lobes(
                self.bits,
                self.tables,
                self.skies,
                self.degrees,
                towards,
                self.normal,
                rows,
                tables.energy,
                colour,
                self.out,
                threads,
            )
            np.maximum(self.out, 0.0, out=self.out)  # of truncation
            if bright is not None and len(bright.texel):
                add_highlights(
                    self.bits,
                    rows,
                    towards,
                    self.normal,
                    bright,
                    int(wide.model[m]),
                    wide.parameters[m],
                    colour,
                    self.out,
                    threads,
                )
        return self.out
