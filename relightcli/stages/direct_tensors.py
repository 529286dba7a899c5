"""Direct light of an asset: transfer tensors of its receivers, written by factorize and read by relight.

Receivers are in groups: one for each family of BRDFs with a tensor, and one, "matte", for all others, which have the
diffuse factor alone. [Sun 2007, sec. 3.2, 4.1; `core.transport.direct_tensor`]
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

import relight_formats as formats
from relightcli.core.brdf.direct_model import FAMILIES, LightFactors, light_factors
from relightcli.core.brdf.models import MaterialTable, widen
from relightcli.core.lights.environment import SkyCube
from relightcli.core.shade.bright import Bright, add_irradiance, split_bright
from relightcli.core.transport.direct_tensor import direct_light, direct_transfer, light_coefficients
from relightcli.core.transport.lobe_visibility import lobe_visibility, table_side
from relightcli.run.accounting import Meter
from relightcli.stages.brdf_data import direct_model
from relightcli.stages.family import Family, Parts, families_of, put_family
from relightcli.stages.lighting import LightingStore

PLACE, MATTE = "direct", "matte"
BLOCK = 2048  # receivers


def group_of(lighting: LightingStore) -> dict[str, NDArray[np.int64]]:
    """Receivers of every group that has any."""
    found = families_of(lighting)
    matte = np.ones(len(lighting.object), bool)
    for receivers in found.values():
        matte[receivers] = False
    return {**found, MATTE: np.flatnonzero(matte)} if matte.any() else found


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
            writer.put(f"{PLACE}/{name}/receiver", receivers.astype(np.int32), dims=(f"{name}_receiver",))
        else:
            model = direct_model(name, ranks)
            put_family(writer, PLACE, name, model, receivers)
            factors, degrees = light_factors(model), model.degrees.tolist()
        count, n = factors.table.shape[2], len(receivers)
        texels = 6 * lighting.resolution**2
        kept = min(keep, texels)

        def array(leaf: str, shape: tuple[int, ...], dtype: str, dims: tuple[str, ...], name: str = name) -> Any:
            return writer.array(
                f"{PLACE}/{name}/{leaf}",
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
            block = f"{PLACE}/{name}-{start}"
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
        self.groups = [_Group(lighting, name) for name in names if f"{PLACE}/{name}/receiver" in store]
        self.known = np.zeros(len(lighting), bool)  # receivers with tensors of their lobes
        for group in self.groups:
            self.known[group.receiver] = group.family is not None
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
            group.set_light(light, lighting.threads)
            if group.family is not None:
                group.family.set_sky(rest, lighting.threads)
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
            if group.family is not None:
                threads = self.lighting.threads
                out[group.receiver] = group.family.specular(table, wide, self.bright, view, active, threads)
        return out, self.known


class _Group:
    """The tensors of a group, and its light; family None: matte."""

    def __init__(self, lighting: LightingStore, name: str) -> None:
        read: Any = lighting.store.read
        self.receiver: NDArray[np.int32] = read(f"{PLACE}/{name}/receiver")
        self.scale = read(f"{PLACE}/{name}/scale")
        names = [f"{PLACE}/{name}/{leaf}" for leaf in ("index", "value")]
        self.transfer = Parts(lighting.store, names, len(self.receiver), turned=True)
        self.family = None if name == MATTE else Family(lighting, PLACE, name)
        self.incident = np.zeros((*self.scale.shape, 3), np.float32) if self.family is None else self.family.incident

    def set_light(self, light: NDArray[np.float32], threads: int) -> None:
        for part, (index, value) in self.transfer:
            direct_light(index, self.scale[part], value, light, self.incident[part], threads)
