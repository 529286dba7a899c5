"""Relights every map from the result of the one before: paint.py RELIGHTCLI FOLDER."""

import json
import subprocess
import sys
from pathlib import Path

relightcli, folder = sys.argv[1], Path(sys.argv[2])
previous = []
for sky in sorted((folder / "maps").glob("*.exr")):
    out = folder / "radiance" / f"{sky.stem}.zarr"
    command = [relightcli, "relight", folder / "clusters.zarr", "--env", sky, *previous]
    done = subprocess.run([*command, "-o", out, "--json"], check=True, capture_output=True, text=True)
    told = json.loads(done.stdout)
    print(f"{sky.name}: {told['changed_clusters']} clusters changed, {1e3 * told['lighting_seconds']:.0f} ms")
    subprocess.run([*command, "-o", folder / "pictures" / f"{sky.stem}.png", "--exposure", "1", "-q"], check=True)
    previous = ["--from", out]
