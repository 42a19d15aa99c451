"""The HTML page of moving bodies: contains the motion, needs no network, runs in a browser."""

import base64
import json
import re
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from plot import chromium

import polhode as ph
from polhode import plot
from polhode.plot import _view

MOMENTS = np.array([1.0, 2.0, 3.0])
TURN = 2 * np.pi  # period of the spinning body [s]


def known(page: plot.View) -> dict:
    """Data of the page, with decoded arrays."""
    text = re.search(r'<script id="motion"[^>]*>(.*?)</script>', page.html, re.S)[1]
    motion = json.loads(text)
    for body in motion["bodies"]:
        for name, width in (("ts", 1), ("wxyz", 4), ("omega_body", 3), ("momentum_space", 3)):
            body[name] = decoded(body[name]).reshape(-1, width).squeeze()
        solid = body["solid"]
        solid["vertices"] = decoded(solid["vertices"]).reshape(-1, 3)
        solid["faces"] = decoded(solid["faces"], "<u4").reshape(-1, 3)
    return motion


def decoded(text: str, dtype: str = "<f4") -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), dtype)


def spinning(samples: int, end: float, tensor=None, start: float = 0.0) -> plot.Samples:
    """A body that rotates about its own and space's z axis at 1 rad/s."""
    ts = np.linspace(start, end, samples)
    half = (ts - start) / 2
    wxyz = np.stack([np.cos(half), 0 * half, 0 * half, np.sin(half)], axis=-1)
    inertia = ph.Inertia.from_tensor(np.diag(MOMENTS) if tensor is None else tensor)
    return plot.samples(ts, np.broadcast_to([0.0, 0.0, 1.0], (samples, 3)), wxyz, inertia)


@pytest.fixture(scope="module")
def trajectory():
    """Two free bodies in closed form."""
    scene = ph.Scene(ph.Inertia.from_moments(MOMENTS))
    omega = jnp.array([[0.01, 1.0, 0.01], [1.0, 0.3, 0.1]])
    return ph.simulate(scene, ph.State(wxyz=[1.0, 0, 0, 0], omega_body=omega), [10.0, 10.5, 12.0])


def test_the_page_holds_the_motion(trajectory):
    motion = known(plot.view(trajectory))
    assert motion["plane"] == "invariable plane"
    assert motion["start"] == 10.0
    assert motion["duration"] == 2.0
    for i, body in enumerate(motion["bodies"]):
        np.testing.assert_allclose(body["ts"], [0.0, 0.5, 2.0])
        for name in ("wxyz", "omega_body", "momentum_space"):
            np.testing.assert_allclose(body[name], getattr(trajectory, name)[i], atol=3e-7)


def test_several_motions_may_be_a_tuple(trajectory):
    bodies = _view.chosen_bodies((trajectory, trajectory), None)
    assert len(bodies) == 2 * len(_view.chosen_bodies(trajectory, None))


def test_momentum_of_wheels_is_shown():
    wheel = ph.Rotor(axis_body=[0.0, 0.0, 1.0], inertia=0.1, momentum=5.0)
    scene = ph.Scene(ph.Inertia.axisymmetric(1.0, 2.0), rotors=wheel)
    moved = ph.simulate(scene, ph.State(wxyz=[1.0, 0, 0, 0], omega_body=[0.3, 0, 0.2]), [0.0, 1.0])
    motion = known(plot.view(moved))
    body = motion["bodies"][0]
    np.testing.assert_allclose(body["momentum_space"], moved.momentum_space, rtol=1e-6)
    assert body["momentum_space"][0, 2] > 5
    # the momentum is constant, but the ellipsoid does not roll on the plane normal to it
    assert np.ptp(body["momentum_space"], axis=0).max() < 1e-5
    assert motion["plane"] == "tangent plane"


def test_time_may_run_backwards(trajectory):
    ts = np.asarray(trajectory.ts)[::-1]
    made = plot.samples(
        ts, trajectory.omega_body[:, ::-1], trajectory.wxyz[:, ::-1], trajectory.scene.inertia
    )
    forward, backward = known(plot.view(trajectory)), known(plot.view(made))
    for one, other in zip(forward["bodies"], backward["bodies"], strict=True):
        np.testing.assert_array_equal(one["wxyz"], other["wxyz"])


@pytest.mark.parametrize("samples", [20_000, 20_001, 20_002, 59_999, 100_003])
def test_long_motions_are_thinned_to_every_kth_sample_and_the_last(samples):
    made = spinning(samples, 0.01 * (samples - 1))
    motion = known(plot.view(made))
    kept = motion["bodies"][0]["ts"]
    assert len(kept) <= _view.MOST_SAMPLES
    step = round(float(kept[1] - kept[0]) / 0.01)
    assert len(range(0, samples, max(step - 1, 1))) + 1 > _view.MOST_SAMPLES or step == 1
    np.testing.assert_allclose(np.diff(kept)[:-1], 0.01 * step, rtol=1e-3)
    assert kept[-1] == pytest.approx(0.01 * (samples - 1))
    assert (f"One sample in {step}" in motion["note"]) == (step > 1)


@pytest.mark.parametrize(("gap", "coarse"), [(1.5, False), (1.65, True)])
def test_samples_a_quarter_turn_apart_are_not_interpolated(gap, coarse):
    motion = known(plot.view(spinning(11, 10 * gap)))
    assert motion["bodies"][0]["coarse"] is coarse
    assert ("quarter turn" in motion["note"]) is coarse


def test_the_box_has_the_inertia():
    tensor = np.array([[2.0, 0.3, -0.2], [0.3, 1.7, 0.1], [-0.2, 0.1, 2.4]])
    corners = known(plot.view(spinning(11, 5.0, tensor)))["bodies"][0]["solid"]["vertices"]
    # of a homogeneous box the second moments are those of its corners, divided by three
    second = np.einsum("vi,vj->ij", corners, corners)
    drawn = np.trace(second) * np.eye(3) - second
    np.testing.assert_allclose(drawn / np.trace(drawn), tensor / np.trace(tensor), atol=1e-6)


def test_meshes(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    ball = trimesh.creation.icosphere(2, 3.0)
    file = tmp_path / "ball.stl"
    ball.export(file)
    pair = (np.asarray(ball.vertices), np.asarray(ball.faces))
    for mesh in (ball, pair, file, [pair]):
        solid = known(plot.view(spinning(11, 5.0), mesh=mesh))["bodies"][0]["solid"]
        assert len(solid["faces"]) == len(ball.faces)
        np.testing.assert_allclose(np.linalg.norm(solid["vertices"], axis=-1), 1, atol=1e-6)


def test_text_of_the_user_stays_text():
    page = plot.view(spinning(11, 5.0), title="</title><script>", names=["</script><b>"])
    assert page.html.count("</script>") == 3
    assert "<title>&lt;/title&gt;" in page.html
    assert known(page)["bodies"][0]["name"] == "</script><b>"
    assert "srcdoc" in page._repr_html_()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"bodies": []}, "1 to 12 bodies"),
        ({"bodies": [1]}, "below the number of bodies, 1"),
        ({"names": ["a", "b"]}, "names must name the 1 bodies"),
        ({"seconds": 0.0}, "seconds must be positive"),
        ({"mesh": (np.zeros((3, 2)), np.zeros((1, 3), int))}, "vertices"),
        ({"mesh": (np.ones((3, 3)), np.array([[0, 1, 3]]))}, "vertices 0 to 2, got 0 to 3"),
        ({"mesh": [None, None]}, "one for each of 1 bodies"),
    ],
)
def test_bad_input_is_named(options, message):
    with pytest.raises(ValueError, match=message):
        plot.view(spinning(11, 5.0), **options)


def test_bodies_that_did_not_finish_are_named():
    made = spinning(11, 5.0)
    made.wxyz.flags.writeable = True
    made.wxyz[0, 5] = np.nan
    with pytest.raises(ValueError, match="body 0 did not finish"):
        plot.view(made)
    with pytest.raises(TypeError, match="pair"):
        plot.view(spinning(11, 5.0), mesh=3)


def test_a_file_of_the_command_line_is_shown(tmp_path):
    pytest.importorskip("h5netcdf")
    from polhode.files import write_netcdf

    text = """
    title = "three clones"
    [inertia]
    moments = [1.0, 2.0, 3.0]
    [state]
    omega_body = [0.1, 1.0, 0.2]
    [times]
    stop = 2.0
    number = 5
    """
    inertia = ph.Inertia.from_moments(jnp.array([[1.0, 2.0, 3.0], [1.1, 2.0, 3.0]]))
    state = ph.State(wxyz=[1.0, 0, 0, 0], omega_body=[0.1, 1.0, 0.2])
    moved = ph.simulate(ph.Scene(inertia), state, np.linspace(0, 2, 5))
    data = moved.to_xarray().rename(body="clone")
    data["moments"] = (("clone", "axis"), np.asarray(inertia.moments))
    data.attrs.update(title="three clones", scene=text)
    page = plot.view_file(write_netcdf(data, tmp_path / "a.nc"), tmp_path / "a.html")
    assert (tmp_path / "a.html").read_text(encoding="utf-8") == page.html
    motion = known(page)
    assert motion["title"] == "three clones"
    assert [body["name"] for body in motion["bodies"]] == ["nominal body", "clone 1"]
    for i, body in enumerate(motion["bodies"]):
        np.testing.assert_allclose(body["wxyz"], moved.wxyz[i], atol=1e-6)
        np.testing.assert_allclose(np.reshape(body["tensor"], (3, 3)), inertia.tensor[i])
    torque = '[torque]\nkind = "body"\nn = { file = "gone.csv" }\n'
    data = moved[0].to_xarray()
    data["moments"] = ("axis", MOMENTS)
    data.attrs.update(title="table", scene=text.replace("    ", "") + torque)
    (body,) = known(plot.view_file(write_netcdf(data, tmp_path / "t.nc")))["bodies"]
    np.testing.assert_allclose(body["wxyz"], moved.wxyz[0], atol=1e-6)
    with pytest.raises(FileNotFoundError):
        plot.view_file(tmp_path / "b.nc")
    with pytest.raises(ValueError, match="moments"):
        plot.view_file(write_netcdf(moved.to_xarray(), tmp_path / "c.nc"))


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    program = chromium.find()
    if program is None:
        pytest.skip(f"no browser to look with: none of {', '.join(chromium.NAMES)} is installed")
    with chromium.opened(program, tmp_path_factory.mktemp("profile")) as found:
        yield found


def at(browser, seconds: float) -> np.ndarray:
    """Image of the body with the slider at a time."""
    browser.run(
        f"(s => {{ s.value = {seconds}; s.dispatchEvent(new Event('input')); }})"
        "(document.getElementById('time'))"
    )
    rows, columns = browser.box(".pane")
    top = browser.box(".pane .caption")[0].stop
    return browser.look()[top : rows.stop, columns]


def changed(one: np.ndarray, other: np.ndarray) -> float:
    """Fraction of the pixels that differ visibly."""
    return float((np.abs(one - other).max(axis=-1) > 0.1).mean())


def test_a_browser_shows_the_body_and_the_slider_moves_it(browser, tmp_path):
    page = tmp_path / "page.html"
    plot.view(spinning(201, 2 * TURN), page, title="A spinning body")
    browser.open(page.as_uri() + "#t=1")
    assert browser.run("document.title") == "A spinning body"
    browser.wait("document.getElementById('readout').textContent === 't = 1.00 s'")
    first = at(browser, 1.0)
    assert first.reshape(-1, 3).std(axis=0).max() > 0.1  # more than a background
    # the box's faces have the hues of the axes: the large one is that of z, blue
    red, blue = first[..., 0], first[..., 2]
    assert ((blue > 0.5) & (blue - red > 0.25)).mean() > 0.03
    quarter = at(browser, 1.0 + TURN / 4)
    assert browser.run("document.getElementById('readout').textContent") == "t = 2.57 s"
    assert changed(first, quarter) > 0.01
    # after a full turn the picture is the same
    assert changed(first, at(browser, 1.0 + TURN)) < 0.002
    assert changed(first, at(browser, 1.0)) == 0
    assert not browser.faults
    assert {address.split(":")[0] for address in browser.requests} <= {"file", "about", "data"}


def test_a_browser_plays_and_hides(browser, trajectory, tmp_path):
    page = tmp_path / "page.html"
    plot.view(trajectory, page, names=["first", "second"])
    browser.open(page.as_uri())
    time = "Number(document.getElementById('time').value)"
    browser.wait(f"{time} > 0.2")  # it starts automatically
    browser.run("document.getElementById('play').click()")
    stopped = browser.run(time)
    shown = browser.look()
    assert browser.run(time) == stopped
    assert browser.run("document.querySelectorAll('.pane').length") == 4
    words = browser.run("[...document.querySelectorAll('.pane b')].map(e => e.textContent).join()")
    assert words == "first,,second,"
    for name in ("body", "polhode", "inertia ellipsoid"):
        click = f"[...document.querySelectorAll('#keys label')].find(e => e.innerText === '{name}')"
        browser.run(f"{click}.click()")
        assert changed(shown, browser.look()) > 1e-4, name
        browser.run(f"{click}.click()")
        assert changed(shown, browser.look()) == 0, name
    assert not browser.faults


def test_a_page_carries_the_licence_of_what_it_carries(trajectory):
    """The licence of three.js requires its copyright notice and the licence text."""
    licence = Path(plot.__file__).parent / "viewer" / "three.LICENSE.txt"
    assert licence.read_text(encoding="utf-8").strip() in plot.view(trajectory).html
