"""From recordings of one body to its best parameters: start, Levenberg-Marquardt, information."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from polhode.fit._motion import AbstractMotion
from polhode.fit._parameters import AbstractInertiaUnknown, Parameters, free_columns
from polhode.fit._recording import Recording
from polhode.fit._residuals import Huber, Model, residuals
from polhode.fit._start import alternatives, regression
from polhode.inertia import Inertia, principal
from polhode.rotation import conjugate, multiply


class Problem(eqx.Module):
    """What is asked: motion, unknowns, loss, start and optimiser (see ``fit_inertia``)."""

    motion: AbstractMotion
    unknown: AbstractInertiaUnknown
    known: Inertia | None = None
    robust: Huber | None = None
    bias: bool = eqx.field(static=True, default=False)
    mounting: bool = eqx.field(static=True, default=False)
    noise_known: bool = eqx.field(static=True, default=False)
    starts: int = eqx.field(static=True, default=1)
    solver: Any = None
    max_steps: int = eqx.field(static=True, default=60)


class Solution(eqx.Module):
    """The optimum and everything that is linear about it.

    ``jacobian`` (m, p): of all residuals with respect to the entries of the tensor (xx, yy, zz,
    and for a full one yz, zx, xy) and then the ravelled other parameters. ``cost``: half the sum
    of squares.
    """

    parameters: Parameters
    model: Model
    tensor: Float[Array, "3 3"]
    residual: dict[str, Array]
    jacobian: Float[Array, "m p"]
    cost: Float[Array, ""]
    steps: Array
    stopped: Array
    start_misfit: Float[Array, ""]


def solve(recording: Recording, problem: Problem) -> Solution:
    """Fit one body to its recordings (leading axis r). Pure; works under jit and vmap."""
    rates = _rates(recording)
    bases, misfit = _bases(recording, rates, problem)
    scale_known = problem.motion.fixes_scale()
    columns = free_columns(problem.unknown, scale_known)
    fixed = tuple(map(tuple, columns.tolist()))
    attitude = None if recording.wxyz is None else recording.wxyz[:, 0]

    def model_of(base):
        return Model(problem.motion, base, attitude, problem.robust, fixed, scale_known)

    dtype = rates.dtype
    zero = jnp.zeros(3, dtype)
    begin = Parameters(
        shape=jnp.zeros(columns.shape[1], dtype),
        omega=rates[:, 0],
        attitude=None if attitude is None else jnp.zeros((rates.shape[0], 3), dtype),
        bias=zero if problem.bias else None,
        mounting=zero if problem.mounting else None,
        lever=zero if recording.force is not None else None,
        motion=jax.tree.map(lambda x: jnp.asarray(x, dtype), problem.motion.start()),
    )
    scale = _scale(begin, recording, rates)
    tolerance = float(jnp.finfo(dtype).eps) ** 0.55
    solver = problem.solver or optx.LevenbergMarquardt(rtol=tolerance, atol=tolerance)

    def run(base):
        def misfits(scaled, _):
            actual = jax.tree.map(jnp.multiply, scaled, scale)
            return residuals(actual, recording, model_of(base))

        found = optx.least_squares(
            misfits,
            solver,
            jax.tree.map(jnp.divide, begin, scale),
            max_steps=problem.max_steps,
            throw=False,
        )
        parameters = jax.tree.map(jnp.multiply, found.value, scale)
        model = model_of(base)
        tensor, jacobian, rest = _linearised(parameters, recording, model)
        cost = sum(jnp.sum(part**2) for part in rest.values()) / 2
        ended = found.result == optx.RESULTS.successful
        count = found.stats["num_steps"]
        return Solution(parameters, model, tensor, rest, jacobian, cost, count, ended, misfit)

    found = jax.vmap(run)(bases)
    best = jnp.argmin(jnp.where(jnp.isfinite(found.cost), found.cost, jnp.inf))
    return jax.tree.map(lambda leaf: leaf[best], found)


def _linearised(parameters, recording, model):
    """The tensor, the Jacobian by its own entries (regular for flat bodies too), the residuals.

    A tensor whose size the data do not show is brought to a largest moment of one.
    """
    tensor = model.tensor(parameters)
    if not model.scale_known:
        tensor = tensor / principal(tensor)[0][2]
    full = model.is_full
    diagonal = jnp.stack([tensor[0, 0], tensor[1, 1], tensor[2, 2]])
    off = jnp.stack([tensor[1, 2], tensor[2, 0], tensor[0, 1]])
    rest, back = ravel_pytree(eqx.tree_at(lambda p: p.shape, parameters, jnp.zeros(0, off.dtype)))
    entries = jnp.concatenate([diagonal, off]) if full else diagonal
    count = entries.shape[0]

    def flat_residual(vector):
        (a, b, c), above = vector[:3], vector[3:count] if full else off
        p, q, r = above
        whole = jnp.stack([jnp.stack([a, r, q]), jnp.stack([r, b, p]), jnp.stack([q, p, c])])
        parts = residuals(back(vector[count:]), recording, model, whole)
        return ravel_pytree(parts)[0], parts

    where = jnp.concatenate([entries, rest])
    jacobian, parts = jax.jacfwd(flat_residual, has_aux=True)(where)
    return tensor, jacobian, parts


def _rates(recording: Recording) -> Float[Array, "r t 3"]:
    """Measured rates, or those between successive attitudes; gaps filled by interpolation."""
    if recording.omega is None:
        turn = multiply(conjugate(recording.wxyz[:, :-1]), recording.wxyz[:, 1:])
        sign = jnp.where(turn[..., :1] < 0, -1, 1).astype(turn.dtype)
        between = 2 * sign * turn[..., 1:] / jnp.diff(recording.times, axis=-1)[..., None]
        inner = (between[:, 1:] + between[:, :-1]) / 2
        return jnp.concatenate([between[:, :1], inner, between[:, -1:]], axis=1)

    def one(times, present, omega):
        # a missing sample takes the value interpolated between its present neighbours
        clock = jnp.where(present > 0, times, jnp.inf)
        order = jnp.argsort(clock)
        count = jnp.sum(present > 0)
        rank = jnp.arange(times.shape[0])
        ordered = jnp.where(rank < count, clock[order], times[-1] - times[0] + jnp.max(times))
        last = omega[order[count - 1]]
        values = jnp.where((rank < count)[:, None], omega[order], last[None])
        return jax.vmap(lambda v: jnp.interp(times, ordered, v), 1, 1)(values)

    return jax.vmap(one)(recording.times, recording.present, recording.omega)


def _bases(recording, rates, problem):
    """Starting log-Cholesky vectors (s, 6) and the regression's misfit."""
    carried = None
    spin = getattr(problem.motion, "spin_inertia", None)
    if spin is not None:
        axis = jnp.asarray(problem.motion.axis, rates.dtype)
        carried = spin * recording.wheel[..., None] * axis[None, None]
    first, misfit = regression(rates, recording.times, recording.present, carried)
    if problem.known is not None:
        first = problem.known.to_log_cholesky()
    bases = jnp.stack([first, *alternatives(rates, first)[: problem.starts - 1]])
    if problem.unknown.columns().shape[1] == 3:
        bases = bases * jnp.asarray([1, 1, 1, 0, 0, 0], bases.dtype)[None]
    return bases, misfit


def _scale(begin: Parameters, recording: Recording, rates: Array) -> Parameters:
    """Natural sizes of the unknowns, so that one damping suits them all."""
    typical = jnp.sqrt(jnp.mean(rates**2)) + jnp.finfo(rates.dtype).tiny
    one = jnp.ones((), rates.dtype)

    def like(leaf, size):
        return None if leaf is None else jnp.broadcast_to(size, leaf.shape)

    length = one
    if recording.force is not None:
        length = jnp.sqrt(jnp.mean(recording.force**2)) / typical**2 + jnp.finfo(rates.dtype).tiny
    return Parameters(
        shape=like(begin.shape, one),
        omega=like(begin.omega, typical),
        attitude=like(begin.attitude, one),
        bias=like(begin.bias, typical),
        mounting=like(begin.mounting, one),
        lever=like(begin.lever, length),
        motion=jax.tree.map(lambda x: jnp.where(x != 0, jnp.abs(x), one), begin.motion),
    )
