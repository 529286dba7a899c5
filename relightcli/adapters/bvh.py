"""Biovision motion files (.bvh): a hierarchy of joints with offsets, and their channels frame by frame."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from relightcli.core.pose.clip import multiply
from relightcli.core.pose.retarget import Motion
from relightcli.errors import InputError, SystemFault

F64 = NDArray[np.float64]
MAX_BYTES = 1 << 28
AXES = "XYZ"


@dataclass
class _Reader:
    """The words of the hierarchy, one after the other, each with its line."""

    path: Path
    words: list[tuple[str, int]]
    at: int = 0

    def next(self, expected: str = "") -> str:
        if self.at >= len(self.words):
            raise InputError(f"{self.path}: ends where {expected or 'more'} was expected; is it cut short?")
        word, line = self.words[self.at]
        self.at += 1
        if expected and word.upper() != expected.upper():
            raise InputError(f"{self.path}: line {line}: expected {expected}, found {word[:40]!r}.")
        return word

    def numbers(self, count: int) -> list[float]:
        out = []
        for _ in range(count):
            word = self.next()
            try:
                out.append(float(word))
            except ValueError:
                raise self.fail("a number", word) from None
        return out

    def fail(self, expected: str, found: str) -> InputError:
        return InputError(f"{self.path}: line {self.words[self.at - 1][1]}: expected {expected}, found {found[:40]!r}.")


@dataclass
class _Joints:
    names: list[str] = field(default_factory=list)
    parent: list[int] = field(default_factory=list)
    offset: list[list[float]] = field(default_factory=list)
    channels: list[list[str]] = field(default_factory=list)


def load_bvh(path: Path) -> Motion:
    """The motion of a file. Rotations apply in the order of the channels, each about the axes that those before left.

    A joint's position channels take the place of its offset. Raises InputError, naming file and line.
    """
    try:
        size = path.stat().st_size
        if size > MAX_BYTES:
            raise InputError(f"{path}: {size:,} bytes; expected at most {MAX_BYTES:,} for a motion.")
        text = path.read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        raise SystemFault(f"{path}: cannot be opened ({error.strerror}).") from None
    lines = text.splitlines()
    start = next((i for i, line in enumerate(lines) if line.strip().upper() == "MOTION"), None)
    if start is None:
        raise InputError(f"{path}: has no line MOTION; expected a BVH file.")
    reader = _Reader(path, [(word, i + 1) for i, line in enumerate(lines[:start]) for word in line.split()])
    joints = _Joints()
    reader.next("HIERARCHY")
    while reader.at < len(reader.words):
        reader.next("ROOT")
        _joint(reader, joints, -1)
    if not joints.names:
        raise InputError(f"{path}: has no joints; expected ROOT.")
    seconds, values = _frames(path, lines, start, sum(map(len, joints.channels)))
    return _motion(joints, seconds, values)


def _joint(reader: _Reader, joints: _Joints, parent: int) -> None:
    """One joint and all below it."""
    stack = [parent]
    name = reader.next()
    while True:
        if name in joints.names:
            raise reader.fail("another name than that of a joint before", name)
        own = len(joints.names)
        joints.names.append(name)
        joints.parent.append(stack[-1])
        reader.next("{")
        reader.next("OFFSET")
        joints.offset.append(reader.numbers(3))
        reader.next("CHANNELS")
        count = reader.next()
        if not count.isdecimal() or int(count) > 6:
            raise reader.fail("0 to 6 channels", count)
        channels = []
        for _ in range(int(count)):
            channel = reader.next()
            if channel[:1].upper() not in AXES or channel[1:].lower() not in ("position", "rotation"):
                raise reader.fail("a channel such as Xposition or Zrotation", channel)
            channels.append(channel[0].upper() + channel[1:].lower())
        joints.channels.append(channels)
        stack.append(own)
        while True:
            word = reader.next()
            if word == "}":
                stack.pop()
                if len(stack) == 1:
                    return
            elif word.upper() == "END":
                reader.next("Site")
                reader.next("{")
                reader.next("OFFSET")
                reader.numbers(3)
                reader.next("}")
            elif word.upper() == "JOINT":
                name = reader.next()
                break
            else:
                raise reader.fail("JOINT, End Site or }", word)


def _frames(path: Path, lines: list[str], start: int, width: int) -> tuple[F64, F64]:
    """Seconds (F,) and values (F, width) of the MOTION part."""
    rest = [line.strip() for line in lines[start + 1 :] if line.strip()]
    head = dict.fromkeys(("Frames:", "Frame Time:"), 0.0)
    for line, key in zip(rest[:2], head, strict=False):
        try:
            if not line.lower().startswith(key.lower()):
                raise ValueError
            head[key] = float(line[len(key) :])
        except ValueError:
            raise InputError(f"{path}: expected {key!r} with a number after MOTION, found {line[:40]!r}.") from None
    count, step = head["Frames:"], head["Frame Time:"]
    if not (count >= 1 and count.is_integer() and 0.0 < step < 1e6):
        raise InputError(f"{path}: expected a whole number of frames and a time above 0, found {count:g} and {step:g}.")
    try:
        values = np.array(" ".join(rest[2:]).split(), dtype=np.float64)
    except ValueError as error:
        raise InputError(f"{path}: expected numbers after Frame Time ({error}).") from None
    if len(values) != int(count) * width or not np.isfinite(values).all():
        raise InputError(
            f"{path}: expected {int(count)} frames of {width} finite numbers, found {len(values)} numbers, "
            f"{int((~np.isfinite(values)).sum())} of them not finite."
        )
    return np.arange(int(count), dtype=np.float64) * step, values.reshape(int(count), width)


def _motion(joints: _Joints, seconds: F64, values: F64) -> Motion:
    frames, count = len(values), len(joints.names)
    offset = np.array(joints.offset)
    rotation = np.tile(np.array([0.0, 0.0, 0.0, 1.0]), (frames, count, 1))
    translation = np.tile(offset, (frames, 1, 1))
    column = 0
    for joint, channels in enumerate(joints.channels):
        for channel in channels:
            axis, value = AXES.index(channel[0]), values[:, column]
            column += 1
            if channel.endswith("position"):
                translation[:, joint, axis] = value
                continue
            half = np.radians(value) / 2.0
            turn = np.zeros((frames, 4))
            turn[:, axis], turn[:, 3] = np.sin(half), np.cos(half)
            rotation[:, joint] = multiply(rotation[:, joint], turn)
    parent = np.array(joints.parent, np.int32)
    return Motion(tuple(joints.names), parent, offset, seconds, rotation, translation)
