"""The demo's page, one file with everything in it: page.py OUT "SKIES" "CHECKED"."""

from __future__ import annotations

import base64
import io
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from relightcli.adapters.html import Picture, Section, Table, page, png_data_uri
from relightcli.adapters.images import read_image
from relightcli.core.display import to_display

FRAME_MILLISECONDS = 120


def main(folder: Path, skies: list[str], checked: list[str]) -> None:
    log = folder / "log"
    store = answer(log, "store")
    turntable = answer(log, "turntable")
    sections = [
        Section(
            "Three skies",
            "Each picture comes from the same store. The skies are made by the program: two clear ones with their sun, "
            "and an overcast one.",
            [Picture(picture_uri(folder / f"{s}.png"), f"{s}: {command(log, f'png-{s}')}") for s in skies],
        ),
        Section(
            "A turning sky",
            f"{turntable['frames']} frames, {np.mean(turntable['frame_seconds']):.2f} s each.",
            [Picture(animation_uri([folder / f for f in turntable["output"]]), command(log, "turntable"))],
        ),
        *[check_section(folder, log, s) for s in checked],
        times_section(log, store, skies, checked, turntable),
    ]
    intro = (
        f"One scene, simulated once: {store['cost']['visibility']['rays'] / 1e6:.0f} million rays in "
        f"{store['summary']['seconds']:.0f} s with {store['summary']['workers']} workers, kept in "
        f"{store['bytes'] / 1e6:.1f} MB. Then pictures of it under other skies, and how far two of them are from path "
        "tracing. All commands run in the folder of this page."
    )
    target = folder / "index.html"
    target.write_text(page("relightcli demo", intro, sections), encoding="utf-8")


def answer(log: Path, name: str) -> dict[str, Any]:
    result: dict[str, Any] = json.loads((log / f"{name}.json").read_text())
    return result


def command(log: Path, name: str) -> str:
    return (log / f"{name}.txt").read_text().strip()


def picture_uri(path: Path) -> str:
    with Image.open(path) as picture:
        return png_data_uri(np.asarray(picture.convert("RGB")))


def animation_uri(frames: list[Path]) -> str:
    pictures = []
    for frame in frames:
        with Image.open(frame) as picture:
            pictures.append(picture.convert("RGB"))
    stream = io.BytesIO()
    pictures[0].save(
        stream, "WEBP", save_all=True, append_images=pictures[1:], duration=FRAME_MILLISECONDS, loop=0, quality=85
    )
    return "data:image/webp;base64," + base64.b64encode(stream.getvalue()).decode("ascii")


def check_section(folder: Path, log: Path, sky: str) -> Section:
    result = answer(log, f"diff-{sky}")
    item, limits = result["items"][0], result["fail"]
    relit, reference = (read_image(folder / f"{name}.exr").pixels[..., :3] for name in (sky, f"reference-{sky}"))
    # One exposure for both, that the brighter parts of the reference come out near white.
    exposure = float(-np.log2(np.quantile(reference, 0.98)))
    pictures = [
        Picture(png_data_uri(to_display(relit, exposure)), f"From the store: {command(log, f'exr-{sky}')}"),
        Picture(png_data_uri(to_display(reference, exposure)), f"Path-traced: {command(log, f'reference-{sky}')}"),
        Picture(
            picture_uri(folder / f"heatmap-{sky}.png"),
            f"Where they differ, the brighter the more; report-{sky}.html has the scale",
        ),
    ]
    rows = [[metric, value, limits[metric]] for metric, value in item["metrics"].items()]
    verdict = "Within the limits." if result["passed"] else "Beyond the limits."
    return Section(
        f"Error under the {sky} sky",
        f"{verdict} The noise of the path-traced picture counts as error too.\n\n{command(log, f'diff-{sky}')}",
        pictures,
        [Table(["error over the whole picture", "measured", "accepted"], rows)],
    )


def times_section(
    log: Path, store: dict[str, Any], skies: list[str], checked: list[str], turntable: dict[str, Any]
) -> Section:
    names = [f"{kind}-{s}" for s in skies for kind in ("exr", "png")]
    names += ["turntable", *(f"reference-{s}" for s in checked)]
    rows: list[list[str | float]] = [[command(log, "precompute"), store["summary"]["seconds"]]]
    rows += [[command(log, name), answer(log, name)["seconds"]] for name in names]
    lit = turntable["lighting_seconds"]
    return Section(
        "Times",
        "Seconds on the clock, from the opening of the store to the last file written. In the turning sky, lighting "
        f"itself takes {lit:.3f} s a frame.",
        tables=[Table(["command", "seconds"], rows)],
    )


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2].split(), sys.argv[3].split())
