"""Frames of a sequence: `--frames SHOTS.toml`, or one frame from the command line.

    format = 1
    frames = 24                     # numbered from `first` (default 1)

    [[key]]
    frame = 1
    env = "noon.exr"                # path relative to this file, or an environment of the scene; holds until the next
    camera = "main"                 # holds until the next
    env_rotate = 0                  # degrees; this and everything below is interpolated linearly between keys
    exposure = 0
    set = { "gold.roughness" = 0.2, "red.diffuse" = [0.6, 0.1, 0.1], "floor" = "blue-acrylic" }
    pose = { man = "walk@0" }       # the clip holds until the next; seconds are interpolated between keys of one clip
    move = { ball = [0, 1, 2] }     # three, six or sixteen numbers as `--move` takes them, the same number in every key

    [[key]]
    frame = 25                      # keys may lie beyond the last frame: a full turn in 24 frames without a double
    env_rotate = 360

Before a value's first key it has that key's value, after its last key that one's. A measured material (a text in `set`)
holds until the next one of the same material; numbers change it further, whichever stands first. Between keys of
different clips an object stands still in the pose of the former. Of a move, translation and scale are interpolated
linearly and the rotation takes the shorter way at an even pace.
"""

from __future__ import annotations

import itertools
import tomllib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from relightcli.errors import InputError
from relightcli.scene.fields import describe, is_number
from relightcli.scene.moving import COUNTS, between
from relightcli.scene.posing import parse_pose
from relightcli.scene.settings import measured_fit

MOST_FRAMES = 100_000
MOST_BYTES = 16 << 20
STEPPED = ("env", "camera")
NUMBERS = ("env_rotate", "exposure")


@dataclass(frozen=True)
class Shot:
    """One frame. `env` is a path or a name, None for the default; `settings` and `moves` are
    texts as `--set` and `--move` take them."""

    number: int
    env: str | None
    env_rotate: float
    camera: str | None
    exposure: float
    settings: tuple[str, ...]
    poses: tuple[str, ...] = ()  # as `--pose` takes them; of several for one object the last holds
    moves: tuple[str, ...] = ()


def read_shots(path: Path, default: Shot) -> list[Shot]:
    """The frames of a file; what it does not say comes from `default`. Raises InputError naming file and key."""
    data = _load(path)
    _known(path, "", data, {"format", "frames", "first", "key"})
    if data.get("format") != 1:
        raise InputError(f"{path}: format: expected 1; found {data.get('format')!r}")
    count = _integer(path, "frames", data.get("frames"), 1, MOST_FRAMES)
    first = _integer(path, "first", data.get("first", 1), 0, 10**9)
    keys = data.get("key", [])
    if not isinstance(keys, list) or not all(isinstance(k, dict) for k in keys):
        raise InputError(f"{path}: key: expected tables [[key]]; found {keys!r}")
    tracks: dict[str, list[tuple[float, Any]]] = {}
    previous = None
    for i, key in enumerate(keys):
        where = f"key[{i}]"
        _known(path, where, key, {"frame", "set", "pose", "move", *STEPPED, *NUMBERS})
        frame = _number(path, f"{where}.frame", key.get("frame"))
        if previous is not None and frame <= previous:
            raise InputError(f"{path}: {where}.frame: expected more than {previous:g}, the key before; found {frame:g}")
        previous = frame
        for name in STEPPED:
            if name in key:
                if not isinstance(key[name], str):
                    raise InputError(f"{path}: {where}.{name}: expected a text; found {key[name]!r}")
                tracks.setdefault(name, []).append((frame, key[name]))
        for name in NUMBERS:
            if name in key:
                tracks.setdefault(name, []).append((frame, (_number(path, f"{where}.{name}", key[name]),)))
        changes = key.get("set", {})
        if not isinstance(changes, dict):
            raise InputError(f"{path}: {where}.set: expected a table; found {changes!r}")
        for name, value in changes.items():
            _add_setting(path, f"{where}.set.{name}", tracks.setdefault(f"set.{name}", []), frame, value)
        poses = key.get("pose", {})
        if not isinstance(poses, dict):
            raise InputError(f"{path}: {where}.pose: expected a table; found {poses!r}")
        for name, value in poses.items():
            if not isinstance(value, str):
                raise InputError(f"{path}: {where}.pose.{name}: expected a text CLIP@SECONDS; found {describe(value)}")
            try:
                pose = parse_pose(f"{name}={value}")
            except InputError as error:
                raise InputError(f"{path}: {where}.pose.{name}: {error}") from None
            tracks.setdefault(f"pose.{name}", []).append((frame, (pose.clip, pose.seconds)))
        moves = key.get("move", {})
        if not isinstance(moves, dict):
            raise InputError(f"{path}: {where}.move: expected a table; found {moves!r}")
        for name, value in moves.items():
            _add_move(path, f"{where}.move.{name}", tracks.setdefault(f"move.{name}", []), frame, value)
    return [_shot(path, first + i, tracks, default) for i in range(count)]


def _add_setting(path: Path, where: str, track: list[tuple[float, Any]], frame: float, value: Any) -> None:
    """Appends numbers, or a measured material's name, to the track of one setting, which is all one or the other."""
    if isinstance(value, str):
        if track and not _is_text(track):
            raise InputError(f"{path}: {where}: expected a number, as in the key before; found {value!r}")
        try:
            track.append((frame, measured_fit(value).name))
        except InputError as error:
            raise InputError(f"{path}: {where}: {error}") from None
        return
    numbers = tuple(_number(path, where, v) for v in (value if isinstance(value, list) else [value]))
    if track and _is_text(track):
        raise InputError(f"{path}: {where}: expected a measured material, as in the key before; found {value!r}")
    if track and len(track[0][1]) != len(numbers):
        raise InputError(f"{path}: {where}: expected {len(track[0][1])} numbers; found {value!r}")
    track.append((frame, numbers))


def _add_move(path: Path, where: str, track: list[tuple[float, Any]], frame: float, value: Any) -> None:
    numbers = tuple(_number(path, where, v) for v in value) if isinstance(value, list) else ()
    counts = (len(track[0][1]),) if track else COUNTS
    if len(numbers) not in counts:
        before = ", as in the key before" if track else ""
        raise InputError(f"{path}: {where}: expected {' or '.join(map(str, counts))} numbers{before}; found {value!r}")
    track.append((frame, numbers))


def _shot(path: Path, number: int, tracks: dict[str, list[tuple[float, Any]]], default: Shot) -> Shot:
    env = _held(tracks.get("env"), number)
    if env is not None and (path.parent / env).is_file():
        env = str(path.parent / env)
    rotate = _between(tracks.get("env_rotate"), number)
    exposure = _between(tracks.get("exposure"), number)
    changes = {name.removeprefix("set."): track for name, track in tracks.items() if name.startswith("set.")}
    # A measured material replaces every parameter, so it goes before the numbers that change it further.
    names = [f"{name}={_held(track, number)}" for name, track in changes.items() if _is_text(track)]
    numbers = [
        f"{name}={','.join(repr(v) for v in _between(track, number) or ())}"
        for name, track in changes.items()
        if not _is_text(track)
    ]
    moves = [
        f"{name.removeprefix('move.')}={','.join(repr(v) for v in _between(track, number, between) or ())}"
        for name, track in tracks.items()
        if name.startswith("move.")
    ]
    return Shot(
        number,
        env if env is not None else default.env,
        rotate[0] if rotate else default.env_rotate,
        _held(tracks.get("camera"), number) or default.camera,
        exposure[0] if exposure else default.exposure,
        (*default.settings, *names, *numbers),
        (*default.poses, *(_pose(n.removeprefix("pose."), t, number) for n, t in tracks.items() if n[:5] == "pose.")),
        (*default.moves, *moves),
    )


def _pose(name: str, track: list[tuple[float, Any]], number: int) -> str:
    """The pose of one object at a frame, as `--pose` takes it."""
    clip, seconds = track[0][1]
    for (a, (clip_a, from_)), (b, (clip_b, to)) in itertools.pairwise(track):
        if a <= number:
            clip, seconds = clip_a, from_
            if number < b and clip_a == clip_b:
                seconds = from_ + (to - from_) * (number - a) / (b - a)
    if number >= track[-1][0]:
        clip, seconds = track[-1][1]
    return f"{name}={clip}@{seconds!r}"


def _is_text(track: list[tuple[float, Any]]) -> bool:
    return isinstance(track[0][1], str)


def _held(track: list[tuple[float, Any]] | None, number: int) -> str | None:
    if not track:
        return None
    past = [value for frame, value in track if frame <= number]
    return str(past[-1] if past else track[0][1])


def _linear(low: tuple[float, ...], high: tuple[float, ...], t: float) -> tuple[float, ...]:
    return tuple((1.0 - t) * x + t * y for x, y in zip(low, high, strict=True))


def _between(
    track: list[tuple[float, Any]] | None,
    number: int,
    mix: Callable[[tuple[float, ...], tuple[float, ...], float], tuple[float, ...]] = _linear,
) -> tuple[float, ...] | None:
    if not track:
        return None
    if number <= track[0][0]:
        return tuple(track[0][1])
    for (a, low), (b, high) in itertools.pairwise(track):
        if a <= number <= b:
            return mix(low, high, (number - a) / (b - a))
    return tuple(track[-1][1])


def _load(path: Path) -> dict[str, Any]:
    try:
        with open(path, "rb") as file:
            content = file.read(MOST_BYTES + 1)
        if len(content) > MOST_BYTES:
            raise InputError(f"{path}: expected at most {MOST_BYTES:,} bytes for a file of keyframes; found more")
        return tomllib.loads(content.decode("utf-8"))
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; expected a file of keyframes for --frames") from None
    except IsADirectoryError:
        raise InputError(f"{path}: is a folder; expected a file of keyframes for --frames") from None
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: not a TOML file: {error}") from None


def _known(path: Path, where: str, table: dict[str, Any], names: set[str]) -> None:
    for name in table:
        if name not in names:
            key = f"{where}.{name}" if where else name
            raise InputError(f"{path}: {key}: unknown key; expected one of {', '.join(sorted(names))}")


def _number(path: Path, where: str, value: Any) -> float:
    if not is_number(value):
        raise InputError(f"{path}: {where}: expected a finite number; found {describe(value)}")
    return float(value)


def _integer(path: Path, where: str, value: Any, low: int, high: int) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
        raise InputError(f"{path}: {where}: expected a whole number from {low} to {high}; found {describe(value)}")
    return value
