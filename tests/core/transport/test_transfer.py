"""Lights that stand for a sky."""

import numpy as np
import pytest

from relightcli.core.transport.transfer import light_fit


def test_lights_are_matched_by_the_light_they_give():
    rng = np.random.default_rng(0)
    even = rng.random((200, 12))
    fit, keep = light_fit(even)
    light = rng.random(12)
    # What the lights can give is found again, wherever the guess was; what they cannot leaves the guess.
    for guess in (np.zeros(12), rng.random(12)):
        np.testing.assert_allclose(
            fit @ (even @ light) + keep @ guess, light, atol=0.02
        )  # the ridge is 0.4 % of the least eigenvalue
    even[:, 3] = 0.0
    fit, keep = light_fit(even)
    assert (fit @ even.sum(1) + keep @ np.full(12, 5.0))[3] == pytest.approx(5.0)
    fit, keep = light_fit(np.zeros((200, 12)))
    np.testing.assert_allclose(keep, np.eye(12))
