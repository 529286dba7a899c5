"""Builds the example store `valid/small`: every data type family, codec and array shape that format 1 allows.

    python formats/examples/build.py FOLDER

The stores in `valid/` are kept as they were written: later programs must go on reading them. `invalid.py` derives the
invalid examples from `valid/small`.
"""

import sys
from pathlib import Path

import numpy as np

from relight_formats import begin, fingerprint_json, pack_bits, quantise

VERTICES, LIGHTS = 6, 10


def build(path: Path) -> None:
    """Write the example store at `path`. All values are exact in binary, so that the bytes are the same anywhere."""
    writer = begin(
        path,
        "example",
        settings={"light_resolution": 4, "tolerance": 0.02, "effects": ["direct", "shadows"]},
        inputs={"scene": fingerprint_json({"objects": 1})},
        program="relightcli 0.1.0",
    )
    if writer is None:
        return
    with writer:
        writer.set_attrs({"scene": {"objects": ["plane"], "tolerance": 0.02}})
        points = np.arange(VERTICES * 3, dtype=np.float32).reshape(VERTICES, 3) / 2
        writer.put("geometry/position", points, dims=("V", "xyz"), units="m")
        writer.put("geometry/faces", np.zeros((0, 3), np.int32), dims=("F", "corner"))
        writer.put("geometry/scale", np.float64(1.5), dims=(), units="m", codec="none")
        visible = (np.arange(VERTICES * LIGHTS).reshape(VERTICES, LIGHTS) % 3) > 0
        bits = pack_bits(visible)
        writer.put("direct/visibility", bits, dims=("V", "byte"), attrs={"bits": LIGHTS}, codec="zstd")
        codes, scale = quantise(np.arange(VERTICES * LIGHTS).reshape(VERTICES, LIGHTS) / 2, "uint8")
        writer.put("direct/scale", scale[:, 0], dims=("V",), units="sr")
        array = writer.array(
            "direct/transfer",
            shape=codes.shape,
            dtype=codes.dtype,
            chunks=(4, LIGHTS),
            dims=("V", "L"),
            units="sr",
            attrs={"scale": "scale"},
        )
        for start in (0, 4):
            array[start : start + 4] = codes[start : start + 4]
            writer.record(f"direct/{start}", {"seconds": 0.5, "rays": 40, "error": 1e-05})
        writer.commit({"seconds": 1.0, "error": 1e-05})


if __name__ == "__main__":
    build(Path(sys.argv[1]))
