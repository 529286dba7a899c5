"""Small rigs made by hand."""

from __future__ import annotations

import numpy as np

from relightcli.core.pose.clip import Channel, Clip
from relightcli.core.pose.rig import Rig, any_tangents


def translation(*by):
    matrix = np.eye(4)
    matrix[:3, 3] = by
    return matrix


def turn_z(degrees):
    half = np.radians(degrees) / 2
    return np.array([0.0, 0.0, np.sin(half), np.cos(half)])


def channel(node, path, times, values, interpolation="LINEAR"):
    return Channel(node, path, interpolation, np.array(times, float), np.array(values, float))


def arm(*clips, weight=None):
    """A bar along y from 0 to 2 of four vertices; joint 0 at the origin, joint 1 at its middle, y = 1.

    The lower two vertices hang on joint 0, the upper ones on joint 1, unless `weight` (4, 2) says otherwise.
    """
    position = np.array([[0.0, 0.0, 0.0], [0.5, 0.5, 0.0], [0.5, 1.5, 0.0], [0.0, 2.0, 0.0]])
    normal = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    return Rig(
        position=position,
        normal=normal,
        tangent=any_tangents(normal),
        joint=np.array([[0, 1]] * 4, np.int32),
        weight=np.array([[1.0, 0.0], [1.0, 0.0], [0.0, 1.0], [0.0, 1.0]])
        if weight is None
        else np.array(weight, float),
        inverse_bind=np.array([np.eye(4), translation(0.0, -1.0, 0.0)]),
        parent=np.array([-1, 0, 1], np.int32),
        rest=np.array([np.eye(4), np.eye(4), translation(0.0, 1.0, 0.0)]),
        translation=np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
        rotation=np.array([[0.0, 0.0, 0.0, 1.0]] * 3),
        scale=np.ones((3, 3)),
        joint_node=np.array([1, 2], np.int32),
        node_names=("top", "lower", "upper"),
        clips=tuple(clips),
    )


def clip(*channels, name="move"):
    return Clip(name, channels)
