"""Stage inspect: what a store holds, what it cost, and whether it is sound. Changes nothing."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import relight_formats as formats
from relightcli.errors import StoreError
from relightcli.stages.budget import budget, costs
from relightcli.stages.field_store import describe_fields


def inspect(path: Path, verify: bool) -> dict[str, Any]:
    """Describes a finished or an unfinished store. Raises StoreError where there is neither, or it cannot be read."""
    if not path.exists() and not path.name.endswith(".partial"):
        partial = path.with_name(path.name + ".partial")
        if partial.exists():
            return _unfinished(partial, verify)
    if path.name.endswith(".partial"):
        return _unfinished(path, verify)
    store = formats.open_store(path)
    sizes = store.sizes()
    result: dict[str, Any] = {
        "store": str(path),
        "complete": True,
        "kind": store.kind,
        "program": store.program,
        "created": store.created,
        "settings": store.settings,
        "inputs": store.inputs,
        "fingerprint": store.fingerprint,
        "plan": store.attrs.get("plan", []),
        "bytes": sum(size.stored for size in sizes.values()),
        "raw_bytes": sum(size.raw for size in sizes.values()),
        "arrays": {
            name: {
                "shape": list(store.layouts[name].shape),
                "dtype": store.layouts[name].data_type,
                "chunks": list(store.layouts[name].chunks),
                "bytes": size.stored,
                "raw_bytes": size.raw,
            }
            for name, size in sizes.items()
        },
        "cost": costs(store.blocks),
        "budget": budget(store),
        "before": store.summary.get("before", []),
        "summary": store.summary,
    }
    fields = describe_fields(store)
    if fields:
        result["fields"] = fields
    models = [_model(block) for block in store.blocks if store.kind == "pose" and block["id"].startswith("fit/")]
    if models:
        result["models"] = models
    if verify:
        result["problems"] = store.verify()
    return result


def _unfinished(path: Path, verify: bool) -> dict[str, Any]:
    if verify:
        raise StoreError(f"{path}: is not finished, so there is nothing to verify; run its command again to finish it")
    return {"store": str(path), "complete": False, **formats.progress(path)}


def _model(block: dict[str, Any]) -> dict[str, Any]:
    """What a pose store says of the model of one object's visibility, with its errors."""
    report = block["report"]
    return {**block["model"], "training": report["training"], "held_out": report["held_out"]}
