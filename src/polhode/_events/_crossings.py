"""When a function of attitude, rates and time crosses zero along a trajectory."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from polhode import _integrate  # its names load diffrax at first use
from polhode._batch import PARTS, flatten, lane_times
from polhode._checks import is_concrete
from polhode._events._event import Event, at_least
from polhode._method import Status
from polhode._scene import Scene, State
from polhode._trajectory import Propagator, Trajectory, moved_through, moved_to, with_initial_spins

SAMPLES_PER_TURN = 32
"""Samples per revolution at the fastest natural rate."""

_MAX_SAMPLES = 20_000_000
"""Samples of all bodies together that fit in memory."""

_MIN_CAPACITY = 16
"""Minimum number of minima of the function that are examined."""

CAPACITY = 256
"""Crossings of each body that the steps store unless told otherwise."""

AT_START = 1e-6
"""Part of the time between two samples within which a crossing is the start itself."""


class Crossings(eqx.Module):
    """Crossings of zero of each body, in the order of the motion.

    **Fields:** ``times`` (..., M) [s], inf where there is none; ``slope`` (..., M): derivative
    of the function there [1/s], 0 where there is none; ``count`` (...): number of crossings, which
    may exceed the capacity M (see ``complete``).
    """

    times: Float[Array, "*b m"]
    slope: Float[Array, "*b m"]
    count: Int[Array, "*b"]

    @property
    def complete(self) -> Array:
        """Whether (...) all crossings of a body are stored."""
        return self.count <= self.times.shape[-1]


def crossings(
    trajectory: Trajectory,
    fn: Callable | Event,
    direction: int = 0,
    *,
    capacity: int | None = None,
    samples: int | None = None,
) -> Crossings:
    """Times within those of ``trajectory`` at which ``fn(wxyz, omega_body, t)`` crosses zero.

    **Arguments:** ``fn``: see ``ph.Event``, which may be given in its place; ``direction``: 1
    rising, -1 falling (in time), 0 both; ``capacity``: how many crossings of a body are
    stored; None: all of them; ``samples``: see ``ph.Event``. Under ``jit``, ``vmap`` and ``grad``
    both are required.

    Times are as accurate as the motion: to rounding for closed forms, to ``rtol`` over the
    derivative of the function for integrated motions. Times and ``slope`` have first and second
    derivatives, by the implicit function theorem; third derivatives raise. A zero at the first time
    (within 1e-6 of the time between two samples) does not count as a crossing.

    The function and its derivative are sampled 32 times per revolution of the fastest natural rate,
    the largest of |L| over the smallest moment at the saved samples and of the rate of gravity. If
    the function turns back towards zero between two samples, its turning point is located, and a
    pair of crossings around it. A pair is therefore missed only if the function has three or more
    turning points between two samples, which a direction fixed in the body does not have. Functions
    that vary faster than the body rotates (high powers, other frequencies of the time) and rates
    that rise and fall again between two saved samples need ``samples``.

    Raises ValueError if the samples do not fit into memory, if the steps of a body run out (under
    ``jit`` it is not ``complete``), or if their number is not known under ``jit``.

        up = ph.crossings(traj, lambda wxyz, omega_body, t: omega_body[0], direction=1)
        traj.at(up.times).euler()
    """
    event = fn if isinstance(fn, Event) else Event(fn, direction, samples)
    slots = at_least("capacity", capacity, 1)
    size = event.samples if samples is None else at_least("samples", samples, 2)
    for name in ("wxyz", "omega_body"):
        getattr(trajectory, name)  # raises where it was not recorded
    if trajectory.propagator is None:
        raise ValueError("this trajectory was made by hand: use one that ph.simulate returns.")
    if not isinstance(trajectory.propagator, Propagator):
        raise ValueError(
            "a SampledTorque holds a command that the samples do not contain: events between them"
            " are not searched for."
        )
    propagator: Any = trajectory.propagator
    if not propagator.method.exact:
        step_result = _by_steps(trajectory, event, slots or CAPACITY)
        if step_result is not None:
            _raise_if_failed(step_result[1], "the steps to the last time")
            return (
                step_result[0]
                if capacity is not None
                else _all_of(step_result[0], trajectory, event)
            )
    if size is None:
        size = _sample_count(trajectory)
    if slots is None:
        if not is_concrete(trajectory):
            raise ValueError(
                "under jit, vmap or grad the number of stored crossings must be given: capacity=8."
            )
        slots = _MIN_CAPACITY
    result, has_failed = _by_sampling(trajectory, event, slots, size)
    _raise_if_failed(has_failed, f"the way through {size:,} samples")
    while capacity is None and int(np.max(result.count, initial=0)) > slots:
        slots = 2 ** int(np.ceil(np.log2(np.max(result.count))))
        result, _ = _by_sampling(trajectory, event, slots, size)
    if capacity is None:  # drop columns that no body uses
        count = int(np.max(result.count, initial=0))
        result = Crossings(result.times[..., :count], result.slope[..., :count], result.count)
    return result


def _raise_if_failed(has_failed: Array, way: str) -> None:
    if is_concrete(has_failed) and np.any(np.asarray(has_failed)):
        raise ValueError(
            f"the steps of a body ran out on {way}: search a shorter time (traj.between), or ask"
            " for more steps, ph.LiePoisson(..., max_steps=2**20)."
        )


def _all_of(result: Crossings, trajectory: Trajectory, event: Event) -> Crossings:
    """All crossings, in as many columns as there are, where their number is known."""
    if not is_concrete(result):
        return result
    capacity = int(np.max(result.count, initial=0))
    if capacity > CAPACITY:
        result, _ = _by_steps(trajectory, event, 2 ** int(np.ceil(np.log2(capacity))))
    return Crossings(result.times[..., :capacity], result.slope[..., :capacity], result.count)


@eqx.filter_jit
def _by_steps(trajectory: Trajectory, event: Event, capacity: int) -> Any:
    """Crossings that the steps find on their way, and for which bodies (...) these did not come to
    the last time; None where the method does not look for them."""
    batch = trajectory.batch_shape
    propagator: Any = trajectory.propagator
    parts = {name: flatten(getattr(trajectory.scene, name), batch) for name in PARTS}
    wxyz, omega, *spins = (x.reshape(-1, *x.shape[len(batch) :])[:, 0] for x in trajectory._samples)
    ts = lane_times(trajectory.ts[..., jnp.array([0, -1])], batch)
    scene = with_initial_spins(Scene(**parts), spins)
    search = _integrate.Search((event.fn,), (event.direction,), (False,), capacity)
    rtol = jnp.min(propagator.rtol)
    solution = propagator.method.search(scene, State(wxyz, omega), ts, rtol, search, True)
    if solution is None:
        return None
    samples, events = solution
    spins = None if samples.spins is None else samples.spins[:, 1:]
    at_events = Trajectory(
        events.rows[:, 1:],
        samples.wxyz[:, 1:],
        samples.omega_body[:, 1:],
        samples.status,
        samples.steps,
        Scene(**parts),
        spins=spins,
        propagator=propagator,
    )
    times = events.rows[:, 1:]
    use = jnp.isfinite(events.times)
    tolerance = 64 * jnp.finfo(times.dtype).eps * jnp.abs(times)
    delay, at_events = event.differentiable_at(at_events, tolerance)
    _, slope = event.values(at_events)
    has_failed = samples.status != Status.SUCCESSFUL
    has_failed = has_failed & (trajectory.status.reshape(-1) == Status.SUCCESSFUL)
    count = jnp.where(has_failed, capacity + 1, events.count).astype(jnp.int32)
    times = jnp.where(use, times + delay, jnp.inf).reshape(*batch, capacity)
    slope = jnp.where(use, slope, 0).reshape(*batch, capacity)
    return Crossings(times, slope, count.reshape(batch)), has_failed.reshape(batch)


def _sample_count(trajectory: Trajectory) -> int:
    """How many samples find every crossing, of a motion that is known."""
    if not is_concrete(trajectory):
        raise ValueError(
            "under jit, vmap or grad the number of samples must be known:"
            " ph.Event(fn, samples=1000), 32 or more per revolution of the fastest rate."
        )
    angle = np.max(np.asarray(_max_angle(trajectory)), initial=0)
    size = max(
        17, 1 + int(np.ceil(SAMPLES_PER_TURN * angle / (2 * np.pi))) if np.isfinite(angle) else 17
    )
    tolerance = 2 ** max(0, int(np.log2(size)) - 2)  # few numbers, for fewer compiled programs
    size = 1 + -(-(size - 1) // tolerance) * tolerance
    if size * max(1, int(np.prod(trajectory.batch_shape))) > _MAX_SAMPLES:
        raise ValueError(
            f"{size:,} samples of each body are needed for the {angle:.3g} rad that it turns:"
            " search a shorter time or fewer bodies at once, or give samples= for a slow function."
        )
    return size


@eqx.filter_jit
def _max_angle(trajectory: Trajectory) -> Array:
    """Most (...) that a body may turn from the first to the last time [rad]."""
    ts = trajectory._t
    span = jnp.max(ts, axis=-1) - jnp.min(ts, axis=-1)
    rate = jnp.max(turning_rates(trajectory), axis=-1)
    return jnp.maximum(rate, _natural_rates(trajectory)) * span


def turning_rates(trajectory: Trajectory) -> Array:
    """Upper bound (..., T) of the rate of a body, by its momentum at each sample [rad/s]."""
    carrier = trajectory._scene.carrier_at(trajectory._t)
    size = jnp.linalg.norm(carrier.momentum(trajectory.omega_body), axis=-1)
    return size / jnp.min(carrier.moments, axis=-1)


def _natural_rates(trajectory: Trajectory) -> Array:
    """Natural rates (...) [rad/s] at the first sample, gravity's included."""
    batch = trajectory.batch_shape
    parts = {name: flatten(getattr(trajectory.scene, name), batch) for name in PARTS}
    lanes = flatten(trajectory.first, batch, shared=False)
    ends = lane_times(trajectory.ts[..., jnp.array([0, -1])], batch)
    return _integrate.natural_rates(Scene(**parts), lanes, ends).reshape(batch)


@eqx.filter_jit
def _by_sampling(
    trajectory: Trajectory, event: Event, capacity: int, size: int
) -> tuple[Crossings, Array]:
    """The first ``capacity`` crossings, and the bodies (...) that could not be sampled."""
    stop_gradient = jax.lax.stop_gradient
    arrays, static = eqx.partition(trajectory, eqx.is_inexact_array)
    constant_trajectory: Trajectory = eqx.combine(stop_gradient(arrays), static)
    batch = trajectory.batch_shape
    ts = constant_trajectory.ts
    share = jnp.linspace(0, 1, size, dtype=ts.dtype).at[0].set(AT_START / (size - 1))
    share = share.reshape((1,) * (ts.ndim - 1) + share.shape)
    grid = ts[..., :1] + share * (ts[..., -1:] - ts[..., :1])
    samples = moved_through(constant_trajectory, grid)
    propagator: Any = trajectory.propagator
    # what is stepped goes on from the nearest look
    origin = constant_trajectory if propagator.method.exact else samples
    values, slopes = event.values(samples)
    values, slopes = (x.reshape(-1, size) for x in (values, slopes))
    grid = jnp.broadcast_to(grid, (*batch, size)).reshape(-1, size)
    values, slopes, grid = stop_gradient((values, slopes, grid))
    time_sign = jnp.where(grid[:, -1:] < grid[:, :1], -1, 1).astype(grid.dtype)

    def evaluate(t):
        pair = event.values(moved_to(origin, t.reshape(*batch, -1)))
        return stop_gradient(tuple(x.reshape(t.shape) for x in pair))

    sides = jnp.where(values >= 0, 1, -1)
    changes = sides[:, 1:] != sides[:, :-1]
    if event.direction:
        changes = changes & (sides[:, 1:] * time_sign == event.direction)
    stored = max(capacity, _MIN_CAPACITY)
    minima = minima_of(grid, values, slopes, sides)

    # a minimum between two samples is evaluated
    place, is_minimum = first_true(minima, stored)
    single, is_single = first_true(changes, stored)
    side = entries(sides, place)
    low, high = entries(grid, place), entries(grid, place + 1)
    turns = low, high, entries(slopes, place), entries(slopes, place + 1), is_minimum

    def brackets(turning, turning_values):
        """Between samples, and on both sides of such a turning point; which are pairs of these."""
        pairs = is_minimum & (jnp.where(turning_values >= 0, 1, -1) != side)
        columns = (
            (entries(grid, single), low, turning),
            (entries(grid, single + 1), turning, high),
            (entries(values, single), entries(values, place), turning_values),
            (entries(values, single + 1), turning_values, entries(values, place + 1)),
            (is_single, pairs, pairs),
            (entries(sides, single + 1) > 0, side < 0, side > 0),  # rising along the motion
        )
        *columns, use, rising = (jnp.concatenate(x, axis=-1) for x in columns)
        if event.direction:
            use = use & (jnp.where(rising, 1, -1) * time_sign == event.direction)
        order = jnp.argsort(jnp.where(use, time_sign * columns[0], jnp.inf), axis=-1)[:, :stored]
        return tuple(entries(x, order) for x in (*columns, use)), pairs

    def search(roots, is_second_pass):
        """The turning points, then the roots: one copy of the motion in the program."""
        arguments = [jnp.where(is_second_pass, b, a) for a, b in zip(turns, brackets(*roots)[0])]

        def fn(t):
            value, slope = evaluate(t)
            return jnp.where(is_second_pass, value, slope), value

        roots = bracketed_roots(fn, *arguments)
        return roots, roots

    zeros = jnp.zeros_like(low)
    _, (points, turning_values) = jax.lax.scan(search, (zeros, zeros), jnp.array([False, True]))
    (*_, use), pairs = brackets(points[0], turning_values[0])
    times = points[1]
    per_pair = 1 if event.direction else 2
    count = jnp.sum(changes, axis=-1) + per_pair * jnp.sum(pairs, axis=-1)
    # minima beyond the stored were not looked at: there may be as many pairs of them
    dipping = jnp.sum(minima, axis=-1)
    count = jnp.where(dipping > stored, jnp.maximum(count, per_pair * dipping), count)
    times, use = (x[:, :capacity].reshape(*batch, capacity) for x in (times, use))
    slope, times = _differentiable_times(trajectory, event, times, use)
    has_failed = (samples.status != Status.SUCCESSFUL) & (trajectory.status == Status.SUCCESSFUL)
    count = jnp.where(has_failed, capacity + 1, count.reshape(batch)).astype(jnp.int32)
    return Crossings(jnp.where(use, times, jnp.inf), jnp.where(use, slope, 0), count), has_failed


def _differentiable_times(trajectory: Trajectory, event: Event, times: Array, use: Array):
    """Slopes and times with their derivatives."""
    safe = jnp.where(use, times, trajectory.ts[..., :1])
    # of the value no more than rounding is left to correct, or of a touch all digits are noise
    tolerance = 64 * jnp.finfo(safe.dtype).eps * jnp.abs(safe)
    delay, at_events = event.refined(moved_to(trajectory, safe), tolerance)
    _, slope = event.values(at_events)
    return slope, safe + delay


def minima_of(grid, values, slopes, sides) -> Array:
    """Between which samples (N, S - 1) the function turns back before zero, and comes near it.

    Near by the cubic through values and slopes, whose error is a hundredth of what it changes by.
    """
    step = grid[:, 1:] - grid[:, :-1]
    side = sides[:, :-1].astype(values.dtype)
    a, end = side * values[:, :-1], side * values[:, 1:]
    b, b_end = side * step * slopes[:, :-1], side * step * slopes[:, 1:]
    turns = (sides[:, 1:] == sides[:, :-1]) & (b < 0) & (b_end > 0)
    jump = end - a
    c, d = 3 * jump - 2 * b - b_end, b + b_end - 2 * jump
    root = jnp.sqrt(jnp.maximum(c * c - 3 * d * b, 0))
    s = -b / jnp.where(c + root > 0, c + root, 1)
    s = jnp.clip(s, 0, 1)
    lowest = a + s * (b + s * (c + s * d))
    return turns & (lowest <= jnp.minimum(a, end) / 2)


def entries(x: Array, k: Array) -> Array:
    """Entries ``k`` (N, D) of the rows of ``x``."""
    return jnp.take_along_axis(x, k, axis=-1)


def first_true(mask: Array, capacity: int) -> tuple[Array, Array]:
    """Places (N, capacity) of the first that are true, and which of these there are."""
    size = mask.shape[-1]
    places = jnp.where(mask, jnp.arange(size), size)
    if capacity > size:
        places = jnp.pad(places, ((0, 0), (0, capacity - size)), constant_values=size)
    places = jnp.sort(places, axis=-1)[:, :capacity]
    return jnp.where(places < size, places, 0), places < size


_MOST = 100
"""Evaluations: halving alone would need about sixty."""


def bracketed_roots(
    fn: Callable[[Array], tuple[Array, Array]],
    low: Array,
    high: Array,
    at_low: Array,
    at_high: Array,
    use: Array,
) -> tuple[Array, Array]:
    """Roots of ``fn``, entry by entry, between ``low`` and ``high``, to a few units in the last
    place of the larger; entries that are not in ``use`` stay at ``low``. ``fn`` returns its values
    and something else, which is returned as it is where the root was last looked at.

    Inverse quadratic interpolation where it is safe, halving elsewhere: T. R. Chandrupatla, Adv.
    Eng. Software 28 (1997) 145.
    """
    tolerance = 2 * jnp.finfo(low.dtype).eps * jnp.maximum(jnp.abs(low), jnp.abs(high))

    def on(walk):
        count, is_done = walk[0], walk[1]
        return (count < _MOST) & ~jnp.all(is_done)

    def iterate(walk):
        count, is_done, x1, x2, f1, f2, share, extra = walk
        x = x1 + share * (x2 - x1)
        f, new_extra = fn(jnp.where(is_done, low, x))
        same_sign = jnp.sign(f) == jnp.sign(f1)
        x3, f3 = jnp.where(same_sign, x1, x2), jnp.where(same_sign, f1, f2)
        new2, g2 = jnp.where(same_sign, x2, x1), jnp.where(same_sign, f2, f1)
        bracket = jnp.abs(new2 - x)
        limit = tolerance / jnp.where(bracket > 0, bracket, 1)
        stop = (bracket <= 2 * tolerance) | (f == 0)
        a, b, c = f - g2, f3 - g2, f3 - f
        ab, ac, bc = (jnp.where(z == 0, 1, z) for z in (a, c, b))
        across = jnp.where(x3 == new2, 1, x3 - new2)
        xi, phi = (x - new2) / across, a / bc
        safe = (phi * phi < xi) & ((1 - phi) * (1 - phi) < 1 - xi)
        span = jnp.where(new2 == x, 1, new2 - x)
        inverse = -(f / ab) * (-f3 / bc) + (x3 - x) / span * (f / ac) * (g2 / bc)
        new_share = jnp.clip(jnp.where(safe, inverse, 0.5), limit, 1 - limit)

        def where_busy(old, new):
            return jnp.where(is_done, old, new)

        values = (
            where_busy(x1, x),
            where_busy(x2, new2),
            where_busy(f1, f),
            where_busy(f2, g2),
            where_busy(share, new_share),
        )
        values = (*values, where_busy(extra, new_extra))
        return count + 1, is_done | stop, *values

    zero = at_low == 0
    start = jnp.where(zero, low, high), low, jnp.where(zero, at_low, at_high), at_low
    is_done = ~use | zero | (at_high == 0)
    walk = (0, is_done, *start, jnp.full_like(low, 0.5), jnp.zeros_like(low))
    _, _, x1, x2, f1, f2, _, extra = jax.lax.while_loop(on, iterate, walk)
    root = jnp.where(jnp.abs(f1) <= jnp.abs(f2), x1, x2)
    return jnp.where(use, root, low), extra
