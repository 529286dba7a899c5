"""Direct light of an asset: transfer tensors of its receivers, written by factorize and read by relight.

Receivers are in groups: one for each family of BRDFs with a tensor, and one, "matte", for all others, which have the
diffuse factor alone. [Sun 2007, sec. 3.2, 4.1; `core.transport.direct_tensor`]
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

import relight_formats as formats
from relightcli.core.brdf.direct_model import (
    ARRAYS,
    FAMILIES,
    LightFactors,
    MaterialSetting,
    from_arrays,
    light_factors,
    setting,
)
from relightcli.core.brdf.disc import RESOLUTION
from relightcli.core.brdf.models import F0, ROUGHNESS, SHININESS, MaterialTable, widen
from relightcli.core.brdf.models import SPECULAR as SPECULAR_COLUMN
from relightcli.core.lights.environment import SkyCube
from relightcli.core.lights.prefiltered import prefiltered_sky
from relightcli.core.shade.bright import Bright, add_highlights, add_irradiance, split_bright
from relightcli.core.transport.direct_tensor import direct_light, direct_transfer, light_coefficients, shade_direct
from relightcli.core.transport.lobe_visibility import add_lobes, lobe_visibility, table_side
from relightcli.run.accounting import Meter
from relightcli.stages.brdf_data import direct_model
from relightcli.stages.lighting import LightingStore

MATTE = "matte"
BLOCK = 2048


def group_of(lighting: LightingStore) -> dict[str, NDArray[np.int64]]:
    """Receivers of every group that has any."""
    models = np.array([m.model for m in lighting.scene.materials.values()])
    may_shine = np.array(
        [m.adjustable or any(c > 0.0 for c in m.specular) for m in lighting.scene.materials.values()], bool
    )
    material = lighting.geometry.material[lighting.object]
    family = np.where(np.isin(models, FAMILIES) & may_shine, models, MATTE)[material]
    return {name: np.flatnonzero(family == name) for name in (*FAMILIES, MATTE) if (family == name).any()}


def put_direct(
    writer: formats.Writer,
    lighting: LightingStore,
    keep: int,
    threads: int,
    ranks: tuple[int, int, int] | None = None,
) -> None:
    """Computes and writes the tensors of all groups, a block of receivers at a time. ranks: see `direct_model`."""
    for name, receivers in group_of(lighting).items():
        if name == MATTE:
            factors = LightFactors(np.full((2, 2, 1), 1.0 / np.pi, np.float32), np.ones(1, np.float32))
            degrees: list[float] = []
        else:
            model = direct_model(name, ranks)
            for leaf, values in model.arrays().items():
                writer.put(f"direct/{name}/brdf/{leaf}", values, dims=ARRAYS[leaf])
            factors, degrees = light_factors(model), model.degrees.tolist()
        count, n = factors.table.shape[2], len(receivers)
        texels = 6 * lighting.resolution**2
        kept = min(keep, texels)
        group = f"direct/{name}"
        writer.put(f"{group}/receiver", receivers.astype(np.int32), dims=(f"{name}_receiver",))

        def array(
            leaf: str, shape: tuple[int, ...], dtype: str, dims: tuple[str, ...], group: str = group, name: str = name
        ) -> Any:
            return writer.array(
                f"{group}/{leaf}",
                shape=shape,
                dtype=dtype,
                chunks=(BLOCK, *shape[1:]),
                dims=(f"{name}_receiver", *dims),
                codec="zstd",
            )

        index = array("index", (n, kept), "uint16" if texels <= 1 << 16 else "int32", ("coefficient",))
        scale = array("scale", (n, count), "float32", ("factor",))
        value = array("value", (n, kept, count), "int8", ("coefficient", "factor"))  # compresses better this way round
        wide = [d for d in degrees if d > 0.0]
        lobes = [
            array(f"lobe_{d:g}", (n, table_side(d), table_side(d)), "uint8", (f"row_{d:g}", f"column_{d:g}"))
            for d in wide
        ]
        for start in range(0, n, BLOCK):
            block = f"direct/{name}-{start}"
            if block in writer.done:
                continue
            meter = Meter()
            own = receivers[start : start + BLOCK]
            bits, normals = lighting.bits_of(own), lighting.normal[own]
            rows = slice(start, start + len(own))
            index[rows], scale[rows], found = direct_transfer(bits, normals, factors, keep, threads)
            value[rows] = found.swapaxes(1, 2)
            for target, table in zip(lobes, lobe_visibility(bits, normals, degrees, threads), strict=True):
                target[rows] = table
            writer.record(block, {**meter.read(), "receivers": len(own)})


class DirectTensors:
    """The tensors in memory; what depends on the light is kept until `set_light`."""

    def __init__(self, lighting: LightingStore) -> None:
        self.lighting = lighting
        store = lighting.store
        names = (*FAMILIES, MATTE)
        self.groups = [_Group(lighting, name) for name in names if f"direct/{name}/receiver" in store]
        self.known = np.zeros(len(lighting), bool)  # receivers with tensors of their lobes
        for group in self.groups:
            self.known[group.receiver] = group.name != MATTE
        self.even = np.zeros((len(lighting), 3), np.float32)
        self.bright: Bright

    def set_light(self, sky: SkyCube) -> None:
        """`even` (N, 3) becomes the irradiance over pi; the lobes get their skies, the brightest texels apart.

        sky: after `environment.splat`.
        """
        lighting = self.lighting
        rest, self.bright = split_bright(sky)
        light = light_coefficients(rest.radiance())
        self.even = np.zeros_like(self.even)  # a new array: what was made of the old one is told by it
        for group in self.groups:
            group.set_light(rest, light, lighting.threads)
            self.even[group.receiver] = np.maximum(group.incident[:, -1], 0.0)
        if len(self.bright.texel):
            for rows, bits in lighting.blocks():
                add_irradiance(bits, lighting.normal[rows], self.bright, self.even[rows], lighting.threads)

    def specular(
        self, table: MaterialTable, view: NDArray[np.float32], active: NDArray[np.bool_] | None
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Specular exit radiance (N, 3) towards view (N, 3) of `active` receivers (N,), 0 of others; and which
        receivers have one from here, (N,)."""
        out = np.zeros((len(self.lighting), 3), np.float32)
        wide = widen(table, 0.5 * np.pi / self.lighting.resolution)
        for group in self.groups:
            if group.name != MATTE:
                out[group.receiver] = group.specular(table, wide, self.bright, view, active, self.lighting.threads)
        return out, self.known


class _Group:
    def __init__(self, lighting: LightingStore, name: str) -> None:
        self.name = name
        read: Any = lighting.store.read
        self.receiver: NDArray[np.int32] = read(f"direct/{name}/receiver")
        self.index, self.scale = read(f"direct/{name}/index"), read(f"direct/{name}/scale")
        self.value = np.ascontiguousarray(read(f"direct/{name}/value").swapaxes(1, 2))
        self.normal = np.ascontiguousarray(lighting.normal[self.receiver])
        material = lighting.geometry.material[lighting.object[self.receiver]]
        self.rows = {int(m): np.flatnonzero(material == m) for m in np.unique(material)}
        self.incident = np.zeros((*self.scale.shape, 3), np.float32)
        self.skies: tuple[NDArray[np.float32], ...] = ()
        self._settings: dict[tuple[float, ...], MaterialSetting] = {}
        if name != MATTE:
            arrays = {leaf: read(f"direct/{name}/brdf/{leaf}") for leaf in ARRAYS}
            self.model = from_arrays(name, RESOLUTION, arrays)
            self.degrees = self.model.degrees.tolist()
            self.bits = lighting.bits_of(self.receiver)
            self.tables = tuple(read(f"direct/{name}/lobe_{d:g}") for d in self.degrees if d > 0.0)
            self.out = np.empty((len(self.receiver), 3), np.float32)

    def set_light(self, sky: SkyCube, light: NDArray[np.float32], threads: int) -> None:
        direct_light(self.index, self.scale, self.value, light, self.incident, threads)
        if self.name != MATTE:
            self.skies = prefiltered_sky(sky, self.degrees, threads=threads)

    def specular(
        self,
        table: MaterialTable,
        wide: MaterialTable,
        bright: Bright,
        view: NDArray[np.float32],
        active: NDArray[np.bool_] | None,
        threads: int,
    ) -> NDArray[np.float32]:
        towards = np.take(view, self.receiver, axis=0)
        black = np.zeros(3, np.float32)
        if active is not None:
            self.out[:] = 0.0
        for m, all_rows in self.rows.items():
            rows = all_rows if active is None else all_rows[active[self.receiver[all_rows]]]
            row = table.parameters[m]
            colour = row[SPECULAR_COLUMN : SPECULAR_COLUMN + 3].astype(np.float32)
            if not colour.any():
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
            if len(bright.texel):
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
