"""Stores open in xarray as they are: names, units, values; nothing is decoded behind the reader's back."""

from pathlib import Path

import numpy as np
import pytest

from tests.formats.jobs import run, values

xarray = pytest.importorskip("xarray")


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("xarray") / "store.zarr"
    run(path)
    return path


def test_a_group_opens_with_names_units_and_values(store: Path) -> None:
    with xarray.open_zarr(store, group="direct", consolidated=False) as data:
        transfer = data["transfer"]
        assert transfer.dims == ("V", "L")
        assert transfer.attrs["units"] == "sr"
        assert transfer.dtype == np.float32
        np.testing.assert_array_equal(transfer.values, values())


def test_the_root_carries_the_header(store: Path) -> None:
    with xarray.open_zarr(store, consolidated=False) as data:
        assert data.attrs["relight"]["kind"] == "test"
        assert "solid angle" in data.attrs["relight"]["conventions"]["cube_map"]
        assert data.attrs["scene"] == {"name": "test"}


def test_the_whole_store_opens_as_a_tree(store: Path) -> None:
    with xarray.open_datatree(store, engine="zarr", consolidated=False) as tree:
        assert tree["geometry/points"].attrs["units"] == "m"
        np.testing.assert_array_equal(tree["direct/transfer"].values, values())
