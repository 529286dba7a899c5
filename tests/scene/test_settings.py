from dataclasses import replace
from pathlib import Path

import pytest

from relightcli.core.brdf.measured import fits
from relightcli.errors import InputError
from relightcli.scene.model import Material
from relightcli.scene.settings import apply_settings

MATERIALS = {
    "gold": Material("gold", "cook-torrance", adjustable=True, specular=(0.9, 0.7, 0.3)),
    "v1.2 skin": Material("v1.2 skin", "translucent", adjustable=True, transmittance=(0.4, 0.4, 0.4)),
    "fixed": Material("fixed"),
    "floor": Material("floor", adjustable=True, diffuse_texture=Path("/tmp/wood.png")),
    "no.1": Material("no.1", "phong", adjustable=True, specular=(0.1, 0.1, 0.1)),
}
FITS = {fit.name: fit for fit in fits()}


def test_parameters_change_in_turn_and_the_rest_stays():
    found = apply_settings(MATERIALS, ["gold.roughness=0.4", "gold.diffuse=0.1, 0.6 ,0.6", "gold.roughness=0.5"])
    assert found["gold"] == Material(
        "gold", "cook-torrance", diffuse=(0.1, 0.6, 0.6), specular=(0.9, 0.7, 0.3), roughness=0.5, adjustable=True
    )
    assert list(found) == list(MATERIALS)
    assert found["fixed"] == MATERIALS["fixed"]
    assert MATERIALS["gold"].roughness == 0.3


def test_nothing_set_changes_nothing():
    assert apply_settings(MATERIALS, []) == MATERIALS


def test_a_name_with_a_dot():
    assert apply_settings(MATERIALS, ["v1.2 skin.diffuse=0,0,0"])["v1.2 skin"].diffuse == (0, 0, 0)


def test_ranges_hold_for_the_result_not_for_each_step():
    found = apply_settings(MATERIALS, ["v1.2 skin.diffuse=0.9,0,0", "v1.2 skin.transmittance=0.1,0,0"])
    assert found["v1.2 skin"].diffuse == (0.9, 0, 0)


def measured(name, fit):
    found = Material(name, "cook-torrance", fit.diffuse, fit.specular, f0=fit.f0, roughness=fit.roughness)
    return replace(found, adjustable=True)


@pytest.mark.parametrize("name", sorted(FITS))
def test_a_measured_material_replaces_all_but_the_texture(name):
    # As in the table: nothing of it is clipped to the range that a scene file has.
    found = apply_settings(MATERIALS, [f"floor={name}"])
    assert found["floor"] == replace(measured("floor", FITS[name]), diffuse_texture=Path("/tmp/wood.png"))
    assert {**found, "floor": MATERIALS["floor"]} == MATERIALS
    assert list(found) == list(MATERIALS)


def test_parameters_of_a_measured_material_change_in_turn():
    chrome = measured("gold", FITS["chrome"])
    after = apply_settings(MATERIALS, ["gold=chrome", "gold.roughness=0.3"])["gold"]
    assert after == replace(chrome, roughness=0.3)
    before = apply_settings(MATERIALS, ["gold.roughness=0.3", "gold=steel", "gold=chrome"])["gold"]
    assert before == chrome
    maple = apply_settings(MATERIALS, ["gold=colonial-maple-223", "gold.f0=0.1"])["gold"]
    assert maple == replace(measured("gold", FITS["colonial-maple-223"]), f0=0.1)


@pytest.mark.parametrize(
    "written", ["blue-metallic-paint2", "Blue Metallic Paint2", " blue_metallic  paint2 ", "BLUE-METALLIC_PAINT2"]
)
def test_spelling_of_measured_materials(written):
    assert apply_settings(MATERIALS, [f"gold={written}"])["gold"] == measured("gold", FITS["blue-metallic-paint2"])


def test_a_material_with_a_dot_in_its_name_becomes_a_measured_one():
    assert apply_settings(MATERIALS, ["no.1=chrome"])["no.1"] == measured("no.1", FITS["chrome"])
    # Where the part before the dot is a material too, the dot separates, as it does for numbers.
    both = {**MATERIALS, "gold.f0": Material("gold.f0", adjustable=True)}
    assert apply_settings(both, ["gold.f0=0.2"])["gold"].f0 == 0.2


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ("gold.roughness", "expected MATERIAL.PARAMETER=VALUE"),
        ("gold.roughness=", "expected MATERIAL.PARAMETER=VALUE"),
        ("", "expected MATERIAL.PARAMETER=VALUE"),
        ("floor=brushed-steel", "no measured material 'brushed-steel'; expected one of alum-bronze, alumina-oxide, "),
        ("floor=Crome", "Did you mean 'chrome'? To change a parameter, give MATERIAL.PARAMETER=VALUE."),
        ("gold=0.4", "no measured material '0.4'"),
        ("flor=chrome", "no material 'flor'; the scene has gold, v1.2 skin, fixed, floor, no.1. Did you mean 'floor'?"),
        ("fixed=chrome", "material 'fixed' is not adjustable"),
        ("v1.2 skin=chrome", "material 'v1.2 skin' is translucent and is lit from both sides"),
        ("gold.=1", "has no parameter ''"),
        (
            "golf.roughness=1",
            "no material 'golf'; the scene has gold, v1.2 skin, fixed, floor, no.1. Did you mean 'gold'?",
        ),
        ("fixed.diffuse=1,1,1", "not adjustable (adjustable: gold, v1.2 skin, floor, no.1)"),
        ("gold.shininess=3", "cook-torrance has no parameter 'shininess'; expected one of diffuse, specular"),
        ("gold.roughnes=3", "Did you mean 'roughness'?"),
        ("gold.model=lambert", "has no parameter 'model'"),
        ("gold.adjustable=0", "has no parameter"),
        ("gold.roughness=a", "expected one number, found 'a'"),
        ("gold.roughness=1,2,3", "expected one number"),
        ("gold.diffuse=0.5", "expected three numbers with commas"),
        ("gold.diffuse=0.5,,1", "expected three numbers"),
        ("gold.roughness=0", "gold.roughness: expected a number from 0.0001 to 10, found 0.0"),
        ("gold.f0=nan", "gold.f0: expected a number from 0 to 1, found nan"),
        ("gold.diffuse=0,0,-1", "gold.diffuse: expected 3 numbers from 0 to 1"),
        ("v1.2 skin.diffuse=0.7,0,0", "at most 1 per colour, found 1.1, 0.4, 0.4"),
    ],
)
def test_refusals(setting, words):
    with pytest.raises(InputError) as caught:
        apply_settings(MATERIALS, [setting])
    assert words in str(caught.value)
    assert str(caught.value).startswith("--set")


def test_a_measured_material_has_the_ranges_of_its_model():
    for wrong in ("gold.shininess=3", "gold.specular=1.2,1,1"):
        with pytest.raises(InputError, match="gold"):
            apply_settings(MATERIALS, ["gold=colonial-maple-223", wrong])
