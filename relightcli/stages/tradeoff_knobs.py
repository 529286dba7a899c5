"""What tradeoff can turn: a table of knobs, and the points that a sweep of them makes.

A point is one setting of knobs. The first value of each knob makes the base; every other value makes a point of its own
that differs from the base in this knob, and in what the value needs besides.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

from relightcli.errors import InputError

STAGES = {
    "transfer": ("precompute",),
    "asset": ("precompute", "cluster", "factorize"),
    "lights": ("precompute", "cluster"),
}


@dataclass(frozen=True)
class Need:
    """A knob only means something where `knob` has a value that `holds`; elsewhere the point takes `otherwise`.

    when: the need is one of this value alone. otherwise: "CAMERA" at its end stands for the camera of the sweep.
    """

    knob: str
    holds: Callable[[str], bool]
    otherwise: str
    when: str | None = None


@dataclass(frozen=True)
class Knob:
    """name: as typed. stage: the command it is an option of, "" where it chooses the commands. read: the text of a
    value to its one spelling, ValueError for what is none; words: a value to arguments of the command.
    """

    name: str
    stage: str
    read: Callable[[str], str]
    expected: str
    words: Callable[[str], tuple[str, ...]]
    needs: tuple[Need, ...] = ()


@dataclass(frozen=True)
class Point:
    """label: how it differs from the base. settings: knob to value, in the order of the table."""

    label: str
    settings: tuple[tuple[str, str], ...]

    @property
    def stages(self) -> tuple[str, ...]:
        return STAGES[dict(self.settings).get("store", "transfer")]

    def words(self, stage: str) -> tuple[str, ...]:
        """Arguments of one of its commands."""
        return tuple(w for name, value in self.settings if KNOBS[name].stage == stage for w in KNOBS[name].words(value))


def expand(asked: Mapping[str, Sequence[str]], bounces: int, camera: str | None) -> list[Point]:
    """The points of a sweep, the base first. asked: knob to values; camera: that of the sweep if it has only one.

    Knobs that need what the base has not are no part of it: each of their values makes a point.
    Raises InputError for knobs and values that are none, and for two values that cannot be had together.
    """
    known = {name: [_read(name, value) for value in values] for name, values in asked.items()}
    base = {"bounces": str(bounces)}
    for name in KNOBS:
        if name in known and all(_met(need, known[name][0], base) for need in KNOBS[name].needs):
            base[name] = known[name][0]
    wanted = [base]
    for name, values in known.items():
        for value in values:
            settings = _settle(base, name, value, camera)
            if settings not in wanted:
                wanted.append(settings)
    return [_point(settings, base) for settings in wanted]


def default_knobs(bounces: int) -> dict[str, list[str]]:
    """A small sweep around what the commands do by default."""
    fewer = [str(k) for k in range(bounces, -1, -1)]
    return {"light-resolution": ["64", "32", "16"], "refine": ["4", "8"], "bounces": fewer}


def parse_knobs(texts: Sequence[str]) -> dict[str, list[str]]:
    """NAME=V1,V2,... to values by name. Raises InputError."""
    found: dict[str, list[str]] = {}
    for text in texts:
        name, equals, values = text.partition("=")
        if name not in KNOBS:
            raise InputError(f"--knob {text}: expected one of {', '.join(KNOBS)}; found {name!r}")
        if not equals or not values:
            raise InputError(f"--knob {text}: expected {name}=VALUE,VALUE,... ({KNOBS[name].expected})")
        if name in found:
            raise InputError(f"--knob {name}: is given twice; write all its values in one")
        found[name] = values.split(",")
    return found


def _read(name: str, value: str) -> str:
    try:
        return KNOBS[name].read(value.strip())
    except ValueError:
        raise InputError(f"--knob {name}: expected {KNOBS[name].expected}; found {value!r}") from None


def _met(need: Need, value: str, settings: Mapping[str, str]) -> bool:
    return need.when not in (None, value) or need.holds(settings.get(need.knob, ""))


def _settle(base: Mapping[str, str], name: str, value: str, camera: str | None) -> dict[str, str]:
    """The base with one value changed, what the value needs, and without what has lost its meaning by that."""
    settings = dict(base)
    pending, fixed = [(name, value)], set()
    while pending:
        knob, wanted = pending.pop()
        settings[knob] = wanted
        fixed.add(knob)
        for need in KNOBS[knob].needs:
            if _met(need, wanted, settings):
                continue
            if need.knob in fixed:
                raise InputError(f"--knob {name}={value}: needs another value of {need.knob} than it has beside it")
            if need.otherwise.endswith("CAMERA") and camera is None:
                raise InputError(f"--knob {name}={value}: needs a sweep of one camera; give one --camera")
            pending.append((need.knob, need.otherwise.replace("CAMERA", camera or "")))
    for knob in KNOBS:
        if knob in settings and not all(_met(need, settings[knob], settings) for need in KNOBS[knob].needs):
            del settings[knob]
    return settings


def _point(settings: Mapping[str, str], base: Mapping[str, str]) -> Point:
    ordered = tuple((name, settings[name]) for name in KNOBS if name in settings)
    other = [f"{name} {value}" for name, value in ordered if base.get(name) != value]
    if "store" in base and "store" not in settings:
        other.append("store transfer")
    return Point(", ".join(other) or "base", ordered)


def _whole(least: int, most: int, step: int = 1) -> Callable[[str], str]:
    def read(text: str) -> str:
        value = int(text)
        if not least <= value <= most or value % step:
            raise ValueError(text)
        return str(value)

    return read


def _positive(text: str) -> str:
    value = float(text)
    if not (math.isfinite(value) and value > 0):
        raise ValueError(text)
    return repr(value)


def _one_of(*names: str) -> Callable[[str], str]:
    def read(text: str) -> str:
        if text not in names:
            raise ValueError(text)
        return text

    return read


def _receivers(text: str) -> str:
    if text != "vertices" and not (text.startswith("pixels:") and text != "pixels:"):
        raise ValueError(text)
    return text


def _option(name: str) -> Callable[[str], tuple[str, ...]]:
    return lambda value: (name, value)


def _is(value: str) -> Callable[[str], bool]:
    return lambda found: found == value


_BOUNCED = Need("bounces", lambda v: v not in ("", "0"), "1")
_PIXELS = Need("receivers", lambda v: v.startswith("pixels:"), "pixels:CAMERA")
_HAAR = Need("basis", _is("haar"), "haar")
_SH = Need("basis", _is("sh"), "sh")
_ASSET = Need("store", _is("asset"), "asset")
_LIGHTS = Need("store", _is("lights"), "lights")

# In this order: a knob comes after those that it needs. Ranges are those of the commands, which check them again.
_TABLE = (
    Knob("light-resolution", "precompute", _whole(16, 256, 8), "16 to 256, by 8", _option("--light-resolution")),
    Knob("refine", "precompute", _whole(1, 8), "1, 2, 4 or 8", _option("--refine")),
    Knob(
        "subdivide",
        "precompute",
        _one_of("yes", "no"),
        "yes or no",
        lambda v: ("--subdivide" if v == "yes" else "--no-subdivide",),
    ),
    Knob("receivers", "precompute", _receivers, "vertices or pixels:CAMERA", _option("--receivers")),
    Knob("pixel-grid", "precompute", _whole(1, 8), "1 to 8", _option("--pixel-grid"), (_PIXELS,)),
    Knob("bounces", "precompute", _whole(0, 64), "0 to 64", _option("--bounces")),
    Knob(
        "bounce-resolution", "precompute", _whole(8, 32, 8), "8, 16 or 32", _option("--bounce-resolution"), (_BOUNCED,)
    ),
    Knob(
        "basis",
        "precompute",
        _one_of("visibility", "haar", "sh", "dense"),
        "visibility, haar, sh or dense",
        _option("--basis"),
    ),
    Knob("coefficients", "precompute", _whole(1, 1 << 20), "1 or more", _option("--coefficients"), (_HAAR,)),
    Knob("sh-order", "precompute", _whole(1, 16), "1 to 16", _option("--sh-order"), (_SH,)),
    Knob(
        "store",
        "",
        _one_of(*STAGES),
        ", ".join(STAGES),
        lambda _: (),
        (
            replace(_BOUNCED, when="asset"),
            Need("receivers", lambda v: not v.startswith("pixels:"), "vertices", when="asset"),
            Need("bounces", _is("0"), "0", when="lights"),
        ),
    ),
    Knob("clusters", "cluster", _whole(1, 1 << 20), "1 or more", _option("--clusters"), (_ASSET,)),
    Knob("eigenvectors", "factorize", _whole(1, 4096), "1 to 4096", _option("--eigenvectors"), (_ASSET,)),
    Knob("light-rank", "factorize", _whole(1, 4096), "1 to 4096", _option("--light-rank"), (_ASSET,)),
    Knob("asset-coefficients", "factorize", _whole(1, 1 << 16), "1 to 65536", _option("--coefficients"), (_ASSET,)),
    Knob("second-order", "factorize", _whole(0, 4), "0 to 4", _option("--second-order"), (_ASSET,)),
    Knob("sky-resolution", "cluster", _whole(1, 4096), "1 to 4096", _option("--light-resolution"), (_LIGHTS,)),
    Knob("epsilon", "cluster", _positive, "a number above 0", _option("--epsilon"), (_LIGHTS,)),
)
KNOBS = {knob.name: knob for knob in _TABLE}
