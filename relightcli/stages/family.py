"""Receivers of one family of BRDFs with a tensor: what they send towards a view, however their incident light is made.
[Sun 2007, Eq. 3, sec. 4.1]

A store keeps the family's model. Where the light of the factors comes from, and what stands for the lobes that factors
cannot hold, is the business of assets (`direct_tensors`) and of clustered lights (`light_factors`).
"""

from __future__ import annotations

from collections.abc import Iterator
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
from relightcli.core.shade.sampled_lobes import Lobe, Skies, like_roughness, make_lobe, make_shares, sample_lobes
from relightcli.core.transport.direct_tensor import shade_direct
from relightcli.core.transport.lobe_visibility import add_lobes
from relightcli.stages.lighting import IN_MEMORY, LightingStore

# Roughness from which lobes are partly, and wholly, those of the factors where narrower ones are sampled; and how much
# later that is where f0 is 0, and reflectance high at grazing angles alone, which factors hold less well.
BROAD = (0.4, 0.55)
LATER, LOW_F0 = 0.35, 0.2
BLACK = np.zeros(3, np.float32)
STREAMED = 1 << 16  # receivers whose arrays are read at a time where memory need not hold all


def families_of(lighting: LightingStore) -> dict[str, NDArray[np.int64]]:
    """Receivers (n,) of every family that has any which shine, or may be made to."""
    materials = list(lighting.scene.materials.values())
    models = np.array([m.model for m in materials])
    may_shine = np.array([m.adjustable or any(c > 0.0 for c in m.specular) for m in materials], bool)
    family = np.where(may_shine, models, "")[lighting.geometry.material[lighting.object]]
    return {name: np.flatnonzero(family == name) for name in FAMILIES if (family == name).any()}


def put_family(writer: formats.Writer, place: str, name: str, model: DirectModel, receivers: NDArray[np.int64]) -> None:
    """Writes a model and its receivers (n,) into the group `place`."""
    for leaf, values in model.arrays().items():
        writer.put(f"{place}/{name}/brdf/{leaf}", values, dims=ARRAYS[leaf])
    writer.put(f"{place}/{name}/receiver", receivers.astype(np.int32), dims=(f"{name}_receiver",))


class Parts:
    """Arrays of a store, a row per receiver: in memory together, or where that is more than IN_MEMORY read for some
    receivers at a time, over and over."""

    def __init__(self, store: formats.Store, names: list[str], count: int, turned: bool = False) -> None:
        """names of arrays for `count` receivers; turned: the last has its last two axes changed about."""
        self.store, self.names, self.count, self.turned = store, names, count, turned
        whole = sum(store.layouts[name].raw_bytes for name in names) <= IN_MEMORY
        self._held = self._turn([store.read(name) for name in names]) if whole else None

    def _read(self, rows: slice) -> tuple[NDArray[Any], ...]:
        arrays: Any = map(self.store.array, self.names)
        return self._turn([np.asarray(array[rows]) for array in arrays])

    def _turn(self, found: list[NDArray[Any]]) -> tuple[NDArray[Any], ...]:
        if self.turned:
            found[-1] = np.ascontiguousarray(found[-1].swapaxes(-1, -2))
        return tuple(found)

    def __iter__(self) -> Iterator[tuple[slice, tuple[NDArray[Any], ...]]]:
        """Ranges of receivers with their part of each array."""
        if self._held is not None:
            yield slice(0, self.count), self._held
            return
        for start in range(0, self.count, STREAMED):
            rows = slice(start, min(start + STREAMED, self.count))
            yield rows, self._read(rows)


class NarrowLobes:
    """Lobes of a family's receivers by a few directions each, for what is narrower than the factors can hold."""

    def __init__(self, name: str, bits: NDArray[np.uint8], threads: int) -> None:
        self.name = name
        self.shares = make_shares(bits, threads)
        self.skies: Skies
        self._lobes: dict[tuple[float, ...], Lobe] = {}

    def part(self, values: tuple[float, ...]) -> float:
        """How much of a material's lobe is left to them, 0 to 1."""
        roughness = like_roughness(self.name, values)
        if self.name == "cook-torrance":
            roughness -= LATER * max(1.0 - values[0] / LOW_F0, 0.0)
        low, high = BROAD
        return min(max((high - roughness) / (high - low), 0.0), 1.0)

    def lobe(self, values: tuple[float, ...]) -> Lobe:
        if values not in self._lobes:
            self._lobes = {**dict(list(self._lobes.items())[-3:]), values: make_lobe(self.name, *values)}
        return self._lobes[values]


class Family:
    """n receivers of a family in memory, under a light.

    receiver (n,) rising; normal (n, 3); incident (n, K+1, 3): I0, radiance times sr sr^-1, the last that of the diffuse
    factor: to be set for every light; skies: of the model's lobes; narrow: what stands for them where it has none.
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
        self.tables = Parts(
            lighting.store, [f"{group}/lobe_{d:g}" for d in self.degrees if d > 0.0], len(self.receiver)
        )
        self.incident = np.zeros((len(self.receiver), self.model.light.shape[1] + 1, 3), np.float32)
        self.skies: tuple[NDArray[np.float32], ...] = ()
        self.narrow = None if self.degrees else NarrowLobes(name, self.bits, lighting.threads)
        self.out = np.empty((len(self.receiver), 3), np.float32)
        self._settings: dict[tuple[float, ...], MaterialSetting] = {}

    def set_sky(self, sky: SkyCube, threads: int) -> None:
        """The sky that the lobes mirror."""
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
        """Specular exit radiance (n, 3) towards view (N, 3) of `active` receivers (N,), 0 of others and of materials
        that are of another model now.

        wide: the table as highlights of `bright` have it, texels whose light is not in that of the factors.
        """
        towards = np.take(view, self.receiver, axis=0)
        if active is not None:
            self.out[:] = 0.0
        for m, all_rows in self.rows.items():
            rows = all_rows if active is None else all_rows[active[self.receiver[all_rows]]]
            row = table.parameters[m]
            colour = row[SPECULAR_COLUMN : SPECULAR_COLUMN + 3].astype(np.float32)
            if table.model[m] != self.code or not colour.any():
                self.out[rows] = 0.0
                continue
            columns = (SHININESS,) if self.name == "blinn-phong" else (F0, ROUGHNESS)
            values = tuple(float(row[column]) for column in columns)
            narrow = 0.0 if self.narrow is None else self.narrow.part(values)
            if narrow < 1.0:
                self._broad(rows, towards, values, colour * np.float32(1.0 - narrow), threads)
            else:
                self.out[rows] = 0.0
            if self.narrow is not None and narrow > 0.0:
                sample_lobes(
                    self.narrow.shares,
                    self.narrow.skies,
                    towards,
                    self.normal,
                    rows,
                    self.narrow.lobe(values),
                    colour * np.float32(narrow),
                    self.out,
                    threads,
                )
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

    def _broad(
        self,
        rows: NDArray[np.int64],
        towards: NDArray[np.float32],
        values: tuple[float, ...],
        colour: NDArray[np.float32],
        threads: int,
    ) -> None:
        """Sets out[rows] to what the factors give, with the model's lobes."""
        if values not in self._settings:
            self._settings = {values: setting(self.model, *values)}
        tables = self._settings[values]
        shade_direct(self.incident, towards, self.normal, rows, tables.view_table, colour, BLACK, self.out, threads)
        for part, own in self.tables if self.degrees else ():
            first, last = np.searchsorted(rows, (part.start, part.stop))
            add_lobes(
                self.bits[part],
                own,
                self.skies,
                self.degrees,
                towards[part],
                self.normal[part],
                rows[first:last] - part.start,
                tables.energy,
                colour,
                self.out[part],
                threads,
            )
        np.maximum(self.out, 0.0, out=self.out)  # of truncation
