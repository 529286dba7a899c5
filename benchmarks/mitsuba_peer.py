"""Mitsuba 3 renders an exported scene: `python -m benchmarks.mitsuba_peer IN.npz OUT.npz VARIANT quick|full`.

Writes two independent long runs, `a` and `b`; prints as JSON how time and error depend on the samples a pixel.
"""

from __future__ import annotations

import json
import math
import sys
import time
from typing import Any

import numpy as np

BATCH = {"quick": 8, "full": 64}  # samples a pixel of one call; larger ones do not run faster
LONG = {"quick": 4, "full": 4}  # calls that make up each long run
REPEATS = 3


def load(mi: Any, data: Any) -> Any:
    """The scene: as many objects as there are, the sky, a box-filtered camera; light, surface, eye."""
    camera = [float(x) for x in data["camera"]]
    film = {
        "type": "hdrfilm",
        "width": int(camera[10]),
        "height": int(camera[11]),
        "rfilter": {"type": "box"},
        "component_format": "float32",
    }
    view = mi.ScalarTransform4f().look_at(origin=camera[:3], target=camera[3:6], up=camera[6:9])
    scene = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 2, "hide_emitters": True},
        "sensor": {
            "type": "perspective",
            "fov": camera[9],
            "fov_axis": "y",
            "to_world": view,
            "film": film,
            "sampler": {"type": "independent"},
        },
        "sky": {"type": "envmap", "bitmap": mi.Bitmap(data["sky"])},
    }
    k = 0
    while f"position{k}" in data:
        props = mi.Properties()
        albedo = [float(x) for x in data[f"albedo{k}"]]
        props["bsdf"] = mi.load_dict({"type": "diffuse", "reflectance": {"type": "rgb", "value": albedo}})
        positions, faces = data[f"position{k}"], data[f"face{k}"]
        mesh = mi.Mesh(f"part{k}", len(positions), len(faces), has_vertex_normals=True, props=props)
        parameters = mi.traverse(mesh)
        parameters["vertex_positions"] = positions.ravel()
        parameters["vertex_normals"] = data[f"normal{k}"].ravel()
        parameters["faces"] = faces.ravel().astype(np.uint32)
        parameters.update()
        scene[f"part{k}"] = mesh
        k += 1
    return mi.load_dict(scene)


def main() -> None:
    source, out, variant, size = sys.argv[1:]
    import mitsuba as mi

    mi.set_variant(variant)
    mi.set_log_level(mi.LogLevel.Error)
    scene = load(mi, np.load(source))
    batch, calls = BATCH[size], LONG[size]

    def picture(spp: int, seed: int) -> np.ndarray:
        return np.array(mi.render(scene, spp=spp, seed=mi.UInt32(seed)), np.float64)[..., :3]

    seconds = {}
    for spp in (batch // 8, batch):
        picture(spp, 0)  # compiles
        clock = time.perf_counter()
        for k in range(REPEATS):
            picture(spp, 1 + k)
        seconds[spp] = (time.perf_counter() - clock) / REPEATS
    slope = max(0.0, (seconds[batch] - seconds[batch // 8]) / (batch - batch // 8))

    halves, squared = [np.zeros(()), np.zeros(())], 0.0
    for k in range(calls):
        pair = [picture(batch, 100 + 2 * k), picture(batch, 101 + 2 * k)]
        squared += float(np.mean((pair[0] - pair[1]) ** 2)) / 2 / calls
        halves = [half + one / calls for half, one in zip(halves, pair, strict=True)]
    power = float(np.mean(halves[0] * halves[1]))
    np.savez(out, a=halves[0].astype(np.float32), b=halves[1].astype(np.float32))
    result = {
        "spp": batch,
        "seconds": seconds[batch],
        "seconds_fixed": max(0.0, seconds[batch] - batch * slope),
        "seconds_per_sample": slope,
        "error_at_one": math.sqrt(squared * batch / power),
    }
    print(json.dumps(result))


if __name__ == "__main__":
    main()
