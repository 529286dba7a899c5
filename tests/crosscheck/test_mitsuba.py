"""The reference path tracer against Mitsuba 3, another program by other people.

Lambert is Mitsuba's own `diffuse`; the other models are written here once more, as Mitsuba plug-ins, straight from
the formulas that the scene file documents. Both sides give a mean and a variance per pixel from independent
repetitions. As in Mitsuba's own tests, a picture passes when 99.75 % of its pixels pass a t-test at 0.01,
Sidak-corrected for their number. Single pixels forgive small errors of all, so the picture's mean is compared too.

Mitsuba runs as `scalar_rgb`, which needs nothing but its wheel. (Its vectorised variants load libLLVM from the system
and end the process if that is older than 17.) Plug-ins in Python are slow there: the pictures are small.
"""

import math

import numpy as np
import pytest
from scipy import stats

from relightcli.core.lights.latlong import make_latlong
from relightcli.core.transport.path_tracer import resolve, trace_rows
from relightcli.scene.model import Camera, Material, RectangleLight
from tests.core.transport.scenes import BLACK, Part, build, lambert, sphere, square

mi = pytest.importorskip("mitsuba", reason="mitsuba is not installed: pip install 'relightcli[test]'")

WIDTH, HEIGHT, REPETITIONS = 20, 15, 16
CAMERA = Camera("c", (0.0, 1.0, 4.5), (0.0, -0.3, 0.0), fov=35, size=(WIDTH, HEIGHT))
LAMP = RectangleLight("lamp", (0.5, 3.0, 1.0), (1.0, 0.0, 0.0), (0.0, 0.0, 0.8), (12.0, 10.0, 7.0))
GLOSSY = {
    "blinn-phong": {"specular": (0.5, 0.4, 0.3), "shininess": 25.0},
    "cook-torrance": {"specular": (0.9, 0.7, 0.4), "f0": 0.6, "roughness": 0.3},
    "phong": {"specular": (0.4, 0.4, 0.5), "shininess": 12.0},
}


@pytest.fixture(scope="module", autouse=True)
def variant():
    mi.set_variant("scalar_rgb")
    mi.set_log_level(mi.LogLevel.Error)
    register_glossy()


def register_glossy():
    import drjit as dr

    class Glossy(mi.BSDF):
        """Blinn-Phong, Cook-Torrance and Phong of the scene file, sampled by the cosine."""

        def __init__(self, props):
            mi.BSDF.__init__(self, props)
            self.kind = props["kind"]
            self.diffuse = mi.Color3f(*[float(x) for x in str(props["albedo"]).split()])
            self.specular = mi.Color3f(*[float(x) for x in str(props["gloss"]).split()])
            self.exponent, self.f0, self.m = float(props["exponent"]), float(props["f0"]), float(props["m"])
            self.m_components = [mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.FrontSide]
            self.m_flags = self.m_components[0]

        def value(self, si, wo):
            v, l = si.wi, wo  # noqa: E741
            nl, nv = l.z, v.z
            a = self.exponent
            if self.kind == "phong":
                mirror = mi.Vector3f(-v.x, -v.y, v.z)
                lobe = (a + 1) / (2 * dr.pi) * dr.power(dr.maximum(0, dr.dot(mirror, l)), a)
            else:
                h = dr.normalize(v + l)
                nh, vh = h.z, dr.dot(v, h)
                if self.kind == "blinn-phong":
                    lobe = nl * (a + 2) * (a + 4) / (8 * dr.pi * (2 ** (-a / 2) + a)) * dr.power(nh, a)
                else:
                    tan2 = 1 / dr.square(nh) - 1
                    d = dr.exp(-tan2 / self.m**2) / (dr.pi * self.m**2 * dr.square(dr.square(nh)))
                    g = dr.minimum(1, dr.minimum(2 * nh * nv / vh, 2 * nh * nl / vh))
                    f = self.f0 + (1 - self.f0) * dr.power(1 - vh, 5)
                    lobe = f * d * g / (4 * nv)
            value = self.diffuse * (nl / dr.pi) + self.specular * lobe
            return dr.select((nl > 0) & (nv > 0), value, 0)

        def sample(self, ctx, si, sample1, sample2, active=True):
            bs = mi.BSDFSample3f()
            bs.wo = mi.warp.square_to_cosine_hemisphere(sample2)
            bs.pdf = mi.warp.square_to_cosine_hemisphere_pdf(bs.wo)
            bs.eta = 1.0
            bs.sampled_type = mi.UInt32(+self.m_flags)
            bs.sampled_component = mi.UInt32(0)
            use = active & (si.wi.z > 0) & (bs.pdf > 0)
            return bs, dr.select(use, self.value(si, bs.wo) / bs.pdf, 0)

        def eval(self, ctx, si, wo, active=True):
            return dr.select(active, self.value(si, wo), 0)

        def pdf(self, ctx, si, wo, active=True):
            return dr.select((si.wi.z > 0) & (wo.z > 0), mi.warp.square_to_cosine_hemisphere_pdf(wo), 0)

        def eval_pdf(self, ctx, si, wo, active=True):
            return self.eval(ctx, si, wo, active), self.pdf(ctx, si, wo, active)

        def to_string(self):
            return f"Glossy[{self.kind}]"

    mi.register_bsdf("relight_glossy", Glossy)


def parts_of(model):
    """A ground and two spheres, so coarse that face and interpolated normals differ by up to 11 degrees."""
    glossy = lambert((0.7, 0.4, 0.2)) if model == "lambert" else Material("m", model, (0.3, 0.2, 0.1), **GLOSSY[model])
    ground = glossy if model != "lambert" else lambert((0.6, 0.6, 0.6))
    return [
        square(6, -1.0, material=ground),
        sphere(0.8, (-0.75, -0.2, 0), rings=8, material=glossy),
        sphere(0.6, (0.8, -0.4, 0.5), rings=8, material=lambert((0.3, 0.6, 0.8))),
    ]


def sky(longitude, latitude):
    """A smooth sky: blue above, brown below, and a sun of 12 degrees (a von Mises-Fisher lobe)."""
    d = np.stack([np.sin(longitude) * np.cos(latitude), np.sin(latitude), np.cos(longitude) * np.cos(latitude)], -1)
    sun = np.array([0.5, 0.6, 0.5]) / np.linalg.norm([0.5, 0.6, 0.5])
    lobe = 20 * np.exp(50 * (d @ sun - 1))
    height = d[..., 1:2]
    return 0.3 + height * np.array([0.05, 0.1, 0.25]) + lobe[..., None] * np.array([1.0, 0.9, 0.7])


def our_sky(height=256, width=512):
    longitude = math.pi * (1 - 2 * (np.arange(width) + 0.5) / width)
    latitude = math.pi * (0.5 - (np.arange(height) + 0.5) / height)
    return sky(*np.meshgrid(longitude, latitude))


def mitsuba_sky(height=257, width=512):
    """The same function where Mitsuba puts the texels between which it interpolates: the outer rows at the poles."""
    longitude = math.pi * (1 - 2 * (np.arange(width) + 0.5) / width)
    latitude = math.pi * (0.5 - np.arange(height) / (height - 1))
    return sky(*np.meshgrid(longitude, latitude)).astype(np.float32)


def write_ply(path, part: Part):
    lines = ["ply", "format ascii 1.0", f"element vertex {len(part.corners)}"]
    lines += [f"property float {name}" for name in ("x", "y", "z", "nx", "ny", "nz")]
    lines += [f"element face {len(part.triangles)}", "property list uchar int vertex_indices", "end_header"]
    lines += [" ".join(f"{x:.9g}" for x in (*p, *n)) for p, n in zip(part.corners, part.normals, strict=True)]
    lines += ["3 " + " ".join(map(str, face)) for face in part.triangles]
    path.write_text("\n".join(lines) + "\n")


def mitsuba_material(m):
    if m.model == "lambert":
        return {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(m.diffuse)}}
    return {
        "type": "relight_glossy",
        "kind": m.model,
        "albedo": " ".join(map(str, m.diffuse)),
        "gloss": " ".join(map(str, m.specular)),
        "exponent": m.shininess,
        "f0": m.f0,
        "m": m.roughness,
    }


def mitsuba_picture(parts, light, bounces, spp, folder):
    """Mean (H, W, 3), variance of the mean, and alpha."""
    scene = {
        "type": "scene",
        # Their depth counts the light's own radiance as 1 and direct light as 2.
        "integrator": {"type": "path", "max_depth": bounces + 2, "rr_depth": 1000, "hide_emitters": True},
        "sensor": {
            "type": "perspective",
            "fov": CAMERA.fov,
            "fov_axis": "y",
            "to_world": mi.ScalarTransform4f().look_at(
                origin=list(CAMERA.eye), target=list(CAMERA.target), up=list(CAMERA.up)
            ),
            "film": {
                "type": "hdrfilm",
                "width": WIDTH,
                "height": HEIGHT,
                "rfilter": {"type": "box"},
                "pixel_format": "rgba",
                "component_format": "float32",
            },
            "sampler": {"type": "independent"},
        },
    }
    for k, part in enumerate(parts):
        path = folder / f"part{k}.ply"
        write_ply(path, part)
        scene[f"part{k}"] = {"type": "ply", "filename": str(path), "material": mitsuba_material(part.material)}
    if light == "sky":
        scene["sky"] = {"type": "envmap", "bitmap": mi.Bitmap(mitsuba_sky())}
    else:
        center, u, v = (np.array(x) for x in (LAMP.center, LAMP.edge_u, LAMP.edge_v))
        matrix = np.eye(4)
        # Their rectangle is [-1, 1]^2 and emits towards u x v.
        matrix[:3, 0], matrix[:3, 1], matrix[:3, 2], matrix[:3, 3] = u / 2, v / 2, np.cross(u, v), center
        scene["lamp"] = {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f(matrix),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": list(LAMP.radiance)}},
        }
    loaded = mi.load_dict(scene)
    runs = np.stack([np.array(mi.render(loaded, spp=spp // REPETITIONS, seed=k)) for k in range(REPETITIONS)]).astype(
        np.float64
    )
    rgb = runs[..., :3]
    return rgb.mean(0), rgb.var(0, ddof=1) / REPETITIONS, runs[..., 3].mean(0)


@pytest.mark.parametrize("bounces", [0, 2])
@pytest.mark.parametrize("light", ["sky", "lamp"])
@pytest.mark.parametrize("model", ["lambert", *(pytest.param(name, marks=pytest.mark.slow) for name in GLOSSY)])
def test_same_picture(model, light, bounces, tmp_path):
    parts = parts_of(model)
    # Sampled by the cosine, glossy bounces have rare bright paths: fewer samples would not be normally distributed.
    spp = 4096 if model == "lambert" else 512 * (bounces + 1)
    theirs, their_variance, their_alpha = mitsuba_picture(parts, light, bounces, spp, tmp_path)
    scene, tracer = build(parts, [LAMP] if light == "lamp" else [])
    environment = make_latlong(our_sky() if light == "sky" else BLACK)
    tile = trace_rows(scene, tracer, environment, CAMERA, (0, HEIGHT), (0, REPETITIONS), 64, bounces)
    ours = resolve(tile)

    # Both alphas estimate the same coverage from 1024 and at least 512 samples.
    np.testing.assert_allclose(ours.alpha, their_alpha, atol=0.2)
    a, b = ours.variance.astype(np.float64), their_variance
    error = np.sqrt(a + b) + 1e-9
    z = (ours.beauty - theirs) / error
    # Degrees of freedom of the difference of two means. [Welch 1947]
    freedom = (a + b + 1e-18) ** 2 / (a**2 + b**2 + 1e-36) * (REPETITIONS - 1)
    p = 2 * stats.t.sf(abs(z), freedom)
    sidak = 1 - 0.99 ** (1 / p.size)
    assert (p > sidak).mean() >= 0.9975, f"{(p <= sidak).sum()} of {p.size} values differ, worst z {abs(z).max():.1f}"

    mean, mean_error = (ours.beauty - theirs).mean((0, 1)), np.sqrt((a + b).sum((0, 1))) / (WIDTH * HEIGHT)
    # 5 standard errors and 2e-4 of the light: the sky between texel centres, theirs linear, ours constant.
    assert (abs(mean) < 5 * mean_error + 2e-4 * theirs.mean((0, 1))).all(), (mean, mean_error)
    assert theirs.mean() > 0.01
