"""Harm to one file, and the files of a store."""

from __future__ import annotations

import random
from pathlib import Path

HARMS = ("bit flipped", "byte changed", "cut", "emptied", "deleted", "zeros", "longer")


def files_of(folder: Path) -> list[Path]:
    return sorted(p for p in folder.rglob("*") if p.is_file())


def damage(path: Path, harm: str, rng: random.Random) -> bool:
    """Does it; whether the file is another one now."""
    data = path.read_bytes()
    if harm == "deleted":
        path.unlink()
        return True
    changed = harmed(data, harm, rng)
    path.write_bytes(changed)
    return changed != data


def harmed(data: bytes, harm: str, rng: random.Random) -> bytes:
    if harm == "emptied" or not data:
        return b""
    at = rng.randrange(len(data))
    if harm == "bit flipped":
        return data[:at] + bytes([data[at] ^ (1 << rng.randrange(8))]) + data[at + 1 :]
    if harm == "byte changed":
        return data[:at] + bytes([rng.randrange(256)]) + data[at + 1 :]
    if harm == "cut":
        return data[:at]
    if harm == "zeros":
        return data[:at] + bytes(min(64, len(data) - at)) + data[at + 64 :]
    assert harm == "longer", harm
    return data + bytes(rng.randrange(256) for _ in range(rng.randint(1, 16)))
