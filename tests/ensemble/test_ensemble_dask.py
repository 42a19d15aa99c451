"""Chunks computed by the workers of a local dask cluster, one of which is killed."""

import os
import signal
import sys
from pathlib import Path

import numpy as np
import pytest

from polhode import ensemble as ens
from polhode.ensemble import _stream

distributed = pytest.importorskip("distributed")
xarray = pytest.importorskip("xarray")
sys.path.insert(0, str(Path(__file__).parent))
from ensemble_case import CHUNK, TS, make

from polhode.ensemble._statistics import tilt

pytestmark = pytest.mark.filterwarnings("ignore")  # warnings when dask starts and stops
TILT = ens.Statistic("tilt", tilt, "rad", 0.0, 3.2, 64)


def same(a, b):
    with ens.open_store(a) as ours, ens.open_store(b) as theirs:
        xarray.testing.assert_identical(ours.load(), theirs.load())


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    path = tmp_path_factory.mktemp("whole") / "whole.zarr"
    return ens.stream(make(), TS, path, chunk=CHUNK, statistics=[TILT], name="dask")


def test_an_active_client_computes_the_chunks(whole, tmp_path):
    """Its worker is a thread of this process, which starts immediately."""
    path, reports = tmp_path / "client.zarr", []
    options = {"dashboard_address": None, "processes": False, "n_workers": 1}
    with distributed.LocalCluster(threads_per_worker=2, **options) as cluster:
        with distributed.Client(cluster):
            ens.stream(
                make(),
                TS,
                path,
                chunk=CHUNK,
                statistics=[TILT],
                name="dask",
                progress=reports.append,
            )
        _stream._build.cache_clear()
    assert reports[-1].done == 40_000
    assert len(reports) == 6
    same(path, whole)


def test_mapped_rows_are_sent_as_the_name_of_their_file(tmp_path):
    rows = np.random.default_rng(0).normal(size=(50, 3))
    np.save(tmp_path / "rows.npy", rows)
    np.save(tmp_path / "columns.npy", np.asfortranarray(rows))
    for name in ("rows", "columns"):
        mapped = np.load(tmp_path / f"{name}.npy", mmap_mode="r")
        reference = _stream._reference(mapped)
        assert isinstance(reference[0], Path)
        np.testing.assert_array_equal(_stream._dereference(reference), rows)
    np.testing.assert_array_equal(_stream._reference(mapped[7:]), rows[7:])
    np.testing.assert_array_equal(_stream._reference(rows), rows)


def test_no_scheduler_at_the_address(tmp_path):
    import dask

    with (
        dask.config.set({"distributed.comm.timeouts.connect": "100ms"}),
        pytest.raises(ens.StoreError, match="no dask scheduler answers at"),
    ):
        ens.stream(make(), TS, tmp_path / "a.zarr", scheduler="tcp://127.0.0.1:1")
    assert not (tmp_path / "a.zarr").exists()


def test_the_command_names_the_scheduler_that_does_not_answer(tmp_path, capsys, monkeypatch):
    import dask

    from polhode.cli import main

    monkeypatch.chdir(tmp_path)
    Path("many.toml").write_text("""
inertia = { axisymmetric = { transverse = 1.0, axial = 1.5 } }
state = { omega_body = [0.5, 0.2, 3.0] }
times = { stop = 2.0, number = 5 }
ensemble = { bodies = 20, seed = 1, attitude = { any = true } }
""")
    with dask.config.set({"distributed.comm.timeouts.connect": "100ms"}):
        assert main(["run", "many.toml", "--scheduler", "tcp://127.0.0.1:1"]) == 1
    assert "no dask scheduler answers at tcp://127.0.0.1:1" in capsys.readouterr().err
    assert not Path("many.zarr").exists()


@pytest.mark.slow
def test_a_worker_that_is_killed_changes_no_bit(whole, tmp_path):
    """Two worker processes, the address of the scheduler, and a function of this module; one worker
    is killed after the first chunk.
    """
    path, killed = tmp_path / "killed.zarr", []
    options = {"dashboard_address": None, "n_workers": 2, "threads_per_worker": 1}
    with distributed.LocalCluster(**options) as cluster:
        pids = [worker.process.pid for worker in cluster.workers.values()]

        def progress(report):
            if report.done and not killed:
                killed.append(pids[0])
                os.kill(pids[0], signal.SIGKILL)

        ens.stream(
            make(),
            TS,
            path,
            chunk=CHUNK,
            statistics=[TILT],
            name="dask",
            scheduler=cluster.scheduler_address,
            progress=progress,
        )
    assert killed
    same(path, whole)
