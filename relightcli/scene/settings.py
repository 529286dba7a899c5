"""Changes of materials at relight time: `--set gold.roughness=0.4`, `--set floor=blue-acrylic`."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

from relightcli.core.brdf.measured import MeasuredFit, fits
from relightcli.errors import InputError
from relightcli.scene.fields import Table, did_you_mean
from relightcli.scene.materials import COLOURS, PARAMETERS, material_from_table, table_from_material
from relightcli.scene.model import Material

MEASURED_MODEL = "cook-torrance"


def apply_settings(materials: dict[str, Material], settings: Iterable[str]) -> dict[str, Material]:
    """Materials with some parameters replaced; order and the rest stay.

    settings: texts `MATERIAL.PARAMETER=VALUE`, the value one number or three with commas, or `MATERIAL=NAME`, which
    replaces the model and all its parameters by those of a measured material and keeps the texture. Applied in turn.
    Raises InputError for unknown materials, materials that are not adjustable, parameters their model does not use,
    unknown names, and values out of range, as the scene file would. The parameters of a measured material itself are
    taken as they are: a colour of one of them is above 1.
    """
    tables = {name: table_from_material(material) for name, material in materials.items()}
    measured: dict[str, MeasuredFit] = {}
    for setting in settings:
        target, equals, text = setting.partition("=")
        target = target.strip()
        if not equals or not text.strip():
            raise InputError(
                f"--set {setting}: expected MATERIAL.PARAMETER=VALUE, as in --set gold.roughness=0.4, or "
                "MATERIAL=NAME, as in --set floor=blue-acrylic."
            )
        name, dot, parameter = target.rpartition(".")
        # A material's name may have a dot of its own.
        if not dot or (target in materials and name not in materials):
            _need_adjustable(setting, target, materials)
            measured[target] = _measured(setting, materials[target], text)
            kept = ("diffuse_texture", "adjustable")
            tables[target] = {"model": MEASURED_MODEL, **{k: v for k, v in tables[target].items() if k in kept}}
            continue
        _need_adjustable(setting, name, materials)
        model = tables[name]["model"]
        used = PARAMETERS[model]
        if parameter not in used:
            raise InputError(
                f"--set {setting}: {model} has no parameter {parameter!r}; expected one of "
                f"{', '.join(used)}.{did_you_mean(parameter, used)}"
            )
        tables[name] = {**tables[name], parameter: _value(setting, parameter, text)}

    return {name: _rebuilt(material, tables[name], measured.get(name)) for name, material in materials.items()}


def measured_fit(written: str) -> MeasuredFit:
    """The measured material of a name, in which capitals do not matter, and spaces and underscores are dashes.

    Raises InputError with the reason alone.
    """
    name = "-".join(written.lower().replace("_", " ").split())
    known = {fit.name: fit for fit in fits()}
    if name not in known:
        raise InputError(
            f"no measured material {written.strip()!r}; expected one of {', '.join(sorted(known))}."
            f"{did_you_mean(name, known)}"
        )
    return known[name]


def _need_adjustable(setting: str, name: str, materials: dict[str, Material]) -> None:
    if name not in materials:
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


def _measured(setting: str, material: Material, text: str) -> MeasuredFit:
    if material.model == "translucent":
        # Whether both sides of a surface are lit, and seen, is decided by its model when the store is made.
        raise InputError(
            f"--set {setting}: material {material.name!r} is translucent and is lit from both sides; a measured "
            "material is not. Give it another model in the scene file and precompute again."
        )
    try:
        return measured_fit(text)
    except InputError as error:
        raise InputError(f"--set {setting}: {error} To change a parameter, give MATERIAL.PARAMETER=VALUE.") from None


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


def _rebuilt(material: Material, table: dict[str, Any], fit: MeasuredFit | None) -> Material:
    """The material of `table`, in which `fit` stands for the parameters that are not there."""

    def unchanged(written: str, kind: str) -> Path:
        return Path(written)

    checked = material_from_table(material.name, Table("--set", material.name, table, unchanged))
    if fit is None:
        return checked
    return replace(checked, **{key: getattr(fit, key) for key in PARAMETERS[MEASURED_MODEL] if key not in table})
