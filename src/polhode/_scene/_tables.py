"""Tables over time, such as from ephemerides, field models and atmospheres, for any part."""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from polhode._checks import ArrayLike, as_float_array, batch_of, is_concrete, require
from polhode._kernels import smooth
from polhode._parts import AbstractPart, shaped

_NEIGHBOURS = 5
"""Number of knots of the polynomials from which derivatives at the times are estimated: cubic
interpolation is of fourth order, so that fourth-order derivatives suffice."""


class Table(AbstractPart):
    """A function of time from values at given times, for any part that takes one.

    **Arguments:** ``times`` (n,) [s], ascending, shared by all bodies; ``values``: (..., n) of a
    number, (..., n, k) of a vector of k components, with leading axes for a batch; ``order``
    (static): 3 for cubic interpolation, whose error falls with the fourth power of the spacing, or
    1 for linear interpolation. ``derivatives``: time derivatives of the values, of their shape, for
    cubic interpolation if they are known, such as the velocities of an ephemeris; their leading
    axes broadcast with those of the values. None: those of the polynomials through five
    neighbouring values. ``kind``: "number" or "vector", if the shape of the values is ambiguous.

    At the table times the first derivative of a linear table and the second derivative of a cubic
    table jump. Steps of the integrator end there to satisfy ``rtol``: a simulation takes at least
    one step for each of the times within its span. Exempt are cubic tables so dense (about 700
    times in a period of their values) that the jumps are negligible.

    ``table(t)`` is a number or a vector (k,) for each of the times ``t`` (...). Before the first
    time and after the last one the outermost polynomials are extrapolated, so that a table should
    cover the simulated span.

        sun = ph.Table([0.0, 3600.0, 7200.0], [[1.0, 0, 0], [0.9, 0.4, 0], [0.7, 0.7, 0]])
        sun(1800.0)

    Cubic Hermite interpolation: F. N. Fritsch and R. E. Carlson, SIAM J. Numer. Anal. 17 (1980)
    238, equation 2, without their limits on the derivatives.

    Raises ValueError for times that do not increase, fewer than two, other shapes or orders.
    """

    smooth: ClassVar[bool] = False  # a derivative jumps at the times

    order: int = eqx.field(static=True)
    is_number: bool = eqx.field(static=True)
    times: Float[Array, " n"]
    values: Float[Array, "*#b n k"] = shaped(None, None)
    derivatives: Float[Array, "*#b n k"] | None = shaped(None, None)
    has_kinks: Float[Array, "*#b"] = shaped()

    def __init__(
        self,
        times: ArrayLike,
        values: ArrayLike,
        order: int = 3,
        derivatives: ArrayLike | None = None,
        kind: str | None = None,
    ):
        require(order in (1, 3), f"Table order must be 1 or 3, got {order!r}.")
        require(
            kind in (None, "number", "vector"),
            f'Table kind must be "number", "vector" or None, got {kind!r}.',
        )
        require(
            derivatives is None or order == 3,
            "Table derivatives belong to order=3: a linear table does not use them.",
        )
        self.times = as_float_array("Table times", times, (None,))
        if self.times.ndim != 1 or self.times.size < 2:
            raise ValueError(
                f"Table times must be two or more, of shape (n,), got {self.times.shape}."
            )
        array = as_float_array("Table values", values)
        self.times = self.times.astype(array.dtype)  # times from a list have the default precision
        if is_concrete(self.times):
            require(
                np.diff(np.asarray(self.times)) > 0,
                f"Table times must ascend, in the dtype of its values ({array.dtype}).",
            )
        self.order, self.is_number = order, _is_number(array.shape, self.times.size, kind)
        self.values = array[..., None] if self.is_number else array
        knots = self.times.astype(array.dtype)
        self.derivatives, self.has_kinks = None, jnp.ones((), array.dtype)
        if order == 1:
            return
        if derivatives is None:
            self.derivatives = _derivatives(self.values, knots)
            self.has_kinks = _has_kinks(self.values, self.derivatives, knots)
            return
        derivative_array = as_float_array("Table derivatives", derivatives)
        core = 1 if self.is_number else 2
        if derivative_array.shape[-core:] != array.shape[-core:]:
            raise ValueError(
                f"Table derivatives must have the shape of the values, {array.shape}, got"
                f" {derivative_array.shape}."
            )
        columns = derivative_array[..., None] if self.is_number else derivative_array
        lead = batch_of(values=(self.values, 2), derivatives=(columns, 2))
        self.values, self.derivatives = (
            jnp.broadcast_to(x, (*lead, *x.shape[-2:])) for x in (self.values, columns)
        )
        self.has_kinks = _has_kinks(self.values, self.derivatives, knots)

    @property
    def input_conditions(self) -> tuple[Array, ...]:
        return (jnp.all(self.times[1:] > self.times[:-1]),)

    def __call__(self, t: Array | float) -> Array:
        """Value at the times ``t`` (...): (...) of a number, (..., k) of a vector."""
        t = jnp.asarray(t, self.values.dtype)
        if self.values.ndim > 2:
            t = jnp.broadcast_to(t, jnp.broadcast_shapes(t.shape, self.values.shape[:-2]))
        times = self.times.astype(self.values.dtype)
        has_kinks = jnp.broadcast_to(self.has_kinks, t.shape)
        interpolate = _linear if self.order == 1 else _cubic
        interpolated = interpolate(self, times, t, has_kinks)
        return interpolated[..., 0] if self.is_number else interpolated


def check_kind(name: str, part: AbstractPart, count: int | None) -> None:
    """ValueError for a table not of vectors of ``count`` components, or (None) not of numbers."""
    if not isinstance(part, Table):
        return
    expected = "numbers" if count is None else f"vectors of {count}"
    kind = "numbers" if part.is_number else f"vectors of {part.values.shape[-1]}"
    require(kind == expected, f"{name} takes a Table of {expected}, got one of {kind}.")


def _is_number(shape: tuple[int, ...], n: int, kind: str | None) -> bool:
    number, vector = shape[-1:] == (n,), len(shape) > 1 and shape[-2] == n
    fits = {None: number or vector, "number": number, "vector": vector}
    if not fits[kind]:
        raise ValueError(
            f"Table values must have shape (..., {n}) or (..., {n}, k) for {n} times, got {shape}."
        )
    if number and vector and kind is None:
        raise ValueError(
            f"Table values of shape {shape} may be numbers or vectors at {n} times: give"
            ' kind="number" or kind="vector".'
        )
    return number if kind is None else kind == "number"


def _linear(table: Table, times: Array, t: Array, has_kinks: Array) -> Array:
    i = _interval(times, t, has_kinks)
    start, stop = times[i], times[i + 1]
    share = ((t - start) / (stop - start))[..., None]
    low, high = _rows(table.values, i), _rows(table.values, i + 1)
    return low + share * (high - low)


@smooth
def _last_before(times: Array, t: Array) -> Array:
    """Index of the last time that is not after ``t``, within [0, n - 2]."""
    # Not by ``jnp.searchsorted``, which uses the total order of floats, an operation that fused
    # kernels do not support: a satellite in a field from a table took eleven times as long.
    low, high = jnp.zeros_like(t, jnp.int32), jnp.full_like(t, times.size - 1, jnp.int32)
    for _ in range((times.size - 2).bit_length()):
        middle = (low + high) // 2
        later = t >= times[middle]
        low, high = jnp.where(later, middle, low), jnp.where(later, high, middle)
    return low


@smooth
def _place(times: Array, t: Array, has_kinks: Array) -> Array:
    i = _last_before(times, t)
    place = i.astype(t.dtype) + (t - times[i]) / (times[i + 1] - times[i])
    return jnp.where(has_kinks > 0, place, 0.5)


def _cubic(table: Table, times: Array, t: Array, has_kinks: Array) -> Array:
    i = _interval(times, t, has_kinks)
    width = (times[i + 1] - times[i])[..., None]
    x = (t - times[i])[..., None] / width
    low, high = _rows(table.values, i), _rows(table.values, i + 1)
    rise = high - low
    a = width * _rows(table.derivatives, i) - rise
    b = rise - width * _rows(table.derivatives, i + 1)
    return low + x * (rise + (1 - x) * (a * (1 - x) + b * x))


def _interval(times: Array, t: Array, has_kinks: Array) -> Array:
    """Index of the last time that is not after ``t``, within [0, n - 2].

    ``floor`` is the only switch that the integrator detects, for any number of times: its argument
    is continuous and passes integers at the times. The integrator keeps it constant within a step
    and ends steps where it changes. For a table without kinks the argument is constant. Without
    this, steps across the times of 14 random values had errors of up to 444 rtol, without a
    warning.
    """
    place = jnp.clip(jnp.floor(_place(times, t, has_kinks)), 0, times.size - 2)
    index = _last_before(times, t)
    return jnp.where(has_kinks > 0, place.astype(index.dtype), index)


def _rows(values: Array, i: Array) -> Array:
    """Rows ``i`` (...) of values (n, k), or of (..., n, k) with the leading axes of ``i``."""
    if values.ndim == 2:
        return values[i]
    values = values.reshape((1,) * (i.ndim + 2 - values.ndim) + values.shape)
    return jnp.take_along_axis(values, i[..., None, None], axis=-2)[..., 0, :]


@jax.jit  # outside jit too, one program for all operations
def _derivatives(values: Array, times: Array) -> Array:
    """At each time, the derivative of the polynomial through the neighbouring values."""
    n = times.size
    count = min(_NEIGHBOURS, n)
    place = np.arange(n)
    first_index = np.clip(place - count // 2, 0, n - count)
    total = jnp.zeros_like(values)
    for j in range(count):
        # Derivative of the Lagrange polynomial l_j, which is 1 at node j: a sum at node j itself,
        # at the other nodes a product without the factor that is zero.
        is_node = first_index + j == place
        at = times[first_index + j]
        weight, product = jnp.zeros_like(times), jnp.ones_like(times)
        for k in range(count):
            if k == j:
                continue
            node_time = times[first_index + k]
            weight = weight + 1 / jnp.where(is_node, times - node_time, 1)
            is_other_node = first_index + k == place
            product = product * jnp.where(is_other_node, 1, times - node_time) / (at - node_time)
        weight = jnp.where(is_node, weight, product)[:, None]
        rows = values[..., first_index + j, :]
        total = total + weight.reshape((1,) * (values.ndim - 2) + weight.shape) * rows
    return total


_NEGLIGIBLE = 1e-9
"""Negligible jump of the second derivative, times the square of the spacing, over the largest
value."""


@jax.jit
def _has_kinks(values: Array, derivatives: Array, times: Array) -> Array:
    """1 where second derivatives of the interpolation have jumps that matter, else 0 (...)."""
    width = jnp.diff(times).reshape((1,) * (values.ndim - 2) + (-1, 1))
    rise = jnp.diff(values, axis=-2) / width
    low, high = derivatives[..., :-1, :], derivatives[..., 1:, :]
    begin, end = (6 * rise - 4 * low - 2 * high) / width, (2 * low + 4 * high - 6 * rise) / width
    jump = jnp.abs(begin[..., 1:, :] - end[..., :-1, :]) * (
        jnp.maximum(width[..., 1:, :], width[..., :-1, :]) ** 2
    )
    size = jnp.max(jnp.abs(values), axis=(-1, -2))
    limit = max(_NEGLIGIBLE, 32 * float(jnp.finfo(values.dtype).eps))
    has_kink = jnp.max(jump, axis=(-1, -2), initial=0.0) > limit * size
    return jax.lax.stop_gradient(jnp.where(has_kink, 1, 0).astype(values.dtype))
