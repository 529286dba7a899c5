"""What movers hide of even light, and of the mirrored view, against closed forms."""

from __future__ import annotations

import numpy as np

from relightcli.core.fields.dimmed import hidden_by, passing_mirrored
from relightcli.core.fields.entities import Lookup
from tests.core.brdf.reflectances import random_directions
from tests.core.fields.bodies import EVEN


def test_the_mirrored_view_passes_what_the_coefficients_say():
    """(1 + z) / 2 in bands 0 and 1, about a normal of z: the mirrored view is as high as the view. To float32."""
    view = random_directions(50, 1)
    passed = np.zeros((50, 4), np.float32)
    passed[:, 0], passed[:, 2] = 0.5 * EVEN, 0.5 * np.sqrt(4.0 * np.pi / 3.0)
    up = np.tile([0.0, 0.0, 1.0], (50, 1))
    np.testing.assert_allclose(passing_mirrored(passed, up, view), 0.5 * (1.0 + view[:, 2]), atol=1e-6)
    assert passing_mirrored(3.0 * passed, up, up).max() == 1.0
    assert passing_mirrored(-passed, up, up).min() == 0.0


def test_hidden_is_one_less_what_passes():
    """Two samples of one entity with weights 0.25 and 0.5; the rest of the weights is empty space, which hides
    nothing, and neither does the second entity, which is no mover."""
    passes = np.random.default_rng(2).normal(size=(3, 4)).astype(np.float32)
    weight, place = np.zeros((1, 2, 8), np.float32), np.zeros((1, 2, 8), np.int32)
    weight[0, 0, :2], place[0, 0, :2], weight[0, 1, 0] = (0.25, 0.5), (2, 1), 1.0
    unused = np.zeros(0, np.int32)
    lookup = Lookup(**dict.fromkeys(Lookup._fields, unused) | {"place": place, "weight": weight})
    hidden = hidden_by(lookup, passes, 1)
    one = np.array([EVEN, 0.0, 0.0, 0.0])
    expected = one - (0.25 * passes[2] + 0.5 * passes[1] + 0.25 * one)
    np.testing.assert_allclose(hidden[0, 0], expected, atol=1e-6)
    assert not hidden[0, 1].any()
