"""The examples and schemas that ship with the specification."""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from relight_formats import StoreError, dequantise, open_store, unpack_bits
from tests.formats.jobs import array_files
from tests.formats.json_schema import violations

FORMATS = Path(__file__).resolve().parents[2] / "formats"
SMALL = FORMATS / "examples/valid/small"


def load(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"formats_examples_{name}", FORMATS / f"examples/{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


INVALID = load("invalid")
VALID = sorted(folder for folder in (FORMATS / "examples/valid").iterdir() if folder.is_dir())


def schema_violations(store: Path) -> list[str]:
    found = []
    for file in sorted(store.rglob("zarr.json")):
        document = json.loads(file.read_bytes())
        place = str(file.relative_to(store))
        if place == "zarr.json":
            kind = "root"
        elif place == "ledger/zarr.json":
            kind = "ledger"
        elif document["node_type"] == "array":
            kind = "array"
        else:
            assert document == {"zarr_format": 3, "node_type": "group", "attributes": {}}
            continue
        schema = json.loads((FORMATS / f"schema/{kind}.schema.json").read_bytes())
        found += [f"{place} {line}" for line in violations(document, schema)]
    return found


@pytest.mark.parametrize("store", VALID, ids=lambda p: p.name)
def test_valid_examples_open_verify_and_match_the_schemas(store: Path) -> None:
    assert open_store(store).verify() == []
    assert schema_violations(store) == []


def test_the_small_example_reads_as_it_was_written() -> None:
    store = open_store(SMALL, kind="example")
    counted = np.arange(60).reshape(6, 10)
    np.testing.assert_array_equal(store.read("geometry/position"), np.arange(18).reshape(6, 3) / 2)
    assert store.read("geometry/faces").shape == (0, 3)
    assert store.read("geometry/scale") == 1.5
    bits = store.array("direct/visibility").attrs["bits"]
    assert isinstance(bits, int)
    visible = unpack_bits(store.read("direct/visibility"), bits)
    np.testing.assert_array_equal(visible, counted % 3 > 0)
    group, _, name = "direct/transfer".rpartition("/")
    scale = store.read(f"{group}/{store.array(f'{group}/{name}').attrs['scale']}")
    values = dequantise(store.read("direct/transfer"), scale[:, np.newaxis])
    # Half a scale, which is a 255th of the largest value of each row.
    assert (np.abs(values - counted / 2) <= scale[:, np.newaxis] * 0.5001).all()


def test_the_program_still_writes_the_small_example(tmp_path: Path) -> None:
    load("build").build(tmp_path / "small")
    assert schema_violations(tmp_path / "small") == []
    # Compressed bytes may change with the compression libraries; names, metadata and values may not.
    old, new = open_store(SMALL), open_store(tmp_path / "small")
    assert array_files(SMALL).keys() == array_files(tmp_path / "small").keys()
    assert old.ledger["documents"] == new.ledger["documents"]
    for name in old.names():
        np.testing.assert_array_equal(old.read(name), new.read(name))


@pytest.mark.parametrize("name", INVALID.DEFECTS)
def test_invalid_examples_are_refused_for_what_their_name_says(tmp_path: Path, name: str) -> None:
    store, defect = tmp_path / "store", INVALID.DEFECTS[name]
    INVALID.make(name, SMALL, store)
    if defect.found_by == "open":
        with pytest.raises(StoreError) as error:
            open_store(store)
        said = str(error.value)
    else:
        problems = open_store(store).verify()
        assert problems
        said = "\n".join(problems)
    assert defect.words in said
    assert str(store) in said


@pytest.mark.parametrize(
    "name",
    [
        "format-newer",
        "format-is-text",
        "settings-have-wrong-type",
        "input-is-no-fingerprint",
        "no-commit-mark",
        "ledger-has-wrong-type",
        "ledger-names-a-path-outside",
        "codec-pickle",
        "codec-without-checksum",
        "data-type-text",
        "dimension-names-missing",
        "units-missing",
        "shape-negative",
        "unknown-metadata-key",
    ],
)
def test_the_schemas_refuse_what_the_reader_refuses(tmp_path: Path, name: str) -> None:
    INVALID.make(name, SMALL, tmp_path / "store")
    assert schema_violations(tmp_path / "store") != []


def test_the_checker_of_schemas_can_say_no() -> None:
    schema: dict[str, Any] = {
        "type": "object",
        "required": ["a"],
        "properties": {"a": {"type": "integer", "minimum": 0}},
    }
    assert violations({"a": 1}, schema) == []
    wrong: list[Any] = [[], {}, {"a": -1}, {"a": True}, {"a": "1"}]
    for bad in wrong:
        assert violations(bad, schema) != []
