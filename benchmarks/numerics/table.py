"""All cases, in order, their table, and what has none."""

from __future__ import annotations

from collections.abc import Sequence

from benchmarks.numerics import brdf, lights, moving, other, sphere
from benchmarks.numerics.case import CASES, Case, Loss, run

ROOMS = (sphere, brdf, lights, moving, other)
HEAD = ("kernel", "over", "stored as", "largest error", "median", "digits lost", "at most", "because")

_WHOLE = "whole numbers, bits and orders; no rounding"
_METHOD = "its error is that of a method (samples, grids, fits), far above rounding, and is bounded where it is tested"
_SUMS = "weights and sums of what others computed, all of one sign or in float64"

# Files of `core` without a row of their own, and why.
EXCUSED: dict[str, str] = {
    "bits.py": _WHOLE,
    "brdf/albedo.py": _METHOD,
    "brdf/basis.py": "singular values by Gram matrices: compress/tucker.py",
    "brdf/dataset.py": _METHOD,
    "brdf/direct_model.py": _METHOD,
    "brdf/measured.py": "constants of a published table",
    "brdf/separable.py": _METHOD,
    "brdf/tensor.py": "factors: compress/tucker.py; lobes: brdf/specular_lobes.py",
    "brdf/transport_basis.py": _METHOD,
    "compress/groups.py": "sums of compress/cpca.py",
    "compress/span.py": _METHOD,
    "fields/adaptive.py": _METHOD,
    "fields/albedos.py": _METHOD,
    "fields/bounce.py": "sums of fields/chain.py",
    "fields/build.py": "rays of fields/sampling.py",
    "fields/close.py": "rays of fields/sampling.py",
    "fields/compression.py": _METHOD,
    "fields/dimmed.py": _SUMS,
    "fields/entities.py": "places of fields/interpolate.py, turns of sphere/rotation.py",
    "fields/field.py": "records, and equal ratios",
    "fields/lobe_functions.py": _METHOD,
    "fields/self_transfer.py": _METHOD,
    "fields/shade.py": _SUMS,
    "fields/shared_exits.py": _METHOD,
    "fields/standing.py": _SUMS,
    "fields/suns.py": "comparisons",
    "measure/front.py": "comparisons",
    "measure/heatmap.py": "colours of a picture of 8 bits",
    "measure/noise_free.py": "a mean of products whose noise is stated beside it",
    "parts.py": _WHOLE,
    "lights/bright_cells.py": _SUMS,
    "pose/beside.py": _SUMS,
    "pose/frames.py": _WHOLE,
    "pose/pose_model.py": "lobes, scores and regressions of its neighbours",
    "pose/seen.py": _METHOD,
    "shade/backdrop.py": _SUMS,
    "shade/bounces.py": _SUMS,
    "shade/bright.py": _SUMS,
    "shade/cluster_sum.py": _SUMS,
    "shade/factor_sum.py": _METHOD,
    "shade/gather.py": _SUMS,
    "shade/glossy.py": _METHOD,
    "shade/lobe_factors.py": _METHOD,
    "shade/local.py": _SUMS,
    "shade/low_order.py": _METHOD,
    "shade/narrow.py": _METHOD,
    "shade/picture.py": _SUMS,
    "shade/primary.py": "rays of transport/camera.py",
    "shade/sampled_lobes.py": _METHOD,
    "shade/seen_points.py": _SUMS,
    "transport/blockers.py": _METHOD,
    "transport/buried.py": _METHOD,
    "transport/channels.py": _SUMS,
    "transport/direct_tensor.py": _METHOD,
    "transport/hits.py": _METHOD,
    "transport/light_clusters.py": _METHOD,
    "transport/light_vectors.py": _WHOLE,
    "transport/light_visibility.py": _WHOLE,
    "transport/lobe_visibility.py": _METHOD,
    "transport/sampling.py": _WHOLE,
    "transport/shading.py": _SUMS,
    "transport/smooth_cuts.py": "lengths and angles, compared",
    "transport/tessellation.py": "midpoints",
    "transport/tracer.py": "declarations",
    "transport/visibility.py": _WHOLE,
}


def cases() -> list[Case]:
    """Every case, in the order of its file."""
    return CASES


def losses() -> list[Loss]:
    """Every case, measured."""
    return [run(one) for one in CASES]


def markdown(rows: Sequence[Loss]) -> str:
    """The rows as a Markdown table."""
    lines: list[tuple[str, ...]] = [HEAD, ("---",) * len(HEAD)]
    for r in rows:
        numbers = (f"{r.largest:.1e}", f"{r.median:.1e}", f"{r.lost:.1f}", f"{r.bound:.1f}")
        lines.append((r.kernel, r.stress, r.storage, *numbers, r.why))
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)
