"""Stage relight: any store and a sky in, pictures out."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import relight_formats as formats
from relightcli.errors import NumericalError
from relightcli.stages.lighting import LightingStore, described
from relightcli.stages.outputs import (
    Config,
    check,
    check_moves,
    check_poses,
    check_shots,
    output_suffix,
    plan_frames,
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
    notes = need_accuracy(config, lighting.store)
    if config.previous is not None:
        notes += lighting.resume(config.previous)
    written, clocks = [], []
    with Session(lighting, config) as session:
        session.notes += notes
        if config.dry_run:
            return _plan(session, shots, suffix, time.perf_counter() - started)
        if not session.begin(shots):
            return {"store": str(config.store), "output": config.output, "status": "up to date", "notes": []}
        opened = time.perf_counter() - started
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


def _plan(session: Session, shots: list[Shot], suffix: str, opened: float) -> dict[str, Any]:
    """What a run would write and what it should take, from the first frame's light; nothing is left behind."""
    config, lighting = session.config, session.lighting
    clock = time.perf_counter()
    session.light(shots[0], suffix)  # what the first frame makes for those after it, and what compiles
    first = time.perf_counter() - clock
    clock = time.perf_counter()
    session.light(shots[-1], suffix)
    more = time.perf_counter() - clock
    return {
        "dry_run": True,
        "store": str(config.store),
        "receivers": len(lighting),
        "frames": plan_frames(config, shots, lighting.scene),
        "predicted": {"seconds": opened + first + (len(shots) - 1) * more},
        "notes": session.notes,
    }


def need_accuracy(config: Config, store: formats.Store) -> list[str]:
    """Notes on what is known of the store's error. Raises NumericalError where it is above the tolerance."""
    if config.tolerance is None:
        return []
    measured = store.attrs.get("measured_error")
    if measured is None:
        return [
            "--tolerance: the store's error was not measured; precompute --tolerance does, and so do --reference "
            "and diff"
        ]
    share = float(measured["share"])
    if share > config.tolerance:
        raise NumericalError(
            f"{store.path}: its error was measured as {share:.2%}, above --tolerance {config.tolerance:.2%}; "
            f"nothing was written. precompute --tolerance {config.tolerance:g}, or use --reference"
        )
    if store.kind == "transfer":
        return []
    return [f"--tolerance: {share:.2%} was measured of the transfer store; what came after it is not in that"]
