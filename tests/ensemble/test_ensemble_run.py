"""Ensembles: the bodies that are drawn, the contents of a store, and recovery after a kill."""

import errno
import itertools
import os
import random
import shutil
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import polhode as ph
from polhode import ensemble as ens
from polhode.ensemble._statistics import summarise, tilt
from polhode.ensemble._stream import Block, Job, chunk_sizes

xarray = pytest.importorskip("xarray")
zarr = pytest.importorskip("zarr")
sys.path.insert(0, str(Path(__file__).parent))
from ensemble_case import CHUNK, TS, make

SCRIPT = Path(__file__).with_name("ensemble_case.py")
STATE = ph.State([1.0, 0.0, 0.0, 0.0], [0.1, 1.0, 0.2])
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


class Gain(eqx.Module):
    k: jax.Array

    def __call__(self, t, wxyz, omega_body):
        return -self.k * omega_body


def shared_parts():
    """Scenes with arrays that have no body axis, by the part that contains them."""
    body, t = ph.Inertia.from_moments([1.0, 1.5, 2.0]), np.linspace(0.0, 9.0, 5)
    table = ph.Table(t, np.stack([np.sin(t), np.cos(t), 0 * t + 0.3], -1), order=1)
    rods = ph.MagneticDipole(
        ph.BDot(4e4, 0.2), ph.DipoleField([0, 0, -7.8e22]), ph.KeplerOrbit(3.986e14, 6.9e6)
    )
    torques = rods + ph.Pulses(ph.BodyTorque(table), [0.2, 0.5], [0.3, 0.7])
    wheels = ph.wheel_cluster(np.eye(3), 1e-2, lambda t, q, w: -0.1 * w)
    growing = ph.VariableInertia(ph.Table(t, np.outer(1 + 0.1 * t, [1.0, 1.5, 2.0])))
    return {
        "torques": ph.Scene(body, torque=torques + ph.FeedbackTorque(Gain(jnp.array(0.3)))),
        "wheels": ph.Scene(growing, rotors=wheels),
        "table": ph.Scene(ph.Inertia.spherical(2.0), torque=ph.BodyTorque(table)),
    }


RATES = (ens.SpreadRates(ens.Deviate(jnp.full(3, 0.1))),)


@pytest.mark.parametrize("name", ["torques", "wheels"])
def test_drawn_bodies_share_what_bodies_cannot_differ_in(name):
    scene = shared_parts()[name]
    drawn, state = ens.Ensemble(scene, STATE, 20, RATES).draw(np.arange(3))
    assert state.omega_body.shape == (3, 3)
    leaves = jax.tree.leaves(drawn), jax.tree.leaves(scene)
    assert {x.ndim - own.ndim for x, own in zip(*leaves, strict=True)} == {0, 1}
    for x, own in zip(*leaves, strict=True):
        np.testing.assert_array_equal(x[1] if x.ndim > own.ndim else x, own)


def test_a_store_of_bodies_that_share_a_table(tmp_path):
    scene = shared_parts()["table"]
    ensemble = ens.Ensemble(scene, STATE, np.int64(20), RATES, np.uint32(1))
    moments = ens.Statistic("tilt", tilt, "rad", np.float32(0), np.float64(3), np.int64(8))
    options = {"rtol": np.float64(1e-8), "statistics": [moments]}
    path = ens.stream(ensemble, [0.0, 1.0], tmp_path / "shared.zarr", name="x", **options)
    assert ens.stream(ensemble, [0.0, 1.0], path, name="x", **options) == path
    _, state = ensemble.draw(np.arange(20))
    # a sphere turns by the integral of the torque, which is linear until the second time
    gain = np.asarray(scene.torque.n(0.0) + scene.torque.n(1.0)) / 2 / 2.0
    found = arrays(path)["omega_body"]
    np.testing.assert_allclose(found[:, 1], np.asarray(state.omega_body) + gain, atol=1e-9)


def test_a_spread_of_what_bodies_share_is_refused():
    def later(key, scene, state):
        times = scene.torque.n.times + jax.random.uniform(key)
        return eqx.tree_at(lambda s: s.torque.n.times, scene, times), state

    ensemble = ens.Ensemble(shared_parts()["table"], STATE, 20, (later,))
    with pytest.raises(ValueError, match="changes an array that all bodies share"):
        ensemble.draw(np.arange(3))


@pytest.mark.parametrize("dtype", [pytest.param(jnp.float32, marks=pytest.mark.slow), jnp.float64])
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


def test_chunks_and_parts_change_no_bit(whole, tmp_path):
    wider = ens.stream(make(), TS, tmp_path / "wider.zarr", chunk=3 * CHUNK, statistics=[TILT])
    assert equal(wider, whole)
    parts = tmp_path / "parts.zarr"
    for i in (2, 3, 1):
        ens.stream(make(), TS, parts, chunk=CHUNK, statistics=[TILT], part=(i, 4))
    with pytest.raises(ens.StoreError, match=r"1 of 5 chunks is missing \(3\)"):
        ens.open_store(parts)
    ens.stream(make(), TS, parts, statistics=[TILT], part=(4, 4))
    with pytest.raises(ens.StoreError, match="not reduced yet"):
        ens.open_store(parts)
    reports = []
    ens.stream(make(), TS, parts, statistics=[TILT], progress=reports.append)
    assert reports[0].reused == reports[-1].done == 40_000
    with ens.open_store(parts) as ours, ens.open_store(whole) as theirs:
        xarray.testing.assert_identical(ours.load(), theirs.load())
    with xarray.open_zarr(wider) as ours, xarray.open_zarr(whole) as theirs:
        xarray.testing.assert_identical(ours.tilt_summary_std, theirs.tilt_summary_std)


@pytest.mark.parametrize(("parts", "chunks"), [(1, 1), (2, 3), (5, 5), (9, 5)])
def test_there_is_a_chunk_for_each_part(parts, chunks, tmp_path):
    """If there are enough blocks: 40,000 bodies are five blocks of 8,192."""
    job = Job(make(), TS, tmp_path, None, None, True, (), jax.local_devices()[:1])
    assert -(-40_000 // chunk_sizes(job, None, None, parts).chunk) == chunks


@pytest.mark.slow
def test_parts_that_begin_together_share_a_store(whole, tmp_path):
    path = tmp_path / "parts.zarr"
    command = [sys.executable, str(SCRIPT), str(path), "0"]
    both = [subprocess.Popen([*command, part]) for part in ("1/2", "2/2")]
    assert [child.wait(timeout=300) for child in both] == [0, 0]
    assert [file.name for file in tmp_path.iterdir()] == ["parts.zarr"]
    assert equal(path, whole)


def test_summaries_may_be_written_at_the_same_time(whole, tmp_path):
    """By processes that finish together: each replaces files, and none removes them."""
    path = tmp_path / "both.zarr"
    shutil.copytree(whole, path)
    job = Job(make(), TS, path, None, None, True, (TILT,), jax.local_devices()[:1])
    stores = [job.open(CHUNK) for _ in range(2)]
    values = np.arange(3.0)

    def put(store):
        for _ in range(40):
            store.put("tilt_summary_extra", values, ("time",), "rad")

    with ThreadPoolExecutor(2) as pool:
        list(pool.map(put, stores))
    np.testing.assert_array_equal(zarr.open_array(path / "tilt_summary_extra")[:], values)


def killed(path, k):
    child = subprocess.run([sys.executable, str(SCRIPT), str(path), str(k)], timeout=300)
    assert child.returncode == -signal.SIGKILL


def test_a_kill_costs_the_chunks_in_progress(whole, tmp_path):
    path, k = tmp_path / "killed.zarr", random.randint(1, 15)
    killed(path, -k)
    assert list(tmp_path.rglob("*.partial"))
    (tmp_path / ".killed.zarr.ab12.partial").mkdir()  # left by a process that was killed
    for left in tmp_path.rglob("*.partial"):
        os.utime(left, (0, 0))
    (tmp_path / ".killed.zarr.cd34.partial").mkdir()  # of a process that is still running
    ens.stream(make(), TS, path, chunk=CHUNK)
    assert equal(path, whole), k
    assert [left.name for left in tmp_path.rglob("*.partial")] == [".killed.zarr.cd34.partial"]


@pytest.mark.slow
def test_kills_end_with_the_same_bits(whole, tmp_path):
    for k in random.sample(range(1, 16), 4):
        path = tmp_path / f"{k}.zarr"
        killed(path, k)
        ens.stream(make(), TS, path, chunk=CHUNK)
        assert equal(path, whole), k


def test_other_runs_are_refused(whole, tmp_path):
    before = arrays(whole)
    for change in (make(seed=8), make(rate=0.2), make(bodies=30_000)):
        with pytest.raises(ens.StoreError, match="another run"):
            ens.stream(change, TS, whole, chunk=CHUNK, statistics=[TILT])
    for changed, words in (
        ({"ts": TS * 2}, "numbers"),
        ({"rtol": 1e-6}, "rtol"),
        ({"name": "x"}, "name"),
        ({"statistics": []}, "statistics"),
        ({"attributes": {"scene": "a"}}, "scene: line 1 of the store"),
    ):
        options = {"ts": TS, "path": whole, "statistics": [TILT]} | changed
        with pytest.raises(ens.StoreError, match=words):
            ens.stream(make(), **options)
    (tmp_path / "mine.zarr").mkdir()
    (tmp_path / "mine.zarr" / "letter").write_text("keep")
    with pytest.raises(ens.StoreError, match=r"no store of an ensemble.*zarr\.json"):
        ens.stream(make(), TS, tmp_path / "mine.zarr")
    assert (tmp_path / "mine.zarr" / "letter").read_text() == "keep"
    after = arrays(whole)
    assert all(np.array_equal(before[name], after[name]) for name in before)


def test_own_functions_need_a_name(tmp_path):
    def turned(key, scene, state):
        return scene, ph.State(state.wxyz, 2 * state.omega_body)

    ensemble = make(bodies=64)
    mine = ens.Ensemble(ensemble.scene, ensemble.state, 64, (turned,), 1)
    path = tmp_path / "mine.zarr"
    with pytest.raises(ValueError, match="name="):
        ens.stream(mine, TS, path)
    assert not path.exists()
    ens.stream(mine, TS, path, name="twice the rates")
    with pytest.raises(ens.StoreError, match="name: the store has 'twice the rates'"):
        ens.stream(mine, TS, path, name="thrice the rates")


def test_full_disk_says_so_and_loses_nothing(whole, tmp_path, monkeypatch):
    """The disk is full, or the quota of the user is exceeded."""
    path = tmp_path / "full.zarr"
    replace = Path.replace
    for code in (errno.ENOSPC, errno.EDQUOT):
        count = itertools.count(1)

        def full(self, target, code=code, count=count):
            if "c" in Path(target).parts and next(count) > 5:
                raise OSError(code, os.strerror(code))
            return replace(self, target)

        monkeypatch.setattr(Path, "replace", full)
        with pytest.raises(ens.StoreError, match=r"full: \d of 5 chunks are complete"):
            ens.stream(make(), TS, path, chunk=CHUNK)
    monkeypatch.undo()
    ens.stream(make(), TS, path, chunk=CHUNK)
    assert equal(path, whole)


@pytest.fixture
def disk(tmp_path):
    """A folder on a small separate disk; ``disk(options)`` mounts it again."""
    folder = tmp_path / "disk"
    folder.mkdir()

    def mount(options):
        command = ["mount", "-t", "tmpfs", "-o", options, "tmpfs", str(folder)]
        if subprocess.run(command, capture_output=True).returncode:
            pytest.skip("only root can mount a disk")
        return folder

    yield mount
    subprocess.run(["umount", str(folder)], capture_output=True)


def test_a_disk_that_is_full(whole, disk, tmp_path):
    folder = disk("size=1M")
    with pytest.raises(ens.StoreError, match="full: 0 of 5 chunks"):
        ens.stream(make(), TS, folder / "full.zarr", chunk=CHUNK)
    subprocess.run(["mount", "-o", "remount,size=50M", str(folder)], check=True)
    ens.stream(make(), TS, folder / "full.zarr", chunk=CHUNK)
    assert equal(folder / "full.zarr", whole)


def test_a_folder_that_is_read_only(disk):
    folder = disk("size=50M")
    ens.stream(make(), TS, folder / "half.zarr", chunk=CHUNK, part=(1, 2))
    subprocess.run(["mount", "-o", "remount,ro", str(folder)], check=True)
    with pytest.raises(ens.StoreError, match=r"cannot make the store .*Read-only"):
        ens.stream(make(), TS, folder / "new.zarr")
    with pytest.raises(ens.StoreError, match=r"cannot write to .*Read-only"):
        ens.stream(make(), TS, folder / "half.zarr")
    with xarray.open_zarr(folder / "half.zarr") as data:
        assert (data.status[CHUNK : 2 * CHUNK] == 255).all()
        assert np.isnan(data.wxyz[CHUNK]).all()


def test_bad_sizes_are_refused(tmp_path):
    path = tmp_path / "bad.zarr"
    with pytest.raises(ValueError, match="multiple of the block of 8192"):
        ens.stream(make(), TS, path, chunk=1000)
    with pytest.raises(ValueError, match="too small"):
        ens.stream(make(), TS, path, memory=10_000_000)
    for part in ((0, 2), (3, 2)):
        with pytest.raises(ValueError, match="part must be"):
            ens.stream(make(), TS, path, part=part)
    with pytest.raises(ValueError, match="nothing to store"):
        ens.stream(make(), TS, path, trajectories=False)
    assert not path.exists()


def test_spreads_of_one_name_draw_independently():
    """Two lambdas have the same name, but their draws must differ."""

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


def test_the_tolerance_chooses_the_method():
    """As in ``ph.simulate``: for an rtol near rounding the frequencies of free bodies are
    compensated.
    """
    bodies = ens.Ensemble(ph.Scene(ph.Inertia.from_moments([1.0, 2.0, 3.0])), STATE, 8)
    for rtol in (None, 1e-13):
        block = Block(bodies, np.asarray(TS), None, rtol, True, (), jax.devices()[:1])
        tolerance = {} if rtol is None else {"rtol": rtol}
        want = ph.explain(bodies.scene, bodies.state, TS, **tolerance).method
        assert str(block.method) == str(want)


def test_the_last_bin_holds_its_end():
    """As in ``numpy.histogram``, so that quantiles of values at the upper end are finite."""
    at_end = ens.Statistic("one", lambda t: jnp.ones_like(t.energy), "1", 0.0, 1.0, 4)
    ts = jnp.array([0.0, 1.0])
    states = ph.State(jnp.tile(STATE.wxyz, (4, 1)), jnp.tile(STATE.omega_body, (4, 1)))
    traj = ph.simulate(ph.Scene(ph.Inertia.spherical(1.0)), states, ts)
    counts = summarise(at_end, traj, jnp.ones(4, bool))["histogram"]
    np.testing.assert_array_equal(counts, [[0, 0, 0, 0, 4, 0]] * 2)
