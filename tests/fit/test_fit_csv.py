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
        ("", "header"),
        ("time,x,y,z\n0,1,2,3\n", "at least 4 rows"),
        (GOOD.replace(",1,", ",400,"), "deg/s"),
    ],
)
def test_bad_files_say_what_is_wrong(tmp_path, text, message):
    path = tmp_path / "bad.csv"
    path.write_text(text)
    with pytest.raises(ValueError, match=message):
        read_recording(path, COLUMNS)
