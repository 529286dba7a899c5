"""The metadata document of one array: how it is built, and what of it is accepted.

Only the subset of Zarr v3 written here is read: regular chunks in one folder, a fixed list of data types and codecs, a
checksum as the last codec, named dimensions and a unit.
"""

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeGuard

from relight_formats.errors import AGAIN, StoreError
from relight_formats.fingerprint import plain

Codec = Literal["lz4", "zstd", "zstd_shuffled", "none"]
CODECS: tuple[Codec, ...] = ("lz4", "zstd", "zstd_shuffled", "none")

ITEM_BYTES = {
    "bool": 1,
    "int8": 1,
    "uint8": 1,
    "int16": 2,
    "uint16": 2,
    "float16": 2,
    "int32": 4,
    "uint32": 4,
    "float32": 4,
    "int64": 8,
    "uint64": 8,
    "float64": 8,
}
"""Allowed data types and their sizes in bytes."""

CHUNK_BYTES = 4 << 20
"""Size of a chunk when nobody chooses, bytes before compression."""

CHUNK_LIMIT = 1 << 30
"""Largest chunk, bytes before compression: what a reader of an untrusted store may be made to allocate at once."""

_NAME = re.compile(r"[A-Za-z0-9_-]+(/[A-Za-z0-9_-]+)*")
_LZ4 = {"cname": "lz4", "clevel": 5, "shuffle": "shuffle", "blocksize": 0}
_ZSTD_SHUFFLED = {"cname": "zstd", "clevel": 3, "shuffle": "shuffle", "blocksize": 0}
_ZSTD = {"name": "zstd", "configuration": {"level": 3, "checksum": False}}
_KEYS = {
    "zarr_format",
    "node_type",
    "shape",
    "data_type",
    "chunk_grid",
    "chunk_key_encoding",
    "fill_value",
    "codecs",
    "attributes",
    "dimension_names",
    "storage_transformers",
}


def check_name(name: str) -> None:
    """Raises ValueError unless `name` is one or more of letters, digits, `_`, `-`, with `/` between groups."""
    if not _NAME.fullmatch(name):
        raise ValueError(f"array name {name!r}: expected letters, digits, _ and -, with / between groups.")
    if name.split("/")[0] == "ledger":
        raise ValueError(f"array name {name!r}: the group 'ledger' is reserved.")


@dataclass(frozen=True)
class Layout:
    """Shape, chunking and packing (one of CODECS) of one array, taken from its checked metadata."""

    shape: tuple[int, ...]
    chunks: tuple[int, ...]
    data_type: str
    dims: tuple[str, ...]
    codec: str

    @property
    def raw_bytes(self) -> int:
        """Bytes of the array's values, uncompressed."""
        return math.prod(self.shape) * ITEM_BYTES[self.data_type]

    @property
    def chunk_count(self) -> int:
        return math.prod(-(-n // c) for n, c in zip(self.shape, self.chunks, strict=True))

    def chunk_names(self) -> Iterator[str]:
        """File names of all chunks, in grid order, the last axis fastest: `c.0.0`; `c` for an array without axes."""
        grid = [-(-n // c) for n, c in zip(self.shape, self.chunks, strict=True)]
        return _chunk_names("c", grid if all(grid) else [0])


def _chunk_names(prefix: str, grid: list[int]) -> Iterator[str]:
    # Lazy in every axis, unlike itertools.product: an untrusted shape may ask for any number of chunks.
    if not grid:
        yield prefix
        return
    for index in range(grid[0]):
        yield from _chunk_names(f"{prefix}.{index}", grid[1:])


def array_metadata(
    name: str,
    *,
    shape: Sequence[int],
    dtype: str,
    chunks: Sequence[int],
    dims: Sequence[str],
    units: str | None,
    attrs: dict[str, Any] | None,
    codec: str,
    fill: float | bool,
) -> dict[str, Any]:
    """The `zarr.json` of an array. Raises ValueError for anything the format does not allow."""
    check_name(name)
    if dtype not in ITEM_BYTES:
        raise ValueError(f"array {name}: data type {dtype!r} is not one of {', '.join(ITEM_BYTES)}.")
    if not len(shape) == len(chunks) == len(dims):
        raise ValueError(f"array {name}: shape {shape}, chunks {chunks} and dims {dims} must have the same length.")
    if len(set(dims)) != len(dims) or not all(dims):
        raise ValueError(f"array {name}: every dimension needs a name of its own, found {list(dims)}.")
    if any(n < 0 for n in shape) or any(c < 1 for c in chunks):
        raise ValueError(f"array {name}: shape {shape} must not be negative, chunks {chunks} must be positive.")
    chunks = [max(1, min(int(n), int(c))) for n, c in zip(shape, chunks, strict=True)]
    if math.prod(chunks) * ITEM_BYTES[dtype] > CHUNK_LIMIT:
        raise ValueError(
            f"array {name}: a chunk of {chunks} {dtype} is larger than {CHUNK_LIMIT >> 20} MiB; choose smaller."
        )
    attributes = plain(dict(attrs or {}), f"array {name}: attrs")
    if {"units", "scale_factor", "add_offset", "_FillValue"} & attributes.keys():
        raise ValueError(
            f"array {name}: 'units' is a parameter; scale_factor, add_offset and _FillValue have a meaning to readers."
        )
    return {
        "zarr_format": 3,
        "node_type": "array",
        "shape": [int(n) for n in shape],
        "data_type": dtype,
        "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": chunks}},
        "chunk_key_encoding": {"name": "default", "configuration": {"separator": "."}},
        "fill_value": _fill_value(name, dtype, fill),
        "codecs": _codecs(dtype, codec),
        "attributes": {**attributes, "units": "1" if units is None else units},
        "dimension_names": list(dims),
        "storage_transformers": [],
    }


def _fill_value(name: str, dtype: str, fill: float | bool) -> Any:
    if dtype == "bool":
        return bool(fill)
    if dtype.startswith("float"):
        value = float(fill)
        if math.isfinite(value):
            return value
        return "NaN" if math.isnan(value) else ("Infinity" if value > 0 else "-Infinity")
    if int(fill) != fill:
        raise ValueError(f"array {name}: fill {fill} is not a whole number, as {dtype} needs.")
    return int(fill)


def _codecs(dtype: str, codec: str) -> list[dict[str, Any]]:
    size = ITEM_BYTES[dtype]
    to_bytes = {"name": "bytes", "configuration": {"endian": "little"}} if size > 1 else {"name": "bytes"}
    packing = {
        "none": [],
        "lz4": [{"name": "blosc", "configuration": {"typesize": size, **_LZ4}}],
        "zstd": [_ZSTD],
        "zstd_shuffled": [{"name": "blosc", "configuration": {"typesize": size, **_ZSTD_SHUFFLED}}],
    }
    if codec not in packing:
        raise ValueError(f"codec {codec!r}: expected one of {', '.join(packing)}.")
    return [to_bytes, *packing[codec], {"name": "crc32c"}]


def read_layout(document: dict[str, Any], where: str) -> Layout:
    """Check the metadata of an array before anything of it is decoded. Raises StoreError."""

    def need(condition: bool, key: str, expected: str) -> None:
        if not condition:
            raise StoreError(f"{where}: {key}: expected {expected}, found {document.get(key)!r}; refused. {AGAIN}")

    need(document.get("zarr_format") == 3 and document.get("node_type") == "array", "node_type", "a Zarr v3 array")
    unknown = sorted(document.keys() - _KEYS)
    if unknown:
        raise StoreError(f"{where}: unknown keys {', '.join(unknown)}; refused. {AGAIN}")
    shape, dims, dtype = document.get("shape"), document.get("dimension_names"), document.get("data_type")
    need(_whole(shape, 0), "shape", "a list of whole numbers")
    need(isinstance(dtype, str) and dtype in ITEM_BYTES, "data_type", f"one of {', '.join(ITEM_BYTES)}")
    assert isinstance(shape, list)
    assert isinstance(dtype, str)
    need(isinstance(dims, list) and all(isinstance(d, str) for d in dims), "dimension_names", "a list of names")
    assert isinstance(dims, list)
    need(len(dims) == len(shape) and len(set(dims)) == len(dims), "dimension_names", "one name of its own per axis")
    grid = document.get("chunk_grid")
    chunks = grid["configuration"].get("chunk_shape") if _regular(grid) else None
    need(_whole(chunks, 1), "chunk_grid", "regular chunks of positive sizes")
    assert isinstance(chunks, list)
    need(len(chunks) == len(shape), "chunk_grid", "one chunk size per axis")
    need(
        math.prod(chunks) * ITEM_BYTES[dtype] <= CHUNK_LIMIT, "chunk_grid", f"chunks of at most {CHUNK_LIMIT >> 20} MiB"
    )
    encoding = {"name": "default", "configuration": {"separator": "."}}
    need(document.get("chunk_key_encoding") == encoding, "chunk_key_encoding", "'default' with separator '.'")
    allowed = {codec: _codecs(dtype, codec) for codec in CODECS}
    need(
        document.get("codecs") in allowed.values(),
        "codecs",
        "bytes, then nothing, zstd or blosc (lz4, zstd), then crc32c",
    )
    need(_fills(document.get("fill_value"), dtype), "fill_value", f"a value of {dtype}")
    need(document.get("storage_transformers", []) == [], "storage_transformers", "none")
    attributes = document.get("attributes")
    need(
        isinstance(attributes, dict) and isinstance(attributes.get("units"), str),
        "attributes",
        "an object with 'units'",
    )
    codec = next(codec for codec, chain in allowed.items() if chain == document["codecs"])
    return Layout(tuple(shape), tuple(chunks), dtype, tuple(dims), codec)


def _fills(value: Any, dtype: str) -> bool:
    if dtype == "bool":
        return isinstance(value, bool)
    if dtype.startswith("float"):
        return (type(value) in (int, float) and abs(value) <= 1e308) or value in ("NaN", "Infinity", "-Infinity")
    bits = 8 * ITEM_BYTES[dtype]
    low, high = (0, 2**bits) if dtype.startswith("u") else (-(2 ** (bits - 1)), 2 ** (bits - 1))
    return type(value) is int and low <= value < high


def _whole(value: Any, least: int) -> bool:
    return isinstance(value, list) and all(type(n) is int and n >= least for n in value)


def _regular(grid: Any) -> TypeGuard[dict[str, dict[str, Any]]]:
    return isinstance(grid, dict) and grid.get("name") == "regular" and isinstance(grid.get("configuration"), dict)
