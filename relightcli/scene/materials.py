"""Which parameters a reflectance model has, their ranges, and materials from tables and back."""

from __future__ import annotations

from typing import Any, cast

from relightcli.scene.fields import Table
from relightcli.scene.model import Material, ModelName

# What each model uses, beside `model`, `diffuse_texture` and `adjustable`.
PARAMETERS: dict[str, tuple[str, ...]] = {
    "lambert": ("diffuse",),
    "blinn-phong": ("diffuse", "specular", "shininess"),
    "cook-torrance": ("diffuse", "specular", "f0", "roughness"),
    "phong": ("diffuse", "specular", "shininess"),
    "translucent": ("diffuse", "transmittance"),
}
# Three numbers from 0 to 1.
COLOURS = ("diffuse", "specular", "transmittance")
# Inclusive ranges of single numbers. Below roughness 1e-4, m^2 is lost in float32; shininess 1e6 is a mirror.
RANGES = {"f0": (0.0, 1.0), "roughness": (1e-4, 10.0), "shininess": (0.0, 1e6)}
# Sums of decimals such as 0.3 + 0.7 may miss 1 by a few roundings.
_ROUNDING = 1e-9


def material_from_table(name: str, table: Table) -> Material:
    """A validated material. Raises InputError for unknown keys, keys of another model, and impossible values."""
    model = table.choice("model", PARAMETERS, "lambert")
    used = PARAMETERS[model]
    foreign = {}
    for key in {*COLOURS, *RANGES} - set(used):
        users = [m for m, parameters in PARAMETERS.items() if key in parameters]
        foreign[key] = f"{model} does not use it; it belongs to {', '.join(users)}."
    table.only(("model", *used, "diffuse_texture", "adjustable"), foreign)
    values: dict[str, Any] = {}
    for key in used:
        if key in table.data:
            if key in COLOURS:
                values[key] = table.vector(key, low=0.0, high=1.0)
            else:
                values[key] = table.number(key, low=RANGES[key][0], high=RANGES[key][1])
    if "diffuse_texture" in table.data:
        values["diffuse_texture"] = table.path("diffuse_texture", "a texture")
    adjustable = table.boolean("adjustable", False)
    material = Material(name, cast(ModelName, model), adjustable=adjustable, **values)
    if model == "translucent":
        sums = [d + t for d, t in zip(material.diffuse, material.transmittance, strict=True)]
        if max(sums) > 1.0 + _ROUNDING:
            key = "transmittance" if "transmittance" in table.data else "diffuse"
            found = ", ".join(f"{s:.6g}" for s in sums)
            table.refuse(key, f"expected diffuse + transmittance of at most 1 per colour, found {found}.")
    return material


def table_from_material(material: Material) -> dict[str, Any]:
    """The inverse of `material_from_table`: only what the model uses, the texture's path absolute."""
    table: dict[str, Any] = {"model": material.model}
    for key in PARAMETERS[material.model]:
        value = getattr(material, key)
        table[key] = list(value) if key in COLOURS else value
    if material.diffuse_texture is not None:
        table["diffuse_texture"] = str(material.diffuse_texture)
    table["adjustable"] = material.adjustable
    return table


def energy_note(material: Material) -> str | None:
    """A sentence on a material that may reflect more than it gets; allowed, but worth knowing."""
    if "specular" not in PARAMETERS[material.model]:
        return None
    sums = [d + s for d, s in zip(material.diffuse, material.specular, strict=True)]
    if max(sums) <= 1.0 + _ROUNDING:
        return None
    return f"materials.{material.name}: diffuse + specular is {max(sums):.4g}; above 1 it may reflect more than it gets"
