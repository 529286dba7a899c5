"""Which effects a scene calls for, with the evidence.

Names follow interface.md: direct, shadows, one-bounce, two-bounce, specular, fields, pose. Left to itself (`auto`) the
plan asks structure first (nothing can block anything), then a pilot (`plan.pilot`): an effect is skipped where leaving
it out costs less than SKIPPED of the tolerance. Specular lobes cost nothing here: they are integrated when a picture is
made.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from relightcli.errors import InputError
from relightcli.plan.pilot import Share

AVAILABLE = ("direct", "shadows", "one-bounce", "two-bounce", "specular", "fields", "pose")
BOUNCES = {"one-bounce": 1, "two-bounce": 2}
SKIPPED = 0.5  # of the tolerance: what effects that are left out may cost together
# Of the light of one interreflection through cells of 11 degrees, at receivers, against every texel of 1.4 degrees:
# 2.5 to 3.9 % in three scenes without textures, up to 6.8 % in one with them, under three skies each.
COARSE_ERROR = {False: 0.039, True: 0.069}
MOST_PLANNED = 8  # interreflections, unless more are asked for


@dataclass(frozen=True)
class Decision:
    """One row of the plan: what is done about an effect, and why; share and bound: of the light, if measured; rest: at
    most what interreflections after the last that is simulated carry."""

    effect: str
    simulate: bool
    evidence: str
    share: float | None = None
    bound: float | None = None
    rest: float | None = None


class Pilot(Protocol):
    """Measurements that the plan asks for where structure decides nothing."""

    def tails(self, allowed: float) -> list[Share]: ...
    def shadows(self) -> Share: ...


def parse_effects(text: str) -> tuple[str, ...] | None:
    """The effects named by `--effects`; None for `auto`. Raises InputError for what is unknown."""
    if text == "auto":
        return None
    if text == "all":
        return AVAILABLE
    names = tuple(name.strip() for name in text.split(","))
    for name in names:
        if name not in AVAILABLE:
            raise InputError(f"--effects: expected auto, all or names out of {', '.join(AVAILABLE)}; found {name!r}")
    if "direct" not in names:
        raise InputError("--effects: 'direct' must be among them: every other effect builds on it")
    if "two-bounce" in names and "one-bounce" not in names:
        raise InputError("--effects: 'two-bounce' needs 'one-bounce' beside it")
    if "one-bounce" in names and "shadows" not in names:
        raise InputError("--effects: 'one-bounce' needs 'shadows' beside it: light bounces off what blocks the sky")
    return names


def bounces_asked(asked: tuple[str, ...] | None, bounces: int | None) -> int | None:
    """Interreflections to simulate: `--bounces`, or what `--effects` names; None where the plan decides.

    Raises InputError if the two contradict.
    """
    named = max((BOUNCES.get(name, 0) for name in asked or ()), default=0)
    if bounces is None:
        return None if asked is None else named
    if asked not in (None, AVAILABLE) and min(bounces, 2) != named:
        raise InputError(
            f"--bounces {bounces}: --effects names {named or 'no'} bounces; expected the same (one-bounce, "
            "two-bounce), or --effects auto"
        )
    return bounces


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
    bounces: int | None,
    tolerance: float,
    pilot: Callable[[], Pilot],
    moving: bool = False,
) -> tuple[list[Decision], int]:
    """The plan but for what moves, and how many interreflections it has.

    both_sides: any object is lit from both; lobes: any material has a specular lobe, or may get one; bounces: None
    leaves their number to the plan; tolerance: relative RMS; pilot: makes the measurements, called only if
    needed; moving: objects may be moved or posed.
    """
    shadows = _shadows(asked, positions, faces, both_sides, moving)
    allowed = SKIPPED * tolerance
    rows = [Decision(name, False, "not asked for") for name in BOUNCES]
    if not shadows.simulate:
        if bounces != 0:
            rows = [Decision(name, False, "no light can go from one point of the scene to another") for name in BOUNCES]
        bounces = bounces or 0
    elif bounces is not None:
        for k, (name, number) in enumerate(BOUNCES.items()):
            if bounces >= number:
                rows[k] = Decision(name, True, f"asked for: {bounces} interreflections")
    elif asked is None:
        measure = pilot()
        tails = measure.tails(allowed)
        bounces = bounces_needed(tails, allowed)
        rows = [_bounce(name, number, tails, bounces, allowed) for name, number in BOUNCES.items()]
        if bounces == 0 and not both_sides and not moving:
            lost = measure.shadows()
            shadows = Decision("shadows", lost.bound > allowed, _text(lost, allowed), lost.share, lost.bound)
    assert bounces is not None
    evidence = "integrated from visibility when a picture is made" if lobes else "no material has a specular lobe"
    return [Decision("direct", True, "always"), shadows, *rows, Decision("specular", lobes, evidence)], bounces


def bounces_needed(tails: Sequence[Share], allowed: float) -> int:
    """The least number of interreflections after which no more than `allowed` is missing, at most MOST_PLANNED.

    tails: what is missing after k, k = 0 ... Beyond the last one the tail is taken to fall as it did there.
    """
    for k, tail in enumerate(tails):
        if tail.bound <= allowed:
            return k
    bound, number = tails[-1].bound, len(tails) - 1
    before = tails[-2].bound
    ratio = min(bound / before, 0.95) if 0.0 < before < math.inf else 0.95
    while bound > allowed and number < MOST_PLANNED:
        bound, number = bound * ratio, number + 1
    return number


def bounce_cells(plan: Sequence[Decision], tolerance: float, textured: bool, promised: bool) -> int:
    """Cells along a face through which light bounces, where the plan has measured how much of it there is: 8 where all
    of it is matte and what they lose is small enough, else 16.

    That is noise from receiver to receiver: SKIPPED of the tolerance's square, or of itself where it is promised.
    """
    rows = {row.effect: row for row in plan}
    bound = rows["one-bounce"].bound
    if bound is None or rows["specular"].simulate:
        return 16
    allowed = (SKIPPED if promised else math.sqrt(SKIPPED)) * tolerance
    return 8 if bound * COARSE_ERROR[textured] <= allowed else 16


def _bounce(name: str, number: int, tails: Sequence[Share], bounces: int, allowed: float) -> Decision:
    tail = tails[number - 1]
    evidence = _text(tail, allowed)
    if number == max(BOUNCES.values()) and bounces > number:
        evidence += f"; {bounces} interreflections are simulated"
        if bounces < len(tails):
            evidence += f", the rest carries at most {tails[bounces].bound:.2%}"
    last = number == min(bounces, max(BOUNCES.values())) and bounces < len(tails)
    rest = tails[bounces].bound if last else None
    return Decision(name, bounces >= number, evidence, tail.share, tail.bound, rest)


def _text(share: Share, allowed: float) -> str:
    return f"at most {share.bound:.2%} of the light ({share.where}); {allowed:.2%} may be left out"


def decide_pose(asked: tuple[str, ...] | None, clips: dict[str, int], receivers: str) -> Decision:
    """Whether skinned objects are posed. clips: how many each of them has; receivers: as `--receivers` names them.

    Raises InputError where poses are asked for by name, and receivers are a camera's pixels, which poses would move.
    """
    moving = [name for name, count in clips.items() if count]
    if not clips:
        return Decision("pose", False, "no object is skinned")
    if not moving:
        return Decision("pose", False, f"no clip moves {', '.join(clips)}")
    if asked is not None and "pose" not in asked:
        return Decision("pose", False, "not asked for: skinned objects stand in their rest pose")
    if receivers != "vertices":
        if asked is not None:
            raise InputError(
                f"--receivers {receivers}: what a pixel sees changes with the pose of {', '.join(moving)}; expected "
                "vertices, or --effects without pose, which keeps the rest pose"
            )
        return Decision("pose", False, "pixels see the rest pose; poses need --receivers vertices")
    return Decision("pose", True, f"skinned: {', '.join(moving)}")


def _shadows(
    asked: tuple[str, ...] | None,
    positions: NDArray[np.float64],
    faces: NDArray[np.int32],
    both_sides: bool,
    moving: bool,
) -> Decision:
    if moving:
        return Decision("shadows", True, "objects may be moved or posed in front of one another")
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
