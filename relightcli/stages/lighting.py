"""A transfer store made ready to light: scene, receivers, visibility, and their exit radiance under a sky."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import relight_formats as formats
from relightcli.core.brdf.models import SPECULAR, pack_materials
from relightcli.core.lights.environment import SkyCube, latlong_to_cube, splat
from relightcli.core.shade.glossy import sky_tree, specular_radiance
from relightcli.core.shade.irradiance import irradiance, moment_prefix
from relightcli.core.shade.local import local_radiance
from relightcli.core.sphere import haar, sh
from relightcli.core.transport.local_lights import pack_lights
from relightcli.errors import InputError, StoreError
from relightcli.scene.describe import scene_from_json
from relightcli.scene.model import Geometry, Material, Scene

IN_MEMORY = 1 << 30  # visibility up to this size stays in memory between frames
BLACK = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Radiance:
    """Exit radiance of receivers, (N, 3) float32 each; `specular` is None where no material shines."""

    diffuse: NDArray[np.float32]
    specular: NDArray[np.float32] | None


def read_scene(store: formats.Store) -> tuple[Scene, Geometry]:
    """The scene that a transfer store was made from, as the store keeps it."""
    read: Any = store.read
    scene = scene_from_json(store.attrs["scene"], folder=store.path.parent)
    textures = {int(name.split("/")[1]): read(name) for name in store.names() if name.startswith("textures/")}
    geometry = Geometry(
        tuple(scene.objects),
        read("mesh/position"),
        read("mesh/normal"),
        read("mesh/uv"),
        read("mesh/face"),
        read("mesh/vertex_object"),
        read("mesh/face_object"),
        read("objects/material"),
        read("objects/two_sided"),
        textures,
    )
    return scene, geometry


class LightingStore:
    """An open transfer store. Reads what it needs when it needs it; keeps small visibility in memory."""

    def __init__(self, path: Path, threads: int) -> None:
        self.store = formats.open_store(path, "transfer")
        self.threads = threads
        self.scene, self.geometry = read_scene(self.store)
        read: Any = self.store.read
        self.position: NDArray[np.float64] = read("receivers/position")
        self.normal: NDArray[np.float32] = read("receivers/normal")
        self.object: NDArray[np.int32] = read("receivers/object")
        self.side: NDArray[np.int8] = read("receivers/side")
        self.vertex: NDArray[np.int32] | None = read("receivers/vertex") if "receivers/vertex" in self.store else None
        self.resolution = int(self.store.settings["light_resolution"])
        self.basis: str = self.store.settings["basis"]
        self._bits: NDArray[np.uint8] | None = None
        layout = self.store.layouts["visibility/bits"]
        if layout.raw_bytes <= IN_MEMORY:
            self._bits = read("visibility/bits")
        self._chunk = layout.chunks[0]

    def __len__(self) -> int:
        return len(self.position)

    @property
    def camera_name(self) -> str | None:
        """The camera whose pixels are the receivers, or None for vertices."""
        kind, _, name = str(self.store.settings["receivers"]).partition(":")
        return name if kind == "pixels" else None

    def receiver_of_vertex(self) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """Receiver on the front and on the back of every vertex, (V,) int32 each, -1 where there is none."""
        if self.vertex is None:
            raise StoreError(
                f"{self.store.path}: its receivers are pixels of camera {self.camera_name!r}, not vertices"
            )
        out = []
        for side in (1, -1):
            index: NDArray[np.int32] = np.full(len(self.geometry.positions), -1, np.int32)
            pick = np.flatnonzero(self.side == side)
            index[self.vertex[pick]] = pick
            out.append(index)
        return out[0], out[1]

    def blocks(self) -> Iterator[tuple[slice, NDArray[np.uint8]]]:
        """Visibility bits in ranges of receivers: all at once if they are in memory, else chunk by chunk."""
        if self._bits is not None:
            yield slice(0, len(self)), self._bits
            return
        array: Any = self.store.array("visibility/bits")
        for start in range(0, len(self), self._chunk):
            rows = slice(start, min(start + self._chunk, len(self)))
            yield rows, np.asarray(array[rows])

    def exit_radiance(
        self,
        environment: NDArray[np.float32],
        rotate: float,
        materials: dict[str, Material],
        view: NDArray[np.float32] | None,
        active: NDArray[np.bool_] | None = None,
        basis: str | None = None,
    ) -> Radiance:
        """Exit radiance of the receivers under a lat-long map (H, W, 3) turned by `rotate` degrees.

        view (N, 3): unit directions to the viewer, needed where a material has a specular lobe. active (N,): receivers
        to light, the others get 0. basis: how diffuse light is computed; the store's own by default.
        """
        sky = latlong_to_cube(environment, self.resolution, rotate)
        per_object = list(materials.values())
        material = self.geometry.material[self.object]
        table = pack_materials(per_object)
        albedo = np.array([m.diffuse for m in per_object], np.float32)[material]
        through = np.array([m.transmittance if m.model == "translucent" else BLACK for m in per_object], np.float32)
        through = through[material]
        partner = self._partner() if through.any() else None
        if partner is not None and active is not None:
            active = active | active[partner]  # light comes through from the other side
        e = self._irradiance(sky, active, basis or self.basis)
        lamps = None
        if "lights/bits" in self.store:
            lamp_e, lamps = local_radiance(
                self.store.read("lights/bits"),
                pack_lights(self.scene.lights.values()),
                self.position,
                self.normal,
                view,
                material,
                table,
                np.ones(len(self), bool) if active is None else active,
                self.threads,
            )
            e = e + lamp_e
        diffuse = e * albedo * np.float32(1.0 / np.pi)
        if partner is not None:
            diffuse += e[partner] * through * np.float32(1.0 / np.pi)
        shiny = np.array([m.model in SHINY and m.specular != BLACK for m in per_object], bool)[material]
        if not shiny.any():
            return Radiance(diffuse, None)
        if view is None:
            raise InputError("a material with a specular lobe looks different from everywhere: a --camera is needed")
        rows = np.flatnonzero(shiny if active is None else shiny & active)
        specular = np.zeros((len(self), 3), np.float32)
        tree = sky_tree(splat(sky), environment, rotate)
        for block, bits in self.blocks():
            pick = rows[(rows >= block.start) & (rows < block.stop)]
            if len(pick):
                specular[pick] = specular_radiance(
                    bits,
                    pick - block.start,
                    self.normal[pick],
                    view[pick],
                    material[pick],
                    table,
                    tree,
                    self.threads,
                )
        if lamps is not None:
            specular += lamps * table.parameters[material][:, SPECULAR : SPECULAR + 3].astype(np.float32)
        return Radiance(diffuse, specular)

    def _irradiance(self, sky: SkyCube, active: NDArray[np.bool_] | None, basis: str) -> NDArray[np.float32]:
        if basis == "visibility":
            prefix = moment_prefix(splat(sky))
            out = np.empty((len(self), 3), np.float32)
            for rows, bits in self.blocks():
                mask = None if active is None else active[rows]
                out[rows] = irradiance(bits, self.normal[rows], prefix, self.threads, mask)
            return out
        name = {"sh": "direct/sh", "haar": "direct/haar_value", "dense": "direct/dense"}[basis]
        if name not in self.store:
            raise StoreError(
                f"{self.store.path}: made with --basis {self.basis}, so it has no {basis} transfer; "
                f"precompute it with --basis {basis}"
            )
        read: Any = self.store.read
        if basis == "sh":
            order = int(self.store.settings["sh_order"])
            light = sh.project_sky(sky.flux, sky.resolution, order).astype(np.float32)
            return self._positive(read(name) @ light)
        if basis == "haar":
            light = haar.forward(np.moveaxis(sky.radiance(), -1, 0)).reshape(3, -1).T.astype(np.float32)
            values = haar.gather(read("direct/haar_index"), read(name), np.ascontiguousarray(light))
            return self._positive(values)
        light = sky.radiance().reshape(-1, 3).astype(np.float32)
        array: Any = self.store.array(name)
        step = array.chunks[0]
        parts = [np.asarray(array[a : a + step]) @ light for a in range(0, len(self), step)]
        return self._positive(np.concatenate(parts))

    @staticmethod
    def _positive(values: NDArray[np.float32]) -> NDArray[np.float32]:
        """Irradiance from the exit radiance of a white surface; what truncation put below zero is cut off."""
        out: NDArray[np.float32] = np.maximum(values, 0.0) * np.float32(np.pi)
        return out

    def _partner(self) -> NDArray[np.int64]:
        """The receiver on the other side of the same vertex, itself where there is none."""
        front, back = self.receiver_of_vertex()
        assert self.vertex is not None
        other = np.where(self.side > 0, back[self.vertex], front[self.vertex]).astype(np.int64)
        return np.where(other >= 0, other, np.arange(len(self)))


SHINY = ("blinn-phong", "cook-torrance", "phong")
