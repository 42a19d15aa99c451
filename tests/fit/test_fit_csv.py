"""Recordings from CSV files: what is read, and the errors for invalid files."""

import jax
import numpy as np
import pytest

from polhode.fit import Recording, read_recording
from polhode.fit._csv import load_recording

COLUMNS = {"t": "time", "wx": "x", "wy": "y", "wz": "z"}
GOOD = """time, x, y, z, n
0,1,2,3,9
0.1,1,2,3,9
0.2,1,,3,9
0.3,1,2,3,9
0.4,1,2,nan,9
0.5,1,2,3,9
"""


def test_a_good_file(tmp_path):
    path = tmp_path / "good.csv"
    path.write_text(GOOD)
    recording = read_recording(path, COLUMNS, scale=0.5)
    np.testing.assert_array_equal(recording.present, [1, 1, 0, 1, 0, 1])
    np.testing.assert_allclose(recording.omega[0], [0.5, 1, 1.5])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (GOOD.replace("time", "clock"), "missing: t -> time; its columns are: clock, x"),
        (GOOD.replace("0.3", "0.1"), r"line 5 \(0.1\) does not follow line 4 \(0.2\)"),
        (GOOD.replace("0.3,1", "0.3,one"), "line 5, column x must be a number, got 'one'"),
        ("", "is empty; expected a header"),
        ("\n# only a remark\n", "is empty"),
        (GOOD.split("\n", 1)[1], r"0, 1, 2, 3, 9 \(is the header line there"),
        (GOOD.replace(" n", " x"), "2 columns named x"),
        (GOOD.replace("0.1,1,2,3,9", "time, x, y, z, n"), "line 3.*the header line again"),
        ("a\0b", "not text in UTF-8"),
        ("time,x,y,z\n0,1,2,3\n", "at least 4 rows"),
        (GOOD.replace(",1,", ",400,"), "deg/s"),
        # decimal commas in comma-separated columns
        (GOOD.replace("0.1,1,2,3,9", "1,0,1,0,2,0,3"), "line 3 has 7 cells, its header 5; .*semi"),
    ],
)
def test_bad_files_say_what_is_wrong(tmp_path, text, message):
    path = tmp_path / "bad.csv"
    path.write_text(text)
    with pytest.raises(ValueError, match=message):
        read_recording(path, COLUMNS)


@pytest.mark.parametrize(
    "change",
    [
        lambda text: "\ufeff" + text,
        lambda text: "# of a phone\n\n" + text,
        lambda text: text.replace("\n", "\r\n"),
        lambda text: text.replace(",", ";"),
        lambda text: text.replace(",", "\t").replace(".", ","),
        lambda text: text.replace("9\n", "9,\n"),
    ],
)
def test_other_ways_to_write_the_same(tmp_path, change):
    path = tmp_path / "odd.csv"
    path.write_bytes(change(GOOD).encode())
    recording = read_recording(path, COLUMNS, scale=0.5)
    np.testing.assert_array_equal(recording.present, [1, 1, 0, 1, 0, 1])
    np.testing.assert_allclose(recording.times, np.arange(6) / 10, atol=1e-15)
    np.testing.assert_allclose(recording.omega[0], [0.5, 1, 1.5])


def test_what_is_no_text_or_has_a_gap_is_named(tmp_path):
    path = tmp_path / "bad.csv"
    path.write_bytes(GOOD.encode("utf-16"))
    with pytest.raises(ValueError, match=r"bad\.csv is not text in UTF-8"):
        read_recording(path, COLUMNS)
    rows = [f"{k / 10 + (k > 20) * 60},1,2,3" for k in range(40)]
    path.write_text("\n".join(["time,x,y,z", *rows]))
    with pytest.raises(ValueError, match=r"bad\.csv: times leave a gap after sample 20"):
        read_recording(path, COLUMNS)


@pytest.mark.parametrize(
    ("head", "factor", "seconds"),
    [
        ("t,wx,wy,wz", 1.0, 1.0),
        ("time_s,gyro_x,gyro_y,gyro_z", 1.0, 1.0),
        ("time,omega_x,omega_y,omega_z", 1.0, 1.0),
        ("Time [s],Gyro X [deg/s],Gyro Y [deg/s],Gyro Z [deg/s]", np.pi / 180, 1.0),
        ("timestamp_ms,gyro_x_dps,gyro_y_dps,gyro_z_dps", np.pi / 180, 1e-3),
        ("time (us),angular_velocity.x,angular_velocity.y,angular_velocity.z", 1.0, 1e-6),
        ("seconds_elapsed,rotationRate x (rad/s),rotation_rate_y,rotation_rate_z", 1.0, 1.0),
        ("t,p,q,r", 1.0, 1.0),
        ("t (ms),wx (rpm),wy (rpm),wz (rpm)", np.pi / 30, 1e-3),
        ("t,wx_rpm,wy_rpm,wz_rpm", np.pi / 30, 1.0),
        ("t,wx_mdeg/s,wy_mdeg/s,wz_mdeg/s", np.pi / 180e3, 1.0),
        ("time [h],wx [rev/s],wy [rev/s],wz [rev/s]", 2 * np.pi, 3600.0),
        ("Time (days),wx (deg/h),wy (deg/h),wz (deg/h)", np.pi / 180 / 3600, 86400.0),
    ],
)
def test_usual_names_and_units_are_found(tmp_path, head, factor, seconds):
    path = tmp_path / "usual.csv"
    rows = "".join(f"{k / 10 / seconds!r},1,2,3,7\n" for k in range(6))
    path.write_text(f"{head},accel_x\n{rows}")
    loaded = load_recording(path)
    np.testing.assert_allclose(loaded.recording.omega[0], np.array([1, 2, 3]) * factor, rtol=1e-14)
    np.testing.assert_allclose(loaded.recording.times, np.arange(6) / 10, rtol=1e-9)
    assert list(loaded.columns.values()) == head.split(",")


@pytest.mark.parametrize(
    ("head", "message"),
    [
        ("t,wx,wy,wz,gyro_x", None),
        ("t,gyro_x,wy,wz,omega_x", "gyro_x, omega_x could all be wx"),
        ("t,gyro_x [deg/s],gyro_y,gyro_z [rad/s],n", "different units: deg/s, rad/s"),
        ("t,gyro_x [ms],gyro_y,gyro_z,n", "states the unit ms"),
        ("t [weeks],gyro_x,gyro_y,gyro_z,n", "states the unit weeks; expected one of s, ms"),
        ("t,gyro_x (Hz),gyro_y (Hz),gyro_z (Hz),n", r"states the unit hz; expected one of rad/s"),
        ("x,gyro_x,gyro_y,gyro_z,n", "missing: t -> t"),
        ("t,p,q,z,n", "missing: wx -> wx, wy -> wy, wz -> wz"),
        ("t,gyro_x_rps,gyro_y_rps,gyro_z_rps,n", "rad/s or revolutions per second"),
    ],
)
def test_names_that_could_mean_several_things_are_refused(tmp_path, head, message):
    path = tmp_path / "odd.csv"
    path.write_text(f"{head}\n" + "".join(f"{k / 10},1,2,3,7\n" for k in range(6)))
    if message is None:  # a column with the name of a role is accepted
        assert load_recording(path).columns["wx"] == "wx"
        return
    with pytest.raises(ValueError, match=message):
        load_recording(path)


@pytest.mark.parametrize(
    ("name", "factor"), [("wheel", 1.0), ("wheel [rpm]", np.pi / 30), ("w_deg/s", np.pi / 180)]
)
def test_speeds_of_a_wheel_have_the_unit_of_their_column(tmp_path, name, factor):
    path = tmp_path / "wheel.csv"
    path.write_text(f"t,wx,wy,wz,{name}\n" + "".join(f"{k / 10},1,2,3,{k}\n" for k in range(6)))
    found = read_recording(path, {"wheel": name}).wheel
    np.testing.assert_allclose(found, np.arange(6) * factor, rtol=1e-14)


def test_a_column_has_one_role_and_one_unit(tmp_path):
    path = tmp_path / "roles.csv"
    path.write_text(
        "t [s],x [rad/s],y [rad/s],z [rad/s]\n" + "".join(f"{k},.1,.2,.3\n" for k in range(6))
    )
    roles = dict(zip(("t", "wx", "wy", "wz"), path.read_text().split("\n")[0].split(",")))
    with pytest.raises(ValueError, match=r"in rad/s by the names .* read as deg/s"):
        read_recording(path, roles, scale=np.pi / 180)
    with pytest.raises(ValueError, match=r"in s by the names .* read as ms"):
        read_recording(path, roles, time_scale=1e-3)
    found = read_recording(path, roles, scale=1.02)  # from a calibration
    np.testing.assert_allclose(found.omega[0], [0.102, 0.204, 0.306], rtol=1e-14)
    with pytest.raises(ValueError, match="is to be wx and wy"):
        read_recording(path, roles | {"wy": roles["wx"]})


@pytest.mark.parametrize(("start", "step"), [(1.7e9, 0.1), (1e5, 0.01)])
def test_times_without_digits_in_single_precision_are_named(start, step):
    with jax.enable_x64(False), pytest.raises(ValueError, match="in float32: subtract the first"):
        Recording.of(start + step * np.arange(20), 0.1 * np.ones((20, 3)))


def test_columns_of_other_names_are_refused(tmp_path):
    path = tmp_path / "good.csv"
    path.write_text(GOOD)
    with pytest.raises(ValueError, match="t, wx, wy, wz and wheel, got the keys flywheel"):
        read_recording(path, COLUMNS | {"flywheel": "n"})


def test_a_file_without_an_end_is_no_text():
    with pytest.raises(ValueError, match="not text"):
        read_recording("/dev/zero")


def test_a_given_factor_stands_for_a_unit_that_is_not_known(tmp_path):
    path = tmp_path / "furlongs.csv"
    path.write_text("t [fortnight],wx,wy,wz\n" + "".join(f"{k / 10},0,0,1e-7\n" for k in range(6)))
    recording = load_recording(path, time_scale=1209600.0).recording
    np.testing.assert_allclose(recording.times, 120960.0 * np.arange(6))
