"""The stress suite: every family against 50 digits in value and gradient, and Principia's cases."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import polhode as ph
from benchmarks import stress
from polhode import rotation

PAIRS = stress.load()
FAMILIES = list(dict.fromkeys(body.family for body, _ in PAIRS))
# In units of eps x max(1, angle turned): about twice the worst that benchmarks/stress.py prints.
BOUND = {"attitude": 7.0, "rates": 11.0, "forward": 25.0, "reverse": 15.0}
# Tensors are rotated to principal axes first; one of them has moments 1 : 100. Twenty e-folds
# at the unstable axis make derivatives of conditioning 100.
ROOM = {"tensors": 3.0, "dwelling": 3.0}


@pytest.fixture(
    scope="module",
    params=[
        pytest.param((np.float64, ()), id="float64"),
        # derivatives of every regime are in tests/free: forward, and forward over reverse
        pytest.param((np.float64, ("reverse",)), id="reverse", marks=pytest.mark.slow),
        pytest.param((np.float32, ()), id="float32", marks=pytest.mark.slow),
    ],
)
def scores(request):
    """Modes and scores, in one program each: values with at most one mode of derivatives."""
    dtype, modes = request.param
    return modes, stress.measure(dtype, PAIRS, "forward" in modes, "reverse" in modes)


def _spread(name: str) -> float:
    """Intermediate over smallest moment of a family that is named by its moments."""
    low, middle, _ = sorted(float(x) for x in name[1 : name.index(")")].split(","))
    return middle / low


@pytest.mark.parametrize("family", FAMILIES)
def test_family(scores, family):
    modes, table = scores
    table = [score for score in table if score["family"] == family]
    assert len(table) >= 3
    for score in table:
        for name in ("attitude", "rates", *modes):
            bound = ROOM.get(family, 1) * BOUND[name]
            if family == "ratios" and name in ("forward", "reverse"):
                # A fast needle: errors of derivatives grow with the ratio of its moments.
                bound += 0.2 * _spread(score["name"])
            assert score[name] <= bound, (score["name"], name)  # NaN fails too


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.slow
def test_spin_about_the_unstable_axis_for_ever(dtype):
    """Values remain exact; derivatives grow without bound and must not become NaN."""
    x = jnp.asarray((2.0, 3.0, 5.0), dtype)

    def run(moments, omega):
        scene = ph.Scene(inertia=ph.Inertia(diagonal=moments))
        state = ph.State(jnp.asarray((1.0, 0, 0, 0), omega.dtype), omega)
        ts = jnp.asarray([0.0, 2.0**16], dtype)
        done = ph.simulate(scene, state, ts, ph.ClosedForm(), record=ph.Record(final_only=True))
        return jnp.concatenate([done.wxyz[0], done.omega_body[0]])

    omega = jnp.asarray((0.0, 2.0, 0.0), dtype)
    found, pull = jax.vjp(jax.jit(run), x, omega)
    angle = 2.0**16
    exact = np.array([np.cos(angle), 0, np.sin(angle), 0])
    turned = np.asarray(found)[:4]
    size = min(np.linalg.norm(turned - exact), np.linalg.norm(turned + exact))
    assert 2 * size <= 2 * np.finfo(dtype).eps * 2 * angle
    np.testing.assert_array_equal(found[4:], omega)
    for part in pull(jnp.ones_like(found)):
        assert np.all(np.isfinite(part))


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.slow  # faster: long horizons of the family, above
def test_compensated_horizons(dtype):
    """Up to a million revolutions the error is that of the last operations, not of the phase."""
    pairs = [pair for pair in PAIRS if pair[0].family in ("horizons", "separatrix", "ulps")]
    pairs = [pair for pair in pairs if dtype == np.float64 or pair[0].fits_single]
    x = jnp.asarray(np.array([body.inputs for body, _ in pairs]), dtype)
    scene = ph.Scene(inertia=ph.Inertia(diagonal=x[:, :3]))
    ts = jnp.stack([0 * x[:, -1], x[:, -1]], axis=-1)
    method, record = ph.ClosedForm(compensated=True), ph.Record(final_only=True)
    done = ph.simulate(scene, ph.State(x[:, 3:7], x[:, 7:10]), ts, method, record=record)
    for n, (body, row) in enumerate(pairs):
        q, w = (np.array(row[k], np.longdouble) for k in ("wxyz_t", "omega_t"))
        found = np.asarray(done.wxyz)[n, 0].astype(np.longdouble)
        off = 2 * min(np.linalg.norm(found - q), np.linalg.norm(found + q))
        rates = np.asarray(done.omega_body)[n, 0]
        off = max(off, np.linalg.norm(rates.astype(np.longdouble) - w) / np.linalg.norm(w))
        # A product of two halves is more accurate than the dtype.
        phase = 2.0**-11 if dtype == np.float32 else 2.0**-27
        room = 1 if body.family != "horizons" else phase
        assert off <= np.finfo(dtype).eps * (6 + 2 * room * row["angle"]), body.name


def test_every_family_is_long_enough():
    assert len(PAIRS) > 240
    assert sum(body.fits_single for body, _ in PAIRS) > 120


# --- Principia's euler_solver_test.cpp, with its own tolerances -----------------------------------

EPS = 2.0**-52
IDENTITY = (1.0, 0.0, 0.0, 0.0)


def _run(moments, momentum, ts, wxyz=IDENTITY):
    moments, momentum = np.array(moments, float), np.array(momentum, float)
    state = ph.State(jnp.array(wxyz), jnp.asarray(momentum / moments))
    scene = ph.Scene(inertia=ph.Inertia(diagonal=jnp.asarray(moments)))
    done = ph.simulate(scene, state, jnp.asarray(ts), ph.ClosedForm())
    return np.asarray(done.wxyz), np.asarray(done.omega_body)


def test_principia_short_fat_symmetric_top():
    ts = np.arange(1001) / 200
    wxyz, omega = _run((3, 3, 9), (0, 5, 7), ts)
    momentum = omega * np.array([3, 3, 9])
    slip = -14 / 9 * ts
    exact = np.stack([5 * np.sin(slip), 5 * np.cos(slip), np.full(1001, 7.0)], -1)
    size = np.hypot(5, 7)
    assert np.linalg.norm(momentum - exact, axis=-1).max() <= 102 * EPS * size
    space = np.asarray(rotation.rotate(jnp.asarray(wxyz), jnp.asarray(momentum)))
    assert np.linalg.norm(space - (0, 5, 7), axis=-1).max() <= 32 * EPS * size
    energy = (omega * momentum).sum(-1)
    np.testing.assert_allclose(energy, 25 / 3 + 49 / 9, rtol=8 * EPS)


def test_principia_dzhanibekov():
    ts = np.arange(1001) / 10
    wxyz, omega = _run((3, 5, 9), (0, 2, 0.01), ts)
    momentum = omega * np.array([3, 5, 9])
    x, y, z = np.asarray(rotation.rotate(jnp.asarray(wxyz), jnp.asarray(momentum))).T
    assert np.abs(x).max() <= 10 * EPS
    assert np.abs(y - 2).max() <= 16 * np.spacing(2.0)
    assert np.abs(z - 0.01).max() <= 965 * np.spacing(0.01)
    energy = (omega * momentum).sum(-1)
    np.testing.assert_allclose(energy, 4 / 5 + 1e-4 / 9, rtol=39 * EPS)
    # 34-digit Taylor series, t = 100
    exact = np.array([0.06969808760992535, 0.3944970962189294, 0.028475810857311386])
    np.testing.assert_allclose(omega[-1], exact, atol=1e-14)


@pytest.mark.parametrize(
    ("axis", "size", "angle", "ulps"), [(0, 5, 25, 17), (1, 6, 20, 1), (2, 7, 14, 148)]
)
def test_principia_principal_spins(axis, size, angle, ulps):
    momentum = np.eye(3)[axis] * size
    wxyz, omega = _run((2, 3, 5), momentum, np.arange(1001) / 100)
    exact = np.array([np.cos(angle / 2), *(np.eye(3)[axis] * np.sin(angle / 2))])
    off = min(np.linalg.norm(wxyz[-1] - exact), np.linalg.norm(wxyz[-1] + exact))
    assert 2 * off <= ulps * np.spacing(float(angle))
    np.testing.assert_array_equal(omega[1:], np.broadcast_to(omega[1], omega[1:].shape))
    np.testing.assert_allclose(omega[:2], [momentum / (2, 3, 5)] * 2, rtol=EPS)  # given, worked out


def test_principia_sphere():
    a, b, c = (
        np.array([np.cos(x / 2), *(np.array(u) * np.sin(x / 2))])
        for x, u in (
            (0.5, (0, 1, 0)),
            (1.5, (0, 0, 1)),
            (-2.5, (0, 1, 0)),
        )
    )
    a, b, c = map(jnp.asarray, (a, b, c))
    start = rotation.multiply(rotation.multiply(a, b), c)
    wxyz, omega = _run((3, 3, 3), (1, 2, 4), np.arange(1001) / 100, start)
    np.testing.assert_allclose(omega[-1], (1 / 3, 2 / 3, 4 / 3), rtol=10 * EPS)
    rate = np.sqrt(21) / 3
    axis = np.array([1, 2, 4]) / np.sqrt(21)
    own = jnp.array([np.cos(5 * rate), *(axis * np.sin(5 * rate))])
    exact = np.asarray(rotation.multiply(start, own))
    off = min(np.linalg.norm(wxyz[-1] - exact), np.linalg.norm(wxyz[-1] + exact))
    assert off <= 114 * EPS


# --- Orekit's TorqueFreeTest.java, with its own tolerances ----------------------------------------


def test_orekit_momentum_and_local_behaviour():
    orders = [list(order) for order in itertools.permutations(range(3))]
    moments = np.array([np.array([0.375, 0.5, 0.625])[a] for a in orders for _ in orders])
    omega = np.array([np.array([0.05, 0.0, 0.04])[b] for _ in orders for b in orders])
    starts = np.array([np.roll((0.9, 0.437, 0.0, 0.0), k) for k in range(4)] * 9)
    for sign in (1, -1):
        ts = sign * np.arange(4001) / 100
        wxyz, rates = _run(moments, moments * omega, ts, starts)
        now = rotation.rotate(jnp.asarray(wxyz), jnp.asarray(rates * moments[:, None]))
        now = np.asarray(now)
        off = np.cross(now, now[:, :1]) / np.sum(now[:, :1] ** 2, -1, keepdims=True)
        assert np.linalg.norm(off, axis=-1).max() <= 1.6e-15
        for t, apart in ((0.1, 5e-6), (1.0, 5e-4)):
            turn = rotation.rotation_vector_to_wxyz(jnp.asarray(sign * t * omega))
            fixed = rotation.multiply(rotation.normalise(jnp.asarray(starts)), turn)
            angle = rotation.angle_between(fixed, jnp.asarray(wxyz[:, round(100 * t)]))
            assert np.max(angle) <= apart
