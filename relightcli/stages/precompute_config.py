"""Settings of stage precompute, and their ranges."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from relightcli.errors import InputError
from relightcli.stages.fields import FieldSettings
from relightcli.stages.pose_job import check_pose_options
from relightcli.stages.receiver_setup import MOST_PIXEL_GRID

BASES = ("visibility", "haar", "sh", "dense")
RESOLUTION = 64  # texels along a face of the light's cube, unless asked for or chosen
MOST_BOUNCES = 64
BOUNCE_RESOLUTIONS = (8, 16, 32)


@dataclass(frozen=True)
class Config:
    """Everything that `precompute` needs to know. `basis` beyond visibility is stored in addition to it."""

    scene: Path
    output: Path
    light_resolution: int | None = None  # 64, or what `tolerance` takes
    refine: int = 4
    effects: str = "auto"
    receivers: str = "vertices"
    pixel_grid: int | None = None  # 1, or what `tolerance` takes
    subdivide: bool = True
    basis: str = "visibility"
    coefficients: int = 128
    tolerance: float | None = None
    allow_miss: bool = False
    sh_order: int = 6
    bounces: int | None = None
    bounce_resolution: int | None = None
    pose_frames: str = "spread:200"
    pose_order: int = 4
    pose_directions: int = 1024
    pose_surroundings: bool = False
    field_shells: int = 16
    field_resolution: int | None = None
    field_proxies: int = 8
    field_order: int = 4
    field_spacing: str = "geometric"
    field_tolerance: float | None = None
    field_library: Path | None = None
    seed: int = 0
    workers: int = 1
    scheduler: str | None = None
    overwrite: bool = False
    allow_outside: bool = False
    dry_run: bool = False
    quiet: bool = False

    @property
    def grid(self) -> int:
        """Receivers along a pixel's side."""
        return self.pixel_grid or 1

    @property
    def fields(self) -> FieldSettings:
        """What fields are to be like."""
        return FieldSettings(
            self.field_shells,
            self.field_resolution,
            self.field_proxies,
            self.field_order,
            self.field_spacing,
            self.field_tolerance,
            self.field_library,
        )


def check_config(config: Config) -> None:
    """Raises InputError where a setting is out of its range, or does not go with another."""
    resolution = config.light_resolution or RESOLUTION
    if not 16 <= resolution <= 256 or resolution % 8:
        raise InputError(f"--light-resolution: expected a multiple of 8 from 16 to 256; found {resolution}")
    if config.basis == "haar" and resolution & (resolution - 1):
        raise InputError(f"--light-resolution: --basis haar needs 16, 32, 64, 128 or 256; found {resolution}")
    if config.refine not in (1, 2, 4, 8) or config.refine * 4 > resolution:
        raise InputError(
            f"--refine: expected 1, 2, 4 or 8, at most a quarter of --light-resolution; found {config.refine}"
        )
    if config.basis not in BASES:
        raise InputError(f"--basis: expected one of {', '.join(BASES)}; found {config.basis!r}")
    if not 1 <= config.coefficients <= 6 * resolution * resolution:
        raise InputError(f"--coefficients: expected 1 to {6 * resolution * resolution}; found {config.coefficients}")
    if config.tolerance is not None and not 0.0 < config.tolerance < 1.0:
        raise InputError(f"--tolerance: expected more than 0 and less than 1; found {config.tolerance}")
    if not 1 <= config.sh_order <= 16:
        raise InputError(f"--sh-order: expected 1 to 16; found {config.sh_order}")
    if config.pixel_grid is not None and not 1 <= config.pixel_grid <= MOST_PIXEL_GRID:
        raise InputError(f"--pixel-grid: expected 1 to {MOST_PIXEL_GRID}; found {config.pixel_grid}")
    if config.grid != 1 and config.receivers == "vertices":
        raise InputError("--pixel-grid: needs --receivers pixels:CAMERA")
    check_pose_options(config.pose_frames, config.pose_order, config.pose_directions)
    if config.bounces is not None and not 0 <= config.bounces <= MOST_BOUNCES:
        raise InputError(f"--bounces: expected 0 to {MOST_BOUNCES}; found {config.bounces}")


def check_bounces(config: Config) -> None:
    """Raises InputError where --bounce-resolution does not fit."""
    cells, resolution = config.bounce_resolution, config.light_resolution or RESOLUTION
    if cells is not None and (cells not in BOUNCE_RESOLUTIONS or resolution % cells):
        raise InputError(
            "--bounce-resolution: expected 8, 16 or 32, and a divisor of --light-resolution "
            f"({resolution}); found {cells}"
        )
