"""The Moser-Veselov step against exact motion, reversal of the splittings, what they refuse."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import polhode as ph
from benchmarks.integrators import heavy_top
from polhode._integrate import Splitting
from polhode._integrate._moser_veselov import ORDERS, paced, prepare, tangents

TERM = diffrax.ODETerm(heavy_top)
BODIES = np.array([[1.0, 2.0, 3.0], [1.0, 1.0, 0.5], [0.01, 1.0, 1.0005], [4.0, 4.0, 4.0]])
AXIS = np.array([[2.0, 3.0, 6.0]]) / 7
OMEGA = np.array([[1.0, 0.25, -0.5], [0.5, -0.75, 1.0], [1.0, 0.5, -0.25], [0.25, 0.5, -1.0]])


def turned(order, span, moments, omega):
    """Quaternions (n, 4) that bodies turn by in one step."""
    inverse = [1 / moments[:, i] for i in range(3)]
    momentum = [moments[:, i] * omega[:, i] for i in range(3)]
    f, square = tangents(*paced(prepare(inverse, order), span, momentum))
    return jnp.stack([jnp.ones_like(square), *f], axis=-1) / jnp.sqrt(square)[:, None]


def exact(span, moments, omega):
    scene = ph.Scene(ph.Inertia.from_moments(moments))
    state = ph.State([1.0, 0, 0, 0], omega)
    times = np.array([0.0, span])
    return ph.simulate(scene, state, times, record=ph.Record(final_only=True)).wxyz[:, 0]


@pytest.mark.parametrize("order", ORDERS)
def test_moser_veselov_has_its_order(order):
    """Errors of single steps of free bodies, needle and sphere among them, fall like h^(p + 1)."""
    step, errors = jax.jit(turned, static_argnums=0), []
    for span in (0.5, 0.25):
        truth = np.asarray(exact(span, BODIES, OMEGA))
        gap = np.abs(step(order, jnp.asarray(span), BODIES, OMEGA) - truth).max(axis=1)
        errors.append(gap)
    assert np.all(errors[1] > 2e-16)  # above rounding: the slope means something
    found = np.log2(errors[0] / errors[1]) - 1
    np.testing.assert_allclose(found, order, atol=0.12 * order)


def test_moser_veselov_at_rest_and_at_its_limit():
    """No turn and right slopes at rest; right up to 1 rad, NaN beyond 1.5 rad; any units."""
    step = jax.jit(turned, static_argnums=0)
    for dtype, many in ((jnp.float64, 1e35), (jnp.float32, 1e12)):  # an asteroid's numbers
        eps = float(jnp.finfo(dtype).eps)
        moments, axis = jnp.asarray(BODIES[:1], dtype), jnp.asarray(AXIS, dtype)
        span, still = jnp.asarray(0.5, dtype), jnp.zeros((1, 3), dtype)
        np.testing.assert_array_equal(step(10, span, moments, still), [[1, 0, 0, 0]])
        slope = jax.jit(jax.jacfwd(lambda w, s=span, m=moments: turned(10, s, m, w)))(still)
        np.testing.assert_allclose(slope[0, 1:, 0], np.eye(3) / 4, atol=4 * eps)
        for angle in np.arange(0.5, 4.0, 0.125):
            got = np.asarray(step(10, jnp.asarray(angle, dtype), moments, axis))
            if angle <= 1:
                gap = np.abs(got - np.asarray(exact(angle, BODIES[:1], AXIS))).max()
                assert gap < max(1e-6 * angle**11, 4 * eps)
            elif angle > 1.5:
                assert np.all(np.isnan(got))
        large = np.asarray(moments) * np.asarray(many, dtype)
        same = np.abs(np.subtract(step(10, span, large, axis), step(10, span, moments, axis)))
        assert same.max() < 4 * eps


CASES = [
    (Splitting(2), jnp.float64),
    (Splitting(4), jnp.float64),
    (Splitting(6), jnp.float64),
    (Splitting(8), jnp.float64),
    (Splitting(4, moser_veselov=6), jnp.float64),
    (Splitting(2), jnp.float32),
    (Splitting(8), jnp.float32),
    (Splitting(6, moser_veselov=10), jnp.float32),
]


@pytest.mark.parametrize(
    ("solver", "dtype"),
    CASES,
    ids=lambda x: f"{x.formal_order}-{x.moser_veselov}" if isinstance(x, Splitting) else x.__name__,
)
def test_steps_are_undone_by_steps_back(solver, dtype):
    """Up to what the motion back makes of the rounding of both ways."""
    moments, steps, width = (1.0, 1.5, 2.0), 200, 0.05
    wxyz = np.array([[0.5, 0.5, -0.5, 0.5], [0.8, 0.0, 0.6, 0.0], [0.28, 0.96, 0.0, 0.0]])
    omega = np.array([[1.25, -0.5, 0.75], [0.25, 1.5, -0.5], [-1.0, 0.5, 1.0]])
    args = (tuple(jnp.full(3, 1 / i, dtype) for i in moments), jnp.ones(3, dtype))
    y0 = tuple(
        tuple(jnp.asarray(x, dtype) for x in np.transpose(part)) for part in (omega * moments, wxyz)
    )

    @jax.jit
    def march(y, width):
        def one(carry, _):
            y, memory = carry
            y, _, _, memory, _ = solver.step(TERM, 0 * width, width, y, args, memory, False)
            return (y, memory), None

        start = (y, solver.init(TERM, 0 * width, width, y, args))
        return jax.lax.scan(one, start, None, length=steps)[0][0]

    def stacked(y):
        return np.stack([np.asarray(x, float) for part in y for x in part], axis=-1)

    def there_and_back(y):
        end = march(y, jnp.asarray(width, dtype))
        return stacked(end), stacked(march(end, jnp.asarray(-width, dtype)))

    eps = float(jnp.finfo(dtype).eps)
    # how much the end depends on the start
    nudge = 1e-4 if dtype == jnp.float32 else 1e-8
    other = (tuple(x + nudge for x in y0[0]), y0[1])
    sensitivity = np.abs(there_and_back(other)[0] - there_and_back(y0)[0]).max() / nudge
    end, back = there_and_back(y0)
    assert np.abs(end - stacked(y0)).max() > 0.1
    bound = 8 * eps * np.sqrt(2 * steps) * max(sensitivity, 1)  # 5.3 on one version of jax
    assert np.abs(back - stacked(y0)).max() < bound


INERTIA = ph.Inertia.from_moments([1.0, 1.5, 2.0])
GRAVITY = ph.UniformGravity(1.0, [0.1, 0.0, 0.5], [0.0, 0.0, -2.0])
STATE = ph.State([0.5, 0.5, 0.5, -0.5], [[0.5, -1.0, 0.75], [0.25, 0.5, -0.5]])


def wave(t):
    return jnp.stack([jnp.sin(t), 0.2 * jnp.cos(t), 0.1 * t])


def test_through_simulate():
    """From time to time in equal steps, with motors and torques of time."""
    motors = ph.Rotor([1.0, 0, 0], inertia=0.1, speed=2.0, impulse=jnp.sin)
    scene = ph.Scene(
        INERTIA, GRAVITY, ph.SpaceTorque(wave), motors + ph.Rotor([0, 0, 1.0], momentum=0.4)
    )
    ts = jnp.array([0.5, 1.0, 3.0, 3.7])
    got = ph.simulate(scene, STATE, ts, ph.LiePoisson(Splitting(8), dt0=0.06))
    best = ph.simulate(scene, STATE, ts, rtol=1e-12)
    np.testing.assert_allclose(got.omega_body, best.omega_body, rtol=0, atol=2e-10)
    assert np.max(ph.rotation.angle_between(got.wxyz, best.wxyz)) < 2e-10
    assert np.all(got.steps == 9 + 34 + 12)


SPLIT = ph.LiePoisson(Splitting(4), dt0=0.1)
WHOLE = ph.LiePoisson(Splitting(4, moser_veselov=10), dt0=0.1)


@pytest.mark.parametrize(
    ("method", "scene", "record", "message"),
    [
        (ph.LiePoisson(Splitting(4)), ph.Scene(INERTIA), None, "dt0"),
        (ph.EulerAngles(Splitting(4), dt0=0.1), ph.Scene(INERTIA), None, "LiePoisson"),
        (SPLIT, ph.Scene(INERTIA, GRAVITY, ph.LinearDamping(0.1)), None, "damping"),
        (SPLIT, ph.Scene(ph.Inertia.from_tensor(np.eye(3) + 0.1)), None, "principal"),
        (SPLIT, ph.Scene(INERTIA), ph.Record(work=True), "work"),
        (WHOLE, ph.Scene(INERTIA, rotors=ph.Rotor([0, 0, 1.0], momentum=0.1)), None, "rotors"),
    ],
)
def test_what_cannot_be_split_is_refused(method, scene, record, message):
    with pytest.raises(ValueError, match=message):
        ph.simulate(scene, STATE, [0.0, 1.0], method, record=record)


def test_a_step_too_wide_is_marked():
    """One body of two turns too far in a step: NaN and a status for it alone."""
    state = ph.State([1.0, 0, 0, 0], [[0.1, 0.2, 0.3], [30.0, 20.0, 10.0]])
    end = ph.simulate(ph.Scene(INERTIA, GRAVITY), state, [0.0, 1.0], WHOLE, throw=False)
    assert list(end.status) == [ph.Status.SUCCESSFUL, ph.Status.NOT_FINITE]
    assert np.all(np.isfinite(end.wxyz[0]))
    with pytest.raises(ph.SimulationError):
        ph.simulate(ph.Scene(INERTIA, GRAVITY), state, [0.0, 1.0], WHOLE)
