"""Triangles of a glTF 2.0 file (.gltf, .glb): nodes, several primitives, normalised, strided and sparse accessors.

Read here and not through trimesh, which drops the texture coordinates of primitives without a material, takes
normalised integers at face value, and fills sparse and compressed accessors with zeros. What is left out (skins,
which `gltf_skin` reads, morph targets, lines and points) is named in the notes. Source: Khronos glTF 2.0
specification, sections in brackets.
"""

from __future__ import annotations

import base64
import binascii
import json
import struct
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from relightcli.core.affine import transform_mesh, unit
from relightcli.errors import InputError

# [3.6.2.2] component types and element sizes
_COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
# An accessor without a buffer view is all zeros and costs no bytes in the file, so its count needs a limit of its own.
_MAX_COUNT = 1 << 27
# Instancing multiplies what a small file can ask for.
MAX_CORNERS = 3 * (1 << 27)
# Extensions that a file may require without changing its triangles.
_HARMLESS = ("KHR_materials_", "KHR_texture_", "KHR_lights_", "KHR_mesh_quantization", "EXT_texture_", "MSFT_texture_")


@dataclass(frozen=True)
class Part:
    """One primitive in the file's world space. positions, normals (V, 3) float64 (normals zero or None where the file
    has none), uvs (V, 2) float64 or None with (0, 0) at the image's lower left, faces (F, 3) int32."""

    positions: NDArray[np.float64]
    faces: NDArray[np.int32]
    normals: NDArray[np.float64] | None = None
    uvs: NDArray[np.float64] | None = None


@dataclass
class GltfFile:
    path: Path
    header: dict[str, Any]
    binary: bytes | None
    buffers: dict[int, bytes] = field(default_factory=dict)
    notes: dict[str, None] = field(default_factory=dict)  # ordered, each once

    def fail(self, message: str) -> InputError:
        return InputError(f"{self.path}: {message}")

    def item(self, kind: str, index: Any) -> dict[str, Any]:
        items = self.header.get(kind, [])
        if not isinstance(index, int) or isinstance(index, bool) or not 0 <= index < len(items):
            raise self.fail(f"{kind} has {len(items)} entries; the file refers to entry {index!r}.")
        entry = items[index]
        if not isinstance(entry, dict):
            raise self.fail(f"{kind}[{index}]: expected an object, found {type(entry).__name__}.")
        return entry


def open_gltf(path: Path, data: bytes) -> GltfFile:
    """The file's header and binary chunk. Raises InputError for other versions, and extensions it cannot do without.

    path names the file, whose folder holds the buffers it refers to (they may not lie outside); data is its content.
    """
    header, binary = _split(path, data)
    file = GltfFile(path, header, binary)
    if str(header.get("asset", {}).get("version", "")).split(".")[0] != "2":
        raise file.fail("expected glTF version 2 (asset.version); export it again as glTF 2.0.")
    foreign = [name for name in header.get("extensionsRequired", []) if not str(name).startswith(_HARMLESS)]
    if foreign:
        raise file.fail(f"requires {', '.join(map(str, foreign))}, which is not supported; export it without.")
    return file


def read_gltf(path: Path, data: bytes) -> tuple[list[Part], tuple[str, ...]]:
    """The triangle primitives of the default scene, each under its node's transform, in depth-first order, and notes.

    Arguments as `open_gltf`. Raises InputError for anything that does not follow the specification.
    """
    file = open_gltf(path, data)
    parts: list[Part] = []
    corners = 0
    for node, matrix in _mesh_nodes(file):
        if "skin" in node:
            file.notes["its skin is not applied: the mesh stands in its bind pose"] = None
        for primitive in file.item("meshes", node["mesh"]).get("primitives", []):
            part = read_primitive(file, primitive)
            if part is None:
                continue
            corners += part.faces.size
            if corners > MAX_CORNERS:
                raise file.fail(f"holds more than {MAX_CORNERS // 3:,} triangles after instancing.")
            normals = np.zeros_like(part.positions) if part.normals is None else part.normals
            positions, normals, faces = transform_mesh(matrix, part.positions, normals, part.faces)
            parts.append(Part(positions, faces, None if part.normals is None else normals, part.uvs))
    return parts, tuple(file.notes)


def buffer_files(path: Path) -> list[Path]:
    """The files beside a mesh file that its geometry lies in: the buffers of a glTF; none for other formats."""
    if path.suffix.lower() not in (".gltf", ".glb"):
        return []
    header, _ = _split(path, path.read_bytes())
    uris = [str(b["uri"]) for b in header.get("buffers", []) if isinstance(b, dict) and b.get("uri") is not None]
    return [path.parent / unquote(uri) for uri in uris if not uri.startswith("data:")]


def _split(path: Path, data: bytes) -> tuple[dict[str, Any], bytes | None]:
    """JSON header and binary chunk [4.4]."""
    binary = None
    text = data
    if data[:4] == b"glTF":
        if len(data) < 20:
            raise InputError(f"{path}: is cut short: expected a 20-byte GLB header, found {len(data)} bytes.")
        version, length = struct.unpack_from("<II", data, 4)
        if version != 2 or length > len(data):
            raise InputError(f"{path}: expected GLB version 2 of {length} bytes, found version {version}, {len(data)}.")
        position = 12
        chunks: dict[bytes, bytes] = {}
        while position + 8 <= length:
            size, kind = struct.unpack_from("<I4s", data, position)
            if position + 8 + size > length:
                raise InputError(f"{path}: is cut short: chunk {kind!r} claims {size} bytes.")
            chunks.setdefault(kind, data[position + 8 : position + 8 + size])
            position += 8 + size
        text, binary = chunks.get(b"JSON", b""), chunks.get(b"BIN\0")
    try:
        header = json.loads(text.decode("utf-8-sig"))
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: its JSON header cannot be read ({error}).") from None
    if not isinstance(header, dict) or not isinstance(header.get("asset", {}), dict):
        raise InputError(f"{path}: expected a glTF header (a JSON object with `asset`).")
    return header, binary


def _mesh_nodes(file: GltfFile) -> list[tuple[dict[str, Any], NDArray[np.float64]]]:
    """Nodes with a mesh, depth first, each with its world matrix [3.5]."""
    found = []
    world: dict[int, NDArray[np.float64]] = {-1: np.eye(4)}
    for index, parent in walk(file):
        node = file.item("nodes", index)
        world[index] = world[parent] @ local_matrix(file, node, index)
        if not np.isfinite(world[index]).all():
            raise file.fail(f"nodes[{index}]: its transform is not finite.")
        if "mesh" in node:
            found.append((node, world[index]))
    return found


def walk(file: GltfFile) -> list[tuple[int, int]]:
    """The nodes of the default scene, depth first: (index, its parent's index or -1) [3.5]."""
    nodes = file.header.get("nodes", [])
    if file.header.get("scenes"):
        roots = file.item("scenes", file.header.get("scene", 0)).get("nodes", [])
    else:
        children = {child for node in nodes for child in node.get("children", [])}
        roots = [i for i in range(len(nodes)) if i not in children]
    found, seen = [], set()
    stack = [(index, -1) for index in reversed(roots)]
    while stack:
        index, parent = stack.pop()
        node = file.item("nodes", index)
        if index in seen:
            raise file.fail(f"nodes[{index}] is reached twice; the nodes must form a tree.")
        seen.add(index)
        found.append((index, parent))
        stack.extend((child, index) for child in reversed(node.get("children", [])))
    return found


def local_matrix(file: GltfFile, node: dict[str, Any], index: int) -> NDArray[np.float64]:
    """A node's matrix (4, 4) relative to its parent [3.5.3]."""

    def vector(key: str, default: list[float]) -> NDArray[np.float64]:
        value = np.asarray(node.get(key, default), dtype=np.float64)
        if value.shape != (len(default),) or not np.isfinite(value).all():
            raise file.fail(f"nodes[{index}].{key}: expected {len(default)} finite numbers, found {node.get(key)!r}.")
        return value

    if "matrix" in node:  # column-major
        matrix = vector("matrix", [0.0] * 16).reshape(4, 4).T
        if not np.array_equal(matrix[3], (0.0, 0.0, 0.0, 1.0)):
            raise file.fail(f"nodes[{index}].matrix: expected a last row of 0 0 0 1, found {matrix[3].tolist()}.")
        return matrix
    x, y, z, w = unit(vector("rotation", [0.0, 0.0, 0.0, 1.0]).reshape(1, 4))[0]
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    matrix = np.eye(4)
    matrix[:3, :3] = rotation * vector("scale", [1.0, 1.0, 1.0])
    matrix[:3, 3] = vector("translation", [0.0, 0.0, 0.0])
    return matrix


def read_primitive(file: GltfFile, primitive: dict[str, Any]) -> Part | None:
    """One primitive in its mesh's own space, or None for lines and points [3.7.2]."""
    mode = primitive.get("mode", 4)
    if mode in (0, 1, 2, 3):
        file.notes["its lines and points were left out"] = None
        return None
    if mode not in (4, 5, 6):
        raise file.fail(f"expected a primitive mode of 0 to 6, found {mode!r}.")
    if primitive.get("targets"):
        file.notes["its morph targets are not applied"] = None
    attributes = primitive.get("attributes", {})
    if "POSITION" not in attributes:
        file.notes["a primitive without POSITION was left out"] = None
        return None
    compressed = "KHR_draco_mesh_compression" in primitive.get("extensions", {})

    def attribute(name: str, width: int) -> NDArray[np.float64]:
        values = read_accessor(file, attributes[name], compressed)
        if values.shape[1] != width:
            raise file.fail(f"{name}: expected {width} components, found {values.shape[1]}.")
        if name != "POSITION" and len(values) != len(positions):
            raise file.fail(f"{name}: expected {len(positions)} entries, one per POSITION, found {len(values)}.")
        return np.asarray(values, dtype=np.float64)

    positions = np.zeros((0, 3))
    positions = attribute("POSITION", 3)
    count = len(positions)
    if "indices" in primitive:
        listed = read_accessor(file, primitive["indices"], compressed)
        if listed.shape[1] != 1 or listed.dtype.kind != "u":
            raise file.fail(f"indices: expected unsigned whole numbers, found {listed.shape[1]} x {listed.dtype}.")
        index = listed[:, 0].astype(np.int64)
    else:
        index = np.arange(count)
    if len(index) and (index.min() < 0 or index.max() >= count):
        raise file.fail(f"indices: expected 0 to {count - 1}, found {index.min()} to {index.max()}.")
    if mode == 4:
        if len(index) % 3:
            raise file.fail(f"a triangle list: expected a multiple of 3 indices, found {len(index)}.")
        faces = index.reshape(-1, 3)
    elif mode == 5:  # strip: every other triangle turns around
        faces = np.stack([index[:-2], index[1:-1], index[2:]], axis=1)
        faces[1::2] = faces[1::2][:, [1, 0, 2]]
    else:  # fan
        faces = np.stack([np.repeat(index[:1], max(len(index) - 2, 0)), index[1:-1], index[2:]], axis=1)
    normals = attribute("NORMAL", 3) if "NORMAL" in attributes else None
    uvs = attribute("TEXCOORD_0", 2) if "TEXCOORD_0" in attributes else None
    if uvs is not None:
        uvs = np.stack([uvs[:, 0], 1.0 - uvs[:, 1]], axis=1)
    return Part(positions, faces.astype(np.int32), normals, uvs)


def read_accessor(file: GltfFile, index: Any, compressed: bool) -> NDArray[Any]:
    """Values (N, width) of an accessor; normalised integers become float64 [3.6.2]."""
    entry = file.item("accessors", index)
    label = f"accessors[{index}]"
    count = entry.get("count")
    if not isinstance(count, int) or isinstance(count, bool) or not 0 <= count <= _MAX_COUNT:
        raise file.fail(f"{label}.count: expected 0 to {_MAX_COUNT}, found {count!r}.")
    dtype, width = _element(file, label, entry)
    if "bufferView" in entry:
        values = _view(file, label, entry["bufferView"], entry.get("byteOffset", 0), count, width, dtype)
    elif compressed:
        raise file.fail("is compressed with Draco, which is not supported; export it uncompressed.")
    else:
        values = np.zeros((count, width), dtype)
    if "sparse" in entry:  # [3.6.2.3]
        sparse = entry["sparse"]
        changed = sparse.get("count", 0)
        where, value = sparse["indices"], sparse["values"]
        index_type, _ = _element(file, f"{label}.sparse", {**where, "type": "SCALAR"})
        at = _view(file, label, where["bufferView"], where.get("byteOffset", 0), changed, 1, index_type)[:, 0]
        if len(at) and int(at.max()) >= count:
            raise file.fail(f"{label}.sparse: expected indices below {count}, found {at.max()}.")
        values = values.copy()
        values[at] = _view(file, label, value["bufferView"], value.get("byteOffset", 0), changed, width, dtype)
    if entry.get("normalized") and dtype.kind in "iu":
        return np.maximum(values / float(np.iinfo(dtype).max), -1.0)  # [3.6.2.2]
    return values


def _element(file: GltfFile, label: str, entry: dict[str, Any]) -> tuple[np.dtype[Any], int]:
    component, kind = entry.get("componentType"), entry.get("type")
    if component not in _COMPONENTS or kind not in _WIDTHS:
        raise file.fail(f"{label}: unknown componentType {component!r} or type {kind!r}.")
    return np.dtype(_COMPONENTS[component]), _WIDTHS[kind]


def _view(
    file: GltfFile, label: str, view_index: Any, offset: int, count: int, width: int, dtype: np.dtype[Any]
) -> NDArray[Any]:
    """(count, width) values inside a buffer view, checked against its bounds before anything is allocated."""
    view = file.item("bufferViews", view_index)
    buffer = _buffer(file, view.get("buffer"))
    start, length = view.get("byteOffset", 0), view.get("byteLength", 0)
    row = width * dtype.itemsize
    stride = view.get("byteStride", row)
    needed = offset + (count - 1) * stride + row if count else 0
    if min(start, length, offset, stride - row) < 0 or start + length > len(buffer) or needed > length:
        raise file.fail(
            f"{label}: expected {needed} bytes in bufferViews[{view_index}], found {length} at {start} of a buffer "
            f"of {len(buffer)}."
        )
    if count == 0:
        return np.zeros((0, width), dtype)
    return np.ndarray((count, width), dtype, buffer, start + offset, (stride, dtype.itemsize))


def _buffer(file: GltfFile, index: Any) -> bytes:
    """The bytes of a buffer: the GLB's own, base64 text, or a file in the same folder or below [3.6.1]."""
    if index in file.buffers:
        return file.buffers[index]
    entry = file.item("buffers", index)
    uri = entry.get("uri")
    if uri is None:
        if index != 0 or file.binary is None:
            raise file.fail(f"buffers[{index}]: has neither a uri nor a binary chunk.")
        content = file.binary
    elif str(uri).startswith("data:"):
        try:
            content = base64.b64decode(str(uri).partition("base64,")[2], validate=True)
        except binascii.Error as error:
            raise file.fail(f"buffers[{index}]: its base64 text cannot be read ({error}).") from None
    else:
        folder = file.path.resolve().parent
        target = (folder / unquote(str(uri))).resolve()
        if "://" in str(uri) or not target.is_relative_to(folder):
            raise file.fail(f"buffers[{index}].uri: expected a file in the same folder, found {str(uri)[:80]!r}.")
        if not target.is_file():
            raise file.fail(f"buffers[{index}].uri: no such file {str(uri)[:80]!r} beside it.")
        content = target.read_bytes()
    wanted = entry.get("byteLength", 0)
    if not isinstance(wanted, int) or len(content) < wanted:
        raise file.fail(f"buffers[{index}]: expected {wanted} bytes, found {len(content)}.")
    file.buffers[index] = content
    return content
