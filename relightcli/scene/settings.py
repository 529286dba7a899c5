"""Changes of materials at relight time: `--set gold.roughness=0.4`."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from relightcli.errors import InputError
from relightcli.scene.fields import Table, did_you_mean
from relightcli.scene.materials import COLOURS, PARAMETERS, material_from_table, table_from_material
from relightcli.scene.model import Material


def apply_settings(materials: dict[str, Material], settings: Iterable[str]) -> dict[str, Material]:
    """Materials with some parameters replaced; order and the rest stay.

    settings: texts `MATERIAL.PARAMETER=VALUE`, the value one number or three with commas, applied in turn.
    Raises InputError for unknown materials, materials that are not adjustable, parameters their model does not use,
    and values out of range, as the scene file would.
    """
    tables = {name: table_from_material(material) for name, material in materials.items()}
    for setting in settings:
        target, equals, text = setting.partition("=")
        name, dot, parameter = target.strip().rpartition(".")
        if not equals or not text.strip():
            raise InputError(f"--set {setting}: expected MATERIAL.PARAMETER=VALUE, as in --set gold.roughness=0.4.")
        if not dot:
            raise InputError(
                f"--set {setting}: picking a measured material needs the BRDF data set stage, which this version does "
                "not have. To change a parameter, give MATERIAL.PARAMETER=VALUE."
            )
        if name not in tables:
            known = ", ".join(materials) or "none"
            raise InputError(
                f"--set {setting}: no material {name!r}; the scene has {known}.{did_you_mean(name, materials)}"
            )
        if not materials[name].adjustable:
            free = ", ".join(n for n, m in materials.items() if m.adjustable) or "none"
            raise InputError(
                f"--set {setting}: material {name!r} is not adjustable (adjustable: {free}). Set adjustable = true in "
                "the scene file and precompute again."
            )
        used = PARAMETERS[materials[name].model]
        if parameter not in used:
            raise InputError(
                f"--set {setting}: {materials[name].model} has no parameter {parameter!r}; expected one of "
                f"{', '.join(used)}.{did_you_mean(parameter, used)}"
            )
        tables[name] = {**tables[name], parameter: _value(setting, parameter, text)}

    return {name: _rebuilt(material, tables[name]) for name, material in materials.items()}


def _value(setting: str, parameter: str, text: str) -> float | list[float]:
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    count = 3 if parameter in COLOURS else 1
    if len(numbers) != count:
        wanted = "three numbers with commas, as in 0.1,0.6,0.6" if count == 3 else "one number"
        raise InputError(f"--set {setting}: {parameter}: expected {wanted}, found {text!r}.")
    return numbers if count == 3 else numbers[0]


def _rebuilt(material: Material, table: dict[str, Any]) -> Material:
    def unchanged(written: str, kind: str) -> Path:
        return Path(written)

    return material_from_table(material.name, Table("--set", material.name, table, unchanged))
