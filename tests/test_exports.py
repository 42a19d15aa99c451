"""Export of trajectories: labels in xarray, SciPy's rotations, CCSDS messages."""

from datetime import datetime, timedelta
from fractions import Fraction

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import polhode as ph

SCENE = ph.Scene(ph.Inertia.from_moments([1.0, 2.0, 2.5]))
STATE = ph.State([0.9, 0.1, 0.2, 0.3], jnp.array([[0.1, 0.2, 0.3], [0.4, -0.1, 0.2]]))
FIELDS = {"object_name": ["ONE", "TWO B"], "object_id": ["2020-224A", "2020-224B"]}


@pytest.fixture(scope="module")
def traj():
    return ph.simulate(SCENE, STATE, jnp.array([0.0, 1.5, 4.0]))


def test_bodies_have_labels(traj):
    pytest.importorskip("xarray")
    named = traj.to_xarray(labels=["first", "second"])
    np.testing.assert_array_equal(named.wxyz.sel(body="second"), traj.wxyz[1])
    assert "body" not in traj.to_xarray().coords
    for labels in (["one"], ["a", "b", "c"]):
        with pytest.raises(ValueError, match="labels name"):
            traj.to_xarray(labels)
    with pytest.raises(ValueError, match="labels name"):
        traj[0].to_xarray(["one"])


def test_a_dataset_has_the_times_of_every_body(traj):
    pytest.importorskip("xarray")
    shared = eqx.tree_at(lambda t: t.ts, traj, traj.ts[None])  # one row of times for all bodies
    data = shared.to_xarray()
    np.testing.assert_array_equal(data.ts.sel(body=1), traj.ts)


def test_the_unit_of_the_error_is_that_of_attitudes_or_of_rates_alone(traj):
    pytest.importorskip("xarray")
    for wxyz, unit in ((traj.wxyz, "rad"), (None, "1")):
        recorded = ph.Trajectory(
            traj.ts,
            wxyz,
            traj.omega_body,
            traj.status,
            traj.steps,
            traj.scene,
            error=jnp.zeros(2),
        )
        assert recorded.to_xarray().error.attrs["units"] == unit


def test_scipy_there_and_back(traj):
    turned = traj[1].to_scipy()
    pointing = ph.rotation.rotate(traj.wxyz[1], jnp.array([[0.0, 0, 1]]))
    np.testing.assert_allclose(turned.apply([0, 0, 1]), pointing)
    back = ph.State(turned, traj.omega_body[1])
    assert float(ph.rotation.angle_between(back.wxyz, traj.wxyz[1]).max()) < 1e-15
    assert ph.State(turned, np.zeros(3, np.float32)).wxyz.dtype == np.float32
    assert len(traj.to_scipy()) == 6
    lost = eqx.tree_at(lambda t: t._wxyz, traj, traj.wxyz.at[0].set(jnp.nan))
    with pytest.raises(ValueError, match="3 attitudes are NaN"):
        lost.to_scipy()


def parsed(text):
    """Header, and (metadata, rows) of each segment, by the rules of section 4 of the standard."""
    head, segments, data, where = {}, [], [], "head"
    for line in filter(None, map(str.strip, text.splitlines())):
        if line == "META_START":
            where, meta = "meta", {}
        elif line in ("META_STOP", "DATA_STOP"):
            where = "between"
        elif line == "DATA_START":
            where, data = "data", []
            segments.append((meta, data))
        elif where == "data":
            data.append(line.split())
        else:
            key, _, value = line.partition(" = ")
            (head if where == "head" else meta)[key] = value
    return head, segments


def test_a_message_of_the_ccsds_holds_the_motion(traj, tmp_path):
    """Read back by the standard; A2B maps components in space to components in the body."""
    path = tmp_path / "bodies.aem"
    traj.to_aem(path, "2029-04-13T21:46:00.25", **FIELDS, center_name="EARTH")
    head, segments = parsed(path.read_text("ascii"))
    assert list(head) == ["CCSDS_AEM_VERS", "CREATION_DATE", "ORIGINATOR"]
    assert head["CCSDS_AEM_VERS"] == "2.0"
    order = [
        "OBJECT_NAME",
        "OBJECT_ID",
        "CENTER_NAME",
        "REF_FRAME_A",
        "REF_FRAME_B",
        "TIME_SYSTEM",
        "START_TIME",
        "STOP_TIME",
        "ATTITUDE_TYPE",
        "ANGVEL_FRAME",
    ]
    vector = np.array([0.3, -0.5, 0.8])
    assert len(segments) == 2
    for k, (meta, rows) in enumerate(segments):
        assert list(meta) == order
        assert (meta["OBJECT_NAME"], meta["OBJECT_ID"]) == (
            FIELDS["object_name"][k],
            FIELDS["object_id"][k],
        )
        assert meta["START_TIME"] == "2029-04-13T21:46:00.250000000"
        assert meta["STOP_TIME"] == rows[-1][0] == "2029-04-13T21:46:04.250000000"
        numbers = np.array([[float(x) for x in row[1:]] for row in rows])
        np.testing.assert_allclose(np.deg2rad(numbers[:, 4:]), traj.omega_body[k], rtol=1e-15)
        q1, q2, q3, qc = numbers[:, :4].T
        x, y, z = vector  # the first row of the matrix of the standard's annex, A to B
        first = (
            (q1**2 - q2**2 - q3**2 + qc**2) * x
            + 2 * (q1 * q2 + q3 * qc) * y
            + 2 * (q1 * q3 - q2 * qc) * z
        )
        want = Rotation.from_quat(np.asarray(traj.wxyz[k])[:, [1, 2, 3, 0]]).inv().apply(vector)
        np.testing.assert_allclose(first, want[:, 0], rtol=1e-14)


def test_messages_that_nobody_could_read_are_not_written(traj, tmp_path):
    path = tmp_path / "no.aem"
    for fields, match in (
        (FIELDS | {"object_id": ["one"]}, "each of 2 bodies"),
        (FIELDS | {"time_system": "CET"}, "time_system"),
        (FIELDS | {"originator": "a\nb"}, "originator"),
        (FIELDS | {"frame": ""}, "frame"),
        (FIELDS | {"creation_date": "today"}, "creation_date"),
    ):
        with pytest.raises(ValueError, match=match):
            traj.to_aem(path, "2029-04-13T21:46:00", **fields)
    for epoch in ("13 April", "2029-13-01T00:00:00", 0):
        with pytest.raises(ValueError, match="epoch"):
            traj.to_aem(path, epoch, **FIELDS)
    assert not path.exists()


def test_messages_of_other_centuries(traj, tmp_path):
    """Nanoseconds in 64 bits represent the years 1678 to 2262 only, and overflow."""
    path, start = tmp_path / "far.aem", "START_TIME = "
    shift = float(traj.ts[0])
    for epoch in ("2300-01-01T00:00:00", "1600-02-28T23:59:59", "0001-01-01T00:00:00.5"):
        traj.to_aem(path, epoch, **FIELDS)
        begun = next(x for x in path.read_text().splitlines() if x.startswith(start))
        expected = datetime.fromisoformat(epoch) + timedelta(seconds=shift)
        assert datetime.fromisoformat(begun.removeprefix(start)) == expected

    scene = ph.Scene(ph.Inertia.from_moments([1.0, 1.6, 2.2]))
    slow = ph.State([1.0, 0, 0, 0], [3e-10, 1e-9, -4e-10])
    fields = {"object_name": "X", "object_id": "1"}
    for seconds in (8e9, 1e10, -2e10):
        ts = np.sort([0.0, seconds])
        ph.simulate(scene, slow, ts).to_aem(path, "2029-01-01T00:00:00", **fields)
        times = [x.split(" = ")[1] for x in path.read_text().splitlines() if "_TIME = " in x]
        expected = [datetime(2029, 1, 1) + timedelta(seconds=x) for x in ts.tolist()]
        assert [datetime.fromisoformat(x) for x in times] == expected
    late = eqx.tree_at(lambda t: t.ts, traj, 1e10 + jnp.array([0.0, 0.999, 2.0]))
    late.to_aem(path, "2029-01-01T00:00:00", **FIELDS)
    exact = round(Fraction(float(late.ts[1]) - 1e10) * 10**9)  # [ns], of the double
    assert f":40.{exact} " in path.read_text()
    with pytest.raises(ValueError, match="years 0 to 9999"):
        ph.simulate(scene, slow, [0.0, 1e12]).to_aem(path, "2029-01-01T00:00:00", **fields)
    with pytest.raises(ValueError, match="object_name"):
        traj.to_aem(path, "2029-01-01T00:00:00", **FIELDS | {"object_name": 3})
    for empty in (traj[:0], traj[..., 1:1]):
        with pytest.raises(ValueError, match="one body and one sample or more"):
            empty.to_aem(path, "2029-01-01T00:00:00", **FIELDS)


def test_wheels_are_exported():
    pytest.importorskip("xarray")
    wheel = ph.Rotor(axis_body=[0, 0, 1.0], inertia=0.05, momentum=0.3, torque=0.02)
    scene = ph.Scene(
        ph.Inertia.from_moments([1.0, 1.6, 2.2]), torque=ph.LinearDamping(0.1), rotors=wheel
    )
    state = ph.State([1.0, 0, 0, 0], [0.3, 1, -0.4])
    traj = ph.simulate(scene, state, np.linspace(0, 2, 5), record=ph.Record(work=True))
    data = traj.to_xarray()
    assert data["wheel_speed"].dims == data["motor_work"].dims == ("time", "wheel")
    np.testing.assert_array_equal(data["wheel_speed"], traj.wheel_speed)
    np.testing.assert_array_equal(data["motor_work"], traj.motor_work)
    assert "motors" in data["work"].attrs["long_name"]


def test_what_a_run_was_asked_to_save_is_exported():
    pytest.importorskip("xarray")
    nested = ph.Record(save=lambda t: {"a": {"b": t.energy}, "a_b": 2 * t.energy})
    data = ph.simulate(SCENE, STATE, jnp.array([0.0, 1.0]), record=nested).to_xarray()
    np.testing.assert_array_equal(2 * data["saved_a_b"], data["saved_a_b_"])
    record = ph.Record(save=lambda t: {"energy": t.energy, "rates": t.omega_body})
    saved = ph.simulate(SCENE, STATE, jnp.array([0.0, 1.0, 2.0]), record=record)
    data = saved.to_xarray()
    assert data.saved_energy.dims == ("body", "time")
    np.testing.assert_array_equal(data.saved_energy, saved.saved["energy"])
    np.testing.assert_array_equal(data.saved_rates, saved.saved["rates"])
    event = ph.Event(lambda wxyz, omega_body, t: omega_body[0], capacity=4)
    met = ph.simulate(SCENE, STATE, jnp.array([0.0, 9.0]), events=[event])
    data = met.to_xarray()
    assert int(met.events.count.max()) > 0
    for name in ("times", "which", "wxyz", "omega_body", "count"):
        field = data[f"events_{name.replace('times', 'time')}"]
        np.testing.assert_array_equal(field, getattr(met.events, name))
        assert field.dims[0] == "body"
