"""The root metadata of a store: what it is, what it was made from, and the commit mark.

The header is the attribute `relight` of the root group. It carries a digest over the whole root document and the
fingerprint of the ledger, which carries those of all other documents: any change to committed metadata shows.
"""

import json
from pathlib import Path
from typing import Any

from relight_formats.errors import AGAIN, StoreError
from relight_formats.files import write_durably
from relight_formats.fingerprint import fingerprint_json
from relight_formats.remote import Place, RemotePath

FORMAT = 1
"""Version of the store format that this package writes and reads."""

DOCUMENT_LIMIT = 256 << 20
"""Largest metadata document, bytes: a ledger of half a million blocks."""

ROOT = "zarr.json"
KEY = "relight"

CONVENTIONS = {
    "axes": "right-handed, +Y up; metres, though no computation assumes a unit",
    "directions": "point away from the surface: wi towards the light, wo towards the viewer, unit length",
    "radiance": "scene-linear RGB, Rec.709 primaries, float32; a BRDF carries its own 1/pi, unit 1/sr",
    "environment": "latitude-longitude: longitude = pi(1 - 2x), latitude = pi(1/2 - y), "
    "direction = (sin lon cos lat, sin lat, cos lon cos lat); texels constant over their solid angle",
    "cube_map": "faces +X -X +Y -Y +Z -Z in OpenGL order and orientation, exact solid angle per texel",
    "spherical_harmonics": "real, orthonormal, index l(l+1)+m, no Condon-Shortley phase; order n is bands 0..n-1",
    "bits": "packed along the last axis, bit 0 of a byte is the element with the lowest index",
    "bounces": "K interreflections; K = 0 is light, surface, eye",
}

_FIELDS: dict[str, type | tuple[type, ...]] = {
    "format": int,
    "kind": str,
    "program": str,
    "settings": dict,
    "inputs": dict,
    "conventions": dict,
    "complete": bool,
    "created": str,
    "summary": dict,
    "ledger": (str, type(None)),
    "content": (str, type(None)),
    "digest": str,
}


def dump(document: dict[str, Any]) -> bytes:
    """The spelling in which every metadata document is written."""
    return (json.dumps(document, indent=2, sort_keys=True, allow_nan=False) + "\n").encode("ascii")


def _digest(document: dict[str, Any]) -> str:
    header = {key: value for key, value in document["attributes"][KEY].items() if key != "digest"}
    return fingerprint_json({**document, "attributes": {**document["attributes"], KEY: header}})


def write_root(folder: Path, header: dict[str, Any], attributes: dict[str, Any]) -> None:
    """Write the root document atomically and durably, with its digest."""
    write_durably(folder / ROOT, root_bytes(header, attributes))


def root_bytes(header: dict[str, Any], attributes: dict[str, Any]) -> bytes:
    """The root document, with its digest."""
    document: dict[str, Any] = {
        "zarr_format": 3,
        "node_type": "group",
        "attributes": {**attributes, KEY: {key: value for key, value in header.items() if key != "digest"}},
    }
    document["attributes"][KEY]["digest"] = _digest(document)
    return dump(document)


def load_document(file: Place, store: Place) -> tuple[dict[str, Any], bytes]:
    """A JSON object and its bytes. Raises StoreError when it is missing or no JSON object, OSError when unreadable."""
    try:
        if isinstance(file, RemotePath):
            content = file.head(DOCUMENT_LIMIT + 1)
        else:
            with open(file, "rb") as stream:
                content = stream.read(DOCUMENT_LIMIT + 1)
    except (FileNotFoundError, NotADirectoryError):
        raise StoreError(f"{store}: {file.name} is missing at {file.parent}; the store is damaged. {AGAIN}") from None
    if len(content) > DOCUMENT_LIMIT:
        raise StoreError(f"{file}: expected at most {DOCUMENT_LIMIT >> 20} MiB of metadata, found more; refused.")
    try:
        document = json.loads(content)
    except (ValueError, RecursionError) as error:
        raise StoreError(
            f"{file}: expected JSON, found something else ({error}); the store is damaged. {AGAIN}"
        ) from None
    if not isinstance(document, dict):
        raise StoreError(
            f"{file}: expected a JSON object, found {type(document).__name__}; the store is damaged. {AGAIN}"
        )
    return document, content


def is_store(folder: Place) -> bool:
    """Whether the folder is a relight store of any version, whole or not: what `--overwrite` may replace."""
    try:
        document, _ = load_document(folder / ROOT, folder)
    except StoreError:
        return False
    attributes = document.get("attributes")
    return isinstance(attributes, dict) and isinstance(attributes.get(KEY), dict) and "format" in attributes[KEY]


def read_root(folder: Place) -> tuple[dict[str, Any], dict[str, Any]]:
    """The header and the user's attributes of a store, finished or not.

    Raises:
        StoreError: nothing there, no relight store, another format version, wrong types, or a digest that does not
            match.
        OSError: unreadable.
    """
    if not folder.is_dir():
        found = "a file" if folder.exists() else "nothing"
        raise StoreError(f"{folder}: expected a relight store, found {found}.")
    if not (folder / ROOT).exists():
        raise StoreError(
            f"{folder}: expected a relight store, found a folder without {ROOT}. If it was a store, move it away and "
            f"make it again."
        )
    document, _ = load_document(folder / ROOT, folder)
    attributes = document.get("attributes")
    header = attributes.get(KEY) if isinstance(attributes, dict) else None
    if document.get("zarr_format") != 3 or document.get("node_type") != "group" or not isinstance(header, dict):
        raise StoreError(
            f"{folder}: expected a relight store (a Zarr v3 group with the attribute {KEY!r}), found another kind."
        )
    version = header.get("format")
    if version != FORMAT or isinstance(version, bool):
        newer = isinstance(version, int) and version > FORMAT
        remedy = "use a newer relightcli" if newer else "make the store again with this program"
        raise StoreError(f"{folder}: expected store format {FORMAT}, found {version!r}; {remedy}.")
    for key, kind in _FIELDS.items():
        if key not in header or not isinstance(header[key], kind):
            found = type(header[key]).__name__ if key in header else "nothing"
            raise StoreError(
                f"{folder}: {ROOT}: relight.{key} has the wrong type ({found}); the store is damaged. {AGAIN}"
            )
    if not all(isinstance(value, str) for value in header["inputs"].values()):
        raise StoreError(
            f"{folder}: {ROOT}: relight.inputs must map names to fingerprints; the store is damaged. {AGAIN}"
        )
    if header["digest"] != _digest(document):
        raise StoreError(
            f"{folder}: {ROOT} does not match its digest: it was changed or damaged after it was written. {AGAIN}"
        )
    return header, {key: value for key, value in document["attributes"].items() if key != KEY}


def differences(old: dict[str, Any], new: dict[str, Any], prefix: str) -> list[str]:
    """Where two JSON objects differ, one `name: old there, new asked for` per leaf; empty when they are equal."""
    found = []
    for key in sorted({*old, *new}):
        name = f"{prefix}{key}"
        if key in old and key in new:
            if isinstance(old[key], dict) and isinstance(new[key], dict):
                found += differences(old[key], new[key], name + ".")
            elif fingerprint_json(old[key]) != fingerprint_json(new[key]):
                found.append(f"{name}: {_short(old[key])} there, {_short(new[key])} asked for")
        else:
            there, asked = (_short(old[key]), "nothing") if key in old else ("nothing", _short(new[key]))
            found.append(f"{name}: {there} there, {asked} asked for")
    return found


def _short(value: Any) -> str:
    text = json.dumps(value)
    if isinstance(value, str) and value.startswith("sha256:"):
        text = value[:19]
    return text if len(text) <= 60 else text[:57] + "..."


def mismatch(header: dict[str, Any], asked: dict[str, Any], *, with_program: bool) -> list[str]:
    """How a store's header differs from what is asked for now, the first few; empty when it does not.

    Unfinished work binds the program version as well.
    """
    found = [] if header["kind"] == asked["kind"] else [f"kind: {header['kind']} there, {asked['kind']} asked for"]
    if with_program and header["program"] != asked["program"]:
        found.append(f"program: {header['program']} there, {asked['program']} asked for")
    found += differences(header["inputs"], asked["inputs"], "input ")
    found += differences(header["settings"], asked["settings"], "setting ")
    return found if len(found) <= 4 else [*found[:3], f"and {len(found) - 3} more"]
