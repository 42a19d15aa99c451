"""Second derivatives with respect to a full tensor: right, or NaN where moments are equal."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import polhode as ph
from polhode._kernels import over_gap

STATE = ph.State([1.0, 0.0, 0.0, 0.0], [0.4, -0.7, 1.1])
TURN = np.asarray(ph.rotation.wxyz_to_matrix(ph.rotation.normalise([0.9, 0.3, -0.2, 0.25])))
ENTRIES = [(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)]
UNIT = np.zeros((6, 3, 3))
for k, (i, j) in enumerate(ENTRIES):
    UNIT[k, i, j] = UNIT[k, j, i] = 1


def tensor(x, base):
    return base + jnp.tensordot(x, jnp.asarray(UNIT), 1)


def rates(x, base):
    scene = ph.Scene(ph.Inertia.from_tensor(tensor(x, base)))
    record = ph.Record(final_only=True, attitude=False)
    return ph.simulate(scene, STATE, jnp.array([0.0, 2.0]), record=record).omega_body[-1]


def attitude_and_rates(x, base):
    scene = ph.Scene(ph.Inertia.from_tensor(tensor(x, base)))
    last = ph.simulate(scene, STATE, jnp.array([0.0, 2.0])).last
    return jnp.concatenate([last.wxyz, last.omega_body])


def moments(x, base):
    return ph.Inertia.from_tensor(tensor(x, base)).moments


def periods(x, base):
    found = ph.periods(ph.Inertia.from_tensor(tensor(x, base)), STATE)
    return jnp.stack([found.P_psi, found.P_phi, found.k2, found.theta_min, found.theta_max])


@functools.cache
def programs(function, inner):
    """Programs of first and second derivatives."""
    return jax.jit(jax.jacfwd(function)), jax.jit(jax.jacfwd(inner(function)))


def second_and_differences(function, base, step, inner=jax.jacfwd):
    """Second derivatives (k, 6, 6), and central differences of the first ones."""
    first, twice = programs(function, inner)
    second = np.asarray(twice(jnp.zeros(6), base))

    def moved(a):
        return np.stack([np.asarray(first(a * step * e, base)) for e in jnp.eye(6)], -1)

    differences = (8 * (moved(1) - moved(-1)) - (moved(2) - moved(-2))) / (12 * step)
    return second, differences


BODIES = {
    "three": [1.0, 2.0, 2.5],
    "greater two equal": [1.0, 2.0, 2.0],
    "lesser two equal": [1.0, 1.0, 1.5],
    "all equal": [1.0, 1.0, 1.0],
}


def right_or_nan(function, kind, *, turned, inner=jax.jacfwd, tolerance=1e-6):
    """Finite second derivatives must agree with differences; the others are NaN."""
    base = np.diag(BODIES[kind])
    if turned:
        base = TURN @ base @ TURN.T
        base = (base + base.T) / 2
    found, differences = second_and_differences(function, jnp.asarray(base), 1e-3, inner)
    known = np.isfinite(found)
    apart = np.abs(np.where(known, found - differences, 0)).max()
    assert apart <= tolerance * np.abs(differences).max(), (kind, apart)
    assert np.all(known) == (kind == "three")
    return known


@pytest.mark.parametrize("turned", [pytest.param(False, marks=pytest.mark.slow), True])
@pytest.mark.parametrize("kind", BODIES)
def test_second_derivatives_of_principal_moments_are_right_or_nan(kind, turned):
    if kind == "three":
        right_or_nan(moments, kind, turned=turned)
    else:  # eigenvalues have no second derivatives there
        base = TURN @ np.diag(BODIES[kind]) @ TURN.T if turned else np.diag(BODIES[kind])
        found = jax.jit(jax.hessian(moments))(jnp.zeros(6), jnp.asarray((base + base.T) / 2))
        assert np.any(np.isnan(found))
        assert np.all(np.isfinite(jax.jit(jax.jacrev(moments))(jnp.zeros(6), jnp.asarray(base))))


@pytest.mark.slow  # faster: derivatives of principal moments, above
@pytest.mark.parametrize("kind", BODIES)
def test_second_derivatives_of_periods_are_right_or_nan(kind):
    if kind == "three":
        right_or_nan(periods, kind, turned=True)
        right_or_nan(periods, kind, turned=True, inner=jax.jacrev)
        return
    second = jax.jit(jax.jacfwd(jax.jacfwd(periods)))
    turned = jnp.asarray(TURN @ np.diag(BODIES[kind]) @ TURN.T)
    for base in (jnp.diag(jnp.asarray(BODIES[kind])), (turned + turned.T) / 2):
        assert np.all(np.isnan(second(jnp.zeros(6), base)))


@pytest.mark.parametrize("gap", [0.0, 1e-9, 1e-7, 0.1])
def test_the_turn_of_axes_is_not_known_where_moments_agree_to_half_of_their_digits(gap):
    first, second = jnp.array([2.0]), jnp.array([2.0 * (1 + gap)])

    def turn(x):
        return over_gap(x, first, second)[0]

    zero = jnp.zeros(1)
    assert turn(zero) == 0
    found = np.array([jax.jacfwd(turn)(zero)[0], jax.jacrev(turn)(zero)[0]])
    if gap < 1.5e-8:
        assert np.all(np.isnan(found))
        assert jax.jvp(turn, (zero,), (zero,))[1] == 0  # a zero tangent gives a zero derivative
    else:
        np.testing.assert_allclose(found, -1 / (2 * gap), rtol=1e-8)


@pytest.mark.slow  # programs compile for minutes: each mode once, only the rates once
@pytest.mark.parametrize(
    ("function", "inner"), [(rates, jax.jacfwd), (attitude_and_rates, jax.jacrev)]
)
def test_second_derivatives_of_the_motion_are_right_or_nan(function, inner):
    for kind in BODIES:
        for turned in (False, True):
            right_or_nan(function, kind, turned=turned, inner=inner)
