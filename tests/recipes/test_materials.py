"""docs/materials.md is in step with the data."""

from relightcli.core.brdf.measured import fits


def test_the_table_lists_every_measured_material(root):
    def colour(values):
        return ", ".join(f"{v:.4f}" for v in values)

    expected = [
        f"| {fit.name} | {colour(fit.diffuse)} | {colour(fit.specular)} | {fit.f0:g} | {fit.roughness:g} |"
        for fit in sorted(fits(), key=lambda fit: fit.name)
    ]
    lines = (root / "docs" / "materials.md").read_text().splitlines()
    start = lines.index("| name | diffuse | specular | f0 | roughness |")
    assert lines[start + 2 :] == expected
