"""What `tradeoff` is asked for, the report's folder, and the views that points are judged by."""

from __future__ import annotations

import json
import platform
import shutil
from dataclasses import dataclass
from pathlib import Path

import relight_formats as formats
from relightcli import __version__
from relightcli.adapters.files import write_atomic
from relightcli.errors import InputError, StoreError
from relightcli.scene.model import Scene
from relightcli.stages.inputs import scene_inputs
from relightcli.stages.outputs import resolve_environment
from relightcli.stages.tradeoff_runs import View

HEADER = "tradeoff.json"
LEAST_SPP = 32  # of the truth: path tracing's own curve starts at a sixteenth of it


@dataclass(frozen=True)
class Config:
    """Everything that `tradeoff` needs to know. output: the report's folder. knobs: NAME=V1,V2,..."""

    scene: Path
    output: Path
    knobs: tuple[str, ...] = ()
    envs: tuple[str, ...] = ()
    cameras: tuple[str, ...] = ()
    bounces: int = 2
    spp: int = 64
    repeats: int = 2
    tolerance: float | None = None
    seed: int = 0
    workers: int = 1
    overwrite: bool = False
    allow_outside: bool = False
    dry_run: bool = False
    quiet: bool = False


def open_folder(config: Config, scene: Scene) -> str:
    """Makes the folder, or takes up what is in it; returns the machine's name.

    Raises StoreError where it is of another scene, program, machine or number of workers; InputError where it is no
    report.
    """
    header = {
        "format": 1,
        "program": f"relightcli {__version__}",
        "scene": formats.fingerprint_json(scene_inputs(scene)),
        "machine": machine(),
        "workers": config.workers,
    }
    folder, path = config.output, config.output / HEADER
    if not path.exists() and folder.is_dir() and any(folder.iterdir()):
        raise InputError(f"--output {folder}: holds files, but no {HEADER}; expected an empty folder, or a report")
    try:
        found = json.loads(path.read_text())
    except FileNotFoundError:
        found = None
    except ValueError:
        found = {}
    if found is not None and found != header:
        changed = [k for k in header if not isinstance(found, dict) or found.get(k) != header[k]]
        if not config.overwrite:
            raise StoreError(
                f"{folder}: was made with another {', '.join(changed)}, and what is measured would not compare "
                f"(inputs: {config.scene} and the files that it names); choose another folder, or --overwrite to start "
                "anew"
            )
        shutil.rmtree(folder / "runs", ignore_errors=True)
    folder.mkdir(exist_ok=True)
    write_atomic(path, json.dumps(header, indent=1).encode())
    return machine()


def command_of(config: Config) -> list[str]:
    """The command line that gives this configuration, without what does not change the result."""
    plain = Config(config.scene, config.output)
    words = ["relightcli", "tradeoff", str(config.scene), "-o", str(config.output)]
    for name, values in (("--knob", config.knobs), ("--env", config.envs), ("--camera", config.cameras)):
        words += [word for value in values for word in (name, value)]
    for name in ("bounces", "spp", "repeats", "tolerance", "seed"):
        if getattr(config, name) != getattr(plain, name):
            words += [f"--{name}", str(getattr(config, name))]
    return [*words, "--workers", str(config.workers), *(["--allow-outside"] if config.allow_outside else [])]


def machine() -> str:
    """Processor and system, as far as the system tells."""
    name = platform.processor() or platform.machine()
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        name = next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), name)
    except OSError:
        pass
    return f"{name}, {platform.system()}"


def make_views(config: Config, scene: Scene, cameras: list[str]) -> list[View]:
    """Every sky from every camera. Without --env the scene's skies; without any, a clear one with its sun."""
    files = {name: resolve_environment(name, scene.environments) for name in config.envs or tuple(scene.environments)}
    if not files:
        files = {"built-in sky": _built_in_sky(config.output)}
    return [
        View(
            Path(name).stem if Path(name).suffix else name, str(path.resolve()), formats.fingerprint_file(path), camera
        )
        for name, path in files.items()
        for camera in cameras
    ]


def _built_in_sky(folder: Path) -> Path:
    from relightcli.adapters.images import write_image
    from relightcli.core.lights.sky import sky_latlong

    path = folder / "sky.exr"
    write_image(path, sky_latlong(40.0, 150.0))
    return path
