"""glTF files made here, byte by byte, against positions worked out by hand."""

import base64
import json
import struct

import numpy as np
import pytest

from relightcli.adapters.meshes import load_mesh
from relightcli.errors import InputError

TRIANGLE = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4")
CODES = {"<i1": 5120, "<u1": 5121, "<i2": 5122, "<u2": 5123, "<u4": 5125, "<f4": 5126}


class Builder:
    """Collects arrays as accessors of one buffer."""

    def __init__(self):
        self.data = b""
        self.header = {"asset": {"version": "2.0"}, "bufferViews": [], "accessors": [], "meshes": [], "nodes": []}

    def view(self, data, **extra):
        self.header["bufferViews"].append({"buffer": 0, "byteOffset": len(self.data), "byteLength": len(data), **extra})
        self.data += data + b"\0" * (-len(data) % 4)
        return len(self.header["bufferViews"]) - 1

    def accessor(self, array, **extra):
        array = np.asarray(array)
        kind = "SCALAR" if array.ndim == 1 else f"VEC{array.shape[1]}"
        entry = {"componentType": CODES[array.dtype.str.replace("|", "<")], "count": len(array), "type": kind}
        self.header["accessors"].append({**entry, "bufferView": self.view(array.tobytes()), **extra})
        return len(self.header["accessors"]) - 1

    def mesh(self, *primitives):
        self.header["meshes"].append({"primitives": list(primitives)})
        return len(self.header["meshes"]) - 1

    def node(self, **node):
        self.header["nodes"].append(node)
        return len(self.header["nodes"]) - 1

    def gltf(self, path):
        uri = "data:application/octet-stream;base64," + base64.b64encode(self.data).decode()
        path.write_text(json.dumps({**self.header, "buffers": [{"byteLength": len(self.data), "uri": uri}]}))
        return path

    def glb(self, path):
        text = json.dumps({**self.header, "buffers": [{"byteLength": len(self.data)}]}).encode()
        text += b" " * (-len(text) % 4)
        body = (
            struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(self.data), b"BIN\0") + self.data
        )
        path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body)
        return path


@pytest.fixture
def simple():
    b = Builder()
    b.node(mesh=b.mesh({"attributes": {"POSITION": b.accessor(TRIANGLE)}}))
    return b


def test_glb_and_gltf_are_the_same(simple, tmp_path):
    one, other = load_mesh(simple.glb(tmp_path / "a.glb")), load_mesh(simple.gltf(tmp_path / "a.gltf"))
    assert np.array_equal(one.positions, TRIANGLE)
    assert np.array_equal(one.positions, other.positions)
    assert one.faces.tolist() == other.faces.tolist() == [[0, 1, 2]]
    assert np.array_equal(one.normals, [[0, 0, 1]] * 3)
    assert np.isnan(one.uvs).all()


def test_nested_transforms_apply_from_the_inside_out(tmp_path):
    b = Builder()
    mesh = b.mesh({"attributes": {"POSITION": b.accessor(TRIANGLE)}})
    half = np.sqrt(0.5)
    child = b.node(mesh=mesh, scale=[2, 3, 4], rotation=[0, half, 0, half], translation=[0, 0, 1])
    # Column-major: a translation by (10, 0, 0).
    b.node(children=[child], matrix=[1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 10, 0, 0, 1])
    found = load_mesh(b.gltf(tmp_path / "a.gltf"))
    # (1,0,0) -> (2,0,0) -> quarter turn about +Y -> (0,0,-2) -> (0,0,-1) -> (10,0,-1); sqrt(0.5) rounds once
    assert np.allclose(found.positions, [[10, 0, 1], [10, 0, -1], [10, 3, 1]], atol=1e-15)


def test_a_mesh_in_two_nodes_and_a_mirrored_one(tmp_path):
    b = Builder()
    normals = b.accessor(np.tile(np.array([0, 0, 2], "<f4"), (3, 1)))
    mesh = b.mesh({"attributes": {"POSITION": b.accessor(TRIANGLE), "NORMAL": normals}})
    b.node(mesh=mesh)
    b.node(mesh=mesh, scale=[-1, 1, 1])
    found = load_mesh(b.gltf(tmp_path / "a.gltf"))
    p = found.positions[found.faces]
    assert np.array_equal(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]), [[0, 0, 1], [0, 0, 1]])
    assert np.array_equal(found.normals, [[0, 0, 1]] * 6)


def test_only_the_default_scene_is_loaded(simple, tmp_path):
    simple.node(mesh=0, translation=[5, 0, 0])
    simple.header.update(scenes=[{"nodes": [0]}, {"nodes": [1]}], scene=1)
    assert load_mesh(simple.gltf(tmp_path / "a.gltf")).positions[0].tolist() == [5, 0, 0]


def test_strips_and_fans(tmp_path):
    ladder = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [0, 2, 0], [1, 2, 0]], "<f4")
    b = Builder()
    strip = {"attributes": {"POSITION": b.accessor(ladder)}, "mode": 5}
    fan = {"attributes": {"POSITION": b.accessor(ladder[[0, 1, 3, 2]])}, "mode": 6}
    b.node(mesh=b.mesh(strip, fan))
    found = load_mesh(b.gltf(tmp_path / "a.gltf"))
    assert found.faces.tolist() == [[0, 1, 2], [2, 1, 3], [2, 3, 4], [4, 3, 5], [6, 7, 8], [6, 8, 9]]
    p = found.positions[found.faces]
    assert (np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])[:, 2] == 1).all()


def test_texture_coordinates_need_no_material_and_start_at_the_lower_left(tmp_path):
    b = Builder()
    uv = b.accessor(np.array([[0, 0], [65535, 0], [0, 65535]], "<u2"), normalized=True)
    with_uv = {"attributes": {"POSITION": b.accessor(TRIANGLE), "TEXCOORD_0": uv}}
    b.node(mesh=b.mesh(with_uv, {"attributes": {"POSITION": b.accessor(TRIANGLE)}}))
    found = load_mesh(b.gltf(tmp_path / "a.gltf"))
    assert np.array_equal(found.uvs[:3], [[0, 1], [1, 1], [0, 0]])
    assert np.isnan(found.uvs[3:]).all()


def test_normalised_strided_and_sparse_accessors(tmp_path):
    b = Builder()
    rows = np.zeros(3, dtype=[("p", "<i2", 3), ("pad", "<i2")])
    rows["p"] = [[0, 0, 0], [32767, 0, 0], [0, -32768, 0]]
    view = b.view(rows.tobytes(), byteStride=8)
    quantised = {"componentType": 5122, "count": 3, "type": "VEC3", "bufferView": view, "normalized": True}
    b.header["accessors"].append(quantised)
    at, to = b.view(np.array([1, 2], "<u2").tobytes()), b.view(np.array([[4, 0, 0], [0, 5, 0]], "<f4").tobytes())
    sparse = {"count": 2, "indices": {"bufferView": at, "componentType": 5123}, "values": {"bufferView": to}}
    b.header["accessors"].append({"componentType": 5126, "count": 3, "type": "VEC3", "sparse": sparse})
    b.node(mesh=b.mesh({"attributes": {"POSITION": 0}}, {"attributes": {"POSITION": 1}}))
    found = load_mesh(b.gltf(tmp_path / "a.gltf"))
    assert np.array_equal(found.positions[:3], [[0, 0, 0], [1, 0, 0], [0, -1, 0]])
    assert np.array_equal(found.positions[3:], [[0, 0, 0], [4, 0, 0], [0, 5, 0]])


def test_what_is_left_out_is_noted(simple, tmp_path):
    simple.header["meshes"][0]["primitives"].append({"attributes": {"POSITION": 0}, "mode": 1})
    simple.header["meshes"][0]["primitives"][0]["targets"] = [{"POSITION": 0}]
    simple.header["nodes"][0]["skin"] = 0
    notes = " ".join(load_mesh(simple.gltf(tmp_path / "a.gltf")).notes)
    assert "lines" in notes
    assert "morph" in notes
    assert "skin" in notes


def test_a_buffer_beside_the_file(simple, tmp_path):
    (tmp_path / "with space.bin").write_bytes(simple.data)
    header = {**simple.header, "buffers": [{"byteLength": len(simple.data), "uri": "with%20space.bin"}]}
    path = tmp_path / "a.gltf"
    path.write_text(json.dumps(header))
    assert np.array_equal(load_mesh(path).positions, TRIANGLE)


def _edit(**changes):
    def apply(header):
        header.update(changes)

    return apply


def _accessor(**changes):
    return lambda header: header["accessors"][0].update(changes)


def _node(**changes):
    return lambda header: header["nodes"][0].update(changes)


def _primitive(**changes):
    return lambda header: header["meshes"][0]["primitives"][0].update(changes)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (_edit(asset={"version": "1.0"}), "version 2"),
        (_edit(asset=3), "asset"),
        (_edit(extensionsRequired=["EXT_meshopt_compression"]), "EXT_meshopt_compression"),
        (_edit(scenes=[{"nodes": [7]}]), "entry 7"),
        (_edit(buffers=[{"byteLength": 10**6, "uri": "data:;base64,AAAA"}]), "expected 1000000 bytes, found 3"),
        (_edit(buffers=[{"byteLength": 36}]), "neither a uri"),
        (_edit(buffers=[{"byteLength": 36, "uri": "missing.bin"}]), "no such file"),
        (_edit(buffers=[{"byteLength": 36, "uri": "../outside.bin"}]), "same folder"),
        (_edit(buffers=[{"byteLength": 36, "uri": "http://example.org/a.bin"}]), "same folder"),
        (_edit(bufferViews=[{"buffer": 0, "byteOffset": 8, "byteLength": 36}]), "found 36 at 8"),
        (_accessor(count=4), "expected 48 bytes"),
        (_accessor(count=10**15), "count"),
        (_accessor(count=-1), "count"),
        (_accessor(byteOffset=-4), "expected"),
        (_accessor(componentType=1), "componentType"),
        (_accessor(type="VEC2"), "expected 3 components, found 2"),
        (_node(children=[0]), "tree"),
        (_node(matrix=[1.0, 2.0]), "16 finite numbers, found"),
        (_node(matrix=[1.0] * 16), "last row"),
        (_node(translation=[float("inf"), 0, 0]), "3 finite numbers"),
        (_node(matrix=[float("nan")] * 16), "16 finite numbers"),
        (_node(scale=[1e305, 1, 1]), "above 1e"),
        (_node(mesh=3), "entry 3"),
        (_primitive(mode=9), "mode"),
        (_primitive(indices=0), "expected unsigned whole numbers"),
        (_primitive(attributes={"POSITION": 0, "NORMAL": 5}), "entry 5"),
    ],
)
def test_broken_files_are_refused(simple, tmp_path, change, words):
    path = simple.gltf(tmp_path / "a.gltf")
    (tmp_path.parent / "outside.bin").write_bytes(simple.data)
    header = json.loads(path.read_text())
    change(header)
    if header.get("nodes", [{}])[0].get("children") == [0]:
        header["scenes"] = [{"nodes": [0]}]
    path.write_text(json.dumps(header))
    with pytest.raises(InputError, match=words) as caught:
        load_mesh(path)
    assert str(path) in str(caught.value)


def test_indices_out_of_range_are_refused(tmp_path):
    b = Builder()
    position, index = b.accessor(TRIANGLE), b.accessor(np.array([0, 1, 3], "<u2"))
    b.node(mesh=b.mesh({"attributes": {"POSITION": position}, "indices": index}))
    with pytest.raises(InputError, match="indices: expected 0 to 2, found 0 to 3"):
        load_mesh(b.glb(tmp_path / "a.glb"))


@pytest.mark.parametrize("length", range(0, 200, 7))
def test_a_truncated_glb_is_refused(simple, tmp_path, length):
    path = simple.glb(tmp_path / "a.glb")
    path.write_bytes(path.read_bytes()[:length])
    with pytest.raises(InputError):
        load_mesh(path)


def test_draco_is_refused_and_not_read_as_zeros(simple, tmp_path):
    del simple.header["accessors"][0]["bufferView"]
    simple.header["meshes"][0]["primitives"][0]["extensions"] = {"KHR_draco_mesh_compression": {}}
    with pytest.raises(InputError, match="Draco"):
        load_mesh(simple.gltf(tmp_path / "a.gltf"))


def test_agrees_with_trimesh_on_positions(shared_data):
    import trimesh

    for name in ("meshes/gltf/Duck.glb", "meshes/classic/suzi_pmndrs.glb", "meshes/hard/trimesh/nested.glb"):
        ours = load_mesh(shared_data / name)
        theirs = trimesh.load_mesh(shared_data / name, process=False)
        ours_p, theirs_p = ours.positions[ours.faces], np.asarray(theirs.vertices)[theirs.faces]
        # Both start from float32; node order may differ, so compare each coordinate's sorted values.
        for axis in range(3):
            a, b = np.sort(ours_p[..., axis], axis=None), np.sort(theirs_p[..., axis], axis=None)
            assert np.allclose(a, b, atol=1e-6 * np.ptp(a)), name
