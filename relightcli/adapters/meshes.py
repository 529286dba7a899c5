"""Mesh files to plain arrays: PLY, OBJ, STL and OFF through trimesh, glTF by `relightcli.adapters.gltf`.

A mesh file is checked before it is trusted: size limits and element counts against the bytes that are there, then
faces, finite coordinates and indices in range. trimesh gets the bytes only, no file names, so it opens nothing else.
"""

from __future__ import annotations

import bz2
import io
import re
import signal
import sys
import threading
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from relightcli.adapters.gltf import Part, read_gltf
from relightcli.core.affine import unit
from relightcli.core.normals import degenerate_faces, vertex_normals
from relightcli.errors import InputError, RelightError, SystemFault

SUFFIXES = (".glb", ".gltf", ".obj", ".off", ".ply", ".stl")
# Bytes, after decompression: about 40 million vertices of binary PLY.
MAX_BYTES = 2 << 30
# Beyond this, products of coordinates leave what float64 can hold in the steps that follow.
MAX_COORDINATE = 1e30


@dataclass(frozen=True)
class LoadedMesh:
    """One mesh in its file's own space.

    positions (V, 3) float64, finite; normals (V, 3) float64, unit; uvs (V, 2) float64 with (0, 0) at the lower left of
    the image, NaN where the file has none; faces (F, 3) int32, in range, none degenerate; notes for the user.
    """

    positions: NDArray[np.float64]
    normals: NDArray[np.float64]
    uvs: NDArray[np.float64]
    faces: NDArray[np.int32]
    notes: tuple[str, ...] = ()


def _import_trimesh() -> None:
    """trimesh swallows whatever its optional imports raise, an interrupt too: interrupts wait until it has loaded."""
    if "trimesh" in sys.modules or threading.current_thread() is not threading.main_thread():
        return
    caught: list[int] = []
    handlers = {
        number: signal.signal(number, lambda signum, frame: caught.append(signum))
        for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        import trimesh  # noqa: F401
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
    for signum in caught:
        signal.raise_signal(signum)


def load_mesh(path: Path) -> LoadedMesh:
    """Load a mesh file; several objects in it become one mesh, in the file's order.

    Normals are the file's where it has finite, non-zero ones, else angle-weighted on the mesh as loaded (an STL shares
    no vertices, so its normals are flat). Faces without area are dropped with a note; vertices that no face uses stay.
    A `.bz2` around one mesh file is unpacked.
    Raises InputError, naming the file, for whatever cannot be loaded as triangles with finite coordinates.
    """
    data, suffix = read_file(path)
    if suffix not in (".gltf", ".glb"):
        _import_trimesh()
    notes: list[str] = []
    try:
        # Infinities that arise here are found and refused by `finish_mesh`.
        with np.errstate(over="ignore", invalid="ignore"):
            if suffix in (".gltf", ".glb"):
                parts, found = read_gltf(path, data)
                notes.extend(found)
            else:
                parts = _through_trimesh(data, suffix)
    except RelightError:
        raise
    except MemoryError:
        raise InputError(f"{path}: does not fit in memory.") from None
    except Exception as error:  # whatever a parser throws at bytes it did not expect
        reason = str(error).strip().split("\n")[0][:200] or type(error).__name__
        raise InputError(f"{path}: cannot be read as a {suffix[1:].upper()} mesh ({reason}).") from error
    try:
        return finish_mesh(parts, notes)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def finish_mesh(parts: list[Part], notes: list[str]) -> LoadedMesh:
    """Join the parts, check them, and give every vertex a normal."""
    parts = [part for part in parts if len(part.faces)]
    if not parts:
        raise InputError("has no triangles (a point cloud, lines or nothing at all); expected a surface mesh.")
    positions = np.concatenate([part.positions for part in parts]).astype(np.float64, copy=False)
    if len(positions) > np.iinfo(np.int32).max:
        raise InputError(f"has {len(positions):,} vertices; expected at most {np.iinfo(np.int32).max:,}.")
    wrong = ~(np.abs(positions) <= MAX_COORDINATE).all(axis=1)
    if wrong.any():
        first = int(np.argmax(wrong))
        raise InputError(
            f"{int(wrong.sum())} of {len(positions)} vertices have coordinates that are not finite or above "
            f"{MAX_COORDINATE:g}; the first is vertex {first}: {positions[first].tolist()}. Repair the mesh."
        )
    all_faces, start = [], 0
    for part in parts:
        low, high = int(part.faces.min()), int(part.faces.max())
        if low < 0 or high >= len(part.positions):
            raise InputError(f"faces use vertices {low} to {high}; expected 0 to {len(part.positions) - 1}.")
        all_faces.append(part.faces.astype(np.int32) + np.int32(start))
        start += len(part.positions)
    faces = np.concatenate(all_faces)
    flat = degenerate_faces(positions, faces)
    if flat.all():
        raise InputError(f"all of its {len(faces)} faces are degenerate (no area); expected a surface mesh.")
    if flat.any():
        notes.append(f"{int(flat.sum())} of {len(faces)} faces have no area and were dropped")
        faces = faces[~flat]

    given = np.concatenate([np.zeros_like(p.positions) if p.normals is None else p.normals for p in parts])
    normals = unit(given.astype(np.float64, copy=False))
    missing = ~normals.any(axis=1)
    if missing.any():
        normals[missing] = vertex_normals(positions, faces)[missing]
        spoilt = int(np.concatenate([np.full(len(p.positions), p.normals is not None) for p in parts])[missing].sum())
        if spoilt:
            notes.append(f"{spoilt} of its vertex normals are zero or not finite and were computed instead")
    uvs = np.concatenate([np.full((len(p.positions), 2), np.nan) if p.uvs is None else p.uvs for p in parts])
    return LoadedMesh(positions, normals, uvs.astype(np.float64, copy=False), faces, tuple(notes))


def read_file(path: Path) -> tuple[bytes, str]:
    """The file's bytes and its lower-case suffix, unpacked if it is a `.bz2`."""
    suffix = path.suffix.lower()
    packed = suffix == ".bz2"
    if packed:
        suffix = Path(path.stem).suffix.lower()
    if suffix not in SUFFIXES:
        raise InputError(f"{path}: expected a mesh file ({', '.join(SUFFIXES)}), found suffix {suffix or 'none'!r}.")
    if not path.exists():
        raise InputError(f"{path}: no such file; expected a mesh.")
    if not path.is_file():
        raise InputError(f"{path}: is not a regular file; expected a mesh.")
    size = path.stat().st_size
    if size > MAX_BYTES:
        raise InputError(f"{path}: {size:,} bytes; expected at most {MAX_BYTES:,}. Split or simplify the mesh.")
    try:
        data = path.read_bytes()
    except OSError as error:
        raise SystemFault(f"{path}: cannot be opened ({error.strerror}).") from None
    if packed:
        try:
            unpacker = bz2.BZ2Decompressor()
            data = unpacker.decompress(data, max_length=MAX_BYTES)
        except (OSError, ValueError) as error:
            raise InputError(f"{path}: cannot be unpacked ({error}).") from None
        if not unpacker.eof:
            raise InputError(f"{path}: is cut short, or unpacks to more than {MAX_BYTES:,} bytes.")
    return data, suffix


def _through_trimesh(data: bytes, suffix: str) -> list[Part]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        # NumPy's text parser stops in silence at what it cannot read; half a file must not pass for a whole one.
        warnings.filterwarnings("error", message="string or file could not be read to its end")
        loaded = {".ply": _ply, ".obj": _obj, ".stl": _stl, ".off": _off}[suffix](data)
    return [_part(kwargs) for kwargs in loaded]


def _meshes(loaded: dict[str, Any]) -> list[dict[str, Any]]:
    """trimesh's loaders return one mesh, or several by name; keep those with faces."""
    several = list(loaded["geometry"].values()) if "geometry" in loaded else [loaded]
    return [mesh for mesh in several if mesh.get("faces") is not None and len(mesh["faces"])]


def _part(kwargs: dict[str, Any]) -> Part:
    from trimesh.geometry import triangulate_quads

    positions = np.asarray(kwargs["vertices"], dtype=np.float64).reshape(-1, 3)
    # Checked before the cast to int32, which would fold large indices back into range.
    faces = np.asarray(triangulate_quads(kwargs["faces"]), dtype=np.int64).reshape(-1, 3)
    if len(faces) and (faces.min() < 0 or faces.max() >= len(positions)):
        raise ValueError(f"faces use vertices {faces.min()} to {faces.max()}; expected 0 to {len(positions) - 1}")

    def per_vertex(values: Any, width: int) -> NDArray[np.float64] | None:
        if values is None or np.shape(values)[:1] != (len(positions),) or np.shape(values)[1] < width:
            return None
        return np.asarray(values, dtype=np.float64)[:, :width]

    uvs = per_vertex(getattr(kwargs.get("visual"), "uv", None), 2)
    return Part(positions, faces.astype(np.int32), per_vertex(kwargs.get("vertex_normals"), 3), uvs)


def _decode(data: bytes) -> str:
    """Text of an unknown exporter: by its byte order mark, else UTF-8, else one byte per letter."""
    for mark, encoding in ((b"\xff\xfe", "utf-16"), (b"\xfe\xff", "utf-16"), (b"\xef\xbb\xbf", "utf-8-sig")):
        if data.startswith(mark):
            return data.decode(encoding)
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError:
        return data.decode("latin-1")


def _ply(data: bytes) -> list[dict[str, Any]]:
    from trimesh.exchange.ply import load_ply

    end = re.search(rb"end_header\s*?\n", data[: 1 << 20])
    if not data.startswith(b"ply") or end is None:
        raise ValueError("expected a PLY header")
    header = data[: end.end()].decode("latin-1")
    counts = [int(n) for n in re.findall(r"(?m)^element\s+\S+\s+(-?\d+)", header)]
    body = len(data) - end.end()
    # One line per element as text, at least one byte as binary.
    room = data.count(b"\n", end.end()) + 1 if re.search(r"(?m)^format\s+ascii", header) else body
    if min(counts, default=0) < 0 or sum(counts) > room:
        raise ValueError(
            f"the header promises {sum(counts):,} elements, the file has room for {room:,}; is it cut short?"
        )
    # trimesh can split vertices along seams of the texture and drop unused ones, but leaves their normals as they
    # were. Needed only where texture coordinates belong to faces; the normals are then computed.
    per_face = re.search(r"(?m)^property\s+list\s+\S+\s+\S+\s+texcoord", header) is not None
    loaded = load_ply(io.BytesIO(data), skip_materials=True, fix_texture=per_face)
    if per_face:
        loaded.pop("vertex_normals", None)
    return _meshes(loaded)


def _obj(data: bytes) -> list[dict[str, Any]]:
    from trimesh.exchange.obj import load_obj

    text = re.sub(r"#[^\n]*", "", _decode(data).replace("\r\n", "\n").replace("\\\n", " "))
    if re.search(r"(?m)^f\s[^\n]*?(?<=[\s/])0+(?=[\s/]|\Z)", text):
        raise ValueError("a face uses index 0; OBJ counts from 1")
    relative = re.search(r"(?m)^f\s[^\n]*?[\s/]-\d", text)
    if relative and re.search(r"(?m)^v[tn]?\s", text[relative.start() :]):
        # trimesh counts negative indices from the end of the file, the format counts from the current line.
        raise ValueError("negative indices with more vertices after them; export it again with absolute indices")
    return _meshes(load_obj(io.BytesIO(text.encode()), skip_materials=True))


def _stl(data: bytes) -> list[dict[str, Any]]:
    from trimesh.exchange.stl import HeaderError, load_stl_ascii, load_stl_binary

    try:
        return _meshes(load_stl_binary(io.BytesIO(data)))
    except HeaderError as error:
        if not data.lstrip()[:5].lower() == b"solid":
            raise ValueError(str(error)) from None
    text = _decode(data)
    if len(re.findall(r"(?i)\bendfacet\b", text)) * 3 != len(re.findall(r"(?im)^\s*vertex\s", text)):
        raise ValueError("expected three vertices per facet; is it cut short?")
    return _meshes(load_stl_ascii(io.BytesIO(text.encode())))


def _off(data: bytes) -> list[dict[str, Any]]:
    from trimesh.exchange.off import load_off

    text = re.sub(r"#[^\n]*", "", _decode(data))
    counts = re.match(r"\s*(?:ST|C|N)*OFF\s*(\d+)\s+(\d+)[^\n]*\n", text)
    if counts is None:
        raise ValueError("expected the word OFF and the numbers of vertices and faces")
    promised = int(counts[1]) + int(counts[2])
    lines = sum(1 for line in text[counts.end() :].splitlines() if line.strip())
    if promised > lines:
        raise ValueError(f"the header promises {promised:,} vertices and faces, the file has {lines:,} lines")
    return _meshes(load_off(io.BytesIO(text.encode())))
