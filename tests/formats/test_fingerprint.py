"""Fingerprints: one value, one fingerprint."""

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from relight_formats import canonical_json, fingerprint_file, fingerprint_json

VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=12,
)


def test_known_values(tmp_path: Path) -> None:
    # SHA-256 of the empty message and of "abc": FIPS 180-4, examples.
    file = tmp_path / "file"
    file.write_bytes(b"")
    assert fingerprint_file(file) == "sha256:e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855"
    file.write_bytes(b"abc")
    assert fingerprint_file(file) == "sha256:ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"


def test_canonical_spelling() -> None:
    assert canonical_json({"b": (1, 1.0), "a": np.float32(0.5), "ä": None}) == '{"a":0.5,"b":[1,1.0],"\\u00e4":null}'


@given(VALUES)
def test_reading_and_spelling_again_changes_nothing(value: object) -> None:
    text = canonical_json(value)
    assert canonical_json(json.loads(text)) == text


@given(VALUES, VALUES)
def test_different_values_have_different_fingerprints(first: object, second: object) -> None:
    same = canonical_json(first) == canonical_json(second)
    assert (fingerprint_json(first) == fingerprint_json(second)) is same


def test_key_order_does_not_count() -> None:
    assert fingerprint_json({"a": 1, "b": 2}) == fingerprint_json({"b": 2, "a": 1})


@pytest.mark.parametrize("bad", [float("nan"), [float("inf")], {"x": -np.inf}, np.array([np.nan])])
def test_what_is_not_finite_is_refused(bad: object) -> None:
    with pytest.raises(ValueError, match="finite"):
        fingerprint_json(bad)


def test_a_missing_file_is_a_system_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        fingerprint_file(tmp_path / "nothing")
