"""Fields in a store: what arrays there are, putting them there, and reading them again.

A field lies under a prefix: `fields/0/` in a transfer store, none in a store of its own (kind `field`):

    mesh/position, normal, face, texture   the object in its own frame; its texture's mean colour around vertices; from
                                           these follow the points that light is known at (`core.fields.body`)
    radii, proxies, valid                  see `core.fields.field.Field`
    hidden                                 the whole sphere less the occlusion, of every sample
    transfer/...                           the transfer, compressed (`core.fields.compression`)
    self                                   irradiance / pi of the points per light about the object, A_l y_i(n) / pi
                                           times their self transfer: without own reflections, which is one part for
                                           all colours; what one of them adds; what all others add
    self_whole/...                         of objects with a specular lobe: the self transfer, compressed

Whole numbers of more than 8 bits lie as two planes of bytes, the low ones q - 256 high, then the high ones rint(q /
256): apart, an entropy coder makes the most of either.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

import relight_formats as formats
from relightcli.core.fields.body import Body
from relightcli.core.fields.compression import CompressedTransfer, places_of
from relightcli.core.fields.field import SourceField
from relightcli.errors import StoreError

CHUNK_BYTES = 4_000_000
SHELL_STEPS = 2047  # from 0 to the largest number of a shell; the rays of a sample are noisier than half a step
POINT_STEPS = 32767


class Packed(NamedTuple):
    """An array to be put into a store."""

    name: str
    data: NDArray[Any]
    dims: tuple[str, ...]
    attrs: dict[str, Any] | None
    codec: str


@dataclass(frozen=True)
class KeptField:
    """A field as it is kept: see `core.fields.field.Field`; occlusion (S 6nn, N) float32.

    self_by_order (P, N, 1 + 2 C) float32: diffuse exit radiance of points of albedo 1 per light about the object (see
    `core.fields.self_transfer.Solution`); self_whole (P, N, N, C) float32: their self transfer, None where nothing
    shines.
    """

    radii: NDArray[np.float64]
    resolution: int
    valid: NDArray[np.bool_]
    proxies: NDArray[np.float64]
    occlusion: NDArray[np.float32]
    transfer: CompressedTransfer
    self_by_order: NDArray[np.float32]
    self_whole: NDArray[np.float32] | None


def pack_transfer(prefix: str, made: CompressedTransfer, tolerance: float) -> list[Packed]:
    """A compressed transfer. Coefficients lie component by component: those of one are alike in size."""
    about = {"shape": list(made.shape), "error": made.error, "tolerance": tolerance}
    return [
        Packed(f"{prefix}cluster", made.cluster, ("sample",), None, "zstd"),
        Packed(f"{prefix}start", made.start, ("cluster_edge",), None, "lz4"),
        Packed(f"{prefix}component", _planes(made.component), ("byte", "component", "number"), about, "zstd"),
        Packed(f"{prefix}scale", made.scale, ("component",), None, "lz4"),
        Packed(f"{prefix}coefficient", _planes(made.coefficient[_by_component(made)]), ("byte", "entry"), None, "zstd"),
        Packed(f"{prefix}coefficient_scale", made.coefficient_scale, ("component",), None, "lz4"),
    ]


def read_transfer(store: formats.Store, prefix: str) -> CompressedTransfer:
    """What `pack_transfer` made."""
    read: Any = store.read
    cluster, start = read(f"{prefix}cluster"), read(f"{prefix}start")
    about: Any = store.array(f"{prefix}component").attrs
    component = _from_planes(read(f"{prefix}component"))
    sorted_ = _from_planes(read(f"{prefix}coefficient"))
    shape: Any = tuple(int(n) for n in about["shape"])
    error = float(about["error"])
    scales = read(f"{prefix}scale"), read(f"{prefix}coefficient_scale")
    made = CompressedTransfer(
        shape, cluster, start, component, scales[0], sorted_, scales[1], error, places_of(cluster, start)
    )
    coefficient = np.empty_like(sorted_)
    coefficient[_by_component(made)] = sorted_
    return replace(made, coefficient=coefficient)


def _by_component(made: CompressedTransfer) -> NDArray[np.int64]:
    """Places of the coefficients, sorted by their components, then samples."""
    count = np.diff(made.first)
    number = np.arange(made.first[-1]) - np.repeat(made.first[:-1], count)
    component = np.repeat(made.start[made.cluster], count) + number
    out: NDArray[np.int64] = np.argsort(component.astype(np.int32), kind="stable")
    return out


def pack_per_shell(name: str, values: NDArray[np.floating]) -> list[Packed]:
    """Values (S, samples, N), in SHELL_STEPS of the largest of every shell and coefficient."""
    return _pack_rounded(name, values, 1, SHELL_STEPS, ("shell", "direction", "harmonic"), ("shell", "harmonic"))


def rounded(name: str, values: NDArray[np.floating], dims: tuple[str, ...]) -> list[Packed]:
    """Values (P, ...), in POINT_STEPS of the largest of every row."""
    return _pack_rounded(name, values, tuple(range(1, values.ndim)), POINT_STEPS, dims, dims[:1])


def _pack_rounded(
    name: str,
    values: NDArray[np.floating],
    axis: int | tuple[int, ...],
    steps: int,
    dims: tuple[str, ...],
    scale_dims: tuple[str, ...],
) -> list[Packed]:
    scale = (np.abs(values).max(axis=axis, keepdims=True, initial=0.0) / steps).astype(np.float32)
    codes = np.rint(values / np.where(scale > 0.0, scale, 1.0).astype(np.float64))
    small = np.clip(codes, -steps, steps).astype(np.int16)
    return [
        Packed(name, _planes(small), ("byte", *dims), {"scale": f"{name}_scale"}, "zstd"),
        Packed(f"{name}_scale", np.squeeze(scale, axis), scale_dims, None, "lz4"),
    ]


def _planes(codes: NDArray[np.int16]) -> NDArray[np.int8]:
    high = (codes.astype(np.int32) + 128) >> 8
    return np.stack([codes - 256 * high, high]).astype(np.int8)


def _from_planes(planes: NDArray[np.int8]) -> NDArray[np.int16]:
    out: NDArray[np.int16] = planes[0] + planes[1].astype(np.int16) * np.int16(256)
    return out


def put_packed(writer: formats.Writer, prefix: str, packed: list[Packed]) -> None:
    """Puts arrays under a prefix; once more is harmless."""
    for array in packed:
        codec: Any = array.codec
        writer.put(f"{prefix}{array.name}", array.data, dims=array.dims, attrs=array.attrs, codec=codec)


def put_body(
    writer: formats.Writer,
    prefix: str,
    body: Body,
    texture: NDArray[np.float32],
    radii: NDArray[np.float64],
    proxies: NDArray[np.float64],
) -> None:
    """The mesh and what is known before any ray. texture (V, 3)."""
    writer.put(f"{prefix}mesh/position", body.positions, dims=("vertex", "axis"))
    writer.put(f"{prefix}mesh/normal", body.normals, dims=("vertex", "axis"))
    writer.put(f"{prefix}mesh/face", body.faces, dims=("face", "corner"))
    writer.put(f"{prefix}mesh/texture", texture, dims=("vertex", "colour"))
    writer.put(f"{prefix}radii", radii, dims=("shell",))
    writer.put(f"{prefix}proxies", proxies, dims=("proxy", "axis"))


def copy_field(store: formats.Store, writer: formats.Writer, prefix: str) -> None:
    """All arrays of a finished `field` store, under a prefix."""
    for name in store.names():
        layout = store.layouts[name]
        source = store.array(name)
        attrs = {k: v for k, v in source.attrs.items() if k != "units"}
        codec: Any = layout.codec
        target = writer.array(
            f"{prefix}{name}",
            shape=layout.shape,
            dtype=layout.data_type,
            chunks=layout.chunks,
            dims=layout.dims,
            attrs=attrs or None,
            codec=codec,
        )
        for start in range(0, layout.shape[0], layout.chunks[0]):
            rows = slice(start, start + layout.chunks[0])
            target[rows] = source[rows]


def read_field(store: formats.Store, prefix: str = "") -> KeptField:
    """The field under a prefix of a finished store. Raises StoreError for the form of an earlier version."""
    read: Any = store.read
    if store.layouts[f"{prefix}self"].dims[-1] != "part":
        raise StoreError(
            f"{store.path}: its fields are of an earlier form; expected a store of this version, make it anew"
        )
    valid = read(f"{prefix}valid")
    hidden = _from_planes(read(f"{prefix}hidden")) * read(f"{prefix}hidden_scale")[:, None, :]
    occlusion = -hidden.reshape(-1, hidden.shape[2])
    occlusion[:, 0] += np.float32(np.sqrt(4.0 * np.pi))
    own = _from_planes(read(f"{prefix}self")) * read(f"{prefix}self_scale")[:, None, None]
    whole = None
    if f"{prefix}self_whole/start" in store:
        whole = read_transfer(store, f"{prefix}self_whole/").decompress()[:, 0]
    return KeptField(
        read(f"{prefix}radii"),
        round((valid.shape[1] / 6) ** 0.5),
        valid,
        read(f"{prefix}proxies"),
        occlusion,
        read_transfer(store, f"{prefix}transfer/"),
        own,
        whole,
    )


def put_source(writer: formats.Writer, prefix: str, field: SourceField, radiance: tuple[float, float, float]) -> None:
    """The field of a local light."""
    brightest = int(np.argmax(radiance))
    seen = field.radiance[..., brightest].astype(np.float64) / (radiance[brightest] or 1.0)
    writer.put(f"{prefix}radii", field.radii, dims=("shell",), units="m")
    writer.put(f"{prefix}radius", np.array(field.radius), dims=(), units="m")
    writer.put(f"{prefix}radiance", np.array(radiance, np.float32), dims=("colour",))
    put_packed(writer, prefix, pack_per_shell("seen", seen))


def read_source(store: formats.Store, prefix: str) -> SourceField:
    """The field of a local light, about its centre, with the scene's axes."""
    read: Any = store.read
    seen = _from_planes(read(f"{prefix}seen")) * read(f"{prefix}seen_scale")[:, None, :]
    resolution = round((seen.shape[1] / 6) ** 0.5)
    radius = float(read(f"{prefix}radius"))
    radiance = seen[..., None] * read(f"{prefix}radiance")
    return SourceField(np.zeros(3), radius, read(f"{prefix}radii"), resolution, radiance)


def describe_fields(store: formats.Store) -> list[dict[str, Any]]:
    """Of every field in a store: whose it is, the transfer's error, its bytes and what they were before."""
    out = []
    objects = store.attrs.get("fields", {}).get("objects", {})
    sizes = store.sizes()
    for name in store.names():
        if not name.endswith("transfer/component"):
            continue
        group = name.removesuffix("component")
        prefix = group.removesuffix("transfer/")
        about: Any = store.array(name).attrs
        samples = store.layouts[f"{group}cluster"].shape[0]
        out.append(
            {
                "field": prefix.rstrip("/"),
                "objects": [o for o, entry in objects.items() if f"fields/{entry['field']}/" == prefix],
                "error": float(about["error"]),
                "tolerance": float(about["tolerance"]),
                "bytes": sum(size.stored for key, size in sizes.items() if key.startswith(prefix)),
                "transfer_bytes": sum(size.stored for key, size in sizes.items() if key.startswith(group)),
                "transfer_raw_bytes": 4 * samples * int(np.prod(about["shape"])),
            }
        )
    return out
