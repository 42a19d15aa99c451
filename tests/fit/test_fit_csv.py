"""Recordings from CSV files: what is read, and what is refused with which words."""

import numpy as np
import pytest

from polhode.fit import read_recording

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
