"""Readers of light curves: accepted formats, assumptions, and errors for invalid files."""

import numpy as np
import pytest

from polhode import lightcurve
from polhode.lightcurve._data import LIGHT_TIME

ROWS = 9
JD = 2456210.6 + 0.01 * np.arange(ROWS)
MAGNITUDE = 12.0 + 0.1 * np.sin(np.arange(ROWS))
SUN, OBSERVER = np.array([-2.0, 0.1, 0.0]), np.array([-1.0, 0.2, 0.1])


def _write(path, header, rows):
    path.write_text("\n".join([header, *(",".join(map(str, row)) for row in rows)]) + "\n")
    return path


@pytest.fixture
def table(tmp_path):
    header = "JD,mag,mag_err,night,sun_x,sun_y,sun_z,earth_x,earth_y,earth_z"
    rows = [
        (t, m, 0.02, "ab"[k % 2], *SUN, *OBSERVER) for k, (t, m) in enumerate(zip(JD, MAGNITUDE))
    ]
    return _write(tmp_path / "curve.csv", header, rows)


def test_table_is_reduced_to_unit_distance_and_to_the_body(table):
    curve = lightcurve.read_light_curve(table)
    r, delta = np.linalg.norm(SUN), np.linalg.norm(OBSERVER)
    np.testing.assert_allclose(curve.t, JD - LIGHT_TIME * delta, atol=1e-9)
    np.testing.assert_allclose(curve.magnitude, MAGNITUDE - 5 * np.log10(r * delta))
    np.testing.assert_allclose(curve.sun[0], SUN / r)
    assert curve.names == ("a", "b")
    assert np.all(curve.sigma == 0.02)
    cosine = SUN @ OBSERVER / r / delta
    np.testing.assert_allclose(np.cos(curve.alpha), cosine)
    assert str(curve).startswith("LightCurve: 9 points of 2 group(s), day 2456210.59")
    assert "median error 0.02, with directions" in str(curve)


def test_barycentric_times_are_moved_to_the_body(table):
    """The Sun, at the origin, represents the barycentre; the body is at -SUN."""
    text = table.read_text()
    observer, delta = OBSERVER - SUN, np.linalg.norm(OBSERVER)
    shift = LIGHT_TIME * observer @ -OBSERVER / delta
    rows = text.split("\n")
    for k, t in enumerate(np.atleast_1d(JD)):
        rows[k + 1] = ",".join([repr(float(t + shift)), *rows[k + 1].split(",")[1:]])
    table.write_text("\n".join(["b" + rows[0], *rows[1:]]))
    curve = lightcurve.read_light_curve(table)
    np.testing.assert_allclose(curve.t, np.sort(JD) - LIGHT_TIME * delta, atol=1e-9)


def test_flux_and_vectors_from_another_file(tmp_path):
    flux = 10 ** (-0.4 * (MAGNITUDE - MAGNITUDE.mean()))
    flux /= flux.mean()
    path = _write(tmp_path / "flux.csv", "jd,brightness", zip(JD, flux))
    names = ",".join(f"{b}_{c}" for b in ("sun", "observer") for c in "xyz")
    ends = [(JD[0] - 0.01, *SUN, *OBSERVER), (JD[-1] + 0.01, *(SUN + 0.1), *OBSERVER)]
    vectors = _write(tmp_path / "vectors.csv", f"jd,{names}", ends)
    curve = lightcurve.read_light_curve(path, vectors)
    np.testing.assert_allclose(curve.magnitude, -2.5 * np.log10(flux))
    middle = SUN + 0.1 * (JD - JD[0] + 0.01)[:, None] / (JD[-1] - JD[0] + 0.02)
    np.testing.assert_allclose(
        curve.sun, middle / np.linalg.norm(middle, axis=1)[:, None], atol=1e-9
    )
    assert "mean 1" in curve.notes[0]
    assert lightcurve.read_light_curve(path).sun is None


def test_damit(tmp_path):
    block = [
        f"{t} {10 ** (-0.4 * m)} " + " ".join(map(str, (*SUN, *OBSERVER)))
        for t, m in zip(JD, MAGNITUDE)
    ]
    path = tmp_path / "lc.txt"
    path.write_text("\n".join(["# DAMIT", "2", f"{ROWS} 0", *block, f"{ROWS} 1", *block]) + "\n")
    curve = lightcurve.read_light_curve(path)
    assert curve.t.size == 2 * ROWS
    assert len(curve.names) == 2
    assert not curve.calibrated  # one of them is relative
    np.testing.assert_allclose(curve.t[::2], JD)  # corrected for light time by definition
    np.testing.assert_allclose(curve.magnitude[::2], MAGNITUDE)
    path.write_text("\n".join(["2", f"{ROWS} 0", *block]))
    with pytest.raises(ValueError, match="announces 2 light curves and holds 1"):
        lightcurve.read_light_curve(path)


def test_alcdef(tmp_path):
    head = [
        "STARTMETADATA",
        "OBJECTNAME=Test",
        "DELIMITER=PIPE",
        "PHASE=10.0",
        "PABL=90.0",
        "PABB=0.0",
        "ENDMETADATA",
    ]
    data = [f"DATA={t}|{m}|0.01" for t, m in zip(JD, MAGNITUDE)]
    path = tmp_path / "alcdef.txt"
    path.write_text("\n".join([*head, *data, "ENDDATA", *head, *data, "ENDDATA"]))
    curve = lightcurve.read_light_curve(path)
    assert len(curve.names) == 2
    np.testing.assert_allclose(curve.alpha, np.radians(10))
    np.testing.assert_allclose((curve.sun + curve.observer)[:, 1], -2 * np.cos(np.radians(5)))
    assert any("approximate" in note for note in curve.notes)
    path.write_text("\n".join([*(x for x in head if "PAB" not in x), *data]))
    assert lightcurve.read_light_curve(path).sun is None
    # unit vectors of five digits, between which the light curve lies: directions, no distances
    angles = np.radians(np.array([0.0, 60.0]))
    sun = np.stack([np.cos(angles), np.sin(angles), 0 * angles], -1)
    ends = [JD[0] - 0.5, JD[-1] + 0.5]
    rows = [f"{t},{x:.5f},{y:.5f},0,0,1,0" for t, (x, y, _) in zip(ends, sun)]
    vectors = tmp_path / "vectors.csv"
    header = "jd,sun_x,sun_y,sun_z,observer_x,observer_y,observer_z"
    vectors.write_text("\n".join([header, *rows]))
    given = lightcurve.read_light_curve(path, vectors)
    np.testing.assert_allclose(np.linalg.norm(given.sun, axis=1), 1)
    np.testing.assert_array_equal(given.t, np.sort(JD))
    vectors.write_text("\n".join([header, *(f"{t},2,0,0,0,1.5,0" for t in ends)]))
    apparent, reduced = (
        lightcurve.read_light_curve(path, vectors, reduced=r).magnitude for r in (False, True)
    )
    np.testing.assert_allclose(reduced - apparent, 5 * np.log10(2 * 1.5))
    # a second session, corrected already
    times = [f"DATA={t + 1}|{m}|0.01" for t, m in zip(JD, MAGNITUDE)]
    metadata = ["LTCAPP=POINT", "REDUCEDMAGS=AVERAGE", "ENDMETADATA"]
    path.write_text("\n".join([*head, *data, *head[:-1], *metadata, *times]))
    vectors.write_text(
        "\n".join([header, f"{ends[0]},2,0,0,0,1.5,0", f"{ends[1] + 1},2,0,0,0,1.5,0"])
    )
    notes = " ".join(lightcurve.read_light_curve(path).notes)
    assert "times of some sessions keep their light time, those of others are corrected" in notes
    curve = lightcurve.read_light_curve(path, vectors)
    moved = np.where(curve.group == 0, LIGHT_TIME * 1.5, 0)
    np.testing.assert_allclose(curve.t + moved, [*np.sort(JD), *(np.sort(JD) + 1)], atol=1e-9)
    np.testing.assert_allclose(curve.magnitude[curve.group == 1], MAGNITUDE[np.argsort(JD)])
    np.testing.assert_allclose(curve.magnitude[curve.group == 0], apparent)
    with pytest.raises(FileNotFoundError):
        lightcurve.read_light_curve(path, tmp_path / "none.csv")
    vectors.write_bytes(b"\xff\xfe")
    with pytest.raises(ValueError, match=r"vectors\.csv is not text"):
        lightcurve.read_light_curve(path, vectors)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "empty"),
        ("jd,mag\n" + "1,2\n" * 3, "at least 8"),
        ("jd,colour\n" + "1,2\n" * 9, "must have a column"),
        ("jd,mag\n1,2\n1,x\n", "line 3, mag must be a number, got 'x'"),
        ("jd,mag\n1,2,3\n", "line 2 has 3 cells"),
        ("jd,flux\n1,1\n2,-1\n", "line 3: a flux must be positive"),
        ("jd,mag,sun_x\n1,2,3\n", "lacks the columns sun_y"),
        ("jd,mag\n" + "1,2\n" * 9, "must span some time"),
        ("0\n", "announces no light curve"),
        ("STARTMETADATA\nENDMETADATA\nDATA=1.0||0.02\n", "line 3, DATA must be a number, got ''"),
        ("STARTMETADATA\nENDMETADATA\nDATA=1.0|\n", "line 3, DATA must be a number, got ''"),
        ("1\n-3 0\n", "line 2, number of points must be a whole number above 0, got '-3'"),
        ("1\n2 0\n1 1 1 0 0 1 0 0\n2 -1 1 0 0 1 0 0\n", "line 4: an intensity must be positive"),
    ],
)
def test_bad_files_are_named(tmp_path, text, message):
    path = tmp_path / "bad.csv"
    path.write_text(text)
    with pytest.raises(ValueError, match=message):
        lightcurve.read_light_curve(path)


def test_shapes_are_checked():
    with pytest.raises(ValueError, match=r"sun must have shape \(9, 3\)"):
        lightcurve.LightCurve.of(JD, MAGNITUDE, np.ones((8, 3)), np.ones((9, 3)))
    with pytest.raises(ValueError, match="neither"):
        lightcurve.LightCurve.of(JD, MAGNITUDE, np.ones((9, 3)))


def test_calibrated_and_reduced_are_what_the_caller_says(tmp_path):
    path = tmp_path / "curve.csv"
    rows = [f"{k / 10},{10 + k / 7},0,0,2.5,1.5,0,0,{k % 2}" for k in range(10)]
    header = "jd,mag,sun_x,sun_y,sun_z,observer_x,observer_y,observer_z,night"
    path.write_text("\n".join([header, *rows]))
    plain, known = (
        lightcurve.read_light_curve(path, calibrated=x, reduced=x) for x in (False, True)
    )
    assert not plain.calibrated
    assert known.calibrated
    np.testing.assert_allclose(known.magnitude - plain.magnitude, 5 * np.log10(2.5 * 1.5))


def test_vectors_in_kilometres_and_copies_of_points_are_named():
    t = np.arange(10.0)
    far = np.tile([3e8, 0, 0], (10, 1))
    with pytest.raises(ValueError, match=r"in au.*as one in km"):
        lightcurve.LightCurve.of(t, np.sin(t), far, far)
    t[4] = t[3]
    light = np.sin(t)
    assert "1 point(s) are exact copies" in lightcurve.LightCurve.of(t, light).notes[-1]
    light[4] += 0.1
    assert lightcurve.LightCurve.of(t, light).notes == ()


def test_fluxes_given_as_magnitudes_are_named():
    t = 10 + 0.01 * np.arange(20)
    flux = 1 + 0.2 * np.sin(np.arange(20))
    with pytest.raises(ValueError, match=r"these are fluxes or counts"):
        lightcurve.LightCurve.of(t, 5000 * flux)
    with pytest.raises(ValueError, match=r"placeholders such as 99\.99.*leave points"):
        lightcurve.LightCurve.of(t, np.where(t > 10.1, 99.99, 15 + flux))
    named = lightcurve.LightCurve.of(t, flux / flux.mean())
    assert any("as a normalised flux" in note for note in named.notes)
    assert lightcurve.LightCurve.of(t, -2.5 * np.log10(flux)).notes == ()
    assert lightcurve.LightCurve.of(t, 15 + flux).notes == ()


def test_a_saturated_night_is_named_and_rounded_magnitudes_are_not():
    t = 10 + 0.01 * np.arange(60)
    magnitude = 15 + 0.3 * np.sin(0.7 * np.arange(60))
    night = np.repeat(["first", "second"], 30)
    clipped = np.where(night == "second", np.maximum(magnitude, 14.85), magnitude)
    (note,) = lightcurve.LightCurve.of(t, clipped, group=night).notes
    assert "group(s) second many points have the brightest magnitude" in note
    assert lightcurve.LightCurve.of(t, magnitude, group=night).notes == ()
    rounded = lightcurve.LightCurve.of(t, np.round(magnitude, 1), group=night)
    assert not any("brightest" in note for note in rounded.notes)


def test_vectors_that_do_not_start_at_the_body_are_named():
    """Sun and Earth are one au apart, seen from the body and in one frame."""
    t = 10 + 0.01 * np.arange(12)
    sun = np.array([2.0, 0.3, 0.1])
    earth = sun - np.array([0.6, 0.8, 0.0])
    magnitude, suns = 15 + np.sin(t), np.tile(sun, (12, 1))
    right = lightcurve.LightCurve.of(t, magnitude, suns, np.tile(earth, (12, 1)))
    assert right.notes == ()
    obliquity = np.radians(23.44)
    turn = np.array(
        [
            [1, 0, 0],
            [0, np.cos(obliquity), -np.sin(obliquity)],
            [0, np.sin(obliquity), np.cos(obliquity)],
        ]
    )
    for wrong in (-earth, turn @ (3 * earth), earth - sun):
        (note,) = lightcurve.LightCurve.of(t, magnitude, suns, np.tile(wrong, (12, 1))).notes
        assert "au apart" in note


def test_unsorted_times_are_sorted_with_their_points():
    t = 10 + 0.01 * np.array([3, 0, 2, 1, 7, 5, 6, 4])
    curve = lightcurve.LightCurve.of(t, 15 + t)
    assert np.all(np.diff(curve.t) > 0)
    np.testing.assert_allclose(curve.magnitude, 15 + curve.t)


def test_times_that_a_precision_does_not_resolve_are_refused():
    """A Julian date in single precision, JAX's default, is one of a quarter of a day."""
    t = 2459000.5 + 0.15 * np.arange(40.0)
    with pytest.raises(ValueError, match=r"in float32 are resolved to 0\.25 d only"):
        lightcurve.LightCurve.of(t.astype(np.float32), np.sin(t))
    since = (t - t[0]).astype(np.float32)
    np.testing.assert_array_equal(lightcurve.LightCurve.of(since, np.sin(t)).t, since)


def test_nothing_of_a_file_is_dropped_in_silence(tmp_path):
    rows = [(t, m, m + 1) for t, m in zip(JD, MAGNITUDE)]
    with pytest.raises(ValueError, match="more than one column mag"):
        lightcurve.read_light_curve(_write(tmp_path / "twice.csv", "jd,mag,mag", rows))
    rows = [(t, t - 2400000.5, m) for t, m in zip(JD, MAGNITUDE)]
    curve = lightcurve.read_light_curve(_write(tmp_path / "times.csv", "mjd,jd,mag", rows))
    assert any("columns jd, mjd the first is taken" in note for note in curve.notes)
    rows = [(t, m, 0.02, 1.3) for t, m in zip(JD, MAGNITUDE)]
    curve = lightcurve.read_light_curve(_write(tmp_path / "e.csv", "hjd,mag,err,airmass", rows))
    np.testing.assert_allclose(curve.sigma, 0.02)
    assert "Columns that are not read: airmass." in curve.notes
    path = tmp_path / "lc.txt"
    lines = [f"{t} 1.0{k} 1 0.1 0 0.2 0.9 0" for k, t in enumerate(JD)]
    path.write_text("\n".join(["1", f"{ROWS - 1} 0", *lines]) + "\n")
    with pytest.raises(ValueError, match=rf"1 line\(s\) from line {ROWS + 2} on"):
        lightcurve.read_light_curve(path)


def test_errors_of_points_are_checked():
    sigma = np.full(ROWS, 0.02)
    cases = (np.ones(5), r"shape \(5,\)"), (sigma - 0.03, "not be negative"), (np.inf, "be finite")
    for wrong, match in cases:
        with pytest.raises(ValueError, match=match):
            lightcurve.LightCurve.of(JD, MAGNITUDE, sigma=wrong)
    sigma[2] = np.nan
    assert lightcurve.LightCurve.of(JD, MAGNITUDE, sigma=sigma).sigma[2] == 0


def test_means_that_leave_too_few_points():
    curve = lightcurve.LightCurve.of(JD, MAGNITUDE)
    with pytest.raises(ValueError, match="at least 8 points, this one has 1"):
        lightcurve.fit_light_curve(curve.binned(10.0))
