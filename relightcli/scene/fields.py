"""Typed reading of one table of a scene file; a refusal names file, key path, what was expected and what was found."""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

from relightcli.errors import InputError
from relightcli.scene.model import Vec3

# How a path as written in the scene file becomes a path on disk: (path as written, kind of file) -> path.
# Raises InputError with the reason alone; the table adds file and key.
PathResolver = Callable[[str, str], Path]

_KINDS = {bool: "boolean", int: "integer", float: "float", str: "string", list: "array", dict: "table"}


def describe(value: Any) -> str:
    """A value as a message shows it: shortened, with its TOML type."""
    try:
        text = repr(value)
    except ValueError:  # an integer with more digits than Python prints
        text = "a huge integer"
    if len(text) > 60:
        text = text[:57] + "..."
    return f"{text} ({_KINDS.get(type(value), type(value).__name__)})"


def did_you_mean(word: str, known: Iterable[str]) -> str:
    close = difflib.get_close_matches(word, list(known), n=1)
    return f" Did you mean {close[0]!r}?" if close else ""


def is_number(value: Any) -> bool:
    """Whether `value` is a finite number; a boolean is none."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    try:
        return math.isfinite(float(value))
    except OverflowError:
        return False


@dataclass(frozen=True)
class Table:
    """One table of the file. `where` is its key path, empty for the file's root."""

    file: str
    where: str
    data: dict[str, Any]
    resolve: PathResolver

    def path_of(self, key: str) -> str:
        plain = key if key.isprintable() and len(key) <= 128 else repr(key[:60] + "...")
        return f"{self.where}.{plain}" if self.where else plain

    def fail(self, key: str, expected: str, advice: str = "") -> NoReturn:
        """Refuse the value of `key`, which may be absent."""
        found = describe(self.data[key]) if key in self.data else "nothing"
        self.refuse(key, f"expected {expected}, found {found}.", advice)

    def refuse(self, key: str, message: str, advice: str = "") -> NoReturn:
        raise InputError(f"{self.file}: {self.path_of(key)}: {message}" + (f" {advice}" if advice else ""))

    def only(self, known: Iterable[str], elsewhere: dict[str, str] | None = None) -> None:
        """Refuse keys that are not `known`; `elsewhere` says where keys of a related table would belong."""
        known = tuple(known)
        for key in self.data:
            if key in known:
                continue
            if elsewhere and key in elsewhere:
                self.refuse(key, elsewhere[key])
            self.refuse(key, f"unknown key; expected one of {', '.join(known)}.{did_you_mean(key, known)}")

    def table(self, key: str, *, required: bool = False) -> Table:
        """A sub-table; an absent one is empty unless `required`."""
        value = self.data.get(key, None if required else {})
        if not isinstance(value, dict):
            self.fail(key, "a table")
        return Table(self.file, self.path_of(key), value, self.resolve)

    def entries(self, key: str) -> list[tuple[str, Table]]:
        """The named tables under `key`, such as [objects.bunny]."""
        group = self.table(key)
        found = []
        for name in group.data:
            if not name or len(name) > 128 or not name.isprintable() or set(name) & set("=/\\"):
                group.refuse(describe(name), "expected a name of 1 to 128 printable letters without = / \\.")
            found.append((name, group.table(name)))
        return found

    def number(
        self,
        key: str,
        default: float | None = None,
        *,
        low: float = -math.inf,
        high: float = math.inf,
        open_low: bool = False,
        open_high: bool = False,
        unit: str = "",
    ) -> float:
        """A finite number in [low, high], or without an end that is open."""
        if key not in self.data and default is not None:
            return default
        value: Any = self.data.get(key)
        inside = is_number(value) and low <= value <= high
        if not inside or (open_low and value == low) or (open_high and value == high):
            self.fail(key, "a number" + _range(low, high, open_low, open_high) + unit)
        return float(value)

    def vector(self, key: str, default: Vec3 | None = None, *, low: float = -math.inf, high: float = math.inf) -> Vec3:
        """Three finite numbers, each in [low, high]."""
        if key not in self.data and default is not None:
            return default
        x, y, z = self.numbers(key, 3, low=low, high=high)
        return x, y, z

    def numbers(self, key: str, count: int, *, low: float = -math.inf, high: float = math.inf) -> list[float]:
        value: Any = self.data.get(key)
        good = isinstance(value, list) and len(value) == count and all(is_number(v) and low <= v <= high for v in value)
        if not good:
            self.fail(key, f"{count} numbers" + _range(low, high, False, False))
        return [float(v) for v in value]

    def boolean(self, key: str, default: bool) -> bool:
        value = self.data.get(key, default)
        if not isinstance(value, bool):
            self.fail(key, "true or false")
        return value

    def string(self, key: str) -> str:
        value = self.data.get(key)
        if not isinstance(value, str) or not value:
            self.fail(key, "a string")
        return value

    def choice(self, key: str, options: Iterable[str], default: str | None = None) -> str:
        options = tuple(options)
        value = self.data.get(key, default)
        if not isinstance(value, str) or value not in options:
            hint = did_you_mean(value, options).strip() if isinstance(value, str) else ""
            self.fail(key, f"one of {', '.join(options)}", hint)
        return value

    def path(self, key: str, kind: str) -> Path:
        """A file that exists, as an absolute path."""
        written = self.string(key)
        try:
            return self.resolve(written, kind)
        except InputError as error:
            self.refuse(key, str(error))


def _range(low: float, high: float, open_low: bool, open_high: bool) -> str:
    if low == -math.inf and high == math.inf:
        return ""
    if high == math.inf:
        return f" {'above' if open_low else 'of at least'} {low:g}"
    if open_low or open_high:
        return f" above {low:g} and {'below' if open_high else 'at most'} {high:g}"
    return f" from {low:g} to {high:g}"
