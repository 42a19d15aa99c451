"""A work queue of bodies: each ends as it does alone, and no body waits for another."""

from functools import partial
from typing import NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import polhode as ph
from polhode import Extrapolation
from polhode._integrate._charts import LiePoissonChart
from polhode._integrate._midpoint import in_lanes
from polhode._policy import LANES, QUEUE

N = 90


class _Countdown(NamedTuple):
    left: jax.Array
    total: jax.Array


class _Weights(NamedTuple):
    body: jax.Array
    weight: jax.Array
    unit: jax.Array


def _counted(wanted, weight, dtype):
    """Bodies that take ``wanted`` steps and sum their weight; number of iterations."""
    n = wanted.shape[0]
    fixed = _Weights(jnp.arange(n, dtype=jnp.int32), weight.astype(dtype), jnp.asarray(1, dtype))

    def able(fixed, walk):
        del fixed
        return walk.left > 0

    def step(fixed, walk, turns):
        on = able(fixed, walk)
        total = walk.total + jnp.where(on, fixed.weight * fixed.unit, 0)
        return _Countdown(walk.left - jnp.where(on, 1, 0), total), turns + 1

    def finished(fixed, walk):
        return walk.total, walk.left, fixed.body

    walk = _Countdown(wanted.astype(jnp.int32), jnp.zeros(n, dtype))
    return in_lanes(step, able, finished, fixed, walk, jnp.zeros((), int))


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@pytest.mark.parametrize("n", [65, 100, 1000])
def test_every_body_takes_its_own_steps_and_few_lanes_stand_empty(n, dtype):
    rng = np.random.default_rng(n)
    wanted = np.sort(rng.integers(1, 200, n))[::-1].copy()
    weight = rng.integers(1, 9, n)
    (total, left, body), turns = jax.jit(_counted, static_argnums=2)(wanted, weight, dtype)
    np.testing.assert_array_equal(total, wanted * weight)
    np.testing.assert_array_equal(left, 0)
    np.testing.assert_array_equal(body, np.arange(n))
    least = max(wanted.max(), wanted.sum() / LANES)
    assert least <= int(turns) <= (1.25 if n == 1000 else 2) * least + 8


def test_a_batch_of_queues_ends_when_the_longest_is_through():
    """Finished queues do not change while others of the batch continue."""
    wanted = np.stack([np.full(80, 2), np.arange(80) + 1, np.full(80, 50)])
    wanted[0, 7] = 0
    run = jax.vmap(lambda x: _counted(x, jnp.arange(80), jnp.float64))
    (total, *_), _ = jax.jit(run)(wanted)
    np.testing.assert_array_equal(total, wanted * np.arange(80))


def _scene(moments, *acts):
    return ph.Scene(ph.Inertia.from_moments(moments), *acts)


def _drawn(n):
    """Tops whose numbers of steps differ by a factor of ten."""
    rng = np.random.default_rng(5)
    moments = np.sort(rng.uniform(1, 2, (n, 3)), axis=-1)
    wxyz = rng.normal(size=(n, 4))
    wxyz /= np.linalg.norm(wxyz, axis=-1, keepdims=True)
    return moments, wxyz, rng.normal(size=(n, 3)) * 10 ** rng.uniform(-0.5, 0.5, (n, 1))


GRAVITY = ph.UniformGravity(1.0, [0.1, 0.2, 0.5])
DRAG = ph.LinearDamping(0.05)


def _ends(chunk, moments, wxyz, omega, acts=(GRAVITY,)):
    method = ph.LiePoisson(Extrapolation(None), chunk=chunk, max_steps=300)
    state = ph.State(wxyz, omega)
    return ph.simulate(_scene(moments, *acts), state, [0.0, 1.0, 3.0], method, throw=False)


def _moved(chunk, acts):
    """Derivatives of a function of the last states, and all final states, in one program."""

    def total(*given):
        found = _ends(chunk, *given, acts)
        end = found.last
        return jnp.sum(end.wxyz**3) + jnp.sum(end.omega_body**2), found

    return jax.jit(jax.grad(total, (0, 1, 2), has_aux=True))


@pytest.mark.slow
def test_a_queue_does_not_change_values():
    """Compared with chunks of 30, none of which has more bodies than lanes; a NaN body does not
    block its lane.
    """
    given = _drawn(N)
    given[2][17] = 1e3
    queued, apart = (jax.jit(partial(_ends, chunk))(*given) for chunk in (None, 30))
    check_equal_motions(queued, apart)


def check_equal_motions(queued, apart):
    assert list(np.flatnonzero(queued.status)) == [17]
    for name in ("wxyz", "omega_body"):
        np.testing.assert_allclose(getattr(queued, name), getattr(apart, name), atol=2e-13)
    np.testing.assert_array_equal(queued.steps, apart.steps)


@pytest.mark.slow
@pytest.mark.parametrize("acts", [(GRAVITY,), (GRAVITY, DRAG)], ids=len)
def test_a_queue_changes_neither_values_nor_slopes(acts):
    given, ways = _drawn(N), [_moved(chunk, acts) for chunk in (None, 30)]
    given[2][17] = 1e3
    (_, queued), (_, apart) = (way(*given) for way in ways)
    check_equal_motions(queued, apart)
    given[2][17] = 1.0
    for one, other in zip(*(way(*given)[0] for way in ways), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-11)


@pytest.mark.slow
def test_batches_of_queues_are_queues():
    moments, wxyz, omega = _drawn(N)
    rates = jnp.stack([omega, 0.1 * omega])

    def end(omega):
        return _ends(None, moments, wxyz, omega).last.wxyz

    both = jax.jit(jax.vmap(end))(rates)
    for one, omega in zip(both, rates, strict=True):
        np.testing.assert_allclose(one, _ends(None, moments, wxyz, omega).last.wxyz, atol=2e-13)


def _together(*acts):
    """Bodies that share one solve."""
    moments, wxyz, omega = _drawn(N)
    scene, chart = _scene(moments, *acts), LiePoissonChart()
    state, ts = ph.State(jnp.asarray(wxyz), jnp.asarray(omega)), jnp.array([0.0, 1.0])
    y, _ = chart.start(scene, state, ts[0])
    dynamics = chart.dynamics(scene, state, ts)
    return Extrapolation(None).bodies_at_once(diffrax.ODETerm(chart.field), ts[0], y, dynamics)


def test_only_bodies_that_have_nothing_in_common_stand_in_a_queue():
    assert _together(GRAVITY) == QUEUE
    assert _together(ph.GravityGradient(0.25, [0.6, 0.0, 0.8]), DRAG) == QUEUE
    table = jnp.linspace(0.0, 1.0, N)  # as long as there are bodies, but not of them
    looked_up = ph.FeedbackTorque(lambda t, wxyz, omega: jnp.interp(omega, 10 * table, table))
    assert _together(GRAVITY, looked_up) == LANES
    assert _together(GRAVITY, ph.BodyTorque(lambda t: jnp.stack([t, t, t]))) == LANES
    orbit = ph.KeplerOrbit(1.0, 2.0, 0.1)
    assert _together(ph.GravityGradient(1.0, orbit)) == LANES
