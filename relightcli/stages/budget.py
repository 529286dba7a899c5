"""What a store cost and where its error comes from, step by step: written by every stage, read by inspect.

A stage's summary holds its `steps` (`run.accounting`), and of a store made from another one the tables of what came
`before`. The table joins them with the ledger's blocks, the bytes of the arrays, and the errors that the stage has
measured of itself. Seconds of all rows add up to the run's, bytes of all rows to the store's.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from typing import Any

import relight_formats as formats
from relightcli.run.accounting import Account

Row = dict[str, Any]

# Step by what the names of arrays begin with, and by the first part of the names of blocks; its own name is another.
ARRAYS = {
    "visibility/": "visibility",
    "lights/": "local lights",
    "bounce/": "bounces",
    "direct/": "direct",
    "fields/": "fields",
    "sources/": "fields",
    "pose/": "pose",
    "light/": "light-basis",
    "cluster/": "groups",
    "light_clusters/": "clusters",
    "light_factors/": "factors",
    "one_bounce/": "one-bounce",
    "two_bounce/": "two-bounce",
}
BLOCKS = {
    "field": "fields",
    "fit": "pose",
    "copy": "copying",
    "roots": "clusters",
    "round": "clusters",
    "promise": "check",
    "refine": "clusters",
    "fraction": "clusters",
    "lobe": "clusters",
    **{f"{part}-{name}": "clusters" for part in ("diffuse", "lobes") for name in ("roots", "refine")},
    "check": "clusters",
}
# Work that blocks of visibility tell apart, by the prefix of what they record.
PARTS = {"light": "local lights", "bounce": "bounces"}
SCENE, REST = "scene", "rest"
SUMMED = (
    "seconds",
    "cpu_seconds",
    *(f"{part}_{key}" for part in ("trace", *PARTS) for key in ("seconds", "cpu_seconds", "rays")),
    "rays",
    "bytes",
    "checked",
    "wrong",
    "inferred",
    "bits",
    "vertices_checked",
    "squared_error",
    "squared_norm",
    "norm2",
    "compression2",
    "error2",
    "error",  # of steps of one block
)


def summary(
    account: Account, started: float, resumed: bool, workers: int, source: formats.Store | None = None
) -> dict[str, Any]:
    """What a stage commits: seconds since `started` (time.perf_counter), its steps, and the table of `source`, the
    store that it was made from, after those of what that was made from."""
    made: dict[str, Any] = {
        "seconds": time.perf_counter() - started,
        "steps": account.steps,
        "resumed": resumed,
        "workers": workers,
    }
    if source is not None:
        made["before"] = [*source.summary.get("before", []), {"kind": source.kind, "rows": budget(source)}]
    return made


def costs(blocks: list[Row]) -> dict[str, Row]:
    """Totals of blocks, by the part of their names before the slash."""
    out: dict[str, Row] = {}
    for block in blocks:
        total = out.setdefault(block["id"].partition("/")[0], {"blocks": 0, "peak_bytes": 0.0})
        total["blocks"] += 1
        total["peak_bytes"] = max(total["peak_bytes"], block.get("peak_bytes", 0.0))
        for name in SUMMED:
            if name in block:
                total[name] = total.get(name, 0.0) + block[name]
    for total in out.values():
        if total.get("checked"):
            total["wrong_bits"] = total["wrong"] / total["checked"] * total["inferred"] / total["bits"]
        if total.get("squared_norm"):
            total["relative_error"] = math.sqrt(total["squared_error"] / total["squared_norm"])
    return out


def budget(store: formats.Store) -> list[Row]:
    """A row for every step that took time or left arrays.

    step; seconds: of the clock, in the run that finished the store; cpu_seconds: of that run's process, or of all
    blocks if that is more; rays; bytes; peak_bytes: of the largest process; errors: a list of {what, value}, values
    being shares of 1.
    """
    rows: dict[str, Row] = {}

    def row(step: str) -> Row:
        new = {"step": step, "seconds": 0.0, "cpu_seconds": 0.0, "rays": 0.0, "bytes": 0, "peak_bytes": 0.0}
        return rows.setdefault(step, {**new, "errors": []})

    for step, cost in store.summary.get("steps", {}).items():
        row(step).update(cost)
    found = costs(store.blocks)
    for group, cost in found.items():
        target = row(BLOCKS.get(group, group))
        # Blocks of this very process are in its step already.
        target["cpu_seconds"] = max(target["cpu_seconds"], cost.get("cpu_seconds", 0.0))
        target["rays"] += cost.get("rays", 0.0)
        target["peak_bytes"] = max(target["peak_bytes"], cost["peak_bytes"])
    if "visibility" in found:
        _split(row, found["visibility"])
    for name, size in store.sizes().items():
        row(next((step for prefix, step in ARRAYS.items() if name.startswith(prefix)), SCENE))["bytes"] += size.stored
    for step, what, value in _errors(store, found):
        row(step)["errors"].append({"what": what, "value": value})
    rest = store.summary.get("seconds", 0.0) - sum(r["seconds"] for r in rows.values())
    row(REST)["seconds"] = max(0.0, rest)
    return list(rows.values())


def _split(row: Callable[[str], Row], cost: Row) -> None:
    """Moves what blocks of visibility spent on their other parts to rows of their own."""
    whole = dict(row("visibility"))
    for part, step in PARTS.items():
        if f"{part}_rays" not in cost:
            continue
        moved: dict[str, float] = {"rays": cost[f"{part}_rays"]}
        for key in ("seconds", "cpu_seconds"):
            moved[key] = whole[key] * cost.get(f"{part}_{key}", 0.0) / cost[key] if cost[key] else 0.0
        for key, value in moved.items():
            row(step)[key] += value
            row("visibility")[key] -= value
        row(step)["peak_bytes"] = whole["peak_bytes"]


def _errors(store: formats.Store, found: dict[str, Row]) -> Iterator[tuple[str, str, float]]:
    """Step, what was measured, and its share of what is true."""
    if store.kind == "transfer":
        yield from _errors_of_transfer(store, found)
    if store.kind == "asset" and "asset_tolerance" in store.settings:
        yield "check", "of radiance, all stages together", store.attrs["measured_error"]["share"]
    if "light-basis" in found:
        yield "light-basis", "of one bounce at held-out receivers", found["light-basis"]["error"]
        yield "groups", "of one bounce, by groups of 16 eigenvectors", found["groups"]["error"]
    for effect in ("one-bounce", "two-bounce"):
        total = found.get(effect, {})
        if total.get("norm2"):
            yield effect, "ranks", math.sqrt(total["compression2"] / total["norm2"])
            rounding = max(0.0, total["error2"] - total["compression2"])
            yield effect, "rounding", math.sqrt(rounding / total["norm2"])
    if store.kind == "light_clusters" and "check" in found:
        yield "clusters", "of a light overhead", found["check"]["error"]
    if store.kind == "light_clusters" and "promise" in found:
        yield (
            "check",
            "of radiance under soft lights from anywhere",
            next(block["share"] for block in store.blocks if block["id"] == "promise"),
        )
    if store.kind == "pose" and "measured_error" in store.attrs:
        yield "check", "of radiance in poses not learnt from", store.attrs["measured_error"]["share"]
    for block in store.blocks:
        if store.kind == "pose" and block["id"].startswith("fit/"):
            report, name = block["report"], block["model"]["object"]
            yield "pose", f"{name} at training frames", report["training"]["bands"]
            if report["held_out"] is not None:
                yield "pose", f"{name} at held-out frames", report["held_out"]["bands"]


def _errors_of_transfer(store: formats.Store, found: dict[str, Row]) -> Iterator[tuple[str, str, float]]:
    plan = store.attrs.get("plan", [])
    bounces_left_out = any("rest" in decision for decision in plan)
    for decision in plan:
        bounce = decision["effect"].endswith("-bounce")
        if not decision["simulate"] and "bound" in decision and not (bounce and bounces_left_out):
            yield "planning", f"at most, of {decision['effect']} left out", decision["bound"]
            bounces_left_out |= bounce
        if "rest" in decision:
            yield "planning", "at most, of further interreflections", decision["rest"]
    for tried in store.attrs.get("tried", []):
        kept = ("light_resolution", 64), ("pixel_grid", 1)
        if all(tried.get(key, least) == store.settings.get(key, least) for key, least in kept):
            yield "resolution", f"of direct light at {tried['light_resolution']} texels", tried["share"]
    if "wrong_bits" in found.get("visibility", {}):
        yield "visibility", "of the bits are wrong", found["visibility"]["wrong_bits"]
    if "relative_error" in found.get("pose", {}):
        yield "pose", "of what vertices see", found["pose"]["relative_error"]
    if "measured_error" in store.attrs:
        yield "check", "of radiance, everything together", store.attrs["measured_error"]["share"]
