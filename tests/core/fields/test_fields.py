"""Fields of bodies whose answers are known: solid angles, furnaces, exit radiance, bowls."""

from __future__ import annotations

import numpy as np
import pytest

from relightcli.core.fields.body import clamped_cosine, diffuse_operator, local_rotations
from relightcli.core.fields.build import build_field, field_samples
from relightcli.core.fields.field import shell_radii
from relightcli.core.fields.proxies import place_proxies
from relightcli.core.fields.sampling import sample_points
from relightcli.core.fields.self_transfer import solve
from relightcli.core.fields.sources import disc_light
from relightcli.core.sphere import sh
from relightcli.scene.model import Material
from tests.core.fields.bodies import EVEN, ball, body_of, bowl, grey, tracer_of


def reflected(field, light):
    """Coefficients (S, 6nn, N, C) of the object's radiance when every proxy receives the same light (N,)."""
    return np.einsum("sdkijc,j->sdic", field.transfer.astype(np.float64), light)


def even(order=4):
    out = np.zeros(order * order)
    out[0] = EVEN
    return out


def test_clamped_cosine_is_its_quadrature():
    x, w = np.polynomial.legendre.leggauss(200)
    x, w = 0.5 * (x + 1), 0.5 * w
    found = clamped_cosine(8)
    for band in range(8):
        legendre = np.polynomial.legendre.Legendre.basis(band)(x)
        assert found[band * band] == pytest.approx(2 * np.pi * (w * x * legendre).sum(), abs=1e-13)


def test_local_rotations_are_orthogonal_and_put_the_normal_on_z():
    normals = np.random.default_rng(0).standard_normal((5, 3))
    normals = (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32)
    turn = local_rotations(normals, 4)
    np.testing.assert_allclose(turn @ turn.transpose(0, 2, 1), np.tile(np.eye(16), (5, 1, 1)), atol=1e-6)
    pole = sh.harmonics(np.array([[0.0, 0, 1]]), 4)[0]
    own = np.einsum("pij,pj->pi", turn, sh.harmonics(normals.astype(np.float64), 4))
    np.testing.assert_allclose(own, np.tile(pole, (5, 1)), atol=1e-6)


@pytest.mark.parametrize("scale", [1e-4, 1.0, 1e6])
def test_a_white_ball_hides_as_much_light_as_it_gives_back(scale):
    """The furnace of one object: under even light whatever it hides it replaces, to the rounding of float32."""
    body = ball(grey(1.0), 8, scale, (3 * scale, 0, 0))
    field, own = build_field(tracer_of(body), body, 4, 4, 5, rays=256)
    assert field.valid.all()
    assert field.transfer.shape == (4, 96, 5, 16, 16, 1)
    total = reflected(field, even())[..., 0] + field.occlusion
    # 256 sums of numbers up to 4 in float32
    np.testing.assert_allclose(total, np.broadcast_to(even(), total.shape), atol=2e-5)
    # Nothing of a convex body is above another point's horizon.
    np.testing.assert_allclose(own.transfer.sum(1)[..., 0], np.tile(np.eye(16), (len(body.point), 1, 1)), atol=1e-6)


def test_a_white_bowl_is_a_furnace_too():
    """Concave: its own reflections must have converged. Seen through its opening, from where no back is in sight."""
    body = bowl(grey(1.0), 8)
    field, own = build_field(tracer_of(body), body, 2, 4, 3, rays=256)
    inside = own.transfer.sum(1)[..., 0] @ even()
    np.testing.assert_allclose(inside, np.tile(even(), (len(inside), 1)), atol=2e-5)
    x, y, z = np.moveaxis(sample_points(field.center, field.radii, 4, 0, 2 * 96).reshape(2, 96, 3), -1, 0)
    above = (y > 0.3) & (np.hypot(x, z) < 0.9)
    assert above.sum() >= 4
    total = reflected(field, even())[..., 0] + field.occlusion
    np.testing.assert_allclose(total[above], np.broadcast_to(even(), total[above].shape), atol=2e-5)


def test_own_reflections_of_a_bowl_by_their_number():
    """Every point of half a sphere sees the sky with half of its cosine, and the bowl with the other half. Its
    irradiance / pi under even light is 1/2 without own reflections, one of them adds a/4, all together 1/2 / (1 - a/2).

    The next band has 1/24 of the clamped cosine, which is 0.02 of a half; at a point comes three times the rays' noise
    of 1 % of even light."""
    for albedo in (0.3, 0.8):
        body = bowl(grey(albedo), 8)
        found = solve(tracer_of(body), body, place_proxies(body.point, 3))
        middle = body.point[:, 1] < -0.3  # the rim's normals are level: its horizon cuts faces
        opened, once, rest = (found.by_order.transpose(0, 2, 1) @ even())[middle].T
        exact = 0.5, albedo / 4, 0.5 / (1 - albedo / 2) - 0.5 - albedo / 4
        for part, wanted in zip((opened, once, rest), exact, strict=True):
            np.testing.assert_allclose(part, wanted, atol=0.02 + 0.03)
            np.testing.assert_allclose(part.mean(), wanted, atol=0.02)
        whole = found.transfer.sum(1, dtype=np.float64)[..., 0]
        np.testing.assert_allclose(
            found.by_order.sum(2), np.einsum("pi,pij->pj", diffuse_operator(body), whole), atol=1e-6
        )


def test_a_convex_object_reflects_nothing_on_itself():
    body = ball(grey(0.9), 12)
    found = solve(tracer_of(body), body, place_proxies(body.point, 3))
    assert not found.by_order[..., 1:].any()
    assert found.by_order[..., 0].any()


def test_the_field_of_a_ball_is_a_disc_at_every_distance():
    """Solid angle and form factor (KT3, KT4) within 1 %, from all samples; a bright ball and a black one."""
    body = ball(grey(0.6), 48)
    radii = shell_radii(1.0, 6)
    solution = solve(tracer_of(body), body, place_proxies(body.point, 4))
    found = field_samples(tracer_of(body), body, solution.exits, radii, 4, 0, 6 * 96)
    points = sample_points(body.center, radii, 4, 0, 6 * 96)
    disc = disc_light(body.center - points, 1.0, 4)
    hidden = even() - found.occlusion
    light = np.einsum("skijc,j->si", found.transfer.astype(np.float64), even()) / 0.6
    for seen in (hidden, light):
        np.testing.assert_allclose(seen[:, 0], disc[:, 0], rtol=0.01)  # solid angle
        # Form factor of a receiver that looks at the centre: the clamped cosine of a disc is pi sin^2; by bands:
        operator = sh.harmonics(-points / np.linalg.norm(points, axis=1, keepdims=True), 4) * clamped_cosine(4)
        ours, exact = (seen * operator).sum(1), (disc * operator).sum(1)
        np.testing.assert_allclose(ours, exact, rtol=0.01)
    # In all bands, relative to the disc.
    error = np.linalg.norm(hidden - disc, axis=1) / np.linalg.norm(disc, axis=1)
    assert error.max() < 0.01
    assert found.valid.all()


def test_a_ball_reflects_light_of_few_bands_as_a_ball_does():
    """KT2: far away, the ball shows its exit radiance rho/pi sum A_l L_lm y_lm(n) on the side that is seen."""
    body = ball(grey(0.8), 32)
    light = np.random.default_rng(0).standard_normal(9)
    light[0] = 4.0
    solution = solve(tracer_of(body), body, place_proxies(body.point, 6))
    found = field_samples(tracer_of(body), body, solution.exits, np.array([20.0]), 2, 0, 24)
    seen = np.einsum("skijc,j->si", found.transfer.astype(np.float64)[:, :, :, :9], light)[:, 0]
    points = sample_points(np.zeros(3), np.array([20.0]), 2, 0, 24)
    # Mean over the visible disc: n on the unit sphere, weight cos to the sample (the ball is 20 radii away).
    k = np.arange(200_000) + 0.5
    z, phi = 1 - 2 * k / len(k), k * np.pi * (3 - np.sqrt(5))
    n = np.stack([np.sqrt(1 - z * z) * np.cos(phi), np.sqrt(1 - z * z) * np.sin(phi), z], -1)
    exit_radiance = 0.8 / np.pi * (sh.harmonics(n, 3) * clamped_cosine(3)) @ light
    for p, coefficient in zip(points, seen, strict=True):
        cosine = np.maximum(n @ (p / 20.0) - 1.0 / 20.0, 0.0)
        weight = np.where(cosine > 0, n @ (p / 20.0), 0.0)
        mean = (exit_radiance * weight).sum() / weight.sum()
        wanted = mean * disc_light(-p[None], 1.0, 4)[0, 0]
        # A disc seen through 1024 rays: 1 % of the light, whatever its pattern (perspective: 1/20 of a percent).
        assert coefficient == pytest.approx(
            wanted, abs=0.01 * np.abs(exit_radiance).max() * disc_light(-p[None], 1.0, 4)[0, 0]
        )


def test_proxies_share_light_out_and_add_none():
    """Where all proxies receive the same, their number changes nothing (float32 sums of 1024 rays)."""
    body = bowl(grey(0.7), 6)
    tracer = tracer_of(body)
    light = np.random.default_rng(0).standard_normal(16)
    fields = [build_field(tracer, body, 2, 2, m, rays=128)[0] for m in (1, 4, 9)]
    for field, m in zip(fields, (1, 4, 9), strict=True):
        assert field.transfer.shape[2] == m
        np.testing.assert_allclose(reflected(field, light), reflected(fields[0], light), atol=2e-5)


def test_black_objects_send_nothing_and_hide_the_same():
    black, white = (build_field(tracer_of(b), b, 2, 2, 2, rays=128) for b in (bowl(grey(0.0), 6), bowl(grey(1.0), 6)))
    assert not black[0].transfer.any()
    np.testing.assert_array_equal(black[0].occlusion, white[0].occlusion)
    assert np.abs(black[1].transfer - white[1].transfer).max() > 0.01


def test_light_in_a_bowl_is_the_series_of_its_reflections():
    """KT5: in a half sphere every point sees half of itself: B = rho (1 - f) / (1 - rho f), f = 1/2, under even light.

    The irradiance from the cavity comes through 4 bands: -1.5 to +1.2 % of it, and 1 % for the sampling."""
    rho = 0.8
    body = bowl(grey(rho), 16)
    solution = solve(tracer_of(body), body, place_proxies(body.point, 3))
    exits = solution.exits.reshape(len(body.point), 3, 16).sum(1)[:, 0] * EVEN
    deep = body.point[:, 1] < -0.3
    np.testing.assert_allclose(exits[deep], rho * 0.5 / (1 - rho * 0.5), rtol=0.025)
    assert 0.001 < solution.noise <= 0.01


def test_colours_are_kept_apart():
    body = bowl(Material("m", diffuse=(0.9, 0.3, 0.0)), 6)
    field, own = build_field(tracer_of(body), body, 2, 2, 2, rays=128)
    for c, albedo in enumerate((0.9, 0.3, 0.0)):
        alone, own_alone = build_field(tracer_of(body), bowl(grey(albedo), 6), 2, 2, 2, rays=128)
        np.testing.assert_allclose(field.transfer[..., c], alone.transfer[..., 0], atol=1e-6)
        np.testing.assert_allclose(own.transfer[..., c], own_alone.transfer[..., 0], atol=1e-6)


def test_a_glossy_ball_shows_a_highlight_where_a_mirror_would():
    """Specular exit radiance of a lobe as wide as a few bands, against quadrature of the model itself."""
    from relightcli.core.brdf.models import evaluate_many, pack_materials

    material = Material("m", model="blinn-phong", diffuse=(0.0,) * 3, specular=(0.5,) * 3, shininess=8.0)
    body = ball(material, 32)
    solution = solve(tracer_of(body), body, place_proxies(body.point, 2))
    assert solution.exits.shape[1] == 17
    sky = np.random.default_rng(3).standard_normal(16)
    distance = 40.0
    found = field_samples(tracer_of(body), body, solution.exits, np.array([distance]), 2, 0, 24)
    seen = np.einsum("skijc,j->si", found.transfer.astype(np.float64), sky)[:, 0]
    k = np.arange(4000) + 0.5
    z, phi = 1 - 2 * k / len(k), k * np.pi * (3 - np.sqrt(5))
    w = np.stack([np.sqrt(1 - z * z) * np.cos(phi), np.sqrt(1 - z * z) * np.sin(phi), z], -1)
    radiance = sh.harmonics(w, 4) @ sky
    table = pack_materials([material])
    for p, coefficient in list(zip(sample_points(np.zeros(3), np.array([distance]), 2, 0, 24), seen, strict=True))[::5]:
        view = p / distance
        n = w[w @ view > 0.02][::4]
        f = evaluate_many(table, np.zeros(1, int), np.zeros(3), n[:, None], w[None], view)[..., 0]
        exit_radiance = (f * radiance).sum(1) * (4 * np.pi / len(w))
        mean = (exit_radiance * (n @ view)).sum() / (n @ view).sum()
        disc = disc_light(-p[None], 1.0, 4)[0, 0]
        # Interpolation of the lobes between points, and sampling: 3 % of the largest radiance on the ball.
        assert coefficient == pytest.approx(mean * disc, abs=0.03 * np.abs(exit_radiance).max() * disc)


def test_samples_inside_a_body_are_not_valid():
    body = ball(grey(0.5), 8)
    field, _ = build_field(tracer_of(body), body, 4, 2, 1, spacing="paper", rays=64)
    # 0.1, 2.7, 5.4 and 8 radii: the first lies inside.
    np.testing.assert_array_equal(field.valid.all(1), [False, True, True, True])
    assert not field.valid[0].any()


def test_flat_objects_have_no_inside():
    corners = np.array([[-1.0, 0, 1], [1, 0, 1], [1, 0, -1], [-1, 0, -1]])
    body = body_of(corners, [[0, 1, 2], [0, 2, 3]], np.tile([0, 1, 0], (4, 1)), grey(1.0), two_sided=True)
    assert len(body.point) == 8
    field, own = build_field(tracer_of(body), body, 3, 2, 2, spacing="paper", rays=128)
    assert field.valid.all()
    assert own.transfer.shape == (8, 2, 16, 16, 1)
    total = reflected(field, even())[..., 0] + field.occlusion
    np.testing.assert_allclose(total, np.broadcast_to(even(), total.shape), atol=2e-5)


def test_the_same_bytes_however_samples_are_put_into_blocks():
    body = bowl(Material("m", diffuse=(0.9, 0.3, 0.1)), 6)
    tracer, radii = tracer_of(body), shell_radii(body.radius, 3, "paper")
    exits = solve(tracer, body, place_proxies(body.point, 2)).exits
    whole = field_samples(tracer, body, exits, radii, 2, 0, 72, rays=64)
    parts = [field_samples(tracer, body, exits, radii, 2, a, b, rays=64) for a, b in ((0, 5), (5, 40), (40, 72))]
    for k in range(3):
        np.testing.assert_array_equal(np.concatenate([p[k] for p in parts]), whole[k])


def test_more_rays_less_error():
    """Solid angle of a tetrahedron-like spike against many rays: the error falls at least with 1 / sqrt(rays)."""
    corners = np.array([[0.0, 0, 0], [3, 0, 0], [0, 0.4, 0], [0, 0, 0.4]])
    triangles = [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]
    body = body_of(corners, triangles, np.tile([0, 1, 0], (4, 1)), grey(0.0))
    tracer = tracer_of(body)
    exits = solve(tracer, body, place_proxies(body.point, 1)).exits
    radii = np.array([1.5 * body.radius])
    truth = field_samples(tracer, body, exits, radii, 3, 0, 54, rays=1 << 16).occlusion
    errors = []
    for rays in (64, 1024):
        found = field_samples(tracer, body, exits, radii, 3, 0, 54, rays=rays).occlusion
        errors.append(np.sqrt(((found - truth) ** 2).mean()))
    assert errors[1] < errors[0] / 4
