"""Which effects are simulated, and why."""

import numpy as np
import pytest

from relightcli.errors import InputError
from relightcli.plan.effects import (
    AVAILABLE,
    MOST_PLANNED,
    blocks_nothing,
    bounce_cells,
    bounces_asked,
    bounces_needed,
    decide,
    decide_fields,
    decide_pose,
    parse_effects,
)
from relightcli.plan.pilot import Share
from tests.core.transport.scenes import sphere_grid

BALL, BALL_FACES = (x[0].astype(x[1]) for x in zip(sphere_grid(12, 24), (np.float64, np.int32), strict=True))
SQUARE = np.array([[0, 0, 0], [0, 0, 1], [1, 0, 1], [1, 0, 0]], float)
SQUARE_FACES = np.array([[0, 1, 2], [0, 2, 3]], np.int32)


def test_names():
    assert parse_effects("auto") is None
    assert parse_effects("all") == AVAILABLE
    assert parse_effects("direct") == ("direct",)
    assert parse_effects("direct, shadows") == ("direct", "shadows")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("caustics", "expected auto, all or names out of direct, .*; found 'caustics'"),
        ("", "found ''"),
        ("direct,one-bounce", "'one-bounce' needs 'shadows'"),
        ("direct,shadows,two-bounce", "'two-bounce' needs 'one-bounce'"),
        ("shadows", "'direct' must be among them"),
    ],
)
def test_names_that_are_refused(text, message):
    with pytest.raises(InputError, match=message):
        parse_effects(text)


@pytest.mark.parametrize(
    ("asked", "clips", "simulate", "evidence"),
    [
        (None, {}, False, "no object is skinned"),
        (("direct", "pose"), {}, False, "no object is skinned"),
        (None, {"man": 0}, False, "no clip moves man"),
        (None, {"man": 0, "fox": 3}, True, "skinned: fox"),
        (AVAILABLE, {"man": 1}, True, "skinned: man"),
        (("direct", "shadows"), {"man": 1}, False, "not asked for"),
    ],
)
def test_poses_of_what_has_clips(asked, clips, simulate, evidence):
    decision = decide_pose(asked, clips, "vertices")
    assert decision.simulate == simulate
    assert decision.evidence.startswith(evidence)


def test_pixels_have_no_poses():
    decision = decide_pose(None, {"man": 1, "box": 0}, "pixels:main")
    assert not decision.simulate
    assert decision.evidence == "pixels see the rest pose; poses need --receivers vertices"
    for asked in (AVAILABLE, ("direct", "pose")):
        assert not decide_pose(asked, {"box": 0}, "pixels:main").simulate
        with pytest.raises(InputError, match=r"--receivers pixels:main: .*pose of man; expected vertices"):
            decide_pose(asked, {"man": 1}, "pixels:main")


@pytest.mark.parametrize(
    ("effects", "motion", "lights", "simulate", "evidence"),
    [
        ("auto", "rigid", 0, True, "b may be moved"),
        ("auto", "rigid", 2, True, "b may be moved, and 2 local lights"),
        ("auto", "static", 2, False, "nothing moves"),
        ("all", "static", 2, False, "nothing moves"),
        ("all", "rigid", 0, True, "b may be moved"),
        ("direct,fields", "static", 2, True, "no object may be moved, and 2 local lights"),
        ("direct,fields", "static", 0, False, "nothing moves"),
        ("direct,shadows", "rigid", 0, False, "not asked for"),
    ],
)
def test_fields_are_for_what_moves(effects, motion, lights, simulate, evidence):
    decision = decide_fields(parse_effects(effects), {"a": "static", "b": motion}, lights)
    assert (decision.simulate, decision.effect) == (simulate, "fields")
    assert evidence in decision.evidence


@pytest.mark.parametrize("scale", [1e-4, 1.0, 1e6])
@pytest.mark.parametrize("shift", [0.0, 10.0])
def test_convex_and_flat_block_nothing(scale, shift):
    assert blocks_nothing((BALL + shift) * scale, BALL_FACES) == "convex"
    assert blocks_nothing((SQUARE + shift) * scale, SQUARE_FACES) == "flat"
    half = BALL_FACES[BALL[BALL_FACES].mean(1)[:, 1] > 0]
    assert blocks_nothing((BALL + shift) * scale, half) == "convex"  # a dome, seen from outside


def test_what_blocks():
    dented = BALL.copy()
    dented[30] *= 0.9
    two = np.concatenate([BALL, BALL + np.array([3, 0, 0])]), np.concatenate([BALL_FACES, BALL_FACES + len(BALL)])
    for positions, faces in (
        (dented, BALL_FACES),
        (BALL, BALL_FACES[:, ::-1]),  # a bowl: its inside sees itself
        two,
        (np.concatenate([SQUARE, SQUARE[:, [1, 0, 2]]]), np.concatenate([SQUARE_FACES, SQUARE_FACES + 4])),
        # Two squares of one plane that look to opposite sides: nothing blocks, but it is not called flat.
        (
            np.concatenate([SQUARE, SQUARE + np.array([2, 0, 0])]),
            np.concatenate([SQUARE_FACES, SQUARE_FACES[:, ::-1] + 4]),
        ),
    ):
        assert blocks_nothing(np.asarray(positions, float), faces.astype(np.int32)) is None


def test_nothing_to_test():
    assert blocks_nothing(np.zeros((4, 3)), SQUARE_FACES) is None
    assert blocks_nothing(SQUARE, np.zeros((1, 3), np.int32)) is None


class Measured:
    """A pilot that has measured what the test says."""

    def __init__(self, tails, shadows=1.0):
        self.found, self.lost = [share(t) for t in tails], share(shadows)

    def tails(self, allowed):
        return self.found

    def shadows(self):
        return self.lost


def share(bound):
    return Share(0.8 * bound, bound, 0.6 * bound, "camera main, even light")


def no_pilot():
    raise AssertionError("structure decides; nothing need be measured")


def plan_of(asked, both=False, positions=BALL, faces=BALL_FACES, lobes=False, bounces=0, tolerance=0.02, pilot=None):
    make = no_pilot if pilot is None else lambda: pilot
    rows, number = decide(asked, positions, faces, both, lobes, bounces, tolerance, make)
    plan = {d.effect: d for d in rows}
    assert plan["direct"].simulate
    if plan["shadows"].simulate:
        assert [plan[name].simulate for name in ("one-bounce", "two-bounce")] == [number >= 1, number >= 2]
    return plan


def shadows(*args, **kwargs):
    kwargs.setdefault("bounces", 0)
    return plan_of(*args, **kwargs)["shadows"]


def test_bounces_are_simulated_when_asked_for_and_possible():
    bowl = BALL_FACES[:, ::-1]
    names = ("one-bounce", "two-bounce")
    for bounces, expected in ((0, [False, False]), (1, [True, False]), (2, [True, True]), (9, [True, True])):
        plan = plan_of(None, faces=bowl, bounces=bounces)
        assert [plan[name].simulate for name in names] == expected
    convex = plan_of(("direct",), bounces=0, faces=bowl)
    assert not any(convex[name].simulate for name in names)
    for asked in (2, None):
        convex = plan_of(None, bounces=asked)
        assert "no light can go" in convex["one-bounce"].evidence
        assert not any(convex[name].simulate for name in names)


def test_lobes_are_told():
    assert plan_of(None, lobes=True)["specular"].simulate
    assert "no material" in plan_of(None)["specular"].evidence


@pytest.mark.parametrize(
    ("effects", "bounces", "expected"),
    [
        ("auto", None, None),
        ("auto", 3, 3),
        ("all", None, 2),
        ("all", 5, 5),
        ("all", 1, 1),
        ("all", 0, 0),
        ("direct,shadows", None, 0),
        ("direct,shadows", 0, 0),
        ("direct,shadows,one-bounce", None, 1),
        ("direct,shadows,one-bounce", 1, 1),
        ("direct,shadows,one-bounce,two-bounce", 4, 4),
    ],
)
def test_number_of_bounces(effects, bounces, expected):
    assert bounces_asked(parse_effects(effects), bounces) == expected


@pytest.mark.parametrize(
    ("effects", "bounces"), [("direct,shadows", 1), ("direct,shadows,one-bounce", 2), ("direct,shadows,one-bounce", 0)]
)
def test_names_and_number_must_agree(effects, bounces):
    with pytest.raises(InputError, match=f"--bounces {bounces}: --effects names"):
        bounces_asked(parse_effects(effects), bounces)


def test_decisions_come_with_their_evidence():
    assert not shadows(None).simulate
    assert "convex" in shadows(None).evidence
    assert shadows(None, faces=BALL_FACES[:, ::-1]).simulate
    assert shadows(None, both=True).simulate
    assert "both sides" in shadows(None, both=True).evidence
    assert shadows(("direct", "shadows")).simulate
    rows, _ = decide(None, BALL, BALL_FACES, False, False, 0, 0.02, no_pilot, moving=True)
    assert {row.effect: row for row in rows}["shadows"].simulate
    assert not shadows(("direct",), faces=BALL_FACES[:, ::-1]).simulate


BOWL = BALL_FACES[:, ::-1]


@pytest.mark.parametrize(
    ("tails", "allowed", "expected"),
    [
        ((0.009, 0.001), 0.01, 0),
        ((0.011, 0.001), 0.01, 1),
        ((0.3, 0.1, 0.03, 0.01), 0.01, 3),
        ((0.4, 0.2), 0.05, 3),  # halves from bounce to bounce
        ((0.4, 0.4), 0.01, MOST_PLANNED),
        ((np.inf, 0.001), 0.01, 1),
        ((0.3, 0.0, 0.1), 0.01, 1),
        ((np.inf, np.inf), 0.01, MOST_PLANNED),
        ((0.0, 0.0), 0.01, 0),
    ],
)
def test_as_many_bounces_as_carry_more_than_may_be_left_out(tails, allowed, expected):
    assert bounces_needed([share(t) for t in tails], allowed) == expected


def test_half_the_tolerance_is_for_what_is_left_out():
    for tolerance, expected in ((0.03, 1), (0.09, 0), (0.005, 3)):
        plan = plan_of(None, faces=BOWL, bounces=None, tolerance=tolerance, pilot=Measured([0.04, 0.01, 0.003, 0.001]))
        assert [plan["one-bounce"].simulate, plan["two-bounce"].simulate] == [expected >= 1, expected >= 2]
        assert plan["one-bounce"].bound == 0.04
        assert f"{0.5 * tolerance:.2%} may be left out" in plan["two-bounce"].evidence
        assert "camera main, even light" in plan["one-bounce"].evidence
    assert "3 interreflections are simulated, the rest carries at most 0.10%" in plan["two-bounce"].evidence


def test_shadows_are_skipped_where_they_and_all_that_follows_are_too_small():
    def plan(tail, lost, both=False):
        return plan_of(None, both, faces=BOWL, bounces=None, pilot=Measured([tail, 0.0], lost))["shadows"]

    assert not plan(0.009, 0.009).simulate
    assert plan(0.009, 0.011).simulate
    assert plan(0.011, 0.009).simulate  # light that bounces needs them
    assert plan(0.009, 0.009, both=True).simulate
    assert plan(0.009, 0.009).bound == 0.009


def test_names_need_no_pilot():
    assert not plan_of(("direct", "shadows"), faces=BOWL)["one-bounce"].simulate


@pytest.mark.parametrize(
    ("tail", "lobes", "textured", "promised", "expected"),
    [
        (0.35, False, False, False, 8),
        (0.4, False, False, False, 16),
        (0.35, False, False, True, 16),
        (0.25, False, False, True, 8),
        (0.25, False, True, False, 16),
        (0.2, False, True, False, 8),
        (0.1, True, False, False, 16),
        (None, False, False, False, 16),
    ],
)
def test_cells_are_wide_where_little_light_bounces(tail, lobes, textured, promised, expected):
    # 3.9 % of it, 6.9 % with textures, may be 1.41 % of all light, half of the square of 2 %; half of 2 % where that is
    # promised. Lobes would show the cells.
    given = {"bounces": 1} if tail is None else {"bounces": None, "pilot": Measured([tail, 0.0])}
    rows = plan_of(None, faces=BOWL, lobes=lobes, **given).values()
    assert bounce_cells(list(rows), 0.02, textured, promised) == expected
