"""A finished store, for reading."""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from relight_formats.arrays import Layout, read_layout
from relight_formats.errors import AGAIN, StoreError
from relight_formats.files import UNFINISHED, local_path, sibling, tree_bytes, walk
from relight_formats.fingerprint import fingerprint_bytes
from relight_formats.header import ROOT, load_document, read_root
from relight_formats.ledger import FILE_NAME, read_ledger
from relight_formats.remote import Place, RemotePath, place
from relight_formats.seal import LEDGER_GROUP
from relight_formats.verify import verify

if TYPE_CHECKING:
    import zarr
    from numpy.typing import NDArray


@dataclass(frozen=True)
class ArraySize:
    """Bytes of one array: its chunk files as stored, and its values uncompressed."""

    stored: int
    raw: int


@dataclass(frozen=True)
class Store:
    """A committed store. Made by `open_store`; nothing in it can be changed."""

    path: Place
    kind: str
    settings: dict[str, Any]
    inputs: dict[str, str]
    program: str
    created: str
    summary: dict[str, Any]
    attrs: dict[str, Any]
    """The JSON attributes of the root, as given to `Writer.set_attrs`."""
    blocks: list[dict[str, Any]]
    """The ledger: per block `id` and what was recorded with it."""
    fingerprint: str
    """Of everything but times and costs: equal for every run of one job, an input fingerprint for the next stage."""
    layouts: dict[str, Layout]
    """Shape, chunks, data type and dimension names per array."""
    ledger: dict[str, Any]
    """The ledger group's attributes: blocks, and digests per array and metadata document."""

    def names(self) -> list[str]:
        """Names of all arrays, sorted."""
        return sorted(self.layouts)

    def __contains__(self, name: object) -> bool:
        return name in self.layouts

    def array(self, name: str) -> "zarr.Array[Any]":
        """An array to index. A chunk that is missing or damaged raises StoreError when it is read.

        Raises:
            StoreError: no such array.
        """
        if name not in self.layouts:
            raise StoreError(f"{self.path}: expected an array {name}, found {', '.join(self.names()) or 'none'}.")
        from relight_formats.chunks import open_committed

        return open_committed(self.path, name)

    def read(self, name: str) -> "NDArray[Any]":
        """A whole array in memory.

        Raises:
            StoreError: no such array, or a chunk that is missing, damaged or cannot be decoded.
        """
        array = self.array(name)
        try:
            return np.asarray(array[...])
        except (ValueError, RuntimeError, TypeError) as error:
            raise StoreError(
                f"{self.path}: array {name}: a chunk passes its checksum and cannot be decoded ({error}). {AGAIN}"
            ) from error

    def sizes(self) -> dict[str, ArraySize]:
        """Stored and raw bytes per array, as they were at commit."""
        entries = self.ledger["arrays"]
        return {name: ArraySize(entries[name]["stored_bytes"], self.layouts[name].raw_bytes) for name in self.names()}

    def verify(self) -> list[str]:
        """Read everything; one sentence per problem, empty when the store is sound."""
        return verify(self.path, self.layouts, self.ledger)


def open_store(path: str | os.PathLike[str], kind: str | None = None) -> Store:
    """Open a finished store for reading. All metadata is checked, no array is read.

    Args:
        path: folder of the store, or a URL that fsspec can open (`s3://bucket/store.zarr`).
        kind: the kind that is needed; None takes any.

    Raises:
        StoreError: nothing there, no relight store, unfinished, another format version, another kind, damaged metadata,
            codecs or data types outside the format, a symbolic link inside.
        OSError: no permission.
    """
    folder = place(path)
    if not folder.exists():
        raise StoreError(f"{folder}: {_absent(folder)}")
    header, attributes = read_root(folder)
    if not header["complete"] or folder.name.endswith(UNFINISHED):
        raise StoreError(f"{folder}: this store is unfinished. Run the command that makes it again; it continues.")
    if kind is not None and header["kind"] != kind:
        raise StoreError(f"{folder}: expected a store of kind {kind}, found {header['kind']}.")
    if isinstance(folder, Path):
        _need_no_links(folder)
    ledger = _load_ledger(folder, header["ledger"])
    return Store(
        path=folder,
        kind=header["kind"],
        settings=header["settings"],
        inputs=header["inputs"],
        program=header["program"],
        created=header["created"],
        summary=header["summary"],
        attrs=attributes,
        blocks=ledger["blocks"],
        fingerprint=header["content"],
        layouts=_load_layouts(folder, ledger),
        ledger=ledger,
    )


def need_whole(folder: Path) -> None:
    """Reads all of a sealed store. Raises StoreError for the first thing that is not as it was committed."""
    header, _ = read_root(folder)
    ledger = _load_ledger(folder, header["ledger"])
    problems = verify(folder, _load_layouts(folder, ledger), ledger)
    if problems:
        raise StoreError(f"{problems[0]} {AGAIN}")


def _need_no_links(folder: Path) -> None:
    for relative, entry in walk(folder):
        if entry.is_symlink():
            raise StoreError(f"{folder}: {relative} is a symbolic link; a store holds files and folders only. Refused.")


def _absent(folder: Place) -> str:
    partial = folder.with_name(folder.name + UNFINISHED)
    if not partial.exists():
        return "expected a relight store, found nothing."
    return f"this store is unfinished; {partial.name} is there. Run the command that makes it again; it continues."


def _load_ledger(folder: Place, fingerprint: str | None) -> dict[str, Any]:
    document, content = load_document(folder / LEDGER_GROUP / ROOT, folder)
    if fingerprint_bytes(content) != fingerprint:
        raise StoreError(f"{folder}: {LEDGER_GROUP}/{ROOT} does not match its digest; the store is damaged. {AGAIN}")
    ledger = document.get("attributes")
    if (
        not isinstance(ledger, dict)
        or not isinstance(ledger.get("blocks"), list)
        or not all(isinstance(block, dict) and isinstance(block.get("id"), str) for block in ledger["blocks"])
        or not isinstance(ledger.get("documents"), dict)
        or not isinstance(ledger.get("arrays"), dict)
        or not all(
            isinstance(entry, dict) and type(entry.get("stored_bytes")) is int and isinstance(entry.get("chunks"), str)
            for entry in ledger["arrays"].values()
        )
    ):
        raise StoreError(
            f"{folder}: {LEDGER_GROUP}/{ROOT}: expected blocks, documents and arrays; the store is damaged. {AGAIN}"
        )
    return ledger


def _load_layouts(folder: Place, ledger: dict[str, Any]) -> dict[str, Layout]:
    layouts = {}
    if isinstance(folder, RemotePath):
        folder.fetch(list(ledger["documents"]))
    for relative, fingerprint in ledger["documents"].items():
        parts = relative.split("/")
        if ".." in parts or parts[0] == "" or parts[-1] != ROOT:
            raise StoreError(
                f"{folder}: the ledger names {relative!r}, which is no metadata of this store; refused. {AGAIN}"
            )
        document, content = load_document(folder / relative, folder)
        if fingerprint_bytes(content) != fingerprint:
            raise StoreError(f"{folder}: {relative} does not match its digest; the store is damaged. {AGAIN}")
        if document.get("node_type") == "array":
            name = relative.rpartition("/")[0]
            layouts[name] = read_layout(document, f"{folder}: array {name}")
    if layouts.keys() != ledger["arrays"].keys():
        raise StoreError(f"{folder}: the ledger's arrays are not those of the store; the store is damaged. {AGAIN}")
    return layouts


def progress(path: str | os.PathLike[str]) -> dict[str, Any]:
    """How far unfinished work has come.

    Args:
        path: `NAME.partial`, or `NAME` when only `NAME.partial` is there.

    Returns:
        path, kind, settings, inputs, program, created; blocks (the ledger so far); bytes on disk.

    Raises:
        StoreError: nothing unfinished there, or damaged root metadata.
    """
    folder = local_path(path)
    if not folder.exists() and sibling(folder, UNFINISHED).exists():
        folder = sibling(folder, UNFINISHED)
    header, _ = read_root(folder)
    if header["complete"] and not folder.name.endswith(UNFINISHED):
        raise StoreError(f"{folder}: expected unfinished work, found a finished store.")
    blocks, _ = read_ledger(folder / FILE_NAME)
    kept = ("kind", "settings", "inputs", "program", "created")
    return {"path": str(folder), **{key: header[key] for key in kept}, "blocks": blocks, "bytes": tree_bytes(folder)}
