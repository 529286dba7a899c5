"""Channels: the parts of exit radiance whose factors may change after the simulation. [Sun 2007, sec. 3.3; digest S1]

An adjustable material has a channel for its diffuse term, one for what it lets through, and one for each basis function
of its specular lobe; a textured diffuse term has one per colour, since the texture's colour is baked in. All fixed
materials together have one channel per colour, or a single one if they are matte and differ in brightness only.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from relightcli.core.brdf.models import BLINN_PHONG, COOK_TORRANCE, PHONG, TRANSLUCENT, MaterialTable
from relightcli.core.brdf.models import DIFFUSE as DIFFUSE_COLUMN
from relightcli.core.brdf.models import SPECULAR as SPECULAR_COLUMN
from relightcli.core.brdf.models import TRANSMITTANCE as TRANSMITTANCE_COLUMN
from relightcli.core.brdf.separable import POLAR, TERMS
from relightcli.core.brdf.transport_basis import FUNCTIONS, TransportBasis, mix, transport_basis
from relightcli.core.transport.transfer import DIFFUSE, SPECULAR, THROUGH, Exits

SHINY = (BLINN_PHONG, COOK_TORRANCE, PHONG)


class Channels(NamedTuple):
    """Q channels: material (Q,) int32, the adjustable material, -1 for the fixed ones; part (Q,) int32 as in
    `transfer.Exits`; tone (Q, 3) float64, the factor per colour of fixed ones, and a mask of colours for the others."""

    material: NDArray[np.int32]
    part: NDArray[np.int32]
    tone: NDArray[np.float64]


def plan_channels(
    table: MaterialTable, adjustable: Sequence[bool], textured: Sequence[bool], functions: int = FUNCTIONS
) -> tuple[Channels, Exits, NDArray[np.int32]]:
    """Channels of a scene's materials, what each material sends into them, and for every material the place of its
    model among those with light factors, (M,) int32, -1 for matte ones. See `light_factors`."""
    models = shiny_models(table, adjustable)
    material: list[int] = []
    part: list[int] = []
    tone: list[NDArray[np.float64]] = []
    view = np.zeros((len(table.model), functions, POLAR, TERMS), np.float32)
    counts = np.zeros(len(table.model), np.int32)
    rows: list[list[tuple[int, int, float, int]]] = [[] for _ in table.model]

    def channel(m: int, p: int, t: NDArray[np.float64]) -> int:
        material.append(m)
        part.append(p)
        tone.append(t)
        return len(material) - 1

    fixed = [m for m in range(len(table.model)) if not adjustable[m]]
    common = _common_colour(table, fixed, textured)
    if fixed:
        ones = [np.eye(3)[c] for c in range(3)] if common is None else [common]
        first = [channel(-1, DIFFUSE, t) for t in ones]
    for m in fixed:
        for k, t in enumerate(ones):
            tint = k if textured[m] else -1
            rows[m].append((first[k], DIFFUSE, _along(table, m, DIFFUSE_COLUMN, t), tint))
            if table.model[m] == TRANSLUCENT:
                rows[m].append((first[k], THROUGH, _along(table, m, TRANSMITTANCE_COLUMN, t), -1))
            if table.model[m] in SHINY:
                rows[m].append((first[k], SPECULAR, _along(table, m, SPECULAR_COLUMN, t), -1))
        if table.model[m] in SHINY:
            basis = transport_basis(int(table.model[m]), functions)
            weights = mix(basis, table.parameters[m], int(table.model[m]))
            view[m, 0] = np.tensordot(weights, basis.view_factor, 1)
            counts[m] = 1
    for m in range(len(table.model)):
        if not adjustable[m]:
            continue
        if textured[m]:
            rows[m] += [(channel(m, DIFFUSE, np.eye(3)[c]), DIFFUSE, 1.0, c) for c in range(3)]
        else:
            rows[m].append((channel(m, DIFFUSE, np.ones(3)), DIFFUSE, 1.0, -1))
        if table.model[m] == TRANSLUCENT:
            rows[m].append((channel(m, THROUGH, np.ones(3)), THROUGH, 1.0, -1))
        if table.model[m] in SHINY:
            basis = transport_basis(int(table.model[m]), functions)
            counts[m] = len(basis.view_factor)
            view[m, : counts[m]] = basis.view_factor
            for p in range(counts[m]):
                rows[m].append((channel(m, SPECULAR + p, np.ones(3)), SPECULAR + p, 1.0, -1))
    entries = [[row for row in rows_m if row[2] != 0.0] for rows_m in rows]
    flat = [row for rows_m in entries for row in rows_m]
    start = np.concatenate([[0], np.cumsum([len(rows_m) for rows_m in entries])]).astype(np.int32)
    exits = Exits(
        start,
        np.array([row[0] for row in flat], np.int32),
        np.array([row[1] for row in flat], np.int32),
        np.array([row[2] for row in flat], np.float32),
        np.array([row[3] for row in flat], np.int32),
        counts,
        view,
    )
    place = np.array([models.index(int(code)) if code in models else -1 for code in table.model], np.int32)
    channels = Channels(np.array(material, np.int32), np.array(part, np.int32), np.array(tone).reshape(-1, 3))
    return channels, exits, place


def _along(table: MaterialTable, material: int, column: int, tone: NDArray[np.float64]) -> float:
    """A colour of a material in units of a tone (3,)."""
    return float(table.parameters[material, column : column + 3] @ tone / (tone @ tone))


def shiny_models(table: MaterialTable, adjustable: Sequence[bool]) -> list[int]:
    """Codes of the models with a lobe, of materials whose lobe is not black or may change, rising."""
    used = [
        int(code)
        for code, row, may in zip(table.model, table.parameters, adjustable, strict=True)
        if code in SHINY and (may or row[SPECULAR_COLUMN : SPECULAR_COLUMN + 3].any())
    ]
    return sorted(set(used))


def light_factors(models: Sequence[int], functions: int = FUNCTIONS) -> NDArray[np.float32]:
    """(models, POLAR, TERMS) of `transport_basis`."""
    out = np.zeros((max(1, len(models)), POLAR, TERMS), np.float32)
    for k, model in enumerate(models):
        out[k] = transport_basis(model, functions).light_factor
    return out


def coefficients(channels: Channels, table: MaterialTable, functions: int = FUNCTIONS) -> NDArray[np.float64]:
    """H (Q, 3): factor of every channel and colour for the materials as they are now. [Sun 2007, Eq. 4]"""
    out = channels.tone.copy()
    bases: dict[int, tuple[TransportBasis, NDArray[np.float64]]] = {}
    for q, (m, part) in enumerate(zip(channels.material, channels.part, strict=True)):
        if m < 0:
            continue
        row = table.parameters[m]
        column = {DIFFUSE: DIFFUSE_COLUMN, THROUGH: TRANSMITTANCE_COLUMN}.get(int(part), SPECULAR_COLUMN)
        out[q] *= row[column : column + 3]
        if part >= SPECULAR:
            code = int(table.model[m])
            if m not in bases:
                basis = transport_basis(code, functions)
                bases[m] = basis, mix(basis, row, code)
            out[q] *= bases[m][1][part - SPECULAR]
    return out


def _common_colour(table: MaterialTable, fixed: Sequence[int], textured: Sequence[bool]) -> NDArray[np.float64] | None:
    """The colour (3,) that all fixed materials have, up to brightness; None if they differ, are textured or shine."""
    colours = []
    for m in fixed:
        row = table.parameters[m]
        if textured[m] or (table.model[m] in SHINY and row[SPECULAR_COLUMN : SPECULAR_COLUMN + 3].any()):
            return None
        colours.append(row[DIFFUSE_COLUMN : DIFFUSE_COLUMN + 3])
        if table.model[m] == TRANSLUCENT:
            colours.append(row[TRANSMITTANCE_COLUMN : TRANSMITTANCE_COLUMN + 3])
    colours = [c / np.linalg.norm(c) for c in colours if c.any()]
    if not colours:
        return np.ones(3)
    same = all(np.abs(c - colours[0]).max() < 1e-9 for c in colours)
    return colours[0] if same else None
