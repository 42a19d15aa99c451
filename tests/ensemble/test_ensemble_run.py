"""Ensembles: what a body is, what a store holds, and what is left after a kill."""

import errno
import os
import socket
import subprocess
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import polhode as ph
from polhode import ensemble as ens
from polhode.ensemble import _store
from polhode.ensemble._statistics import tilt

xarray = pytest.importorskip("xarray")
zarr = pytest.importorskip("zarr")
sys.path.insert(0, str(Path(__file__).parent))
from ensemble_case import CHUNK, TS, make

SCRIPT = Path(__file__).with_name("ensemble_case.py")
TILT = ens.Statistic("tilt", tilt, "rad", 0.0, 3.2, 64)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    path = tmp_path_factory.mktemp("whole") / "whole.zarr"
    return ens.stream(make(), TS, path, chunk=CHUNK, statistics=[TILT])


def arrays(path):
    with xarray.open_zarr(path) as data:
        return {name: data[name].values for name in ("wxyz", "omega_body", "status")}


def equal(a, b):
    a, b = arrays(a), arrays(b)
    return all(np.array_equal(a[name], b[name]) for name in a)


def test_a_body_depends_on_its_index_alone():
    ensemble = make()
    _, few = ensemble.draw(np.array([39_999, 3]))
    _, many = ensemble.draw(np.arange(8))
    np.testing.assert_array_equal(few.wxyz[1], many.wxyz[3])
    np.testing.assert_array_equal(few.omega_body[1], many.omega_body[3])
    _, other = make(seed=8).draw(np.arange(8))
    assert not np.any(np.asarray(other.wxyz) == np.asarray(many.wxyz))


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_draws_have_the_distribution_asked_for(dtype):
    scene = ph.Scene(ph.Inertia.from_moments(jnp.array([1.0, 2.0, 2.9], dtype)))
    state = ph.State(jnp.array([1.0, 0, 0, 0], dtype), jnp.array([0.1, 1.0, 0.2], dtype))
    turns = ens.SpreadAttitude(ens.Deviate(jnp.array([0.0, 0.0, 0.5], dtype), uniform=True))
    moments = ens.SpreadMoments(ens.Deviate(jnp.full(3, 0.05, dtype)))
    rates = ens.SpreadRates(ens.Deviate(jnp.array([0.0, 0.3, 0.1], dtype)))
    n = 40_000
    drawn, at = ens.Ensemble(scene, state, n, (moments, turns, rates), 1).draw(np.arange(n))
    m = np.asarray(drawn.inertia.moments)
    assert m.dtype == dtype
    assert np.all(2 * m.max(axis=1) <= m.sum(axis=1))  # about a third of the raw draws break this
    omega = np.asarray(at.omega_body)
    np.testing.assert_array_equal(omega[:, 0], dtype(0.1))
    # five standard errors of mean and standard deviation
    assert abs(omega[:, 1].mean() - 1) < 5 * 0.3 / n**0.5
    assert abs(omega[:, 1].std() - 0.3) < 5 * 0.3 / (2 * n) ** 0.5
    angle = 2 * np.arctan2(np.asarray(at.wxyz[:, 3]), np.asarray(at.wxyz[:, 0]))
    assert abs(angle).max() <= 0.5 * (1 + 1e-6)
    assert abs(angle.var() - 0.5**2 / 3) < 0.003
    _, even = ens.Ensemble(scene, state, n, (ens.AnyAttitude(),), 1).draw(np.arange(n))
    q = np.asarray(even.wxyz)
    np.testing.assert_allclose(q.T @ q / n, np.eye(4) / 4, atol=0.006)


def test_arrays_are_cut_by_index():
    n = 50
    rates = np.random.default_rng(0).normal(size=(n, 3))
    scene = ph.Scene(ph.Inertia.from_moments([1.0, 2.0, 2.5]))
    ensemble = ens.Ensemble(scene, ph.State([1.0, 0, 0, 0], rates), n)
    _, state = ensemble.draw(np.array([7, 3]))
    np.testing.assert_array_equal(state.omega_body, rates[[7, 3]])
    with pytest.raises(ValueError, match="leading axis"):
        ens.Ensemble(scene, ph.State([1.0, 0, 0, 0], rates), n + 1)


def test_store_holds_what_simulate_gives(whole):
    picked = np.array([0, 8191, 8192, 39_999])
    expected = ph.simulate(*make().draw(picked), TS)
    with xarray.open_zarr(whole) as data:
        assert dict(data.wxyz.sizes) == {"body": 40_000, "time": 3, "quaternion": 4}
        assert data.omega_body.attrs["units"] == "rad s-1"
        assert data.wxyz.encoding["chunks"] == (CHUNK, 3, 4)
        np.testing.assert_allclose(data.wxyz[picked], expected.wxyz, atol=1e-13)
        np.testing.assert_allclose(data.omega_body[picked], expected.omega_body, atol=1e-13)
        assert not data.status.values.any()


def test_statistics_are_those_of_the_trajectories(whole):
    with xarray.open_zarr(whole) as data:
        w, x, y, z = np.moveaxis(data.wxyz.values, -1, 0)
        tilts = np.arccos(w * w - x * x - y * y + z * z)
        np.testing.assert_allclose(data.tilt_summary_mean, tilts.mean(axis=0), rtol=1e-12)
        np.testing.assert_allclose(data.tilt_summary_std, tilts.std(axis=0), rtol=1e-12)
        np.testing.assert_allclose(data.tilt_summary_max, tilts.max(axis=0), rtol=1e-7)
        for k in range(3):
            counts, _ = np.histogram(tilts[:, k], TILT.edges)
            assert np.abs(data.tilt_summary_histogram.values[k, 1:-1] - counts).max() <= 1
        exact = np.quantile(tilts, data["quantile"].values, axis=0)
        np.testing.assert_allclose(data.tilt_quantiles, exact, atol=3.2 / 64)


@pytest.mark.slow
def test_processes_meet_one_dies_and_the_rest_is_made_good(whole, tmp_path):
    """Two processes under jax.distributed, one killed after its first chunk; then a damaged and a
    lost file, and one process that does what is missing.
    """
    path, begun = tmp_path / "killed.zarr", tmp_path / "begun"
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    base = os.environ | {"JAX_COORDINATOR_ADDRESS": address, "JAX_NUM_PROCESSES": "2"}
    both = [
        subprocess.Popen(
            [sys.executable, str(SCRIPT), str(path), kill, f"{begun}{process}"],
            env=base | {"JAX_PROCESS_ID": str(process)},
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )
        for process, kill in enumerate(("0", "8192"))
    ]  # fmt: skip
    (told, errors), (_, other) = (p.communicate(timeout=300) for p in both)
    assert [p.returncode for p in both] == [0, -9], errors + other
    # the dead one had one chunk of two; whether its fellow ended later is up to the system
    assert told in ("", "process 1 of 2 is not running and 1 of its 2 chunks are missing: give its"
                    " command again.\n")  # fmt: skip
    chunks = [int(n) for k in (0, 1) for n in Path(f"{begun}{k}").read_text().split()]
    assert sorted(chunks) == [0, 1, 2, 4]
    with open(path / "wxyz" / "c" / "1" / "0" / "0", "r+b") as file:
        file.seek(5000)
        file.write(b"damage")
    os.remove(path / "omega_body" / "c" / "4" / "0" / "0")
    reports, words = [], []
    ens.stream(
        make(), TS, path, chunk=CHUNK, process=0, processes=2, progress=reports.append,
        warn=words.append,
    )  # fmt: skip
    assert words == ["process 1 of 2 is not running and 1 of its 2 chunks are missing: give its"
                     " command again."]  # fmt: skip
    assert (reports[0].reused, reports[-1].reused) == (40_000 - 2 * 8192, 2 * 8192)
    ens.stream(make(), TS, path, chunk=CHUNK, progress=reports.append)
    assert reports[-1].reused == 40_000 - 2 * 8192  # chunk 3 was missing, chunk 1 damaged
    assert reports[-1].done == 40_000
    assert equal(path, whole)


def test_chunks_and_processes_change_no_bit(whole, tmp_path):
    wider = ens.stream(make(), TS, tmp_path / "wider.zarr", chunk=3 * CHUNK)
    assert equal(wider, whole)
    shared = tmp_path / "shared.zarr"
    for process in (2, 0, 3, 1):
        ens.stream(
            make(), TS, shared, chunk=CHUNK, statistics=[TILT], process=process, processes=4,
            warn=lambda _: None,
        )  # fmt: skip
    assert equal(shared, whole)
    with xarray.open_zarr(shared) as ours, xarray.open_zarr(whole) as theirs:
        xarray.testing.assert_identical(ours.tilt_summary_std, theirs.tilt_summary_std)


def test_kills_cost_one_chunk_each(whole, tmp_path):
    """A process is killed twice, each time in a chunk that it has just begun."""
    path, begun = tmp_path / "killed.zarr", tmp_path / "begun"
    command = [sys.executable, str(SCRIPT), str(path), "0", str(begun)]
    for k in (1, 2):
        child = subprocess.Popen(command)
        while not begun.exists() or len(begun.read_text().split()) < 2 * k - 1:
            assert child.poll() is None
            time.sleep(0.001)
        child.kill()
        child.wait()
    reports = []
    ens.stream(make(), TS, path, chunk=CHUNK, progress=reports.append)
    finished = reports[0].reused // CHUNK
    assert finished >= 1
    assert len(begun.read_text().split()) <= finished + 2
    assert equal(path, whole)


def test_other_runs_are_refused(whole, tmp_path):
    before = arrays(whole)
    for change in (make(seed=8), make(rate=0.2), make(bodies=30_000)):
        with pytest.raises(ens.StoreError, match="another run"):
            ens.stream(change, TS, whole, chunk=CHUNK, statistics=[TILT])
    with pytest.raises(ens.StoreError, match="scene"):
        ens.stream(make(), TS * 2, whole, chunk=CHUNK, statistics=[TILT])
    with (
        _store.locked(whole, 0, 1),
        pytest.raises(ens.StoreError, match="in use by another run"),
    ):
        ens.stream(make(), TS, whole, chunk=CHUNK, statistics=[TILT])
    with (
        _store.locked(whole, 1, 2),
        pytest.raises(ens.StoreError, match="another process 1"),
    ):
        ens.stream(make(), TS, whole, statistics=[TILT], process=1, processes=2)
    (tmp_path / "mine.zarr").mkdir()
    (tmp_path / "mine.zarr" / "letter").write_text("keep")
    with pytest.raises(ens.StoreError, match="no store of an ensemble"):
        ens.stream(make(), TS, tmp_path / "mine.zarr")
    assert (tmp_path / "mine.zarr" / "letter").read_text() == "keep"
    after = arrays(whole)
    assert all(np.array_equal(before[name], after[name]) for name in before)


def test_full_disk_says_so_and_loses_nothing(whole, tmp_path, monkeypatch):
    path = tmp_path / "full.zarr"
    synced = _store.Store._sync
    calls = []

    def sync(self, name, array, chunk):
        calls.append(name)
        if len(calls) > 5:
            raise OSError(errno.ENOSPC, "No space left on device")
        synced(self, name, array, chunk)

    monkeypatch.setattr(_store.Store, "_sync", sync)
    with pytest.raises(ens.StoreError, match="full: 1 of 5 chunks"):
        ens.stream(make(), TS, path, chunk=CHUNK)
    monkeypatch.undo()
    ens.stream(make(), TS, path, chunk=CHUNK)
    assert equal(path, whole)


def test_bad_sizes_are_refused(tmp_path):
    path = tmp_path / "bad.zarr"
    with pytest.raises(ValueError, match="multiple of the block of 8192"):
        ens.stream(make(), TS, path, chunk=1000)
    with pytest.raises(ValueError, match="too small"):
        ens.stream(make(), TS, path, memory=10_000_000)
    with pytest.raises(ValueError, match="process must be"):
        ens.stream(make(), TS, path, process=2, processes=2)
    with pytest.raises(ValueError, match="nothing to keep"):
        ens.stream(make(), TS, path, trajectories=False)
    assert not path.exists()


def test_spreads_of_one_name_draw_independently():
    """Two lambdas share their name; their draws must not be the same numbers."""

    def shifted(axis):
        def spread(key, scene, state):
            push = jax.random.normal(key, dtype=state.omega_body.dtype)
            return scene, ph.State(state.wxyz, state.omega_body.at[axis].add(push))

        return spread

    scene = ph.Scene(ph.Inertia.from_moments([1.0, 1.5, 2.0]))
    state = ph.State([1.0, 0, 0, 0], [0.0, 0.0, 0.0])
    bodies = ens.Ensemble(scene, state, 200, (shifted(0), shifted(1)), seed=3)
    _, drawn = bodies.draw(jnp.arange(200))
    x, y = np.asarray(drawn.omega_body[:, :2]).T
    assert abs(np.corrcoef(x, y)[0, 1]) < 0.3
    alone = ens.Ensemble(scene, state, 200, (shifted(0),), seed=3)
    _, first = alone.draw(jnp.arange(200))
    np.testing.assert_array_equal(first.omega_body[:, 0], x)
