"""Shading of posed vertices against the same sums written out in float64."""

import math

import numpy as np
import pytest

from relightcli.core.pose.lobe_parameters import lobes_of
from relightcli.core.pose.phong_operator import kernel_factors, phong_factors, phong_matrix
from relightcli.core.pose.shading import Synthesis, lighting, shade, synthesis, visibility
from relightcli.core.pose.zh_lobes import visibility_of
from relightcli.core.sphere import sh

VERTICES = 50


def _frames(rng: np.random.Generator) -> np.ndarray:
    turn = np.linalg.qr(rng.normal(size=(VERTICES, 3, 3)))[0]
    return (turn * np.sign(np.linalg.det(turn))[:, None, None]).astype(np.float32)


def _model(kind: str, order: int, rng: np.random.Generator) -> tuple[Synthesis, np.ndarray, np.ndarray]:
    """A model, a pose's scores, and the visibility (V, n^2) that it stands for, in the vertices' frames."""
    count = 0 if kind == "sh" else 2
    size = 1 + count * (order + 1) if count else order**2
    intercept = rng.normal(size=(VERTICES, size)).astype(np.float32)
    scale = np.full((VERTICES, size), 0.01, np.float32)
    code = rng.integers(-127, 128, (VERTICES, size, 5)).astype(np.int8)
    centre = rng.normal(size=(VERTICES, count, 3)).astype(np.float32)
    scores = rng.normal(size=5)
    model = synthesis(intercept, scale, code, centre, kind, order)
    numbers = intercept + scale * (code @ scores)
    if not count:
        return model, scores, numbers
    unit = centre / np.linalg.norm(centre, axis=-1, keepdims=True)
    return model, scores, visibility_of(lobes_of(numbers[None].astype(np.float32), unit, kind))[0]


def _to_world(local: np.ndarray, frames: np.ndarray) -> np.ndarray:
    """The coefficients of local functions in the world, by a rule exact for their bands."""
    order = math.isqrt(local.shape[1])
    x, w = np.polynomial.legendre.leggauss(order)
    phi = math.pi * np.arange(2 * order) / order
    z, f = np.meshgrid(x, phi, indexing="ij")
    r = np.sqrt(1 - z * z)
    world = np.stack([r * np.cos(f), r * np.sin(f), z], -1).reshape(-1, 3)
    weight = np.repeat(w, 2 * order) * math.pi / order
    values = np.einsum("vqs,vs->vq", sh.harmonics(np.einsum("vxn,qn->vqx", frames.astype(float), world), order), local)
    return np.einsum("vq,qs->vs", values, sh.harmonics(world, order) * weight[:, None])


@pytest.mark.parametrize("kind", ["log", "angles", "sh"])
@pytest.mark.parametrize("order", [3, 4])
def test_visibility_in_the_world(kind: str, order: int) -> None:
    """float32: 1e-6 of numbers of some 5, times a few operations."""
    rng = np.random.default_rng(0)
    frames = _frames(rng)
    model, scores, local = _model(kind, order, rng)
    np.testing.assert_allclose(visibility(model, scores, frames), _to_world(local, frames), atol=2e-5)


@pytest.mark.parametrize("kind", ["log", "angles", "sh"])
@pytest.mark.parametrize("exponent", [0.0, 1.0, 30.0, 1e6])
def test_shade_is_the_triple_product(kind: str, exponent: float) -> None:
    """Against M^a in the kernel's own frame, which is another route. Sums of 16 x 16 float32 products."""
    rng = np.random.default_rng(1)
    frames = _frames(rng)
    model, scores, local = _model(kind, 4, rng)
    light = rng.normal(size=(16, 3))
    axis = rng.normal(size=(VERTICES, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    kernel = np.where(np.arange(VERTICES) % 5 == 0, -1, 0).astype(np.int32)
    found = shade(
        model, scores, frames, axis.astype(np.float32), kernel, [lighting(phong_factors(exponent, 7), light, 4)]
    )
    side = np.cross(axis, [0.2, 0.9, -0.3])
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    lobe = np.stack([side, np.cross(axis, side), axis], 1)  # rows: the frame with R on z
    back = np.swapaxes(lobe, 1, 2)
    seen = _to_world(_to_world(local, frames), back)
    lit = np.stack([_to_world(np.tile(light[:, c], (VERTICES, 1)), back) for c in range(3)], 1)
    expected = (exponent + 1) / (2 * math.pi) * np.einsum("vci,ij,vj->vc", lit, phong_matrix(exponent, 4), seen)
    expected = np.where(kernel[:, None] < 0, 0.0, np.maximum(expected, 0.0))
    np.testing.assert_allclose(found, expected, atol=3e-5)


def test_kernels_are_told_apart() -> None:
    rng = np.random.default_rng(2)
    frames = _frames(rng)
    model, scores, _ = _model("log", 4, rng)
    light = rng.normal(size=(16, 3))
    lights = [
        lighting(phong_factors(1.0, 7), light, 4),
        lighting(kernel_factors(lambda t: np.maximum(t, 0.0) ** 3, 7), light, 4),
    ]
    kernel = (np.arange(VERTICES) % 2).astype(np.int32)
    axis = np.ascontiguousarray(frames[:, 2])
    both = shade(model, scores, frames, axis, kernel, lights)
    for k in range(2):
        alone = shade(model, scores, frames, axis, np.zeros(VERTICES, np.int32), lights[k : k + 1])
        np.testing.assert_array_equal(both[kernel == k], alone[kernel == k])


def test_threads_do_not_matter() -> None:
    rng = np.random.default_rng(3)
    frames = _frames(rng)
    model, scores, _ = _model("log", 4, rng)
    light = [lighting(phong_factors(5.0, 7), rng.normal(size=(16, 3)), 4)]
    args = (model, scores, frames, np.ascontiguousarray(frames[:, 2]), np.zeros(VERTICES, np.int32), light)
    np.testing.assert_array_equal(shade(*args), shade(*args, threads=3))


def test_one_pose_turned_is_lit_alike() -> None:
    """Turning frames, axes and light together changes nothing but rounding."""
    rng = np.random.default_rng(5)
    frames = _frames(rng)
    model, scores, _ = _model("log", 4, rng)
    light = rng.normal(size=(1, 16))
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    turned_light = _to_world(light, np.ascontiguousarray(turn.T)[None])
    kernel = np.zeros(VERTICES, np.int32)

    def lit(f: np.ndarray, coefficients: np.ndarray) -> np.ndarray:
        light3 = np.tile(coefficients.T, (1, 3))
        return shade(
            model, scores, f, np.ascontiguousarray(f[:, 2]), kernel, [lighting(phong_factors(9.0, 7), light3, 4)]
        )

    moved = (frames.astype(float) @ turn.T).astype(np.float32)
    np.testing.assert_allclose(lit(moved, turned_light), lit(frames, light), atol=3e-5)
