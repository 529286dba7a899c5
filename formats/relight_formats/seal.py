"""The commit mark: a digest of everything in the store, the block ledger, and last the root metadata."""

import hashlib
import os
from pathlib import Path
from typing import Any

from relight_formats.arrays import Layout, read_layout
from relight_formats.errors import StoreError
from relight_formats.files import fsync_folder, walk, write_durably
from relight_formats.fingerprint import fingerprint_bytes, fingerprint_json
from relight_formats.header import ROOT, dump, load_document, write_root
from relight_formats.remote import Place, RemotePath

LEDGER_GROUP = "ledger"


def chunk_digest(folder: Place, layout: Layout) -> tuple[str, int, list[str]]:
    """SHA-256 over name, size and checksum of an array's chunk files in grid order; their bytes; the missing ones.

    Only the last four bytes of each file are read: its CRC-32C.
    """
    digest = hashlib.sha256()
    total = 0
    missing = []
    for name in layout.chunk_names():
        try:
            size, checksum = _size_and_end(folder / name)
        except FileNotFoundError:
            missing.append(name)
            continue
        digest.update(f"{name} {size} {checksum.hex()}\n".encode("ascii"))
        total += size
    return "sha256:" + digest.hexdigest(), total, missing


def _size_and_end(file: Place) -> tuple[int, bytes]:
    if isinstance(file, RemotePath):
        return file.size_and_end(4)
    with open(file, "rb") as opened:
        size = opened.seek(0, os.SEEK_END)
        opened.seek(max(0, size - 4))
        return size, opened.read(4)


def content_fingerprint(
    header: dict[str, Any], attributes: dict[str, Any], documents: dict[str, str], arrays: dict[str, dict[str, Any]]
) -> str:
    """Fingerprint of what a store says, leaving out when and how fast it was made: equal for every run of one job."""
    return fingerprint_json(
        {
            "kind": header["kind"],
            "settings": header["settings"],
            "inputs": header["inputs"],
            "attributes": attributes,
            "documents": documents,
            "chunks": {name: entry["chunks"] for name, entry in arrays.items()},
        }
    )


def seal(folder: Path, header: dict[str, Any], attributes: dict[str, Any], blocks: list[dict[str, Any]]) -> None:
    """Write the ledger group and then the root with its mark. Raises StoreError when a chunk was never written."""
    documents: dict[str, str] = {}
    arrays: dict[str, dict[str, Any]] = {}
    for relative, entry in walk(folder):
        group = relative.rpartition("/")[0]
        if entry.name != ROOT or group in ("", LEDGER_GROUP):
            continue
        document, content = load_document(Path(entry.path), folder)
        documents[relative] = fingerprint_bytes(content)
        if document.get("node_type") != "array":
            continue
        layout = read_layout(document, f"{folder}: array {group}")
        digest, stored, missing = chunk_digest(folder / group, layout)
        if missing:
            raise StoreError(
                f"{folder}: array {group}: expected {layout.chunk_count} chunks, {len(missing)} were never written "
                f"({', '.join(missing[:3])}{', ...' if len(missing) > 3 else ''}). Start again with --overwrite."
            )
        arrays[group] = {"chunks": digest, "stored_bytes": stored, "raw_bytes": layout.raw_bytes}
    ledger = {
        "zarr_format": 3,
        "node_type": "group",
        "attributes": {"blocks": blocks, "arrays": arrays, "documents": documents},
    }
    (folder / LEDGER_GROUP).mkdir(exist_ok=True)
    content = dump(ledger)
    write_durably(folder / LEDGER_GROUP / ROOT, content)
    for _, entry in walk(folder):
        if entry.is_dir(follow_symlinks=False):
            fsync_folder(Path(entry.path))
    mark = {
        **header,
        "complete": True,
        "ledger": fingerprint_bytes(content),
        "content": content_fingerprint(header, attributes, documents, arrays),
    }
    write_root(folder, mark, attributes)
