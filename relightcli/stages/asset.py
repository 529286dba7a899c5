"""An asset made ready to light: interreflections from compressed transfer tensors, kept by what has changed.

    new light           light into every cluster's tensor and every receiver's direct one; what follows
    new materials       channels weighted and summed, clusters to receivers, diffuse light; what follows
    new view            specular lobes towards it

[Sun 2007, sec. 4, Eq. 3-4]. Direct light comes from tensors too (`direct_tensors`), or with the basis visibility from
the bits in the asset, as in a transfer store.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

import relight_formats as formats
from relightcli.core.brdf.models import SPECULAR as SPECULAR_COLUMN
from relightcli.core.brdf.separable import POLAR
from relightcli.core.lights.environment import SkyCube, latlong_to_cube, splat
from relightcli.core.parts import in_parts, side_by_side
from relightcli.core.shade.irradiance import irradiance, moment_prefix
from relightcli.core.shade.low_order import response, shade_low_order
from relightcli.core.transport.channels import SHINY, coefficients, plan_channels
from relightcli.core.transport.transfer import even_projection, local_rotations
from relightcli.errors import InputError, StoreError
from relightcli.scene.model import Material
from relightcli.stages.direct_tensors import DirectTensors
from relightcli.stages.lighting import LightingStore, Radiance, _Coats
from relightcli.stages.transfer_setup import CELLS, COARSE, LAMP_COLUMNS, cell_radiance, fit_receivers

Factors = NDArray[np.float32]

ROWS = 128  # receivers of a matrix product: it stays in a core's memory, and on one thread
TURNED = 1 << 16  # receivers whose rotations are made at a time


class AssetStore(LightingStore):
    """An open asset, with the interface of `LightingStore`."""

    def __init__(self, store: Path | formats.Store, threads: int) -> None:
        super().__init__(store, threads)
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
        self._direct_store: DirectTensors | None = None
        self._direct_sky: SkyCube | None = None
        self._lit: tuple[NDArray[np.float32], float, SkyCube, SkyCube] | None = None
        self._diffuse: dict[int, tuple[Factors, _Coats, Factors]] = {}

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
        """See `LightingStore.exit_radiance`. Raises StoreError for more interreflections than the asset has, InputError
        for a material that has become another model than its tensors were made for."""
        bounces = self.bounces if bounces is None else bounces
        if bounces > self.bounces:
            raise StoreError(f"--bounces {bounces}: the asset has {self.bounces}; use the transfer store it came from")
        coats = self._coats_of(materials)
        if basis is not None:
            parts = super().exit_radiance(environment, rotate, materials, view, active, basis, 0)
            if bounces == 0:
                return parts
            return parts + self._tensor_bounces(*self._sky_of(environment, rotate), coats, view, active, bounces)
        if coats.shiny.any() and view is None:
            raise InputError("a material with a specular lobe looks different from everywhere: name a --camera")
        sky, spread = self._sky_of(environment, rotate)

        def direct() -> list[Radiance]:
            return [self._direct_tensors(sky, spread, environment, rotate, coats, view, active)]

        if bounces == 0:
            return direct()
        first, rest = side_by_side(
            direct, lambda: self._tensor_bounces(sky, spread, coats, view, active, bounces), self.threads
        )
        return first + rest

    def _tensor_bounces(
        self,
        sky: SkyCube,
        spread: SkyCube,
        coats: _Coats,
        view: NDArray[np.float32] | None,
        active: NDArray[np.bool_] | None,
        bounces: int,
    ) -> list[Radiance]:
        """Exit radiance after each of the interreflections."""
        if self._tensors is None:
            self._tensors = _Tensors(self)
        tensors = self._tensors
        tensors.set_light(sky, spread)
        tensors.set_materials(coefficients(self.channels, coats.table, self.functions))
        shines = bool(coats.shiny.any()) and view is not None
        specular = self._specular(coats, view, active) if shines else [None] * len(tensors.even)
        return [
            Radiance(self._diffuse_of(k + 1, even, coats), lobes)
            for k, (even, lobes) in enumerate(zip(tensors.even[:bounces], specular[:bounces], strict=True))
        ]

    def _coats_of(self, materials: dict[str, Material]) -> _Coats:
        for material, model in zip(materials.values(), self.made_for, strict=True):
            if material.model != model:
                raise InputError(
                    f"material {material.name}: is {material.model} now, and the asset was made for {model}; "
                    "use the transfer store it came from"
                )
        return super()._coats_of(materials)

    def _diffuse_of(self, part: int, even: Factors, coats: _Coats) -> Factors:
        """Diffuse exit radiance of a part of the light from its irradiance over pi, kept while neither changes."""
        kept = self._diffuse.get(part)
        if kept is None or kept[0] is not even or kept[1] is not coats:
            kept = self._diffuse[part] = (even, coats, coats.diffuse(even * np.float32(np.pi)))
        return kept[2]

    def _sky_of(self, environment: NDArray[np.float32], rotate: float) -> tuple[SkyCube, SkyCube]:
        """The sky, and the same spread over neighbouring texels (`environment.splat`)."""
        if self._lit is None or self._lit[0] is not environment or self._lit[1] != rotate:
            sky = latlong_to_cube(environment, self.resolution, rotate)
            self._lit = (environment, rotate, sky, splat(sky, self.threads))
        return self._lit[2:]

    def _direct_tensors(
        self,
        sky: SkyCube,
        spread: SkyCube,
        environment: NDArray[np.float32],
        rotate: float,
        coats: _Coats,
        view: NDArray[np.float32] | None,
        active: NDArray[np.bool_] | None,
    ) -> Radiance:
        """Direct light from the tensors; from the bits for lobes of models that have none."""
        if self._direct_store is None:
            self._direct_store = DirectTensors(self)
        direct = self._direct_store
        if self._direct_sky is not sky:
            direct.set_light(spread)
            self._direct_sky = sky
        lamp_e, lamps = self._lamps(coats, view, active)
        if lamp_e is None:
            diffuse = self._diffuse_of(0, direct.even, coats)
        else:
            diffuse = coats.diffuse(direct.even * np.float32(np.pi) + lamp_e)
        if not coats.shiny.any() or view is None:
            return Radiance(diffuse, None)
        specular, known = direct.specular(coats.table, view, active)
        rest = coats.shiny & ~known if active is None else coats.shiny & ~known & active
        if rest.any():
            specular += self._exact_specular(sky, environment, rotate, coats, view, np.flatnonzero(rest))
        if lamps is not None:
            colours = coats.table.parameters[:, SPECULAR_COLUMN : SPECULAR_COLUMN + 3].astype(np.float32)
            specular += lamps * colours[coats.material]
        return Radiance(diffuse, specular)

    def _specular(
        self, coats: _Coats, view: NDArray[np.float32] | None, active: NDArray[np.bool_] | None
    ) -> list[NDArray[np.float32] | None]:
        """Specular exit radiance after every bounce, of `active` receivers; 0 of others."""
        assert self._tensors is not None
        assert view is not None
        tensors, table = self._tensors, coats.table
        shiny = np.isin(table.model, SHINY)
        tables = np.zeros((len(table.model), POLAR, self.order * (self.order + 1) // 2), np.float32)
        for m in np.flatnonzero(shiny):
            tables[m] = response(int(table.model[m]), table.parameters[m], self.order)
        rows = np.arange(len(tensors.lobed)) if active is None else np.flatnonzero(active[tensors.lobed])
        colours = table.parameters[:, SPECULAR_COLUMN : SPECULAR_COLUMN + 3]
        colour = np.where(shiny[:, None], colours, 0.0).astype(np.float32)
        seen = np.take(view, tensors.lobed, axis=0)
        uniform = tensors.uniform if tensors.uniform is not None else np.zeros((len(seen), 3), np.float32)
        found: list[NDArray[np.float32]] = []
        for k, light in enumerate(tensors.light):
            both = shade_low_order(
                rows,
                light,
                uniform,
                tensors.lobed_normal,
                seen,
                tables,
                colour,
                tensors.lobed_material,
                self.threads,
                tensors.rotations,
            )
            found.append(both[0])
            if k == 0 and tensors.uniform is not None:
                found.append(both[1])
        out: list[NDArray[np.float32] | None] = []
        for part in found:
            whole = np.zeros((len(self), 3), np.float32)
            _put(part, tensors.lobed, whole)
            out.append(whole)
        return out


class _Tensors:
    """The asset's tensors in memory, receivers in the order of their clusters, and what has been made of them.

    even: per bounce (N, 3), irradiance over pi, in the receivers' own order; light: (n, 3, S), harmonics at the
    receivers with a lobe, `lobed` (n,), for one bounce, and for two if it has harmonics; uniform (n, 3), the second
    bounce's value if it has none.
    """

    def __init__(self, asset: AssetStore) -> None:
        self.asset = asset
        read: Any = asset.store.read
        receiver: NDArray[np.int32] = read("cluster/receiver")
        start: NDArray[np.int64] = read("cluster/start")
        self.receiver = receiver
        self.start = start
        cluster = np.repeat(np.arange(len(start) - 1), np.diff(start)).astype(np.int32)
        place = np.arange(len(receiver)) - start[cluster]
        self.basis: NDArray[np.float32] = read("one_bounce/basis")
        self.q = len(asset.channels.material)
        self.rows = [_factors(asset.store, "one_bounce/receiver_factor")[cluster, place]]
        self.light_factor = _factors(asset.store, "one_bounce/light_factor")
        self.core: NDArray[np.int8] = read("one_bounce/core")
        self.core_scale: Factors = read("one_bounce/core_scale")[..., 0]
        self.second: Factors | None = None
        if asset.bounces > 1:
            self.rows.append(_factors(asset.store, "two_bounce/receiver_factor")[cluster, place])
            core = _factors(asset.store, "two_bounce/core")
            lights = asset.store.layouts["two_bounce/keep"].shape[0] + asset.lamps
            parts = core.reshape(*core.shape[:2], -1, lights, self.q)  # light last, for a plain product with it
            self.second = np.ascontiguousarray(parts.swapaxes(3, 4))
        material = asset.geometry.material[asset.object]
        may_shine = np.isin(asset.made_for, list(LOBED))[material[receiver]]
        self.lobed = receiver[may_shine]
        self.lobe_row = np.where(may_shine, np.cumsum(may_shine) - 1, -1).astype(np.int32)
        self.lobed_normal = np.ascontiguousarray(asset.normal[self.lobed])
        self.lobed_material = material[self.lobed].astype(np.int32)
        kept = np.flatnonzero(np.equal.outer(*[_bands(asset.order)] * 2).reshape(-1))  # a rotation keeps the band
        self.even_weights = np.empty((len(receiver), asset.order**2), np.float32)
        self.rotations = np.empty((len(self.lobed), len(kept)), np.float32)
        for a in range(0, len(receiver), TURNED):
            part = slice(a, a + TURNED)
            rotations = local_rotations(asset.normal[receiver[part]], asset.order)
            self.even_weights[part] = even_projection(asset.order) @ rotations
            own = np.flatnonzero(may_shine[part])
            turned = np.swapaxes(rotations[own], 1, 2).reshape(-1, asset.order**4)  # column after column
            self.rotations[self.lobe_row[part][own]] = turned[:, kept]
        self.even: list[NDArray[np.float32]] = []
        self.light: list[NDArray[np.float32]] = []
        self.uniform: NDArray[np.float32] | None = None
        self._sky: SkyCube | None = None
        self._weights: NDArray[np.float64] | None = None
        self._one: NDArray[np.float32] | None = None
        self._two: NDArray[np.float32] | None = None
        self._room: list[NDArray[np.float32]] = []
        some = fit_receivers(len(receiver))
        self._fit_bits, self._fit_normal = asset.bits_of(some), np.ascontiguousarray(asset.normal[some])
        self._fit = [
            (read(f"{name}/fit"), read(f"{name}/keep")) for name in ("one_bounce", "two_bounce")[: asset.bounces]
        ]

    def set_light(self, sky: SkyCube, spread: SkyCube) -> None:
        if self._sky is sky:
            return
        self._sky, self._weights = sky, None
        lamps = np.eye(3, dtype=np.float32)[: self.asset.lamps]
        prefix, threads = moment_prefix(spread), self.asset.threads
        incident = irradiance(self._fit_bits, self._fit_normal, prefix, threads) / np.float32(np.pi)

        def matched(bounce: int, mean: NDArray[np.floating[Any]]) -> NDArray[np.float32]:
            fit, keep = self._fit[bounce]
            return np.concatenate([fit @ incident + keep @ mean.astype(np.float32), lamps])  # (L, 3)

        light = matched(0, self.basis.T @ cell_radiance(sky.flux, sky.resolution, CELLS))
        reduced = np.matmul(light.T, self.light_factor)  # (C, 3, light eigenvectors)
        one = np.zeros((len(reduced), 3, *self.core.shape[2:]), np.float32)
        in_parts(lambda a, b: _contract(a, b, self.core, self.core_scale, reduced, one), len(one), threads)
        self._one = one.reshape(len(one), 3, -1, self.q, self.asset.order**2)
        if self.second is not None:
            light = matched(1, cell_radiance(sky.flux, sky.resolution, COARSE))
            self._two = self.second @ light

    def set_materials(self, weights: NDArray[np.float64]) -> None:
        """weights (Q, 3) of the channels."""
        if self._weights is not None and np.array_equal(weights, self._weights):
            return
        self._weights = weights
        h = weights.astype(np.float32)
        assert self._one is not None
        self.even, self.light, self.uniform = [], [], None
        self._spread(self.rows[0], np.einsum("ckvqs,qk->cvks", self._one, h, optimize=True))
        if self._two is not None:
            c, r = self._two.shape[:2]
            parts = self._two.reshape(c, r, self.q, -1, self.q, 3)  # second channel, harmonic, first channel
            self._spread(self.rows[1], np.einsum("crasbk,ak,bk->crks", parts, h, h, optimize=True))

    def _spread(self, rows: Factors, values: NDArray[np.float32]) -> None:
        """From (C, eigenvectors, 3, S) to all receivers."""
        c, v, _, s = values.shape
        flat = np.ascontiguousarray(values, np.float32).reshape(c, v, 3 * s)
        k = len(self.even)
        if len(self._room) == k:  # memory is taken once: fresh pages would cost more than filling them
            self._room.append(np.empty((len(self.lobed), 3, s), np.float32))
        light = self._room[k]
        even = np.empty((len(rows), 3), np.float32)  # not taken from there: what was made of the old one is told by it

        def part(a: int, b: int) -> None:
            _spread(a, b, rows, self.start, flat, self.even_weights, self.receiver, even, self.lobe_row, light)

        in_parts(part, c, self.asset.threads)
        self.even.append(even)
        if s == 1:
            self.uniform = np.maximum(light[:, :, 0], np.float32(0.0))
        else:
            self.light.append(light)


@njit(cache=True, nogil=True)
def _put(values, rows, out):  # type: ignore[no-untyped-def]
    """Values (n, 3), not below 0, at the rows (n,) of out."""
    for j in range(len(rows)):
        for c in range(3):
            out[rows[j], c] = max(values[j, c], np.float32(0.0))


LOBED = ("blinn-phong", "cook-torrance", "phong")


def _bands(order: int) -> NDArray[np.int64]:
    """Band of every harmonic, (order^2,)."""
    return np.repeat(np.arange(order), 2 * np.arange(order) + 1)


def _factors(store: formats.Store, name: str) -> Factors:
    codes, scale = store.read(name), store.read(f"{name}_scale")
    values: Factors = codes.astype(np.float32) * scale
    return values


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz"})
def _contract(first, last, core, scale, light, out):  # type: ignore[no-untyped-def]
    """Light (C, 3, L) into the cores of clusters first to last: codes (C, L, V, S) int8 in steps of scale (C, L, V).
    Adds to out (C, 3, V, S). Four eigenvectors of light at a time: the codes are read once, as the bytes they are."""
    count, zero = core.shape[1], np.float32(0.0)
    for c in range(first, last):
        for group in range(0, count, 4):
            k0, k1, k2, k3 = group, min(group + 1, count - 1), min(group + 2, count - 1), min(group + 3, count - 1)
            for v in range(core.shape[2]):
                s0, s1 = scale[c, k0, v], scale[c, k1, v] if group + 1 < count else zero
                s2, s3 = scale[c, k2, v] if group + 2 < count else zero, scale[c, k3, v] if group + 3 < count else zero
                codes0, codes1, codes2, codes3 = core[c, k0, v], core[c, k1, v], core[c, k2, v], core[c, k3, v]
                of = light[c]
                r0, r1, r2, r3 = of[0, k0] * s0, of[0, k1] * s1, of[0, k2] * s2, of[0, k3] * s3
                g0, g1, g2, g3 = of[1, k0] * s0, of[1, k1] * s1, of[1, k2] * s2, of[1, k3] * s3
                b0, b1, b2, b3 = of[2, k0] * s0, of[2, k1] * s1, of[2, k2] * s2, of[2, k3] * s3
                red, green, blue = out[c, 0, v], out[c, 1, v], out[c, 2, v]
                for m in range(core.shape[3]):
                    w, x, y, z = (
                        np.float32(codes0[m]),
                        np.float32(codes1[m]),
                        np.float32(codes2[m]),
                        np.float32(codes3[m]),
                    )
                    red[m] += r0 * w + r1 * x + r2 * y + r3 * z
                    green[m] += g0 * w + g1 * x + g2 * y + g3 * z
                    blue[m] += b0 * w + b1 * x + b2 * y + b3 * z


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract", "nsz"})
def _spread(first, last, rows, start, flat, even_weights, receiver, even, lobe_row, light):  # type: ignore[no-untyped-def]
    """From the vectors of clusters first to last to their receivers: even light of all, harmonics where a lobe is."""
    size = flat.shape[2]
    count = size // 3
    room = np.empty((ROWS, size), np.float32)
    zero = np.float32(0.0)
    for own in range(first, last):
        for low in range(start[own], start[own + 1], ROWS):
            high = min(low + ROWS, start[own + 1])
            np.dot(rows[low:high], flat[own], room[: high - low])
            for i in range(low, high):
                world = room[i - low]
                row = lobe_row[i]
                for colour in range(3):
                    of = world[colour * count : (colour + 1) * count]
                    total = of[0]  # of a uniform value: the mean itself
                    if count > 1:
                        total = zero
                        for k in range(count):
                            total += even_weights[i, k] * of[k]
                    even[receiver[i], colour] = max(total, zero)
                    if row >= 0:
                        light[row, colour, :] = of
