"""What cluster and factorize share: a transfer store made ready for the transfer tensors of its interreflections."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from relightcli.adapters.scratch import Scratch
from relightcli.core.brdf.models import pack_materials
from relightcli.core.shade.gather import pick
from relightcli.core.shade.lobe_factors import LobeFactors, local_lobes
from relightcli.core.shade.local import local_radiance
from relightcli.core.sphere import cube
from relightcli.core.transport.channels import light_factors, plan_channels, shiny_models
from relightcli.core.transport.local_lights import pack_lights
from relightcli.core.transport.transfer import (
    Sources,
    even_projection,
    gather_transfer,
    light_factor_projections,
    local_rotations,
    sky_sources,
    used_terms,
)
from relightcli.errors import StoreError
from relightcli.stages.lighting import IN_MEMORY, LightingStore

CELLS = 8  # of a face of the sky, for one bounce
COARSE = 2  # the same for two bounces
LAMP_COLUMNS = 3  # the local lights' light, by colour, comes after the sky's cells
FIT = 1024  # receivers at which lights are matched by the direct light that they give
BLOCK = 512  # receivers whose tensors are gathered at a time
SOME = 128  # receivers whose entries are read from files at a time
TOUCHED = 1 << 29  # bytes of files that all threads may reach for at a time
AROUND = 1 << 16  # bytes that the system brings with any
SOURCES = 4096  # receivers whose light is taken at a time


def fit_receivers(count: int) -> NDArray[np.int64]:
    """The receivers, of `count`, at which lights are matched, rising."""
    return np.sort(np.random.default_rng(0).permutation(count)[:FIT])


def coarse_cells() -> NDArray[np.float32]:
    """Response to a coarse cell from those to its fine cells, (6 CELLS^2, 6 COARSE^2): which one each lies in."""
    ratio = CELLS // COARSE
    face, row, column = np.meshgrid(np.arange(6), np.arange(CELLS), np.arange(CELLS), indexing="ij")
    cell = ((face * COARSE + row // ratio) * COARSE + column // ratio).reshape(-1)
    rows: NDArray[np.float32] = np.eye(6 * COARSE * COARSE, dtype=np.float32)[cell]
    return rows


def cell_radiance(flux: NDArray[np.float64], resolution: int, cells: int) -> NDArray[np.float64]:
    """Mean radiance (6 C C, 3) of a sky's coarse cells from the flux (6 R R, 3) of its texels."""
    side = resolution // cells
    total = cube.block_sums(flux, resolution, side)
    solid = np.tile(cube.solid_angles(resolution).reshape(cells, side, cells, side).sum(axis=(1, 3)), (6, 1, 1))
    radiance: NDArray[np.float64] = total / solid.reshape(-1, 1)
    return radiance


class TransferSetup:
    """Channels, gathers and sources of one store.

    functions: specular basis functions of an adjustable material; folder: of the files that take the place of memory.
    """

    def __init__(self, lighting: LightingStore, functions: int, threads: int, folder: Path | None = None) -> None:
        self.lighting, self.threads = lighting, threads
        self.scratch = Scratch(folder)
        scene, geometry = lighting.scene, lighting.geometry
        materials = list(scene.materials.values())
        self.table = pack_materials(materials)
        self.adjustable = [m.adjustable for m in materials]
        self.textured = [m in geometry.textures for m in range(len(materials))]
        self.channels, self.exits, place = plan_channels(self.table, self.adjustable, self.textured, functions)
        self.factors = light_factors(shiny_models(self.table, self.adjustable), functions)
        self.material: NDArray[np.int32] = geometry.material[lighting.object].astype(np.int32)
        self.model = np.where(self.exits.functions[self.material] > 0, place[self.material], -1).astype(np.int32)
        self.row = np.where(self.model >= 0, np.cumsum(self.model >= 0) - 1, -1).astype(np.int32)
        self.partner = lighting.partner()
        self.texture = lighting.tint()
        self.lamps = LAMP_COLUMNS if scene.lights else 0
        outgrown = lighting.hit_bytes() > IN_MEMORY
        gather = lighting.gather_into(self.scratch) if outgrown else lighting.gather()
        if gather is None:
            raise StoreError(f"{lighting.store.path}: nothing blocks anything in it; there are no interreflections")
        self.gather = gather

    @property
    def count(self) -> int:
        """Channels."""
        return len(self.channels.material)

    def seen_from(self, rows: NDArray[np.int64]) -> NDArray[np.int64]:
        """The receivers whose light some others reflect, rising."""
        seen = np.zeros(len(self.row), bool)
        for start in range(0, len(rows), SOME):
            self._mark_seen(rows[start : start + SOME], seen)
            self.scratch.let_go()
        seen[self.partner[seen]] = True
        return np.flatnonzero(seen)

    def _mark_seen(self, rows: NDArray[np.int64], seen: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """`seen` (N,), with the receivers that some others see."""
        for a, b in zip(self.gather.start[rows], self.gather.start[rows + 1], strict=True):
            seen[self.gather.source[a:b]] = True
        return seen

    def sources(self, basis: NDArray[np.float32], only: NDArray[np.int64] | None = None) -> Sources:
        """Responses to the lights of `basis` (6 CELLS^2, L), the lamps' columns after them.

        only: those that they are computed for, rising, without the lamps; None for all with them.
        """
        lighting, used = self.lighting, used_terms(len(self.factors[0]))
        lights = basis.shape[1]
        lamps = self.lamps if only is None else 0
        wanted, row = (np.arange(len(lighting)), self.row) if only is None else (only, self._rows_of(only))
        even = self.scratch.zeros((len(lighting), lights + lamps), np.float32)
        factor = self.scratch.zeros((int(row.max(initial=-1)) + 1, len(used), lights + lamps), np.float32)
        needed = np.zeros(len(lighting), bool)
        needed[wanted] = True
        for block, bits in lighting.blocks(needed=needed):
            ours = wanted[np.searchsorted(wanted, block.start) : np.searchsorted(wanted, block.stop)]
            for start in range(0, len(ours), SOURCES):
                rows = ours[start : start + SOURCES]
                part = bits[rows - block.start]
                own = row[rows]
                own = own[own >= 0]
                for face in range(6):
                    cells = basis[face * CELLS**2 : (face + 1) * CELLS**2]
                    if not cells.any():
                        continue
                    e, f = sky_sources(
                        part,
                        lighting.normal[rows],
                        self.model[rows],
                        self.factors,
                        face,
                        CELLS,
                        used,
                        self.threads,
                    )
                    even[rows, :lights] += e @ cells
                    if len(own):
                        factor[own[0] : own[-1] + 1, :, :lights] += f @ cells
                self.scratch.let_go()
        if lamps:
            self._add_lamps(even, factor, used)
        return Sources(even, factor, row, used, self.partner)

    def _rows_of(self, only: NDArray[np.int64]) -> NDArray[np.int32]:
        """Rows of the light factors, (N,), if those receivers alone have any."""
        row = np.full(len(self.row), -1, np.int32)
        shiny = only[self.model[only] >= 0]
        row[shiny] = np.arange(len(shiny))
        return row

    def _add_lamps(self, even: NDArray[np.float32], factor: NDArray[np.float32], used: NDArray[np.int64]) -> None:
        lighting = self.lighting
        bits, lights = lighting.store.read("lights/bits"), pack_lights(lighting.scene.lights.values())
        irradiance, _ = local_radiance(
            bits,
            lights,
            lighting.position,
            lighting.normal,
            None,
            self.material,
            self.table,
            np.ones(len(lighting), bool),
            self.threads,
        )
        even[:, -LAMP_COLUMNS:] = irradiance / np.float32(np.pi)
        if not len(factor):
            return
        place = np.array([self.model[self.material == m].max(initial=-1) for m in range(len(self.table.model))])
        white = np.ones((len(place), 3), np.float32)
        own = LobeFactors(place >= 0, self.exits.view_factor[:, 0], self.factors[place], white)
        lobe = np.zeros((len(factor), 6, self.factors.shape[2]), np.float32)
        local_lobes(bits, lights, lighting.position, lighting.normal, self.material, own, lobe, self.row, self.threads)
        for f, (side, term) in enumerate(used):
            factor[:, f, -LAMP_COLUMNS:] = lobe[:, 3 * side : 3 * side + 3, term]

    def gather_rows(self, rows: NDArray[np.int64], sources: Sources, order: int) -> NDArray[np.float32]:
        """Transfer (len(rows), Q, S, L) of some receivers, `transfer.gather_transfer`."""
        parts = []
        for run in self._runs(rows, sources):
            parts.append(
                gather_transfer(
                    pick(self.gather, run),
                    0,
                    sources,
                    self.exits,
                    self.count,
                    order,
                    self.lighting.normal,
                    self.material,
                    self.texture,
                    self.threads,
                )
            )
            self.scratch.let_go()
        return parts[0] if len(parts) == 1 else np.concatenate(parts)

    def _runs(self, rows: NDArray[np.int64], sources: Sources) -> Iterator[NDArray[np.int64]]:
        """Some receivers in runs that reach for no more than TOUCHED bytes of what lies in files, if anything does."""
        each = AROUND + sum(values.nbytes // max(1, len(values)) for values in (sources.even, sources.factor))
        most = TOUCHED // (each * self.threads)  # clusters are compressed side by side
        if len(rows) < 2 or not self.scratch.used:
            yield rows
            return
        if np.count_nonzero(self._mark_seen(rows, np.zeros(len(self.row), bool))) <= most:
            yield rows
            return
        half = len(rows) // 2
        yield from self._runs(rows[:half], sources)
        yield from self._runs(rows[half:], sources)

    def second_sources(self, lights: Sources, order: int, only: NDArray[np.int64] | None = None) -> Sources:
        """What receivers gather of light that was reflected once: for each light of `lights` and channel, (l, q).
        only: those that it is computed for, rising, the others get 0; None for all."""
        lighting = self.lighting
        even_weights = even_projection(order).astype(np.float32)
        used = used_terms(order - 1)
        projections = np.stack([light_factor_projections(f, order) for f in self.factors])
        weights = projections[:, used[:, 1], used[:, 0]].astype(np.float32)  # (models, F, S)
        n, q, count = len(lighting), self.count, lights.even.shape[1]
        even = self.scratch.zeros((n, count * q), np.float32)
        factor = self.scratch.zeros((int((self.model >= 0).sum()), len(used), count * q), np.float32)
        wanted = np.arange(n) if only is None else only
        for start in range(0, len(wanted), BLOCK):
            rows = wanted[start : start + BLOCK]
            world = self.gather_rows(rows, lights, order)
            flat = np.moveaxis(world, 1, 3).reshape(len(rows), order * order, count * q)
            local = local_rotations(lighting.normal[rows], order) @ flat
            even[rows] = even_weights @ local
            shiny = np.flatnonzero(self.model[rows] >= 0)
            if len(shiny):
                factor[self.row[rows[shiny]]] = weights[self.model[rows[shiny]]] @ local[shiny]
        return Sources(even, factor, self.row, used, self.partner)
