"""The scene file's schema: valid files are read correctly; errors name the key and the fix."""

import datetime
import math

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from polhode.files import SceneFileError, build_attitudes, parse_scene, read_scene

GOOD = """
title = "box"
epoch = 2020-01-01T00:00:00Z
[inertia]
moments = [1.0, 2, 2.5]
[state]
euler = { sequence = "ZYZ", angles = [90, 0, 0], unit = "deg" }
omega_body = { value = [0, 180, 0], unit = "deg/s" }
[times]
stop = 2.0
number = 5
unit = "min"
[monte_carlo]
clones = 3
seed = 1
moments = { relative_sigma = 0.01, source = "assumed" }
omega_body = { sigma = [1, 0, 2], unit = "deg/s", source = "assumed" }
[[published]]
name = "P_psi"
value = 2.0
uncertainty = 0.1
unit = "h"
source = "nobody"
[observations]
rate_unit = "deg/s"
rows = [ { utc = 2020-01-01T00:01:00Z, wxyz = [2, 0, 0, 0], omega_body = [0, 90, 0] },
         { time = 90.0, wxyz = [0, 0, 0, -0.1] } ]
"""


def test_values_are_read_in_si_units():
    scene = parse_scene(GOOD, "box.toml")
    half = math.sqrt(0.5)
    wxyz = build_attitudes(scene.state.attitude, np.float64)
    np.testing.assert_allclose(wxyz, [half, 0, 0, half], atol=1e-16)
    np.testing.assert_allclose(scene.state.value, [0, math.pi, 0], rtol=1e-15)
    np.testing.assert_allclose(scene.times.seconds, [0, 30, 60, 90, 120])
    np.testing.assert_array_equal(scene.inertia.moments, [1, 2, 2.5])
    moments, omega = scene.monte_carlo.spreads.values()
    np.testing.assert_array_equal(moments.sigma, [0.01] * 3)
    np.testing.assert_allclose(omega.sigma, np.deg2rad([1, 0, 2]))
    assert scene.published[0].value == 7200
    np.testing.assert_array_equal(scene.observations.seconds, [60, 90])
    wxyz = build_attitudes(scene.observations.attitudes, np.float32)
    np.testing.assert_array_equal(wxyz, [[1, 0, 0, 0], [0, 0, 0, -1]])
    assert wxyz.dtype == np.float32
    np.testing.assert_allclose(scene.observations.omega_body[0], [0, math.pi / 2, 0])
    assert np.isnan(scene.observations.omega_body[1]).all()
    assert scene.epoch == datetime.datetime(2020, 1, 1, tzinfo=datetime.UTC)


def test_euler_sequences_agree_with_scipy():
    from scipy.spatial.transform import Rotation

    angles = [0.3, -1.1, 2.5]
    for sequence in ("ZYZ", "ZXZ", "XYZ", "ZYX", "YXY"):
        text = GOOD.replace("ZYZ", sequence).replace("[90, 0, 0]", str(angles))
        state = parse_scene(text.replace("deg", "rad", 1)).state
        mine = np.asarray(build_attitudes(state.attitude, np.float64))
        # an upper-case sequence is intrinsic in SciPy: the product R_a R_b R_c
        truth = Rotation.from_euler(sequence, angles).as_quat(scalar_first=True)
        np.testing.assert_allclose(mine * np.sign(mine @ truth), truth, atol=4e-16)


@pytest.mark.parametrize(
    ("old", "new", "key", "hint"),
    [
        ("moments = [1.0", "momnets = [1.0", "[inertia] momnets", 'did you mean "moments"?'),
        ("[state]", "[stat]", "stat", 'did you mean "state"?'),
        ("[1.0, 2, 2.5]", "[1.0, 2]", "[inertia] moments", "at least 3 items"),
        ("[1.0, 2, 2.5]", "[1.0, 2, nan]", "[inertia] moments", "a finite number"),
        ("[1.0, 2, 2.5]", "[1.0, 2, true]", "[inertia] moments", "a valid number"),
        ("[1.0, 2, 2.5]", "'abc'", "[inertia] moments", "a valid list"),
        ("[1.0, 2, 2.5]", f"[1, 2, 1{'0' * 400}]", "[inertia] moments", "a valid number"),
        ("[1.0, 2, 2.5]", "[1.0, 2, 2.5]\nspherical = 1", "[inertia]", "exactly one of"),
        ('"deg/s" }\n[times]', '"deg/sec" }\n[times]', "[state.omega_body] unit", "deg/s"),
        ('"ZYZ"', '"ZZY"', "[state.euler] sequence", 'did you mean "ZYZ"?'),
        ('"ZYZ"', '"zyx"', "[state.euler] sequence", 'reverse letters and angles: "XYZ"'),
        ("stop = 2.0", "stop = 0.0", "[times]", "stop must be other than start"),
        ("stop = 2.0\nnumber = 5", "values = [0, 2, 1]", "[times] values", "sort them"),
        ("stop = 2.0\nnumber = 5", "values = [0, 0]", "[times] values", "sort them"),
        ("stop = 2.0\nnumber = 5", "values = [1]", "[times] values", "at least 2 items"),
        ("stop = 2.0\nnumber = 5", "values = [1, 2]\nstop = 3", "[times]", "exactly one of"),
        ("number = 5", "number = 5.5", "[times] number", "a valid integer"),
        ("number = 5", "number = true", "[times] number", "a valid integer"),
        ("number = 5", "number = 1", "[times] number", "greater than or equal to 2"),
        ("number = 5", "", "[times]", "add `number = ...`"),
        ("clones = 3", "clones = -3", "[monte_carlo] clones", "greater than or equal to 1"),
        ("relative_sigma = 0.01", "relative_sigma = -1", "_sigma", "greater than or equal to 0"),
        ("relative_sigma = 0.01", "sigma = 0.01", "[monte_carlo.moments] sigma", "relative_sigma"),
        (', source = "assumed" }\nom', " }\nom", "[monte_carlo.moments] source", "Field required"),
        ('name = "P_psi"', 'name = "P_ksi"', "[published 1] name", 'did you mean "P_psi"?'),
        ("epoch = 2020-01-01T00:00:00Z", "", "epoch", "add `epoch"),
        ("epoch = 2020-01-01T00:00:00Z", "epoch = '2020'", "epoch", "a valid datetime"),
        ("wxyz = [2, 0, 0, 0]", "wxyz = [0, 0, 0, 0]", "rows 1] wxyz", "not all be zero"),
        ("time = 90.0", "time = 60.0", "[observations] rows", "sort the rows"),
        ("wxyz = [0, 0, 0, -0.1]", "angles = [1, 2, 3]", "[observations]", "every row"),
        ("omega_body = [0, 90, 0]", "omega_body = [0, 90]", "rows 1] omega_body", "at least 3"),
        (", wxyz = [0, 0, 0, -0.1]", "", "[observations.rows 2]", "omega_body"),
        ("time = 90.0,", "", "[observations.rows 2]", "exactly one of utc, time"),
        ("[state]", "[method]\nkind='fast'\n[state]", "[method] kind", "closed-form"),
        ("[state]", "[method]\nsolver='Dopri8'\n[state]", "[method]", "lie-poisson"),
        ("[state]", "[method]\nrtol=2\n[state]", "[method] rtol", "less than 1"),
        ("[state]", "[torque]\nkind='damping'\n[state]", "[torque]", "linear-damping"),
        ("[state]", "[torque]\nkind='body'\n[state]", "[torque] n", "Field required"),
        ("[state]", "[[rotors]]\naxis_body=[0,0,1]\ninertia=1\n[state]", "[rotors 1]", "speed"),
        ("moments = [1.0, 2, 2.5]", "[[inertia.parts]]\nshape='box'\nradius=1", "radius", "sides"),
        ("title", "title = [", "", "TOML"),
    ],
)
def test_each_mistake_is_named_with_its_cure(old, new, key, hint):
    assert old in GOOD
    with pytest.raises(SceneFileError) as caught:
        parse_scene(GOOD.replace(old, new, 1), "box.toml")
    message = str(caught.value)
    assert message.startswith("box.toml: ")
    assert key in message
    assert hint in message
    assert len(message) < 700


def test_only_keys_of_the_same_table_are_suggested():
    """Not ``seed`` and ``speed`` of other tables, nor keys of other kinds of torques."""
    torque = "[torque]\nkind='pointing'\nkp=1\n{}\n[state]"
    for keys, hint in (("kd=1\nspeed=3", ""), ("kdd=1", "kd"), ("kd=1\nmax_moment=1", "")):
        with pytest.raises(SceneFileError) as caught:
            parse_scene(GOOD.replace("[state]", torque.format(keys), 1))
        assert caught.value.fix == (f'did you mean "{hint}"?' if hint else "")


def test_files_that_are_no_text(tmp_path):
    with pytest.raises(SceneFileError, match="No such file"):
        read_scene(tmp_path / "absent.toml")
    with pytest.raises(SceneFileError, match="cannot be read"):
        read_scene(tmp_path)
    binary = tmp_path / "binary.toml"
    binary.write_bytes(b"\xff\x00\x80")
    with pytest.raises(SceneFileError, match="UTF-8"):
        read_scene(binary)


KEYS = [
    "title",
    "inertia",
    "moments",
    "unit",
    "state",
    "euler",
    "angles",
    "wxyz",
    "omega_body",
    "value",
    "times",
    "stop",
    "number",
    "values",
    "torque",
    "kind",
    "monte_carlo",
    "seed",
    "observations",
    "rows",
    "utc",
    "published",
    "rotors",
    "epoch",
    "x",
]
scalars = (
    st.booleans()
    | st.integers()
    | st.floats()
    | st.text(max_size=8)
    | st.sampled_from(["deg", "rad/s", "zxz", "box", "P_psi", "auto"])
    | st.datetimes()
)
garbage = st.recursive(
    scalars,
    lambda inner: (
        st.lists(inner, max_size=4) | st.dictionaries(st.sampled_from(KEYS), inner, max_size=4)
    ),
    max_leaves=12,
)


@settings(max_examples=300, deadline=None)
@given(st.dictionaries(st.sampled_from(KEYS), garbage, max_size=6))
def test_garbage_tables_only_ever_raise_the_one_error(tables):
    _raises_or_reads(_toml(tables))


@settings(max_examples=200, deadline=None)
@given(st.data())
def test_good_file_with_one_value_turned_to_garbage(data):
    lines = GOOD.splitlines()
    index = data.draw(st.sampled_from([i for i, line in enumerate(lines) if "=" in line]))
    name = lines[index].split("=")[0]
    lines[index] = f"{name}= {_value(data.draw(garbage))}"
    _raises_or_reads("\n".join(lines))


@settings(max_examples=200, deadline=None)
@given(st.text(max_size=200))
def test_any_text_only_ever_raises_the_one_error(text):
    _raises_or_reads(text)


def _raises_or_reads(text):
    try:
        scene = parse_scene(text, "garbage.toml")
    except SceneFileError as error:
        error.args[0].index("garbage.toml: ")
        return
    assert np.isfinite(scene.times.seconds).all()
    assert np.isfinite(scene.state.value).all()
    assert np.isfinite(scene.state.attitude.values).all()


def _toml(tables):
    return "\n".join(f"{key} = {_value(value)}" for key, value in tables.items())


def _value(value):
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list):
        return "[" + ", ".join(map(_value, value)) + "]"
    if isinstance(value, dict):
        return "{" + ", ".join(f"{k} = {_value(v)}" for k, v in value.items()) + "}"
    if isinstance(value, str):
        return (
            '"'
            + "".join(f"\\U{ord(c):08x}" if not 0xD800 <= ord(c) < 0xE000 else "" for c in value)
            + '"'
        )
    return value.isoformat() if isinstance(value, datetime.datetime) else repr(value)
