"""Scene folders made of the parts of tests.core.transport.scenes: meshes, maps and a scene file."""

from __future__ import annotations

import numpy as np

from relightcli.adapters.images import read_image, write_image
from relightcli.stages.precompute import precompute
from relightcli.stages.precompute_config import Config as PrecomputeConfig
from relightcli.stages.relight import Config as RelightConfig
from relightcli.stages.relight import relight

USED = {
    "lambert": (),
    "blinn-phong": ("specular", "shininess"),
    "cook-torrance": ("specular", "f0", "roughness"),
    "phong": ("specular", "shininess"),
    "translucent": ("transmittance",),
}


def _toml(value):
    if isinstance(value, bool):
        return str(value).lower()
    return repr([float(v) for v in value] if isinstance(value, tuple | list | np.ndarray) else value)


def _write_obj(path, part):
    corners, triangles, normals, uvs = part.corners, part.triangles, part.normals, part.uvs
    if normals is None:
        # Flat faces have corners of their own.
        corners = corners[triangles].reshape(-1, 3)
        triangles = np.arange(len(corners)).reshape(-1, 3)
        normals = np.repeat(np.cross(corners[1::3] - corners[::3], corners[2::3] - corners[::3]), 3, axis=0)
        normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
        uvs = None
    lines = ["v " + " ".join(repr(float(x)) for x in v) for v in corners]
    lines += ["vn " + " ".join(repr(float(x)) for x in n) for n in normals]
    if uvs is not None:
        lines += ["vt " + " ".join(repr(float(x)) for x in t) for t in uvs]
    for face in triangles + 1:
        lines.append("f " + " ".join(f"{i}/{i if uvs is not None else ''}/{i}" for i in face))
    path.write_text("\n".join(lines) + "\n")


def write_scene(folder, parts, cameras, maps, adjustable=False, more=""):
    """Writes `scene.toml` and what it names; returns its path. parts: name to Part; maps: name to (H, W, 3)."""
    folder.mkdir(parents=True, exist_ok=True)
    text = ["format = 1"]
    for name, part in parts.items():
        _write_obj(folder / f"{name}.obj", part)
        m = part.material
        text += [f"[objects.{name}]", f"mesh = '{name}.obj'", f"material = '{name}'"]
        text += [f"two_sided = {_toml(part.two_sided)}"]
        text += [f"[materials.{name}]", f"model = '{m.model}'", f"diffuse = {_toml(m.diffuse)}"]
        text += [f"{key} = {_toml(getattr(m, key))}" for key in USED[m.model]]
        text += [f"adjustable = {_toml(adjustable)}"]
        if part.texture is not None:
            write_image(folder / f"{name}.exr", part.texture.astype(np.float32))
            text.append(f"diffuse_texture = '{name}.exr'")
    for camera in cameras:
        text += [f"[cameras.{camera.name}]"]
        text += [f"{key} = {_toml(getattr(camera, key))}" for key in ("eye", "target", "up", "fov")]
        text += [f"size = [{camera.size[0]}, {camera.size[1]}]"]
    for name, pixels in maps.items():
        write_image(folder / f"{name}-sky.exr", np.asarray(pixels, np.float32))
        text += [f"[environments.{name}]", f"map = '{name}-sky.exr'"]
    path = folder / "scene.toml"
    path.write_text("\n".join(text) + "\n" + more)
    return path


def make_store(scene, name="transfer.zarr", **settings):
    """Precomputes next to the scene file, without bounces unless told; returns the store's path."""
    output = scene.parent / name
    if "effects" not in settings:
        settings.setdefault("bounces", 0)
    precompute(PrecomputeConfig(scene=scene, output=output, quiet=True, **{"workers": 1, **settings}))
    return output


def picture(store, name="out.exr", **settings):
    """Relights to a picture; returns (RGB (H, W, 3), alpha (H, W)) as read from the file."""
    output = store.parent / name
    relight(RelightConfig(store=store, output=str(output), quiet=True, **{"workers": 1, **settings}))
    channels = read_layers(output)
    return channels[""], channels["A"]


def read_layers(path):
    """RGB of every layer of a picture by name, "" is the beauty; and alpha as "A"."""
    image = read_image(path)
    at = {name: image.pixels[..., k] for k, name in enumerate(image.names)}
    layers = {name: [image.names[k] for k in index] for name, index in image.layers().items()}
    out = {}
    for layer, names in layers.items():
        prefix = f"{layer}." if layer else ""
        out[layer] = np.stack([at[f"{prefix}{c}"] for c in "RGB"], -1)
        assert set(names) <= {f"{prefix}{c}" for c in "RGBA"}
    out["A"] = at.get("A")
    return out
