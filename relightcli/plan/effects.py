"""Which effects a scene calls for, with the evidence.

Names follow interface.md: direct, shadows, one-bounce, two-bounce, specular, fields, pose. This version does not
simulate the last; a scene or a user that needs it is told so. Fields are for objects that move. Interreflections are
simulated when they are asked for, by name or by number. Specular lobes cost nothing here: they are integrated when a
picture is made.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from relightcli.errors import InputError

KNOWN = ("direct", "shadows", "one-bounce", "two-bounce", "specular", "fields", "pose")
AVAILABLE = ("direct", "shadows", "one-bounce", "two-bounce", "specular", "fields")
BOUNCES = {"one-bounce": 1, "two-bounce": 2}


@dataclass(frozen=True)
class Decision:
    """One row of the plan: what is done about an effect, and why."""

    effect: str
    simulate: bool
    evidence: str


def parse_effects(text: str) -> tuple[str, ...] | None:
    """The effects named by `--effects`; None for `auto`. Raises InputError for what is unknown or not there yet."""
    if text == "auto":
        return None
    if text == "all":
        return AVAILABLE
    names = tuple(name.strip() for name in text.split(","))
    for name in names:
        if name not in KNOWN:
            raise InputError(f"--effects: expected auto, all or names out of {', '.join(KNOWN)}; found {name!r}")
        if name not in AVAILABLE:
            raise InputError(
                f"--effects: {name!r} is not simulated by this version; expected names out of {', '.join(AVAILABLE)}"
            )
    if "direct" not in names:
        raise InputError("--effects: 'direct' must be among them: every other effect builds on it")
    if "two-bounce" in names and "one-bounce" not in names:
        raise InputError("--effects: 'two-bounce' needs 'one-bounce' beside it")
    if "one-bounce" in names and "shadows" not in names:
        raise InputError("--effects: 'one-bounce' needs 'shadows' beside it: light bounces off what blocks the sky")
    return names


def bounces_asked(asked: tuple[str, ...] | None, bounces: int | None) -> int:
    """Interreflections to simulate: `--bounces`, or what `--effects` names. Raises InputError if they contradict."""
    named = max((BOUNCES.get(name, 0) for name in asked or ()), default=0)
    if bounces is None:
        return named
    if asked not in (None, AVAILABLE) and min(bounces, 2) != named:
        raise InputError(
            f"--bounces {bounces}: --effects names {named or 'no'} bounces; expected the same (one-bounce, "
            "two-bounce), or --effects auto"
        )
    return bounces


def need_static(motions: dict[str, str], asked: tuple[str, ...] | None) -> None:
    """Raises InputError where an object is skinned: its effect (pose) is not simulated by this version.

    Naming the effects (`--effects direct,shadows`) simulates moving objects where the scene file puts them.
    """
    if asked is not None:
        return
    for name, motion in motions.items():
        if motion == "skinned":
            raise InputError(
                f"objects.{name}.motion is {motion!r}: this needs the effect 'pose', which this version does not "
                'simulate; use motion = "static", or --effects direct,shadows to keep the object where it stands'
            )


def decide_fields(asked: tuple[str, ...] | None, motions: dict[str, str], lights: int) -> Decision:
    """Fields of rigid objects and `lights` local lights: where there are rigid objects, or when asked for by name."""
    rigid = [name for name, motion in motions.items() if motion == "rigid"]
    if asked is not None and "fields" not in asked:
        return Decision("fields", False, "not asked for: objects stay where they stand")
    if not rigid and (asked in (None, AVAILABLE) or not lights):
        return Decision("fields", False, "nothing moves")
    named = f"{', '.join(rigid) or 'no object'} may be moved"
    return Decision("fields", True, named + (f", and {lights} local lights" if lights else ""))


def decide(
    asked: tuple[str, ...] | None,
    positions: NDArray[np.float64],
    faces: NDArray[np.int32],
    both_sides: bool,
    lobes: bool,
    bounces: int,
    moving: bool = False,
) -> list[Decision]:
    """The plan but for fields: `direct` always, `shadows` unless nothing can block anything, `bounces` with it.

    both_sides: any object is lit from both; lobes: any material has a specular lobe, or may get one; moving: objects
    may be moved, and are traced apart.
    """
    shadows = _shadows(asked, positions, faces, both_sides, moving)
    plan = [Decision("direct", True, "always"), shadows]
    for name, number in BOUNCES.items():
        if bounces < number:
            plan.append(Decision(name, False, "not asked for"))
        elif not shadows.simulate:
            plan.append(Decision(name, False, "no light can go from one point of the scene to another"))
        else:
            plan.append(Decision(name, True, f"asked for: {bounces} interreflections"))
    evidence = "integrated from visibility when a picture is made" if lobes else "no material has a specular lobe"
    return [*plan, Decision("specular", lobes, evidence)]


def _shadows(
    asked: tuple[str, ...] | None,
    positions: NDArray[np.float64],
    faces: NDArray[np.int32],
    both_sides: bool,
    moving: bool,
) -> Decision:
    if moving:
        return Decision("shadows", True, "objects may be moved in front of one another")
    if asked is not None:
        return Decision("shadows", "shadows" in asked, "asked for with --effects")
    if both_sides:
        return Decision("shadows", True, "objects lit from both sides")
    shape = blocks_nothing(positions, faces)
    if shape is not None:
        return Decision("shadows", False, f"{shape}: no point of it is above another point's horizon")
    return Decision("shadows", True, "the surfaces are not one convex body")


def blocks_nothing(positions: NDArray[np.float64], faces: NDArray[np.int32]) -> str | None:
    """'flat' or 'convex' where no face has a vertex in front of it; None otherwise, or where that was not tested."""
    from scipy.spatial import ConvexHull, QhullError

    used = positions[np.unique(faces)]
    if len(used) < 3:
        return None
    scale = float(np.ptp(used, axis=0).max())
    if not scale > 0:
        return None
    corners = (positions[faces] - used.mean(axis=0)) / scale
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1)
    solid = length > 1e-12
    normals = normals[solid] / length[solid, None]
    level = np.einsum("ij,ij->i", normals, corners[solid, 0])
    try:
        hull = corners.reshape(-1, 3)[ConvexHull(corners.reshape(-1, 3)).vertices]
    except QhullError:
        return "flat" if len(normals) and (normals @ normals[0] > 0.999999).all() else None
    if len(normals) * len(hull) > 4e8:
        return None
    for start in range(0, len(normals), 4096):
        height = normals[start : start + 4096] @ hull.T - level[start : start + 4096, None]
        if height.max() > 1e-6:
            return None
    return "convex"
