"""The public functions: prepare a motion and evaluate it."""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from polhode._closed_forms.free._compensated import compensate
from polhode._closed_forms.free._flow import Instant, advance, attitude, rates
from polhode._closed_forms.free._frame import Quadruple
from polhode._closed_forms.free._motion import (
    FreeConstants,
    Swing,
    Turning,
    prepare_swing,
    prepare_turning,
)
from polhode._closed_forms.free._roles import Triple, assign_roles
from polhode._closed_forms.free._rule import Found, answer_rule
from polhode._kernels import kernel, opaque_ones

Scalars = Float[Array, "*b"]

# States that a core keeps in its nearest caches through all stages.
_CHUNK = 8192

_ABREAST = 64
"""Bodies from which loops over them are long enough."""

LANES = 512
"""Bodies whose constants a core keeps near while it moves them to many times."""


def components(values, count: int) -> tuple[Scalars, ...]:
    """A tuple of component arrays, from one or from an array with the components last."""
    if isinstance(values, tuple | list):
        return tuple(values)
    return tuple(values[..., k] for k in range(count))


def prepare(moments, wxyz, omega, products=None, *, compensated: bool = False) -> FreeConstants:
    """Constants of the exact motion of free bodies.

    **Arguments:** principal ``moments`` (..., 3), positive, in any order; initial attitude
    ``wxyz`` (..., 4), or None when only rates will be asked; initial body rates ``omega``
    (..., 3) along the principal axes; ``products`` (..., 3), the entries xy, xz, yz of the inertia
    tensor, of value zero: they only carry tangents. Each may be a tuple of component arrays; all
    components share one shape, the batch. ``compensated``: the frequencies in sums of two floats,
    for long horizons.
    """
    moments, omega = components(moments, 3), components(omega, 3)
    products = None if products is None else components(products, 3)
    wxyz = None if wxyz is None else components(wxyz, 4)
    roles = assign_roles(moments, omega)
    swing = prepare_swing(roles)
    turning = None if wxyz is None else prepare_turning(swing, wxyz)
    if compensated:
        swing, turning = compensate(swing, turning, roles)
    return FreeConstants(moments, products, omega, wxyz, swing, turning)


def evaluate(
    motion: FreeConstants, t: Float[Array, "..."], *, attitude: bool = True, rates: bool = True
) -> tuple[Triple | None, Quadruple | None]:
    """Body rates and attitude at times ``t`` from the start, as tuples of component arrays.

    ``t`` has the rank of the batch and broadcasts with it, or one trailing axis more: the times
    of each body. Times may be negative. What is not asked is None and costs nothing.
    """
    batch = motion.moments[0].ndim
    t = jnp.asarray(t)
    if t.ndim > batch + 1:
        raise ValueError(f"t has {t.ndim} axes, the motion {batch}: expected as many or one more")
    if attitude and motion.turning is None:
        raise ValueError("the motion was prepared without wxyz: give it, or ask attitude=False")
    many = t.ndim == batch + 1
    if many:
        motion = jax.tree.map(lambda x: x[..., None], motion)
    elif t.ndim < batch:
        t = t.reshape((1,) * (batch - t.ndim) + t.shape)
    turning = motion.turning if attitude else None
    given = (motion.moments, motion.products, motion.omega, motion.wxyz if attitude else None, t)
    # Derivatives do not pass through the constants (see _rule.py).
    constants = jax.lax.stop_gradient((motion.swing, turning))
    return _evaluate((attitude, rates, many), constants, given)


def free_motion(
    moments,
    wxyz,
    omega,
    t,
    products=None,
    *,
    attitude: bool = True,
    rates: bool = True,
    compensated: bool = False,
) -> tuple[Triple | None, Quadruple | None]:
    """The exact free motion: `prepare` and `evaluate` in one call.

    A long batch of one axis is worked off in chunks that fit the cache of a processor core.

    First and second derivatives, forward and reverse, are exact in every regime, with two limits
    on second ones: those by ``products`` lose digits in proportion to the inverse relative
    difference of two moments, and are NaN where two agree to half of their digits; those by the
    rates lose the ratio of a radian to the angle turned through, except at rest.
    """
    parts = (
        components(moments, 3),
        components(wxyz, 4) if attitude else None,
        components(omega, 3),
        None if products is None else components(products, 3),
    )

    t = jnp.asarray(t)
    wanted = {"attitude": attitude, "rates": rates}
    if t.ndim == 2 and parts[0][0].ndim == 1 and is_abreast(len(parts[0][0]), t.shape[1]):
        return _chunked(lambda given, t: _abreast(given, t, compensated, wanted), parts, t, LANES)

    def whole(given, t):
        return evaluate(prepare(*given, compensated=compensated), t, **wanted)

    rows = max(1, _CHUNK // max(t.shape[1] if t.ndim == 2 else 1, 1))
    return _chunked(kernel(whole, linearised=True), parts, t, rows)


def is_abreast(bodies: int, times: int) -> bool:
    """Whether all bodies are moved to one time after the other: the loops are then over bodies."""
    return jax.default_backend() == "cpu" and times > 1 and bodies >= _ABREAST


def _abreast(given, t, compensated: bool, wanted):
    """The motion of many bodies, one time after the other; the constants are worked out once."""

    def constants(given):
        motion = prepare(*given, compensated=compensated)
        return motion.swing, motion.turning

    found = kernel(constants)(jax.lax.stop_gradient(given))

    def at(given, found, t):
        moments, wxyz, omega, products = given
        return evaluate(FreeConstants(moments, products, omega, wxyz, *found), t, **wanted)

    # Coefficients of the derivative are worked out again where they are used: kept for all times
    # they would go through the memory, which takes longer.
    one = jax.checkpoint(kernel(at, linearised=True), prevent_cse=False)
    samples = jax.lax.map(lambda t: one(given, found, t), t.T)
    return jax.tree.map(jnp.transpose, samples)


def even_rows(count: int, most: int = LANES) -> int:
    """Bodies of a chunk: if possible a divisor, which spares the copies that padding makes."""
    if count < 2 * most:
        return count
    return next((n for n in range(most, most // 4 - 1, -1) if n > 0 and count % n == 0), most)


def _chunked(fn, parts, t, rows):
    """``fn(parts, t)``, ``rows`` bodies at a time where a processor has many to do."""
    lanes = parts[0][0]
    if jax.default_backend() != "cpu" or lanes.ndim != 1 or lanes.shape[0] < 2 * rows:
        return fn(parts, t)
    count = lanes.shape[0]
    rows = even_rows(count, rows)
    missing = -count % rows

    def cut(x):
        if missing == 0:
            return x.reshape(-1, rows, *x.shape[1:])
        last = jnp.broadcast_to(x[-1:], (missing, *x.shape[1:]))
        return jnp.concatenate([x, last]).reshape(-1, rows, *x.shape[1:])

    own = t.ndim > 0 and t.shape[0] == count
    pieces = jax.tree.map(cut, (parts, t) if own else (parts, None))
    out = jax.lax.map(lambda p: fn(p[0], p[1] if own else t), pieces)
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[:count], out)


def _results(asked, swing: Swing, turning: Turning | None, at: Instant):
    return (
        rates(swing, at) if asked[1] else None,
        attitude(swing, turning, at) if asked[0] else None,
    )


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _evaluate(asked, constants, given):
    swing, turning = constants
    one = None if asked[2] else swing.one
    return _results(asked, swing, turning, advance(swing, turning, given[-1], one))


def _evaluate_rule(asked, primals, tangents):
    (swing, turning), given = primals
    t = jax.lax.stop_gradient(given[-1])
    # The tangent has many kernels, and each would repeat the motion itself.
    at = advance(swing, turning, t, opaque_ones(t * swing.one), fine=True)
    found = Found(swing, turning, at, _results(asked, swing, turning, at))
    return answer_rule(asked, (found, given), (None, tangents[1]))


_evaluate.defjvp(_evaluate_rule, symbolic_zeros=True)
