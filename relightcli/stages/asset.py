"""An asset made ready to light: interreflections from compressed transfer tensors, kept by what has changed.

    new light           light into every cluster's tensor; what follows
    new materials       channels weighted and summed, clusters to receivers; what follows
    new view            specular lobes towards it

[Sun 2007, sec. 4, Eq. 3-4]. Direct light comes from the visibility in the asset, as in a transfer store.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

import relight_formats as formats
from relightcli.core.brdf.models import SPECULAR as SPECULAR_COLUMN
from relightcli.core.lights.environment import latlong_to_cube
from relightcli.core.shade.gather import in_parts
from relightcli.core.shade.low_order import response, shade_low_order
from relightcli.core.transport.channels import SHINY, coefficients, plan_channels
from relightcli.core.transport.transfer import even_projection, local_rotations
from relightcli.errors import InputError
from relightcli.scene.model import Material
from relightcli.stages.lighting import LightingStore, Radiance, _Coats
from relightcli.stages.transfer_setup import CELLS, COARSE, LAMP_COLUMNS, cell_radiance

Factors = NDArray[np.float32]


class AssetStore(LightingStore):
    """An open asset, with the interface of `LightingStore`."""

    def __init__(self, path: Path, threads: int) -> None:
        super().__init__(path, threads)
        settings = self.store.settings
        self.functions, self.order = int(settings["functions"]), int(settings["order"])
        self.second_order = int(settings["second_order"])
        materials = list(self.scene.materials.values())
        textured = [m in self.geometry.textures for m in range(len(materials))]
        self.made_for = [m.model for m in materials]
        table = self._coats(materials).table
        self.channels, _, _ = plan_channels(table, [m.adjustable for m in materials], textured, self.functions)
        self.lamps = LAMP_COLUMNS if self.scene.lights else 0
        self._tensors: _Tensors | None = None

    def exit_radiance(
        self,
        environment: NDArray[np.float32],
        rotate: float,
        materials: dict[str, Material],
        view: NDArray[np.float32] | None,
        active: NDArray[np.bool_] | None = None,
        basis: str | None = None,
        bounces: int | None = None,
    ) -> list[Radiance]:
        """See `LightingStore.exit_radiance`. Raises InputError for more interreflections than the asset has, and for a
        material that has become another model than its tensors were made for."""
        bounces = self.bounces if bounces is None else bounces
        if bounces > self.bounces:
            raise InputError(f"--bounces {bounces}: the asset holds {self.bounces}; use the transfer store it came from")
        listed = list(materials.values())
        for material, model in zip(listed, self.made_for, strict=True):
            if material.model != model:
                raise InputError(
                    f"material {material.name}: is {material.model} now, and the asset was made for {model}; "
                    "use the transfer store it came from"
                )
        parts = super().exit_radiance(environment, rotate, materials, view, active, basis, 0)
        if bounces == 0:
            return parts
        coats = self._coats(listed)
        if self._tensors is None:
            self._tensors = _Tensors(self)
        tensors = self._tensors
        tensors.set_light(environment, rotate)
        tensors.set_materials(coefficients(self.channels, coats.table, self.functions))
        for fields in tensors.fields[:bounces]:
            diffuse = coats.diffuse(fields.even * np.float32(np.pi))
            specular = None
            if coats.shiny.any() and view is not None:
                specular = self._specular(coats, fields, view)
            parts.append(Radiance(diffuse, specular))
        return parts

    def _specular(self, coats: _Coats, fields: _Fields, view: NDArray[np.float32]) -> NDArray[np.float32]:
        assert self._tensors is not None
        rows = self._tensors.lobed
        order = 1 if fields.local.shape[1] == 1 else self.order
        bands = order * (order + 1) // 2
        tables = np.zeros((len(coats.table.model), *response(SHINY[0], coats.table.parameters[0], 1).shape[:1], bands))
        for m, code in enumerate(coats.table.model):
            if code in SHINY:
                tables[m] = response(int(code), coats.table.parameters[m], order)
        colour = coats.table.parameters[:, SPECULAR_COLUMN : SPECULAR_COLUMN + 3]
        out = np.zeros((len(self), 3), np.float32)
        found = shade_low_order(
            fields.local,
            self._tensors.lobed_normal,
            view[rows],
            tables.astype(np.float32),
            np.where(np.isin(coats.table.model, SHINY)[:, None], colour, 0.0).astype(np.float32),
            self._tensors.lobed_material,
            self.threads,
        )
        out[rows] = np.maximum(found, 0.0)
        return out


class _Fields:
    """Light that arrives after some bounces: even (N, 3), irradiance over pi; local (n, S, 3), harmonics in the frames
    of the receivers with a lobe; S = 1 for a uniform value."""

    def __init__(self, even: NDArray[np.float32], local: NDArray[np.float32]) -> None:
        self.even, self.local = even, local


class _Tensors:
    """The asset's tensors in memory, and what has been made of them."""

    def __init__(self, asset: AssetStore) -> None:
        self.asset = asset
        read: Any = asset.store.read
        self.receiver: NDArray[np.int32] = read("cluster/receiver")
        self.start: NDArray[np.int64] = read("cluster/start")
        self.basis: NDArray[np.float32] = read("one_bounce/basis")
        self.q, self.s = len(asset.channels.material), asset.order**2
        self.first = {k: _factors(asset.store, f"one_bounce/{k}") for k in ("receiver_factor", "light_factor", "core")}
        self.second: dict[str, Factors] = {}
        if asset.bounces > 1:
            self.second = {k: _factors(asset.store, f"two_bounce/{k}") for k in ("receiver_factor", "core")}
        materials = asset.geometry.material[asset.object]
        may_shine = np.array([m in ("blinn-phong", "cook-torrance", "phong") for m in asset.made_for])
        self.lobed = np.flatnonzero(may_shine[materials])
        self.lobed_normal = np.ascontiguousarray(asset.normal[self.lobed])
        self.lobed_material = materials[self.lobed].astype(np.int32)
        rotations = local_rotations(asset.normal, asset.order)
        self.even_weights = np.ascontiguousarray(even_projection(asset.order) @ rotations, np.float32)
        self.rotations = np.ascontiguousarray(rotations[self.lobed])
        self.fields: list[_Fields] = []
        self._light: tuple[NDArray[np.float32], float] | None = None
        self._weights: NDArray[np.float64] | None = None
        self._one: NDArray[np.float32] | None = None
        self._two: NDArray[np.float32] | None = None

    def set_light(self, environment: NDArray[np.float32], rotate: float) -> None:
        if self._light is not None and self._light[0] is environment and self._light[1] == rotate:
            return
        self._light, self._weights = (environment, rotate), None
        sky = latlong_to_cube(environment, CELLS, rotate)
        fine = cell_radiance(sky.flux, CELLS, CELLS).astype(np.float32)
        coarse = cell_radiance(sky.flux, CELLS, COARSE).astype(np.float32)
        lamps = np.eye(3, dtype=np.float32)[: self.asset.lamps]
        light = np.concatenate([self.basis.T @ fine, lamps])  # (L, 3)
        reduced = np.matmul(light.T, self.first["light_factor"])  # (C, 3, light eigenvectors)
        core = self.first["core"]
        one = np.matmul(reduced, core.reshape(len(core), core.shape[1], -1))
        self._one = one.reshape(len(core), 3, -1, self.q, self.s)
        if self.second:
            core = self.second["core"]
            light = np.concatenate([coarse, lamps])
            parts = core.reshape(*core.shape[:2], -1, len(light), self.q)
            self._two = np.einsum("crxlq,lk->crxqk", parts, light, optimize=True)

    def set_materials(self, weights: NDArray[np.float64]) -> None:
        """weights (Q, 3) of the channels."""
        if self._weights is not None and np.array_equal(weights, self._weights):
            return
        self._weights = weights
        h = weights.astype(np.float32)
        assert self._one is not None
        self.fields = [self._spread(self.first["receiver_factor"], np.einsum("ckvqs,qk->cvsk", self._one, h))]
        if self._two is not None:
            c, r = self._two.shape[:2]
            parts = self._two.reshape(c, r, self.q, -1, self.q, 3)  # second channel, harmonic, first channel
            both = np.einsum("crasbk,ak,bk->crsk", parts, h, h, optimize=True)
            self.fields.append(self._spread(self.second["receiver_factor"], both))

    def _spread(self, receivers: Factors, values: NDArray[np.float32]) -> _Fields:
        """From (C, eigenvectors, S, 3) to all receivers."""
        c, v, s, _ = values.shape
        world = np.empty((len(self.receiver), s, 3), np.float32)
        flat = np.ascontiguousarray(values.reshape(c, v, s * 3))
        for k in range(c):
            rows = self.receiver[self.start[k] : self.start[k + 1]]
            world[rows] = (receivers[k, : len(rows)] @ flat[k]).reshape(-1, s, 3)
        if s == 1:
            even = np.maximum(world[:, 0], 0.0)
            return _Fields(even, (even[self.lobed] * np.float32(np.sqrt(4.0 * np.pi)))[:, None])
        even = np.empty((len(world), 3), np.float32)
        local = np.empty((len(self.lobed), s, 3), np.float32)

        def part(a: int, b: int) -> None:
            _even(world[a:b], self.even_weights[a:b], even[a:b])

        def turn(a: int, b: int) -> None:
            _rotate(world, self.lobed[a:b], self.rotations[a:b], local[a:b])

        in_parts(part, len(world), self.asset.threads)
        in_parts(turn, len(self.lobed), self.asset.threads)
        return _Fields(even, local)


def _factors(store: formats.Store, name: str) -> Factors:
    return formats.dequantise(store.read(name), store.read(f"{name}_scale"))


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract", "nsz"})
def _even(world, weights, out):  # type: ignore[no-untyped-def]
    for i in range(len(world)):
        r = g = b = np.float32(0.0)
        for s in range(weights.shape[1]):
            w = weights[i, s]
            r += w * world[i, s, 0]
            g += w * world[i, s, 1]
            b += w * world[i, s, 2]
        zero = np.float32(0.0)
        out[i, 0], out[i, 1], out[i, 2] = max(r, zero), max(g, zero), max(b, zero)


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract", "nsz"})
def _rotate(world, rows, rotations, out):  # type: ignore[no-untyped-def]
    """Band by band: a rotation does not mix them."""
    for i in range(len(rows)):
        x = world[rows[i]]
        low, band = 0, 0
        while low < rotations.shape[1]:
            high = low + 2 * band + 1
            for j in range(low, high):
                r = g = b = np.float32(0.0)
                for s in range(low, high):
                    w = rotations[i, j, s]
                    r += w * x[s, 0]
                    g += w * x[s, 1]
                    b += w * x[s, 2]
                out[i, j, 0], out[i, j, 1], out[i, j, 2] = r, g, b
            low, band = high, band + 1
