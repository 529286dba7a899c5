import pytest

from relightcli.errors import InputError
from relightcli.scene.model import Material
from relightcli.scene.settings import apply_settings

MATERIALS = {
    "gold": Material("gold", "cook-torrance", adjustable=True, specular=(0.9, 0.7, 0.3)),
    "v1.2 skin": Material("v1.2 skin", "translucent", adjustable=True, transmittance=(0.4, 0.4, 0.4)),
    "fixed": Material("fixed"),
}


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


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ("gold.roughness", "expected MATERIAL.PARAMETER=VALUE"),
        ("gold.roughness=", "expected MATERIAL.PARAMETER=VALUE"),
        ("", "expected MATERIAL.PARAMETER=VALUE"),
        ("floor=brushed-steel", "BRDF data set stage, which this version does not have"),
        ("golf.roughness=1", "no material 'golf'; the scene has gold, v1.2 skin, fixed. Did you mean 'gold'?"),
        ("fixed.diffuse=1,1,1", "not adjustable (adjustable: gold, v1.2 skin)"),
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
