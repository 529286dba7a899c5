"""Embree's C interface: rays in packets of eight, with the interpreter's lock released.

The package `embreex` hands Embree one ray at a time and holds the lock. The library that it brings is called here
directly: eight rays in one call, in Embree's mode for coherent rays where the eight share an origin and a narrow cone.
Embree's answers are those to single rays. Where the library is not found beside the package, `library` returns None,
and `relightcli.adapters.rays` goes through embreex. [Embree 4 API, rtcore_ray.h, rtcore_scene.h]
"""

from __future__ import annotations

import ctypes
import weakref
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic
from numpy.typing import NDArray

from relightcli.errors import SystemFault

WIDTH = 8  # rays of a packet: what AVX holds; Embree splits them on processors that hold fewer
# Rays of a packet are coherent where they start at one point and the squared cosine between each and the first is
# larger than this: found by trial, and flat. Rays through a cell of 4 x 4 texels are, from 16 texels along a face on.
_NARROW = 0.85

# rtcore_common.h, rtcore_geometry.h, rtcore_buffer.h, rtcore_scene.h
_TRIANGLES, _INDEX, _VERTEX, _UINT3, _FLOAT3, _ROBUST, _COHERENT = 0, 0, 1, 0x5003, 0x9003, 4, 1 << 16
# RTCRayHit8 in words of four bytes, each a row of eight: origin, tnear, direction, time, tfar, mask, id, flags, then
# normal, u, v, primID, geomID and two kinds of instance.
_ROWS, _TFAR, _MASK, _U, _V, _FACE, _GEOMETRY = 21, 8, 9, 15, 16, 17, 18
_ALIGNMENT = 64
_FAR = 1e37  # where rays end, and the distance of a ray that hits nothing: as in embreex
_NONE = 0xFFFFFFFF

_PATTERNS = ("../embreex.libs/libembree4*.so*", ".dylibs/libembree4*.dylib", "../embreex.libs/embree4*.dll")
_POINTER = ctypes.c_void_p
_SIGNATURES: dict[str, tuple[Any, list[Any]]] = {
    "rtcNewDevice": (_POINTER, [ctypes.c_char_p]),
    "rtcGetDeviceError": (ctypes.c_int, [_POINTER]),
    "rtcNewScene": (_POINTER, [_POINTER]),
    "rtcSetSceneFlags": (None, [_POINTER, ctypes.c_int]),
    "rtcNewGeometry": (_POINTER, [_POINTER, ctypes.c_int]),
    "rtcSetSharedGeometryBuffer": (
        None,
        [_POINTER, ctypes.c_int, ctypes.c_uint, ctypes.c_int, _POINTER, *3 * [ctypes.c_size_t]],
    ),
    "rtcCommitGeometry": (None, [_POINTER]),
    "rtcAttachGeometry": (ctypes.c_uint, [_POINTER, _POINTER]),
    "rtcReleaseGeometry": (None, [_POINTER]),
    "rtcCommitScene": (None, [_POINTER]),
    "rtcReleaseScene": (None, [_POINTER]),
}


@cache
def library() -> tuple[ctypes.CDLL, Any] | None:
    """Embree 4 as embreex brings it, and a device of it; None where there is none that can be called."""
    spec = find_spec("embreex")
    if spec is None or spec.origin is None or ctypes.sizeof(_POINTER) != 8:
        return None
    found = [file for pattern in _PATTERNS for file in sorted(Path(spec.origin).parent.glob(pattern))]
    if not found:
        return None
    try:
        import embreex.rtcore_scene  # noqa: F401  (loads what the library itself needs)

        loaded = ctypes.CDLL(str(found[0]))
        for name, (result, arguments) in _SIGNATURES.items():
            function = getattr(loaded, name)
            function.restype, function.argtypes = result, arguments
    except (OSError, AttributeError, ImportError):
        return None
    device = loaded.rtcNewDevice(None)
    return (loaded, device) if device else None


class PacketScene:
    """A committed scene of triangles, traced in packets.

    vertices (V, 3) float32; faces (F, 3) int32, F > 0. Its methods take rays as origins and directions (N, 3) float32.
    """

    def __init__(
        self, loaded: tuple[ctypes.CDLL, Any], vertices: NDArray[np.float32], faces: NDArray[np.int32]
    ) -> None:
        embree, device = loaded
        padded = np.zeros((len(vertices) + 1, 3), np.float32)  # Embree reads 16 bytes at the last one
        padded[:-1] = vertices
        corners = np.array(faces, np.uint32, order="C")
        self._scene = embree.rtcNewScene(device)
        embree.rtcSetSceneFlags(self._scene, _ROBUST)
        mesh = embree.rtcNewGeometry(device, _TRIANGLES)
        for kind, form, data, count in (
            (_VERTEX, _FLOAT3, padded, len(vertices)),
            (_INDEX, _UINT3, corners, len(corners)),
        ):
            embree.rtcSetSharedGeometryBuffer(mesh, kind, 0, form, data.ctypes.data, 0, 12, count)
        embree.rtcCommitGeometry(mesh)
        embree.rtcAttachGeometry(self._scene, mesh)
        embree.rtcReleaseGeometry(mesh)  # the scene has it
        embree.rtcCommitScene(self._scene)
        # The buffers are the scene's as long as it lives.
        weakref.finalize(self, _release, embree, self._scene, padded, corners)
        code = embree.rtcGetDeviceError(device)
        if code:
            raise SystemFault(f"Embree cannot hold a mesh of {len(faces)} faces: expected no error, found {code}.")
        self._occluded = ctypes.cast(embree.rtcOccluded8, _POINTER).value
        self._intersect = ctypes.cast(embree.rtcIntersect8, _POINTER).value

    def occluded(
        self,
        origins: NDArray[np.float32],
        directions: NDArray[np.float32],
        max_distance: NDArray[np.float32] | None = None,
    ) -> NDArray[np.bool_]:
        """True (N,) where anything lies along the ray, up to `max_distance` (N,)."""
        o, d = _rays(origins, directions)
        far = _far(max_distance, len(o))
        blocked = np.empty(len(o), np.bool_)
        _occluded(self._occluded, self._scene, o, d, far, _scratch(), _arguments(), blocked)
        return blocked

    def intersect(
        self, origins: NDArray[np.float32], directions: NDArray[np.float32]
    ) -> tuple[NDArray[np.int32], NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
        """Of the nearest hit: its face (N,), -1 for none; u and v (N,), 0 for none; distance (N,), 1e37 for none."""
        o, d = _rays(origins, directions)
        n = len(o)
        face, hit = np.empty(n, np.int32), np.empty((3, n), np.float32)
        _intersect(self._intersect, self._scene, o, d, _scratch(), _arguments(), face, hit)
        return face, hit[0], hit[1], hit[2]


def _release(embree: ctypes.CDLL, scene: Any, *buffers: NDArray[Any]) -> None:
    embree.rtcReleaseScene(scene)


def _rays(origins: NDArray[Any], directions: NDArray[Any]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """C-contiguous float32. Raises ValueError unless both are (N, 3): compiled loops do not check."""
    if origins.shape != directions.shape or origins.ndim != 2 or origins.shape[1] != 3:
        raise ValueError(f"expected origins and directions (N, 3); found {origins.shape} and {directions.shape}")
    return np.ascontiguousarray(origins, np.float32), np.ascontiguousarray(directions, np.float32)


def _far(max_distance: NDArray[np.float32] | None, count: int) -> NDArray[np.float32]:
    """Where rays end, (N,), or (0,) for far away."""
    if max_distance is None:
        return np.empty(0, np.float32)
    if max_distance.shape != (count,):
        raise ValueError(f"expected a distance for each of {count} rays; found {max_distance.shape}")
    return np.ascontiguousarray(max_distance, np.float32)


def _scratch() -> NDArray[np.float32]:
    """A packet, aligned: its rows, and one more for which of its rays are in use."""
    words = (_ROWS + 1) * WIDTH
    raw = np.zeros(4 * words + _ALIGNMENT, np.uint8)
    start = -raw.ctypes.data % _ALIGNMENT
    packet = raw[start : start + 4 * words].view(np.float32)
    packet.view(np.uint32)[_MASK * WIDTH : (_MASK + 1) * WIDTH] = _NONE
    return packet


def _arguments() -> NDArray[np.uint32]:
    """Two of RTCOccludedArguments or RTCIntersectArguments, for rays of any kind and for coherent ones: flags, features
    (all), no context, no callbacks."""
    both = np.zeros((2, 16), np.uint32)
    both[:, 1] = _NONE
    both[1, 0] = _COHERENT
    return both


def _call(typing_context: Any, function: Any, valid: Any, scene: Any, rays: Any, arguments: Any) -> Any:
    """Calls `function` (valid, scene, rays, arguments), all given as addresses."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        word = ir.IntType(64)
        kind = ir.FunctionType(ir.VoidType(), [word] * 4)
        builder.call(builder.inttoptr(values[0], kind.as_pointer()), values[1:])
        return context.get_dummy_value()

    return types.void(*[types.int64] * 5), generate


_trace: Any = intrinsic(_call)


@njit(cache=True, nogil=True)
def _load(start, stop, origins, directions, packet, valid):  # type: ignore[no-untyped-def]
    """Rays from `start` on into the packet; returns whether they are coherent."""
    w = WIDTH
    narrow = True
    x, y, z = origins[start, 0], origins[start, 1], origins[start, 2]
    a, b, c = directions[start, 0], directions[start, 1], directions[start, 2]
    length2 = a * a + b * b + c * c
    for k in range(w):
        r = start + k
        if r >= stop:
            valid[k] = 0
            continue
        valid[k] = -1
        ox, oy, oz = origins[r, 0], origins[r, 1], origins[r, 2]
        dx, dy, dz = directions[r, 0], directions[r, 1], directions[r, 2]
        packet[k], packet[w + k], packet[2 * w + k] = ox, oy, oz
        packet[4 * w + k], packet[5 * w + k], packet[6 * w + k] = dx, dy, dz
        dot = a * dx + b * dy + c * dz
        if ox != x or oy != y or oz != z or dot <= 0 or dot * dot < _NARROW * length2 * (dx * dx + dy * dy + dz * dz):
            narrow = False
    return narrow


@njit(cache=True, nogil=True)
def _occluded(function, scene, origins, directions, far, packet, arguments, blocked):  # type: ignore[no-untyped-def]
    w, n = WIDTH, len(origins)
    valid = packet.view(np.int32)[_ROWS * w :]
    for start in range(0, n, w):
        narrow = _load(start, n, origins, directions, packet, valid)
        count = min(w, n - start)
        for k in range(count):
            packet[_TFAR * w + k] = far[start + k] if len(far) else _FAR
        _trace(function, valid.ctypes.data, scene, packet.ctypes.data, arguments[1 if narrow else 0].ctypes.data)
        for k in range(count):
            blocked[start + k] = packet[_TFAR * w + k] < 0  # -inf where something was met


@njit(cache=True, nogil=True)
def _intersect(function, scene, origins, directions, packet, arguments, face, hit):  # type: ignore[no-untyped-def]
    w, n = WIDTH, len(origins)
    words = packet.view(np.int32)
    valid = words[_ROWS * w :]
    for start in range(0, n, w):
        narrow = _load(start, n, origins, directions, packet, valid)
        for k in range(w):
            packet[_TFAR * w + k] = _FAR
            words[_FACE * w + k] = words[_GEOMETRY * w + k] = -1
        _trace(function, valid.ctypes.data, scene, packet.ctypes.data, arguments[1 if narrow else 0].ctypes.data)
        for k in range(min(w, n - start)):
            r = start + k
            missed = words[_GEOMETRY * w + k] == -1
            face[r] = words[_FACE * w + k]
            hit[0, r] = np.float32(0.0) if missed else packet[_U * w + k]
            hit[1, r] = np.float32(0.0) if missed else packet[_V * w + k]
            hit[2, r] = packet[_TFAR * w + k]
