"""Which effects are simulated, and why."""

import numpy as np
import pytest

from relightcli.errors import InputError
from relightcli.plan.effects import (
    AVAILABLE,
    blocks_nothing,
    bounces_asked,
    decide,
    decide_fields,
    need_static,
    parse_effects,
)
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
        ("direct,pose", "'pose' is not simulated by this version"),
        ("direct,one-bounce", "'one-bounce' needs 'shadows'"),
        ("direct,shadows,two-bounce", "'two-bounce' needs 'one-bounce'"),
        ("shadows", "'direct' must be among them"),
    ],
)
def test_names_that_are_refused(text, message):
    with pytest.raises(InputError, match=message):
        parse_effects(text)


def test_skinned_objects_need_an_effect_that_is_not_there():
    need_static({"a": "static", "b": "rigid"}, None)
    need_static({"a": "skinned"}, ("direct", "shadows"))
    with pytest.raises(InputError, match=r"objects.b.motion is 'skinned'.*'pose'"):
        need_static({"a": "static", "b": "skinned"}, None)


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


def plan_of(asked, both=False, positions=BALL, faces=BALL_FACES, lobes=False, bounces=0):
    plan = {d.effect: d for d in decide(asked, positions, faces, both, lobes, bounces)}
    assert plan["direct"].simulate
    return plan


def shadows(*args, **kwargs):
    return plan_of(*args, **kwargs)["shadows"]


def test_bounces_are_simulated_when_asked_for_and_possible():
    bowl = BALL_FACES[:, ::-1]
    names = ("one-bounce", "two-bounce")
    for bounces, expected in ((0, [False, False]), (1, [True, False]), (2, [True, True]), (9, [True, True])):
        plan = plan_of(None, faces=bowl, bounces=bounces)
        assert [plan[name].simulate for name in names] == expected
    convex = plan_of(None, bounces=2)
    assert not any(convex[name].simulate for name in names)
    assert "no light can go" in convex["one-bounce"].evidence


def test_lobes_are_told():
    assert plan_of(None, lobes=True)["specular"].simulate
    assert "no material" in plan_of(None)["specular"].evidence


@pytest.mark.parametrize(
    ("effects", "bounces", "expected"),
    [
        ("auto", None, 0),
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
    moving = {d.effect: d for d in decide(None, BALL, BALL_FACES, False, False, 0, moving=True)}
    assert moving["shadows"].simulate
    assert not shadows(("direct",), faces=BALL_FACES[:, ::-1]).simulate
