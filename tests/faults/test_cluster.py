"""On a Dask cluster as locally: interrupted, continued, a worker killed midway, and the bytes are the same."""

from __future__ import annotations

import signal

import pytest

from tests.faults import harness
from tests.run.cluster import Cluster

pytest.importorskip("distributed", reason="Dask is not installed: pip install 'relightcli[cluster]'")


@pytest.fixture
def cluster(tmp_path):
    cluster = Cluster(tmp_path)
    cluster.heal()
    yield cluster
    cluster.close()


def test_interrupted_and_with_a_worker_killed_midway(undisturbed, folder, cluster):
    command = (*harness.PRECOMPUTE, "-o", "t.zarr", "--scheduler", cluster.address)
    process = harness.start(folder, *command)
    harness.wait_for_blocks(process, folder / "t.zarr", 1)
    process.send_signal(signal.SIGINT)
    code, stderr = harness.finish(process)
    assert (code, "run the same command again to continue" in stderr) == (130, True), stderr
    done = harness.blocks_done(folder / "t.zarr")
    process = harness.start(folder, *command)
    harness.wait_for_blocks(process, folder / "t.zarr", done + 1)
    cluster.workers[0].kill()
    code, stderr = harness.finish(process)
    assert code == 0, stderr
    assert "distributed" not in stderr  # the library's own log
    assert harness.content(folder / "t.zarr") == harness.content(undisturbed)
