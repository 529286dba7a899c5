"""Reflectances: the models' lobes at their extremes, sampling, lobe norms, the disc; and what compresses them."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np

from benchmarks.numerics.case import case, directions, dot, mp, mpf, norm, numbers, relative, unit
from benchmarks.numerics.sphere import ROUNDINGS

BLACK = (0.0, 0.0, 0.0)


def table(model, **values):
    from relightcli.core.brdf.models import pack_materials

    defaults = {"diffuse": BLACK, "specular": (1.0, 1.0, 1.0), "transmittance": BLACK}
    numbers_ = {"f0": 0.5, "roughness": 0.3, "shininess": 50.0}
    return pack_materials([SimpleNamespace(model=model, **(defaults | numbers_ | values))])


def exact_lobe(model, n, l, v, a=None, m=None, f0=None):  # noqa: E741
    """f |n.l| of the models' formulas as they are printed, of the directions at exactly unit length."""
    n, l, v = (unit(mpf(x)) for x in (n, l, v))  # noqa: E741
    nl, nv = dot(n, l), dot(n, v)
    if model == "phong":
        r = [2 * nv * x - y for x, y in zip(n, v, strict=True)]
        return (mp.mpf(a) + 1) / (2 * mp.pi) * mp.power(dot(unit(r), unit(l)), mp.mpf(a))
    h = unit([x + y for x, y in zip(l, v, strict=True)])
    nh, vh = dot(unit(n), h), dot(v, h)
    if model == "blinn-phong":
        a = mp.mpf(a)
        return nl * (a + 2) * (a + 4) / (8 * mp.pi * (mp.power(2, -a / 2) + a)) * mp.power(nh, a)
    m, f0 = mp.mpf(m), mp.mpf(f0)
    tan2 = 1 / nh**2 - 1
    d = mp.exp(-tan2 / m**2) / (mp.pi * m**2 * nh**4)
    g = min(mp.mpf(1), 2 * nh * nv / vh, 2 * nh * nl / vh)
    return (f0 + (1 - f0) * (1 - vh) ** 5) * d * g / (4 * nv)


def frame(n):
    x = np.array([1.0, 0, 0]) if abs(n[0]) < 0.6 else np.array([0.0, 1, 0])
    s = np.cross(n, x)
    s /= np.linalg.norm(s)
    return np.stack([s, np.cross(n, s), n])


def pairs(width, n, cosine, count=8, seed=0):
    """Views at cos(theta) = `cosine` and lights up to three `width`s about the mirror direction."""
    rng = np.random.default_rng(seed)
    axes = frame(n)
    out = []
    for k in range(count):
        t, phi = np.arccos(cosine), 2 * np.pi * k / count
        v = np.array([np.sin(t) * np.cos(phi), np.sin(t) * np.sin(phi), cosine])
        l = v * (-1, -1, 1) + 3 * width * rng.random() * cosine * directions(1, k)[0] / 2  # noqa: E741
        out.append([x @ axes for x in (l / np.linalg.norm(l), v / np.linalg.norm(v))])
    return out


def lobes(model, settings, cosines, n):
    from relightcli.core.brdf.models import evaluate_many

    errors = []
    for values, width in settings:
        own = table(model, **values)
        short = {"a": values.get("shininess"), "m": values.get("roughness"), "f0": values.get("f0")}
        for cosine in cosines:
            for l, v in pairs(width, n, cosine):  # noqa: E741
                exact = exact_lobe(model, n, l, v, **short)
                found = evaluate_many(own, np.zeros(1, int), np.zeros(3), n, l, v)[0, 0]
                if exact > 1e-12:
                    errors.append(relative(np.array([found]), numbers([exact]))[0])
    return np.array(errors)


UP = np.array([0.0, 0, 1])
EXPONENTS = [({"shininess": a}, min(1.0, (2.0 / (a + 1)) ** 0.5)) for a in (0.0, 1e-9, 0.5, 10.0, 1e3, 1e6)]
ROUGH = [({"roughness": m, "f0": f}, min(m, 1.0)) for m in (0.005, 0.02, 0.1, 0.5, 1.0) for f in (1e-3, 0.5, 1.0)]
COSINES = (1.0, 0.9, 0.3, 1e-2, 1e-4, 1e-6)
EXPONENTIAL = "the rounding of the directions' own angle times the slope of the narrowest lobe, some 1e3 per radian"


@case("Blinn-Phong lobe", "brdf/models.py", "exponents 0 to 1e6, n.v 1 to 1e-6", "float64", 3.2, EXPONENTIAL)
def blinn_phong():
    return lobes("blinn-phong", EXPONENTS, COSINES, UP)


@case("Phong lobe", "brdf/models.py", "exponents 0 to 1e6, n.v 1 to 1e-6", "float64", 3.2, EXPONENTIAL)
def phong():
    return lobes("phong", EXPONENTS, COSINES, UP)


@case(
    "Cook-Torrance lobe",
    "brdf/models.py",
    "roughness 0.005 to 1, f0 1e-3 to 1, n.v 1 to 1e-6",
    "float64",
    3.2,
    EXPONENTIAL,
)
def cook_torrance():
    return lobes("cook-torrance", ROUGH, COSINES, UP)


@case(
    "lobes about a normal that is no axis",
    "brdf/models.py",
    "the same, n.v 1 to 1e-2",
    "float64",
    4.0,
    "n.v of unit vectors has a rounding over n.v; 2 digits at 1e-2, beside those above",
)
def turned():
    n = directions(1, 3)[0]
    cosines = COSINES[:4]
    return np.concatenate(
        [
            lobes("blinn-phong", EXPONENTS, cosines, n),
            lobes("phong", EXPONENTS, cosines, n),
            lobes("cook-torrance", ROUGH, cosines, n),
        ]
    )


@case(
    "Cook-Torrance lobe without f0",
    "brdf/models.py",
    "f0 = 0, roughness 0.05 to 1",
    "float64",
    2.5,
    "(1 - v.h)^5 at small angles is a difference; relative to the lobe of F = 1, which the reflected light is a "
    "part of",
)
def no_fresnel():
    from relightcli.core.brdf.models import evaluate_many

    errors = []
    for m in (0.05, 0.3, 1.0):
        own = table("cook-torrance", roughness=m, f0=0.0)
        for cosine in (1.0, 0.9999, 0.9, 0.3, 0.01):
            for l, v in pairs(m, UP, cosine):  # noqa: E741
                exact, whole = (exact_lobe("cook-torrance", UP, l, v, m=m, f0=f) for f in (0.0, 1.0))
                if whole > 1e-12:
                    found = evaluate_many(own, np.zeros(1, int), np.zeros(3), UP, l, v)[0, :1]
                    errors.append(relative(found, numbers([exact]), whole)[0])
    return np.array(errors)


@case("norms of lobes", "brdf/models.py", "exponents 0 to 1e12, roughness 1e-6 to 10", "float64", 1.0, ROUNDINGS)
def constants():
    from relightcli.core.brdf.models import NORMALISATION

    errors = []
    for a in (0.0, 1e-12, 0.3, 7.0, 1e6, 1e12):
        x = mp.mpf(a)
        for model, exact in (
            ("blinn-phong", (x + 2) * (x + 4) / (8 * mp.pi * (mp.power(2, -x / 2) + x))),
            ("phong", (x + 1) / (2 * mp.pi)),
        ):
            errors.append(relative(table(model, shininess=a).parameters[0, NORMALISATION : NORMALISATION + 1], [exact]))
    for m in (1e-6, 0.005, 0.3, 10.0):
        found = table("cook-torrance", roughness=m).parameters[0, NORMALISATION : NORMALISATION + 1]
        errors.append(relative(found, [1 / (mp.pi * mp.mpf(m) ** 2)]))
    return np.array(errors)


@case(
    "directions drawn from a lobe",
    "brdf/sampling.py",
    "exponents 0.1 to 1e6, u to 1 - 1e-12",
    "float64",
    1.6,
    "the angle by log1p and expm1, a frame, a reflection; relative to the unit length",
)
def draws():
    from relightcli.core.brdf.sampling import sample_direction

    errors = []
    n = (0.0, 0.0, 1.0)
    v = (0.6, 0.0, 0.8)
    for a in (0.1, 10.0, 1e6):
        own = table("phong", shininess=a)
        for u1, u2 in ((1e-12, 0.1), (0.3, 0.9), (0.99, 0.4), (1 - 1e-12, 0.7)):
            found, _ = sample_direction(own.model[0], own.parameters[0], BLACK, n, v, u1, u2)
            cosine = mp.power(1 - mp.mpf(u1), 1 / (mp.mpf(a) + 1))
            r = unit([mp.mpf(-0.6), mp.mpf(0), mp.mpf(0.8)])
            errors.append(relative(np.array(dot(mpf(found), r), float), cosine, 1.0))
            errors.append(relative(np.array(norm(mpf(found)), float), mp.mpf(1)))
    return np.array(errors)


@case(
    "frames about a normal",
    "brdf/sampling.py",
    "anywhere, and within 1e-8 of the poles",
    "float64",
    1.3,
    ROUNDINGS + "; lengths and angles, relative to 1",
)
def frames():
    from relightcli.core.brdf.sampling import orthonormal_frame

    errors = []
    for n in [*directions(20, 1), *directions(20, 2, 1e-8), *directions(20, 3, 1e-3)]:
        axes = [mpf(np.array(x)) for x in (*orthonormal_frame(tuple(n)), n / float(norm(mpf(n))))]
        errors += [float(abs(dot(axes[i], axes[j]) - (i == j))) for i in range(3) for j in range(i + 1)]
    return np.array(errors)


@case(
    "integrals of Gaussian lobes",
    "brdf/specular_lobes.py",
    "7 to 540 degrees",
    "float64",
    1.5,
    "64 Gauss points over ten standard deviations",
)
def gaussians():
    from relightcli.core.brdf.specular_lobes import normaliser

    def exact(degrees):
        s = mp.radians(mp.mpf(degrees)) / 3
        return 2 * mp.pi * mp.quad(lambda t: mp.exp(-t * t / (2 * s * s)) * mp.sin(t), mp.linspace(0, mp.pi, 9))

    mp.dps = 25
    try:
        return np.array([relative(np.array(normaliser(d)), exact(d)) for d in (7.0, 14.0, 21.0, 90.0, 540.0)])
    finally:
        mp.dps = 50


@case(
    "directions of the disc's cells",
    "brdf/disc.py",
    "2 to 64 cells across, to the rim",
    "float64",
    1.5,
    "1 - |p|^2 of cells that touch the rim is as small as 2/N = 1/32: its rounding over it",
)
def disc():
    from relightcli.core.brdf.disc import disc_grid

    errors = []
    for n in (2, 8, 32, 64):
        grid = disc_grid(n)
        rim = np.argsort(grid.direction[:, 2], kind="stable")[:20]
        cell = np.rint(grid.position[rim] * n).astype(int).tolist()
        exact = numbers(mp.sqrt(mp.mpf(n * n - x * x - y * y)) / n for x, y in cell)
        errors.append(relative(grid.direction[rim, 2], exact))
    return np.concatenate(errors)


@case(
    "singular values by Gram matrices",
    "compress/tucker.py",
    "1 to 1e-12 in one matrix",
    "float64",
    2.0,
    "an eigenvalue problem of 12 rows; squares, relative to the largest",
)
def spectrum():
    from relightcli.core.compress.tucker import gram_spectrum

    size = 10.0 ** -np.arange(0, 13)
    rng = np.random.default_rng(1)
    u, v = (np.linalg.qr(rng.standard_normal((n, 13)))[0] for n in (13, 40))
    a = (u * size) @ v.T
    found, vectors = gram_spectrum(a @ a.T)
    exact = mp.svd_r(mp.matrix(a.tolist()), compute_uv=False)
    values = relative(found, numbers(exact[k] ** 2 for k in range(len(found))), 1.0)
    return np.append(values, np.abs(vectors.T @ vectors - np.eye(len(found))).reshape(-1))


@case(
    "error of a tensor factorisation",
    "compress/tucker.py",
    "exact errors of 1e-1 to 1e-20 of |X|^2",
    "float64",
    2.5,
    "a difference of squares, relative to |X|^2: errors below 1e-15 of that count as none",
)
def tucker():
    from relightcli.core.compress.tucker import hosvd, reconstruct

    errors = []
    rng = np.random.default_rng(2)
    for size in (0.3, 1e-3, 1e-6, 1e-10):
        x = np.einsum("i,j,k", *(rng.random(n) for n in (6, 7, 8))) + size * rng.standard_normal((6, 7, 8))
        found = hosvd(x, (1, 1, 1))
        exact = mp.fsum((mpf(x) - mpf(reconstruct(found))).reshape(-1) ** 2)
        errors.append(relative(np.array(found.error2), exact, found.norm2))
    return np.array(errors)


@case(
    "residual of clustered rows",
    "compress/cpca.py",
    "rows that differ by 1e-6 of what they have in common",
    "float64",
    2.0,
    "what all rows have in common is taken off before squares are; sums of 720 of them",
)
def clusters():
    from relightcli.core.compress.cpca import cpca

    rng = np.random.default_rng(4)
    x = 1.0 + rng.random(12) + 1e-6 * rng.standard_normal((60, 12))
    found = cpca(x, 1, 0)
    rows = mpf(x)
    mean = rows.sum(0) / mp.mpf(len(x))
    return relative(np.array(found.residuals[-1]), mp.fsum(((rows - mean) ** 2).reshape(-1)))


@case(
    "numbers as small integers",
    "(formats) quantisation",
    "1e-30 to 1e30, int8 and int16",
    "float32",
    0.5,
    "q s rounded once",
)
def integers():
    import relight_formats as formats

    values = np.random.default_rng(6).standard_normal((12, 64)) * 10.0 ** np.linspace(-30, 30, 12)[:, None]
    errors = []
    for dtype in ("int8", "int16"):
        codes, scale = formats.quantise(values, dtype)
        found = formats.dequantise(codes, scale)
        errors.append(relative(found, mpf(codes) * mpf(np.broadcast_to(scale, codes.shape))))
        away = relative(
            values, mpf(codes) * mpf(np.broadcast_to(scale, codes.shape)), np.broadcast_to(scale, codes.shape)
        )
        errors.append(np.maximum(away - 0.5, 0.0))
    return np.concatenate(errors)
