"""Zeros of functions of a motion that can be evaluated at any time.

A motion in closed form takes long to compile, so that the program of a search contains it once. The
samples, the turning points between them, the roots, and the states at the roots are passes of one
loop. Each iteration evaluates the motion at some times, and the results determine the next times.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from polhode._kernels import kernel

_SAMPLES, _TURNING_POINTS, _ROOTS, _STATES = range(4)
"""The passes of the loop."""

_MAX_EVALUATIONS = 100
"""Maximum number of evaluations for one root: bisection alone would need about sixty."""


class Evaluation(NamedTuple):
    """N bodies at times (N, W): ``values`` and time ``derivatives`` (E, N, W) of E functions,
    states (N, W, ...), and whether the motion of each body (N,) was computed successfully."""

    values: Array
    derivatives: Array
    states: list[Array]
    is_successful: Array


class Brackets(NamedTuple):
    """Times (E N, K) before and after zeros of a function, its values there, and which entries are
    used."""

    low: Array
    high: Array
    at_low: Array
    at_high: Array
    use: Array


class SearchResult(NamedTuple):
    """Samples; roots (E N, K), which entries are used, and the second result of ``brackets``; time
    derivatives at the roots, and the states (E N, K, ...)."""

    samples: Evaluation
    roots: Array
    use: Array
    auxiliary: Any
    derivatives: Array
    states: list[Array]


def search_roots(
    evaluate: Callable[[Array], Evaluation],
    grid: Array,
    columns: int,
    width: int,
    analyse: Callable[[Evaluation], Any],
    turning_brackets: Callable[[Evaluation, Any], Brackets],
    brackets: Callable[[Evaluation, Any, Array, Array], tuple[Brackets, Any]],
    samples: Evaluation | None = None,
    store_states: bool = True,
) -> SearchResult:
    """Samples at the times ``grid`` (N, S), and the roots between them.

    - ``evaluate``: evaluates the motion at times (N, W), W = ``width`` or more, and at least E K.
    - ``analyse(samples)``: the analysis of all samples, made once.
    - ``turning_brackets(samples, analysis)``: brackets of the zeros of the time derivatives.
    - ``brackets(samples, analysis, turning, turning_values)``: brackets of the zeros of the
      functions, for these turning points and the values there, and any other result. Both return
      K = ``columns`` entries.
    - ``samples``: those at ``grid``, if they are available without ``evaluate``.
    - ``store_states``: whether the samples include the states.
    """
    (n, size), is_sampled = grid.shape, samples is not None
    ones = _ones_like(evaluate, jnp.broadcast_to(grid[:, :1], (n, width)))
    rows = ones.values.shape[0]
    assert width >= rows * columns
    chunks = -(-size // width)
    padded = jnp.pad(grid, ((0, 0), (0, chunks * width - size)), mode="edge")

    def of_bodies(t):
        """Times (E N, K) of each row -> (N, W)."""
        t = jnp.moveaxis(t.reshape(rows, n, columns), 0, 1).reshape(n, rows * columns)
        return jnp.pad(t, ((0, 0), (0, width - rows * columns)), mode="edge")

    def of_rows(x):
        """From every function at the times of all rows (E, N, W, ...) to each at those of its own
        row (E N, K, ...)."""
        x = x[:, :, : rows * columns].reshape(rows, n, rows, columns, *x.shape[3:])
        own = jnp.stack([x[k, :, k] for k in range(rows)])
        return own.reshape(rows * n, columns, *x.shape[4:])

    def one_pass(carry, number):
        store, analysis, points, point_values, evaluation, use = carry
        is_sampling, is_turning, is_last = (
            number == k for k in (_SAMPLES, _TURNING_POINTS, _STATES)
        )
        all_samples = _first_samples(store, size)
        if not is_sampled:
            analysis = jax.lax.cond(is_turning, analyse, lambda _: analysis, all_samples)
        of_roots, auxiliary = brackets(all_samples, analysis, points, point_values)
        problems = turning_brackets(all_samples, analysis), of_roots
        bracket = _bracket_between(*(jnp.where(is_turning, a, b) for a, b in zip(*problems)))
        limit = jnp.where(is_sampling, chunks, jnp.where(is_last, 1, _MAX_EVALUATIONS))

        def continues(loop):
            count, bracket, *_ = loop
            is_unfinished = jnp.where(is_last, jnp.any(use), ~jnp.all(bracket.is_done))
            return (count < limit) & (is_sampling | is_unfinished)

        def iterate(loop):
            count, bracket, store, _ = loop
            t = of_bodies(jnp.where(is_last, points, bracket.next))
            if not is_sampled:
                start = jnp.where(is_sampling, count, 0) * width
                part = jax.lax.dynamic_slice_in_dim(padded, start, width, axis=1)
                t = jnp.where(is_sampling, part, t)
            evaluation = evaluate(t)
            if not is_sampled:
                store = _with_samples(store, evaluation, start, is_sampling)
            values, derivatives = of_rows(evaluation.values), of_rows(evaluation.derivatives)
            bracket = kernel(_update)(bracket, jnp.where(is_turning, derivatives, values), values)
            return count + 1, bracket, store, evaluation

        loop = jnp.zeros((), jnp.int32), bracket, store, evaluation
        _, bracket, store, evaluation = jax.lax.while_loop(continues, iterate, loop)
        points = jnp.where(is_last, points, _root(bracket))
        return (store, analysis, points, bracket.value, evaluation, of_roots.use), (
            of_roots.use,
            auxiliary,
        )

    store = samples
    if store is None:
        store = _sample_storage(ones, chunks, store_states)
    zeros = jnp.zeros((rows * n, columns), grid.dtype)
    passes = (_SAMPLES, _TURNING_POINTS, _ROOTS, _STATES)[is_sampled:]
    analysis = (
        analyse(_first_samples(store, size))
        if is_sampled
        else _ones_like(analyse, _first_samples(store, size))
    )
    carry = (store, analysis, zeros, zeros.astype(store.values.dtype), ones, zeros > 0)
    (store, _, roots, _, evaluation, _), of_passes = jax.lax.scan(
        one_pass, carry, jnp.array(passes)
    )
    use, auxiliary = jax.tree.map(lambda x: x[-2], of_passes)  # of the roots
    states = [of_rows(jnp.broadcast_to(x, (rows, *x.shape))) for x in evaluation.states]
    return SearchResult(
        _first_samples(store, size), roots, use, auxiliary, of_rows(evaluation.derivatives), states
    )


def _ones_like(function: Callable, argument: Any) -> Any:
    """Ones with the shapes and dtypes of the function's results."""
    return jax.tree.map(lambda x: jnp.ones(x.shape, x.dtype), jax.eval_shape(function, argument))


def _sample_storage(evaluation: Evaluation, count: int, store_states: bool) -> Evaluation:
    """Arrays to store the results of ``count`` evaluations one after another."""
    values, derivatives = (
        jnp.tile(x, (1, 1, count)) for x in (evaluation.values, evaluation.derivatives)
    )
    states = [jnp.tile(x, (1, count, 1)) for x in evaluation.states] if store_states else []
    return Evaluation(values, derivatives, states, evaluation.is_successful)


def _first_samples(store: Evaluation, size: int) -> Evaluation:
    states = [x[:, :size] for x in store.states]
    return Evaluation(
        store.values[..., :size], store.derivatives[..., :size], states, store.is_successful
    )


def _with_samples(
    store: Evaluation, evaluation: Evaluation, start: Array, is_sampling: Array
) -> Evaluation:
    """The samples with the new ones stored from index ``start`` on, if this is the first pass."""

    def with_new(old, new, axis):
        stored = jax.lax.dynamic_slice_in_dim(old, start, new.shape[axis], axis)
        new = jnp.where(is_sampling, new, stored)
        return jax.lax.dynamic_update_slice_in_dim(old, new, start, axis)

    return Evaluation(
        with_new(store.values, evaluation.values, 2),
        with_new(store.derivatives, evaluation.derivatives, 2),
        [with_new(x, y, 1) for x, y in zip(store.states, evaluation.states)],
        store.is_successful & (evaluation.is_successful | ~is_sampling),
    )


class _RootBracket(NamedTuple):
    """The search for a root between the times ``x1``, evaluated last, and ``x2``: the function
    there, the next time to evaluate, the tolerance, and another value at the last time."""

    is_done: Array
    x1: Array
    x2: Array
    f1: Array
    f2: Array
    next: Array
    tolerance: Array
    value: Array


def _bracket_between(
    low: Array, high: Array, at_low: Array, at_high: Array, use: Array
) -> _RootBracket:
    zero = at_low == 0
    x1, f1 = jnp.where(zero, low, high), jnp.where(zero, at_low, at_high)
    is_done = ~use | zero | (at_high == 0)
    tolerance = 2 * jnp.finfo(low.dtype).eps * jnp.maximum(jnp.abs(low), jnp.abs(high))
    middle = jnp.where(is_done, x1, x1 + (low - x1) / 2)
    return _RootBracket(is_done, x1, low, f1, at_low, middle, tolerance, jnp.zeros_like(at_low))


def _update(bracket: _RootBracket, f: Array, value: Array) -> _RootBracket:
    """The search after an evaluation at ``bracket.next``, where the function is ``f``.

    Inverse quadratic interpolation where it is safe, bisection elsewhere: T. R. Chandrupatla, Adv.
    Eng. Software 28 (1997) 145; to a few units in the last place of the larger time.
    """
    is_done, x1, x2, f1, f2, x, tolerance, _ = bracket
    same_sign = jnp.sign(f) == jnp.sign(f1)
    x3, f3 = jnp.where(same_sign, x1, x2), jnp.where(same_sign, f1, f2)
    new2, g2 = jnp.where(same_sign, x2, x1), jnp.where(same_sign, f2, f1)
    width = jnp.abs(new2 - x)
    limit = tolerance / jnp.where(width > 0, width, 1)
    is_converged = (width <= 2 * tolerance) | (f == 0)
    a, b, c = f - g2, f3 - g2, f3 - f
    ab, ac, bc = (jnp.where(z == 0, 1, z) for z in (a, c, b))
    denominator = jnp.where(x3 == new2, 1, x3 - new2)
    xi, phi = (x - new2) / denominator, a / bc
    is_safe = (phi * phi < xi) & ((1 - phi) * (1 - phi) < 1 - xi)
    span = jnp.where(new2 == x, 1, new2 - x)
    inverse = -(f / ab) * (-f3 / bc) + (x3 - x) / span * (f / ac) * (g2 / bc)
    share = jnp.clip(jnp.where(is_safe, inverse, 0.5), limit, 1 - limit)
    next_time = jnp.where(is_converged, x, x + share * (new2 - x))
    updated = is_converged, x, new2, f, g2, next_time, tolerance, value
    return _RootBracket(
        is_done | is_converged,
        *(jnp.where(is_done, o, w) for o, w in zip(bracket[1:], updated[1:])),
    )


def _root(bracket: _RootBracket) -> Array:
    return jnp.where(jnp.abs(bracket.f1) <= jnp.abs(bracket.f2), bracket.x1, bracket.x2)


def minima_of(grid, values, derivatives, sides) -> Array:
    """Intervals between samples (N, S - 1) in which the function turns back before zero, close to
    it.

    Whether it is close follows from the cubic through the values and derivatives at both samples.
    The error of the cubic is a hundredth of the change of the function.
    """
    step = grid[:, 1:] - grid[:, :-1]
    side = sides[:, :-1].astype(values.dtype)
    a, end = side * values[:, :-1], side * values[:, 1:]
    b, b_end = side * step * derivatives[:, :-1], side * step * derivatives[:, 1:]
    has_minimum = (sides[:, 1:] == sides[:, :-1]) & (b < 0) & (b_end > 0)
    jump = end - a
    c, d = 3 * jump - 2 * b - b_end, b + b_end - 2 * jump
    root = jnp.sqrt(jnp.maximum(c * c - 3 * d * b, 0))
    s = -b / jnp.where(c + root > 0, c + root, 1)
    s = jnp.clip(s, 0, 1)
    lowest = a + s * (b + s * (c + s * d))
    return has_minimum & (lowest <= jnp.minimum(a, end) / 2)


def entries(x: Array, k: Array) -> Array:
    """Entries ``k`` (N, D) of the rows of ``x``."""
    return jnp.take_along_axis(x, k, axis=-1)


def first_true(mask: Array, capacity: int) -> tuple[Array, Array]:
    """Indices (N, capacity) of the first true entries, and which of these exist."""
    size = mask.shape[-1]
    places = jnp.where(mask, jnp.arange(size), size)
    if capacity > size:
        places = jnp.pad(places, ((0, 0), (0, capacity - size)), constant_values=size)
    places = jnp.sort(places, axis=-1)[:, :capacity]
    return jnp.where(places < size, places, 0), places < size
