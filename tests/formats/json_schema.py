"""As much of JSON Schema (draft 2020-12) as formats/schema uses; any other keyword is an error."""

from __future__ import annotations

import json
import re
from typing import Any

TYPES: dict[str, type | tuple[type, ...]] = {
    "object": dict,
    "array": list,
    "string": str,
    "integer": int,
    "number": (int, float),
    "boolean": bool,
}
ANNOTATIONS = {"$schema", "$defs", "title", "description"}


def violations(value: Any, schema: dict[str, Any], root: dict[str, Any] | None = None, at: str = "$") -> list[str]:
    """Where and how `value` breaks `schema`; empty when it does not."""
    root = root or schema
    found: list[str] = []
    for keyword, rule in schema.items():
        if keyword in ANNOTATIONS:
            continue
        if keyword == "$ref":
            found += violations(value, root["$defs"][rule.removeprefix("#/$defs/")], root, at)
        elif keyword == "type":
            kinds = [rule] if isinstance(rule, str) else rule
            if not any(isinstance(value, TYPES[k]) and (k == "boolean") == isinstance(value, bool) for k in kinds):
                found.append(f"{at}: expected {rule}")
        elif keyword == "const":
            found += [] if _same(value, rule) else [f"{at}: expected {rule}"]
        elif keyword == "enum":
            found += [] if any(_same(value, item) for item in rule) else [f"{at}: expected one of {rule}"]
        elif keyword == "oneOf":
            if sum(not violations(value, option, root, at) for option in rule) != 1:
                found.append(f"{at}: expected exactly one of {len(rule)} options")
        elif keyword in ("required", "properties", "additionalProperties", "propertyNames"):
            if isinstance(value, dict):
                found += _object(value, keyword, rule, schema, root, at)
        elif keyword in ("items", "prefixItems", "minItems", "maxItems"):
            if isinstance(value, list):
                found += _array(value, keyword, rule, root, at)
        elif keyword == "pattern":
            if isinstance(value, str) and not re.search(rule, value):
                found.append(f"{at}: expected {rule}")
        elif keyword == "minimum":
            if isinstance(value, (int, float)) and value < rule:
                found.append(f"{at}: expected at least {rule}")
        else:
            raise AssertionError(f"the schema uses {keyword}, which this checker does not know")
    return found


def _same(first: Any, second: Any) -> bool:
    return json.dumps(first, sort_keys=True) == json.dumps(second, sort_keys=True)


def _object(
    value: dict[str, Any], keyword: str, rule: Any, schema: dict[str, Any], root: dict[str, Any], at: str
) -> list[str]:
    if keyword == "required":
        return [f"{at}: {key} is missing" for key in rule if key not in value]
    if keyword == "propertyNames":
        return [line for key in value for line in violations(key, rule, root, f"{at} key {key}")]
    if keyword == "properties":
        return [line for key in rule if key in value for line in violations(value[key], rule[key], root, f"{at}.{key}")]
    others = [key for key in value if key not in schema.get("properties", {})]
    if rule is False:
        return [f"{at}: unknown {key}" for key in others]
    return [line for key in others for line in violations(value[key], rule, root, f"{at}.{key}")]


def _array(value: list[Any], keyword: str, rule: Any, root: dict[str, Any], at: str) -> list[str]:
    if keyword == "minItems":
        return [f"{at}: too short"] if len(value) < rule else []
    if keyword == "maxItems":
        return [f"{at}: too long"] if len(value) > rule else []
    pairs = zip(value, rule, strict=False) if keyword == "prefixItems" else ((item, rule) for item in value)
    return [line for i, (item, schema) in enumerate(pairs) for line in violations(item, schema, root, f"{at}[{i}]")]
