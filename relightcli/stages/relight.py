"""Stage relight: any store and a sky in, pictures out."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import relight_formats as formats
from relightcli.stages.lighting import LightingStore, described
from relightcli.stages.outputs import (
    Config,
    check,
    check_moves,
    check_poses,
    check_shots,
    numbered,
    output_suffix,
    resolve_environment,
)
from relightcli.stages.session import Session
from relightcli.stages.shots import Shot, read_shots

__all__ = ["Config", "relight"]


def relight(config: Config) -> dict[str, Any]:
    """Runs the stage; returns what was written and what it took."""
    started = time.perf_counter()
    suffix = output_suffix(config.output)
    check(config, suffix)
    default = Shot(
        1,
        config.env,
        config.env_rotate,
        config.camera,
        config.exposure,
        config.settings,
        config.poses,
        config.moves,
    )
    shots = [default] if config.frames is None else read_shots(config.frames, default)
    if config.reference:
        from relightcli.stages.reference import render_reference

        return render_reference(config, shots, suffix, started)
    lighting = open_lighting(config.store, config.workers)
    check_shots(config, shots, lighting.scene, lighting.camera_name)
    if config.suns == "traced":
        lighting.trace_suns()
    for shot in shots:
        if shot.poses:  # whether the store poses at all, before anything is written
            check_poses(config, shots, lighting.scene, lighting.geometry)
            lighting.set_poses(shot.poses)
            lighting.set_poses(())
            break
    check_moves(config, shots, lighting.set_moves)
    if config.previous is not None:
        lighting.resume(config.previous)
    if config.dry_run:
        return _plan(config, shots, lighting)
    session = Session(lighting, config)
    opened = time.perf_counter() - started
    written, clocks = [], []
    for shot in shots:
        clock = time.perf_counter()
        written.append(session.write(shot, suffix))
        clocks.append(time.perf_counter() - clock)
    session.finish()
    costs = lighting.costs()
    return {
        "store": str(config.store),
        "output": written if config.frames else written[0],
        "frames": len(written),
        "seconds": time.perf_counter() - started,
        "open_seconds": opened,
        "lighting_seconds": session.lighting_seconds / len(written),
        "frame_seconds": clocks,
        "rates": session.rates(),
        **({} if lighting.changed is None else {"changed_clusters": lighting.changed}),
        **({"moving": costs} if costs else {}),
        "notes": session.notes,
    }


def open_lighting(path: Path, threads: int) -> LightingStore:
    """The store of any stage that pictures are made from."""
    store = formats.open_store(path)
    with described(store.path):
        return _of_kind(store, threads)


def _of_kind(store: formats.Store, threads: int) -> LightingStore:
    if "fields" in store.attrs and store.kind == "pose":
        from relightcli.stages.posed_moving import PosedMovingStore

        return PosedMovingStore(store, threads)
    if "fields" in store.attrs:
        from relightcli.stages.moving import MovingStore

        return MovingStore(store, threads)
    if store.kind == "asset":
        from relightcli.stages.asset import AssetStore

        return AssetStore(store, threads)
    if store.kind == "light_clusters":
        from relightcli.stages.clustered import ClusteredStore

        return ClusteredStore(store, threads)
    if store.kind == "pose":
        from relightcli.stages.posed import PoseStore

        return PoseStore(store, threads)
    return LightingStore(store, threads)


def _plan(config: Config, shots: list[Shot], lighting: LightingStore) -> dict[str, Any]:
    """What a run would write, with everything that can be wrong looked at, and nothing done."""
    frames = [
        {
            "output": numbered(config.output, shot.number) if config.frames else config.output,
            "environment": str(resolve_environment(shot.env, lighting.scene.environments)),
            "env_rotate": shot.env_rotate,
            "set": list(shot.settings),
        }
        for shot in shots
    ]
    return {"dry_run": True, "store": str(config.store), "receivers": len(lighting), "frames": frames, "notes": []}
