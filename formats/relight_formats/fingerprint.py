"""Fingerprints: SHA-256 of a file's bytes, or of a JSON value in one canonical spelling."""

import hashlib
import json
import os
from pathlib import Path
from typing import Any

JSON = Any
"""A value made of dict (string keys), list, str, int, finite float, bool and None."""


def plain(value: Any, where: str = "value") -> JSON:
    """Turn tuples, paths and NumPy scalars and arrays inside `value` into plain JSON values.

    Raises:
        ValueError: not a finite number.
        TypeError: a key that is no string, or a type that JSON has no word for.
    """
    if hasattr(value, "tolist"):  # NumPy scalars and arrays, without importing NumPy
        value = value.tolist()
    if value is None or isinstance(value, (str, bool, int)):
        return value
    if isinstance(value, float):
        if value != value or value in (float("inf"), float("-inf")):
            raise ValueError(
                f"{where}: JSON metadata holds finite numbers only, found {value}; leave it out or use null."
            )
        return value
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if isinstance(value, (list, tuple)):
        return [plain(item, f"{where}[{i}]") for i, item in enumerate(value)]
    if isinstance(value, dict):
        for key in value:
            if not isinstance(key, str):
                raise TypeError(f"{where}: keys of JSON metadata are strings, found {key!r}.")
        return {key: plain(item, f"{where}.{key}") for key, item in value.items()}
    raise TypeError(f"{where}: {type(value).__name__} cannot be stored as JSON metadata.")


def canonical_json(value: Any) -> str:
    """One spelling per value: keys sorted, no spaces, ASCII, shortest round-trip floats. 1 and 1.0 differ."""
    return json.dumps(plain(value), sort_keys=True, separators=(",", ":"), allow_nan=False)


def fingerprint_bytes(data: bytes) -> str:
    """`sha256:<hex>` of the bytes."""
    return "sha256:" + hashlib.sha256(data).hexdigest()


def fingerprint_json(obj: Any) -> str:
    """`sha256:<hex>` of the canonical JSON of `obj`; equal values give equal fingerprints, whatever the key order."""
    return fingerprint_bytes(canonical_json(obj).encode("ascii"))


def fingerprint_file(path: str | Path) -> str:
    """`sha256:<hex>` of a file's content; its name and times do not count. Raises OSError."""
    with open(path, "rb") as file:
        return "sha256:" + hashlib.file_digest(file, "sha256").hexdigest()
