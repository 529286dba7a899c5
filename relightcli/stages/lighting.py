"""A transfer store made ready to light: scene, receivers, visibility, and their exit radiance under a sky."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

import relight_formats as formats
from relightcli.core.brdf.models import SPECULAR, MaterialTable, pack_materials, widen
from relightcli.core.lights.environment import SkyCube, latlong_to_cube, splat
from relightcli.core.shade.glossy import sky_tree, specular_radiance
from relightcli.core.shade.irradiance import irradiance, moment_prefix
from relightcli.core.shade.local import local_radiance
from relightcli.core.sphere import haar, sh
from relightcli.core.transport.local_lights import LocalLights, pack_lights
from relightcli.core.transport.receivers import receivers_of_vertices
from relightcli.errors import InputError, StoreError
from relightcli.scene.describe import scene_from_json
from relightcli.scene.model import Geometry, Material, Scene
from relightcli.stages.precompute_config import BASES, MOST_BOUNCES
from relightcli.stages.rig_store import read_rigs

if TYPE_CHECKING:
    from relightcli.adapters.scratch import Scratch
    from relightcli.core.shade.bounces import Exit
    from relightcli.core.shade.gather import Gather
    from relightcli.core.shade.lobe_factors import LobeFactors

IN_MEMORY = 1 << 30  # visibility up to this size stays in memory between frames
ENTRIES = 1 << 23  # of pixels' gathers that are made at a time
MOST_RESOLUTION = 4096  # that a store may name: it decides how much memory is asked for
KINDS = ("transfer", "clusters", "asset", "light_clusters", "pose")
BLACK = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Radiance:
    """Exit radiance of receivers, (N, 3) float32 each; `specular` is None where no material shines."""

    diffuse: NDArray[np.float32]
    specular: NDArray[np.float32] | None


def together(parts: list[Radiance]) -> Radiance:
    """The sum of exit radiances."""
    if len(parts) == 1:
        return parts[0]
    diffuse: NDArray[np.float32] = np.sum([part.diffuse for part in parts], axis=0)
    lobes = [part.specular for part in parts if part.specular is not None]
    return Radiance(diffuse, np.sum(lobes, axis=0) if lobes else None)


@dataclass(frozen=True)
class _Coats:
    """The receivers' materials: index (N,) into `table`; albedo and transmittance (N, 3); partner (N,), the receiver on
    the other side, where light comes through; shiny (N,), those with a specular lobe."""

    material: NDArray[np.int32]
    table: MaterialTable
    albedo: NDArray[np.float32]
    through: NDArray[np.float32]
    partner: NDArray[np.int64] | None
    shiny: NDArray[np.bool_]

    def diffuse(self, e: NDArray[np.float32]) -> NDArray[np.float32]:
        """Diffuse exit radiance, (N, 3), of an irradiance (N, 3)."""
        out: NDArray[np.float32] = e * self.albedo
        out *= np.float32(1.0 / np.pi)
        if self.partner is not None:
            out += e[self.partner] * self.through * np.float32(1.0 / np.pi)
        return out


def read_scene(store: formats.Store) -> tuple[Scene, Geometry]:
    """The scene that a transfer store was made from, as the store keeps it."""
    read: Any = store.read
    folder = store.path.parent if isinstance(store.path, Path) else None  # maps are read from files only
    scene = scene_from_json(store.attrs["scene"], folder=folder)
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
        rigs=read_rigs(store),
    )
    return scene, geometry


def need_scene(store: formats.Store) -> None:
    """Raises StoreError for a store that no picture is made from."""
    if store.kind not in KINDS:
        raise StoreError(f"{store.path}: expected a store of kind {' or '.join(KINDS)}, found {store.kind}.")


def whole_setting(store: formats.Store, name: str, low: int, high: int) -> int:
    """A setting of the store, which may be a stranger's."""
    value = store.settings[name]
    if type(value) is not int or not low <= value <= high:
        raise ValueError(f"settings.{name}: expected {low} to {high}, found {value!r}")
    return value


def need_still(store: formats.Store) -> None:
    """Raises StoreError for a store whose objects may be moved, which a stage would take for parts of the rest."""
    if "fields" in store.attrs:
        raise StoreError(
            f"{store.path}: holds objects that may be moved, which are simulated apart; expected a store without. "
            'Precompute with motion = "static", or with --effects direct,shadows.'
        )


@contextlib.contextmanager
def described(path: object) -> Iterator[None]:
    """A store whose files are sound, but which does not describe what its kind has to: StoreError."""
    try:
        yield
    except (KeyError, TypeError, ValueError, AttributeError, IndexError, OverflowError) as error:
        what = f"lacks {error}" if isinstance(error, KeyError) else str(error)
        raise StoreError(
            f"{path}: its metadata do not describe a store of its kind ({what[:200]}). Make it again (--overwrite)."
        ) from error


class LightingStore:
    """An open transfer store. Reads what it needs when it needs it; keeps small visibility in memory.

    apart: whether the entries of `exit_radiance` are wanted one by one, or no more than their sum. streams: whether
    what receivers see of each other may be read again for every interreflection.
    """

    apart = True
    streams = True
    kept = IN_MEMORY  # bytes of what pixels see that are kept between frames

    def __init__(self, store: Path | formats.Store, threads: int) -> None:
        self.store = formats.open_store(store) if isinstance(store, Path) else store
        need_scene(self.store)
        self.threads = threads
        with described(self.store.path):
            self._open()

    def _open(self) -> None:
        self.scene, self.geometry = read_scene(self.store)
        read: Any = self.store.read
        self.position: NDArray[np.float64] = read("receivers/position")
        self.normal: NDArray[np.float32] = read("receivers/normal")
        self.object: NDArray[np.int32] = read("receivers/object")
        self.side: NDArray[np.int8] = read("receivers/side")
        self.vertex: NDArray[np.int32] | None = read("receivers/vertex") if "receivers/vertex" in self.store else None
        self.resolution = whole_setting(self.store, "light_resolution", 1, MOST_RESOLUTION)
        self.basis: str = self.store.settings["basis"]
        if self.basis not in BASES:
            raise ValueError(f"settings.basis: expected one of {', '.join(BASES)}, found {self.basis!r}")
        self.bounces = whole_setting(self.store, "bounces", 0, MOST_BOUNCES)
        if not isinstance(self.store.settings["receivers"], str):
            raise TypeError("settings.receivers: expected a text")
        # Receivers of pixels, which come first; those on vertices, if any, follow.
        self.pixels = self.store.layouts["receivers/pixel"].shape[0] if "receivers/pixel" in self.store else 0
        self._gathered: dict[int, Gather] = {}
        self._seen: list[tuple[int, Gather]] | None = None
        self._coated: tuple[dict[str, Material], _Coats] | None = None
        self._cubes: list[tuple[NDArray[np.float32], int, float, SkyCube]] = []
        self._bits: Future[NDArray[np.uint8]] | None = None
        if "visibility/bits" in self.store:
            layout = self.store.layouts["visibility/bits"]
            if layout.raw_bytes <= IN_MEMORY:  # decoded beside the making of the first view
                self._bits = ThreadPoolExecutor(1).submit(read, "visibility/bits")
            self._chunk = layout.chunks[0]

    def __len__(self) -> int:
        return len(self.position)

    @property
    def camera_name(self) -> str | None:
        """The camera whose pixels are the receivers, or None for vertices."""
        kind, _, name = str(self.store.settings["receivers"]).partition(":")
        return name if kind == "pixels" else None

    @property
    def changed(self) -> int | None:
        """Clusters of lights that the last frame changed; None where that is not how light is computed."""
        return None

    def resume(self, previous: Path) -> list[str]:
        """Takes up the light of an earlier run; notes about it. Raises StoreError if that was of another store."""
        self._earlier(previous)
        return [
            f"--from {previous}: nothing of it is of use; only a store of clustered lights, which cluster "
            "--light-resolution makes, changes light in part. All of it was computed"
        ]

    def _earlier(self, path: Path) -> formats.Store:
        """The radiance store at `path`. Raises StoreError if it was not made from this store."""
        earlier = formats.open_store(path, "radiance")
        if earlier.inputs.get("store") != self.store.fingerprint:
            raise StoreError(f"{path}: was not made from {self.store.path}, as --from needs it")
        return earlier

    def set_poses(self, poses: tuple[str, ...]) -> list[str]:
        """Poses skinned objects; notes about it. Raises InputError where a store cannot."""
        if poses:
            raise InputError(
                f"--pose: {self.store.path} lights its objects where they stood when it was made; add --reference, or "
                + ("pose what fit-pose made of it" if self.camera_name is None else "precompute --receivers vertices")
            )
        return []

    def set_moves(self, moves: tuple[str, ...]) -> list[str]:
        """Puts rigid objects and local lights elsewhere; notes about it. Raises InputError where a store cannot."""
        if moves:
            raise InputError(
                f"--move: {self.store.path} lights its objects where they stood when it was made; add --reference, or "
                'precompute objects with motion = "rigid" and their fields'
            )
        return []

    def trace_suns(self) -> None:
        """Shadows that movers throw in the light of suns become sharp. Raises InputError where nothing moves."""
        raise InputError(
            f"--suns traced: {self.store.path} holds nothing that may be moved: its shadows are as sharp as they get"
        )

    def costs(self) -> dict[str, Any]:
        """What the pictures so far took, by step; empty where there are no steps."""
        return {}

    def put_light(self, writer: formats.Writer) -> None:
        """Writes what a later `resume` needs, if anything."""

    def receiver_of_vertex(self) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """Receiver on the front and on the back of every vertex, (V,) int32 each, -1 where there is none."""
        if self.vertex is None or self.camera_name is not None:
            raise StoreError(
                f"{self.store.path}: its receivers are pixels of camera {self.camera_name!r}, not vertices"
            )
        return receivers_of_vertices(self.vertex, self.side, len(self.geometry.positions))

    def buried(self) -> NDArray[np.bool_]:
        """Vertex receivers that nothing can see, (N,)."""
        found: Any = self.store.read("receivers/buried")
        buried: NDArray[np.bool_] = found
        return buried

    def blocks(
        self, first: int = 0, last: int | None = None, needed: NDArray[np.bool_] | None = None
    ) -> Iterator[tuple[slice, NDArray[np.uint8]]]:
        """Visibility bits in ranges of the receivers from `first` to `last`: all at once if they are in memory, else
        chunk by chunk, of which those without any receiver `needed` (N,) are not read."""
        last = len(self) if last is None else last
        if self._bits is not None:
            yield slice(first, last), self._bits.result()[first:last]
            return
        array: Any = self.store.array("visibility/bits")
        for start in range(first - first % self._chunk, last, self._chunk):
            rows = slice(max(start, first), min(start + self._chunk, last))
            if needed is None or needed[rows].any():
                yield rows, np.asarray(array[rows])

    def bits_of(self, receivers: NDArray[np.integer[Any]]) -> NDArray[np.uint8]:
        """Visibility bits of some receivers, rising indices."""
        parts = []
        for block, bits in self.blocks(needed=self._mask(receivers)):
            own = receivers[(receivers >= block.start) & (receivers < block.stop)]
            if len(own):
                parts.append(bits[own - block.start])
        return np.concatenate(parts)

    def _mask(self, receivers: NDArray[np.integer[Any]]) -> NDArray[np.bool_]:
        """Which receivers are among those, (N,)."""
        mask = np.zeros(len(self), bool)
        mask[receivers] = True
        return mask

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
        """Exit radiance of the receivers under a lat-long map (H, W, 3) turned by `rotate` degrees.

        One entry for light that was reflected once, then one for each interreflection; they add up. view (N, 3): unit
        directions to the viewer, needed where a material has a specular lobe. active (N,): receivers to light, the
        others may get 0. basis: how diffuse light is computed; bounces: interreflections; the store's own by default.
        """
        bounces = self.bounces if bounces is None else bounces
        coats = self._coats_of(materials)
        if coats.shiny.any() and view is None:
            raise InputError("a material with a specular lobe looks different from everywhere: a --camera is needed")
        streamed = bool(bounces) and self.streams and self.hit_bytes() > IN_MEMORY
        gather = self.gather(self.pixels) if bounces and not streamed else None
        lit = active if gather is None and not streamed else None
        direct = self._direct(environment, rotate, coats, view, active, lit, basis or self.basis)
        if gather is None and not streamed:
            return [direct, *[Radiance(np.zeros_like(direct.diffuse), None)] * bounces]
        return [direct, *self._bounces(gather, direct, environment, rotate, coats, view, active, bounces)]

    def _coats_of(self, materials: dict[str, Material]) -> _Coats:
        """The receivers' materials, kept while they stay the same."""
        if self._coated is None or self._coated[0] != materials:
            self._coated = (materials, self._coats(list(materials.values())))
        return self._coated[1]

    def _coats(self, materials: list[Material]) -> _Coats:
        material = self.geometry.material[self.object]
        through = np.array([m.transmittance if m.model == "translucent" else BLACK for m in materials], np.float32)
        albedo = np.array([m.diffuse for m in materials], np.float32)
        shiny = np.array([m.model in SHINY and m.specular != BLACK for m in materials], bool)
        passes = bool(through[material].any()) if through.any() else False
        return _Coats(
            material,
            pack_materials(materials),
            np.take(albedo, material, axis=0),
            np.take(through, material, axis=0) if passes else np.zeros((len(material), 3), np.float32),
            self.partner() if passes else None,
            np.take(shiny, material),
        )

    def _direct(
        self,
        environment: NDArray[np.float32],
        rotate: float,
        coats: _Coats,
        view: NDArray[np.float32] | None,
        looked_at: NDArray[np.bool_] | None,
        active: NDArray[np.bool_] | None,
        basis: str,
    ) -> Radiance:
        """Light that is reflected once: diffuse of `active` receivers, specular of those `looked_at` (None: all)."""
        sky = self._cube(environment, self.resolution, rotate)
        material, table, partner = coats.material, coats.table, coats.partner
        if partner is not None and active is not None:
            active = active | active[partner]  # light comes through from the other side
        e = self._irradiance(sky, active, basis)
        lamp_e, lamps = self._lamps(coats, view, active)
        if lamp_e is not None:
            e = e + lamp_e
        diffuse = coats.diffuse(e)
        if not coats.shiny.any() or view is None:
            return Radiance(diffuse, None)
        rows = np.flatnonzero(coats.shiny if looked_at is None else coats.shiny & looked_at)
        specular = self._exact_specular(sky, environment, rotate, coats, view, rows)
        if lamps is not None:
            specular += lamps * table.parameters[material][:, SPECULAR : SPECULAR + 3].astype(np.float32)
        return Radiance(diffuse, specular)

    def _cube(self, environment: NDArray[np.float32], resolution: int, rotate: float) -> SkyCube:
        """The map as a cube; those of the last two arrays are kept."""
        for known, size, turn, sky in self._cubes:
            if known is environment and (size, turn) == (resolution, rotate):
                return sky
        made = latlong_to_cube(environment, resolution, rotate)
        self._cubes = [*self._cubes[-1:], (environment, resolution, rotate, made)]
        return made

    def _exact_specular(
        self,
        sky: SkyCube,
        environment: NDArray[np.float32],
        rotate: float,
        coats: _Coats,
        view: NDArray[np.float32],
        rows: NDArray[np.int64],
    ) -> NDArray[np.float32]:
        """Specular light of the sky at `rows`, integrated from the bits, (N, 3); 0 elsewhere."""
        specular = np.zeros((len(self), 3), np.float32)
        tree = sky_tree(splat(sky, self.threads), environment, rotate)
        for block, bits in self.blocks(needed=self._mask(rows)):
            pick = rows[(rows >= block.start) & (rows < block.stop)]
            if len(pick):
                specular[pick] = specular_radiance(
                    bits,
                    pick - block.start,
                    self.normal[pick],
                    view[pick],
                    coats.material[pick],
                    coats.table,
                    tree,
                    self.threads,
                )
        return specular

    def _lamps(
        self, coats: _Coats, view: NDArray[np.float32] | None, active: NDArray[np.bool_] | None
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]] | tuple[None, None]:
        """Irradiance (N, 3) of the local lights, and their specular light without its colour; None without lights."""
        lights = self._local_lights()
        if lights is None:
            return None, None
        return local_radiance(
            *lights,
            self.position,
            self.normal,
            view,
            coats.material,
            coats.table,
            np.ones(len(self), bool) if active is None else active,
            self.threads,
        )

    def _local_lights(self) -> tuple[NDArray[np.uint8], LocalLights] | None:
        """Bits of the local lights' points that every receiver sees, and the lights; None without lights."""
        if "lights/bits" not in self.store:
            return None
        bits: Any = self.store.read("lights/bits")
        return bits, pack_lights(self.scene.lights.values())

    def _bounces(
        self,
        gather: Gather | None,
        direct: Radiance,
        environment: NDArray[np.float32],
        rotate: float,
        coats: _Coats,
        view: NDArray[np.float32] | None,
        active: NDArray[np.bool_] | None,
        bounces: int,
    ) -> Iterator[Radiance]:
        """Exit radiance after each of `bounces` interreflections of the directly lit receivers. Without `gather`, which
        memory need not hold, it is made again for each of them, part by part."""
        # Loaded here: pictures of direct light need not wait for them.
        from relightcli.core.brdf.separable import TERMS
        from relightcli.core.shade.bounces import Exit, Received, bounce
        from relightcli.core.shade.lobe_factors import lobe_factors, lobe_rows, local_lobes, sky_lobes

        cells = self.store.layouts["bounce/hit"].shape[2] if gather is None else gather.cells
        table = widen(coats.table, 0.5 * np.pi / cells)
        factors = lobe_factors(table)
        first = self.pixels  # light comes from the receivers after these only, so that only they need room for lobes
        row = np.roll(lobe_rows(np.roll(coats.material, -first), factors), first)
        lobe = np.zeros((int(row[first:].max()) + 1, 6, TERMS), np.float32)
        if len(lobe):
            sky = splat(latlong_to_cube(environment, cells, rotate))
            for block, bits in self.blocks(first):
                sky_lobes(bits, self.normal[block], coats.material[block], factors, sky, lobe, row[block], self.threads)
            lights_seen = self._local_lights()
            if lights_seen is not None:
                local_lobes(
                    lights_seen[0][first:],
                    lights_seen[1],
                    self.position[first:],
                    self.normal[first:],
                    coats.material[first:],
                    factors,
                    lobe,
                    row[first:],
                    self.threads,
                )
        tint = self.tint()
        diffuse = direct.diffuse
        mask = np.ones(len(self), bool) if active is None else active
        if coats.partner is not None:
            mask = mask | mask[coats.partner]

        def send(who: Gather, at: int, light: Exit, go_on: bool, into: Received | None = None) -> Received:
            material, threads = coats.material, self.threads
            return bounce(who, light, self.normal, material, table, factors, view, mask, go_on, threads, at, into)

        def send_to_all(light: Exit, go_on: bool) -> Received:
            received = None
            for at, who in self._some_gathers(first, len(self)) if gather is None else [(first, gather)]:
                received = send(who, at, light, go_on, received)
            assert received is not None
            return received

        lights: list[Exit] = []
        arrived = []
        for number in range(1, bounces + 1):
            light = Exit(diffuse if tint is None else diffuse * tint, lobe, row)
            e, specular, lobe = send_to_all(light, number < bounces)
            diffuse = self._reflected(coats, view, light, factors, e, specular)
            if first:
                lights.append(light)
                arrived.append((e, specular))
            else:
                yield Radiance(diffuse, specular if coats.shiny.any() else None)
        for at, seen in self._pixel_gathers() if first else ():
            for light, (e, specular) in zip(lights, arrived, strict=True):
                send(seen, at, light, False, (e, specular, lobe))
        for e, specular in arrived:
            yield Radiance(coats.diffuse(e), specular if coats.shiny.any() else None)

    def _reflected(
        self,
        coats: _Coats,
        view: NDArray[np.float32] | None,
        light: Exit,
        factors: LobeFactors,
        e: NDArray[np.float32],
        specular: NDArray[np.float32],
    ) -> NDArray[np.float32]:
        """Diffuse exit radiance (N, 3) after one interreflection of `light`, which gives irradiance e and specular
        exit radiance, (N, 3) each. A store may add to the latter what else arrives."""
        return coats.diffuse(e)

    def gather(self, first: int = 0) -> Gather | None:
        """Who sees whom, of the receivers from `first` on; None where nothing blocks anything.

        Raises StoreError if that was not simulated.
        """
        if "bounce/hit" not in self.store:
            if self.store.attrs["nothing_blocks"]:
                return None
            raise StoreError(
                f"{self.store.path}: holds direct light only; precompute with --bounces 1 or more, or use --reference"
            )
        if first not in self._gathered:
            from relightcli.core.shade.gather import join

            step = len(self) if self.hit_bytes() <= IN_MEMORY else self._chunk
            self._gathered[first] = join([part for _, part in self._gathers(first, len(self), step)])
        return self._gathered[first]

    def gather_into(self, scratch: Scratch) -> Gather:
        """`gather` in files of `scratch`, part by part; for what memory need not hold."""
        from relightcli.core.shade.gather import collect

        def parts() -> Iterator[Gather]:
            for _, part in self._some_gathers(0, len(self)):
                yield part
                scratch.let_go()

        hits: Any = self.store.array("bounce/hit")
        step = hits.chunks[0]
        entries = sum(int(np.count_nonzero(hits[a : a + step])) for a in range(0, len(self), step))
        return collect(parts(), len(self), entries, scratch.filed)

    def _gathers(self, first: int, last: int, step: int) -> Iterator[tuple[int, Gather]]:
        """Who sees whom, of the receivers from `first` to `last`, at most `step` at a time; with each part's first."""
        from relightcli.core.shade.gather import build_gather

        hits: Any = self.store.array("bounce/hit")
        for block, bits in self.blocks(first, last):
            for start in range(block.start, block.stop, step):
                rows = slice(start, min(start + step, block.stop))
                seen = bits[start - block.start : rows.stop - block.start]
                yield start, build_gather(np.asarray(hits[rows]), seen, self.normal[rows], self.threads)

    def _some_gathers(self, first: int, last: int) -> Iterator[tuple[int, Gather]]:
        """`_gathers` of some receivers at a time, so that there are no more than ENTRIES."""
        return self._gathers(first, last, max(1, ENTRIES // int(np.prod(self.store.layouts["bounce/hit"].shape[1:]))))

    def hit_bytes(self) -> int:
        """Of whom the receivers see, in memory."""
        return self.store.layouts["bounce/hit"].raw_bytes if "bounce/hit" in self.store else 0

    def _pixel_gathers(self) -> Iterator[tuple[int, Gather]]:
        """Whom the receivers of pixels see, part by part; kept for the next frame if that takes no more than
        `kept`."""
        if self._seen is not None:
            yield from self._seen
            return
        kept, size = [], 0
        for at, part in self._some_gathers(0, self.pixels):
            size += part.source.nbytes + part.cell.nbytes + part.cosine.nbytes + part.solid_angle.nbytes
            if size <= self.kept:
                kept.append((at, part))
            else:
                kept.clear()
            yield at, part
        if size <= self.kept:
            self._seen = kept

    def tint(self) -> NDArray[np.float32] | None:
        """Colour of the texture at every receiver, (N, 3) float32; None without textures."""
        if "bounce/texture" not in self.store:
            return None
        colours: Any = self.store.read("bounce/texture")
        assert self.vertex is not None
        tint: NDArray[np.float32] = colours[self.vertex]
        tint[: self.pixels] = 1.0  # a pixel's own texture acts in the picture
        return tint

    def _irradiance(self, sky: SkyCube, active: NDArray[np.bool_] | None, basis: str) -> NDArray[np.float32]:
        if basis == "visibility":
            prefix = moment_prefix(splat(sky, self.threads))
            out = np.zeros((len(self), 3), np.float32)
            for rows, bits in self.blocks(needed=active):
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

    def partner(self) -> NDArray[np.int64]:
        """The receiver on the other side of the same vertex, itself where there is none."""
        if self.vertex is None or self.pixels:  # pixels come without translucent materials
            return np.arange(len(self))
        front, back = self.receiver_of_vertex()
        other = np.where(self.side > 0, back[self.vertex], front[self.vertex]).astype(np.int64)
        return np.where(other >= 0, other, np.arange(len(self)))


SHINY = ("blinn-phong", "cook-torrance", "phong")
