"""Frames to learn from."""

import numpy as np

from relightcli.core.pose.frames import all_frames, every, spread
from relightcli.core.pose.rig import pose_features
from tests.core.pose.rigs import arm, channel, clip, turn_z

SWING = clip(channel(2, "rotation", np.arange(7.0), [turn_z(a) for a in (0, 1, 2, 80, 81, 82, 40)]), name="swing")
HOLD = clip(channel(2, "rotation", [0.0, 0.5, 1.0], [turn_z(81)] * 3), name="hold")


def test_all_frames_of_all_clips():
    rig = arm(SWING, HOLD)
    frames = all_frames(rig)
    assert frames.clip.tolist() == [0] * 7 + [1] * 3
    assert frames.seconds.tolist() == [*range(7), 0, 0.5, 1]
    assert frames.features.shape == (10, 3)
    assert np.array_equal(frames.features[3], pose_features(rig, SWING, 3.0))


def test_every_nth_starts_anew_in_each_clip():
    frames = every(all_frames(arm(SWING, HOLD)), 3)
    assert frames.clip.tolist() == [0, 0, 0, 1]
    assert frames.seconds.tolist() == [0, 3, 6, 0]


def test_spread_takes_the_mean_then_the_ends():
    frames = spread(all_frames(arm(SWING, HOLD)), 3)
    # The mean is 52.9 degrees: 40 is nearest, then 82 (42 away), then 0.
    assert frames.seconds.tolist() == [0, 5, 6]


def test_spread_takes_no_pose_twice():
    frames = spread(all_frames(arm(SWING, HOLD)), 9)
    assert len(frames) == 7  # 81 degrees occurs four times
    assert len(np.unique(np.round(frames.features, 9), axis=0)) == 7
    assert len(spread(all_frames(arm(SWING, HOLD)), 10)) == 10  # nothing to choose


def test_a_clip_that_moves_nothing_gives_one_frame():
    frames = all_frames(arm(HOLD))
    assert frames.features.shape == (3, 0)
    assert len(spread(frames, 2)) == 1
