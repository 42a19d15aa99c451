"""How the body moves between its first sample and the others: the model that a fit compares."""

import abc
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Float

from polhode._closed_forms._free import free_motion
from polhode._hamiltonian import (
    Attitude,
    Dynamics,
    Hamiltonian,
    components,
    inverse_inertia,
    lie_poisson_field,
    momentum_rate,
)
from polhode._hamiltonian._energy import from_rows
from polhode._integrate._classical import ClassicalRungeKutta
from polhode._scene import AbstractTorque, LinearDamping, QuadraticDamping
from polhode.inertia import Inertia, principal
from polhode.rotation import conjugate, multiply, normalise, rotate, wxyz_to_matrix


class Predicted(NamedTuple):
    """Body rates, their derivatives (None: unknown) and attitudes (None: not computed)."""

    omega: Float[Array, "t 3"]
    omega_dot: Float[Array, "t 3"] | None
    wxyz: Float[Array, "t 4"] | None


class AbstractMotion(eqx.Module):
    """A motion from initial rates (and attitude) on, for one body and one recording."""

    @abc.abstractmethod
    def start(self) -> Any:
        """Starting values (a pytree of arrays) of the unknowns of this motion; None without."""

    @abc.abstractmethod
    def fixes_scale(self) -> bool:
        """Whether rates alone depend on the absolute size of the inertia (static)."""

    def bounded(self, unknown: Any) -> Any:
        """Values of the motion's unknowns from numbers that may be anything."""
        return unknown

    def unbounded(self, values: Any) -> Any:
        """The inverse of ``bounded``."""
        return values

    def at_bound(self, values: Any) -> Array:
        """Whether an unknown is at its bound."""
        return jnp.asarray(False)

    def prior_std(self) -> list[Array | None]:
        """Standard deviations of normal priors about the start, one for each unknown leaf."""
        return [None for _ in jax.tree.leaves(self.start())]

    @abc.abstractmethod
    def __call__(
        self,
        tensor: Float[Array, "3 3"],
        omega: Float[Array, " 3"],
        wxyz: Float[Array, " 4"] | None,
        times: Float[Array, " t"],
        wheel: Float[Array, " t"] | None,
        unknown: Any,
    ) -> Predicted:
        """Motion with the inertia ``tensor`` from ``omega`` and ``wxyz`` at ``times[0]``."""


class Drag(eqx.Module):
    """Isotropic torque of the air, ``-(linear + quadratic |omega|) omega``.

    **Fields:** ``linear`` [N m s], ``quadratic`` [N m s^2].
    """

    linear: Array | float = 0.0
    quadratic: Array | float = 0.0

    def torque(self, dtype: DTypeLike) -> AbstractTorque:
        """The torque in a scene; a fit may try negative coefficients, which a scene refuses."""
        parts = LinearDamping(1.0) + QuadraticDamping(1.0)
        tried = [jnp.full(3, c, dtype) for c in (self.linear, self.quadratic)]
        return eqx.tree_at(lambda s: [term.c for term in s.terms], parts, tried)


def _three_floats(values: Sequence[float]) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z


class SteppedMotion(AbstractMotion):
    """Flight with air drag and a reaction wheel of known speed, by Runge-Kutta steps of order 4.

    **Fields:** ``spin_inertia`` [kg m^2] of the wheel about its ``axis`` (3,), a unit vector in
    sensor axes (None: no wheel): its momentum is ``spin_inertia`` times the speed W(t - ``delay``)
    of the recording, and the inertia is that with the wheel locked; ``drag``: a ``Drag`` or None;
    ``fit_drag``, ``fit_delay``: whether these are unknown; ``steps`` between two samples.
    """

    spin_inertia: Array | float | None = None
    axis: tuple[float, float, float] = eqx.field(
        static=True, converter=_three_floats, default=(0.0, 0.0, 1.0)
    )
    delay: Array | float = 0.0
    drag: Drag | None = None
    fit_drag: bool = eqx.field(static=True, default=False)
    fit_delay: bool = eqx.field(static=True, default=False)
    steps: int = eqx.field(static=True, default=1)

    def start(self) -> dict[str, Any]:
        return {
            "drag": self.drag if self.fit_drag else None,
            "delay": self.delay if self.fit_delay else None,
        }

    def fixes_scale(self) -> bool:
        return self.spin_inertia is not None or (self.drag is not None and not self.fit_drag)

    def __call__(
        self,
        tensor: Float[Array, "3 3"],
        omega: Float[Array, " 3"],
        wxyz: Float[Array, " 4"] | None,
        times: Float[Array, " t"],
        wheel: Float[Array, " t"] | None,
        unknown: Any,
    ) -> Predicted:
        inertia = Inertia(full=tensor)
        drag = unknown["drag"] if self.fit_drag else self.drag
        torque = None if drag is None else drag.torque(times.dtype)
        inverse = inverse_inertia(inertia)

        def dynamics(size) -> Dynamics:
            carried = None if size is None else lambda t: self._along(size(t))
            return Dynamics(Hamiltonian(inverse, inertia, None, carried), torque)

        wheel_at = self._wheel(times, wheel, unknown["delay"] if self.fit_delay else self.delay)
        halves = jnp.arange(2 * self.steps + 1, dtype=times.dtype) / (2 * self.steps)
        nodes = times[:-1, None] + jnp.diff(times)[:, None] * halves[None]
        solver, term = ClassicalRungeKutta(), diffrax.ODETerm(_field)

        def interval(y, inputs):
            ts, spins = inputs
            for k in range(0, 2 * self.steps, 2):
                now = dynamics(
                    None if spins is None else _parabola(ts[k : k + 3], spins[k : k + 3])
                )
                y, *_ = solver.step(term, ts[k], ts[k + 2], y, now, None, made_jump=False)
            return y, y

        momentum = inertia.momentum(omega)
        if wheel_at is not None:
            momentum = momentum + jnp.stack(self._along(wheel_at(times[0])))
        y = components(momentum), None if wxyz is None else tuple(wxyz)
        _, path = jax.lax.scan(interval, y, (nodes, wheel_at and wheel_at(nodes)))
        momentum, attitude = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), y, path)
        push, rates = momentum_rate(times, momentum, _attitude(), dynamics(wheel_at))
        push, rates = jnp.stack(push, axis=-1), jnp.stack(rates, axis=-1)
        if wheel_at is not None:  # what the wheel takes up does not turn the body
            carried = jnp.stack(self._along(wheel_at(times)), axis=-1)
            gained, step = (jnp.asarray(jnp.gradient(x, axis=0)) for x in (carried, times))
            push = push - gained / step[:, None]
        if attitude is not None:
            attitude = normalise(jnp.stack(attitude, axis=-1))
        return Predicted(rates, inertia.rates(push), attitude)

    def _wheel(self, times, wheel, delay) -> Callable[[Array], Array] | None:
        """The wheel's momentum along its axis as a function of time; None without a wheel."""
        spin = self.spin_inertia
        if spin is None:
            return None
        return lambda t: spin * jnp.interp(t - delay, times, wheel)

    def _along(self, size: Array) -> tuple[Array, ...]:
        return tuple(size * component for component in self.axis)


def _parabola(ts: Array, values: Array) -> Callable[[Array], Array]:
    """Through a step's two ends and its middle, where alone it is asked: no look-up in a table."""
    first, middle, last = values

    def at(t):
        s = (t - ts[1]) / (ts[2] - ts[1])
        return middle + s * ((last - first) / 2 + s * ((first + last) / 2 - middle))

    return at


def free_acceleration(inertia: Inertia, omega: Float[Array, "t 3"]) -> Float[Array, "t 3"]:
    """d(omega)/dt of the free body."""
    dynamics = Dynamics(Hamiltonian(inverse_inertia(inertia), inertia))
    push, _ = momentum_rate(0.0, components(inertia.momentum(omega)), None, dynamics)
    return inertia.rates(jnp.stack(push, axis=-1))


def _attitude() -> Attitude:
    """An attitude without rows, for a drag and a wheel do not depend on it."""
    return from_rows({})


def _field(t, y, dynamics):
    """Rates of the body momentum and, where there is one, of the attitude."""
    if y[1] is not None:
        return lie_poisson_field(t, y, dynamics)
    return momentum_rate(t, y[0], _attitude(), dynamics)[0], None


class FreeMotion(AbstractMotion):
    """Torque-free motion in closed form (Jacobi elliptic functions)."""

    def start(self) -> None:
        return None

    def fixes_scale(self) -> bool:
        return False

    def __call__(
        self,
        tensor: Float[Array, "3 3"],
        omega: Float[Array, " 3"],
        wxyz: Float[Array, " 4"] | None,
        times: Float[Array, " t"],
        wheel: Float[Array, " t"] | None,
        unknown: Any,
    ) -> Predicted:
        moments, axes, (yz, zx, xy) = principal(tensor)
        start = rotate(conjugate(axes), omega)
        attitude = None if wxyz is None else tuple(multiply(wxyz, axes))
        rates, turned = free_motion(
            tuple(moments),
            attitude,
            tuple(start),
            times - times[0],
            (xy, zx, yz),
            attitude=wxyz is not None,
        )
        path = _combined(wxyz_to_matrix(axes), rates)
        if turned is not None:
            turned = _combined(_right_product(conjugate(axes)), turned)
        return Predicted(path, free_acceleration(Inertia(full=tensor), path), turned)


def _combined(matrix: Float[Array, "n n"], components: tuple[Array, ...]) -> Float[Array, "t n"]:
    """``matrix`` times a vector of components that are arrays over time.

    As a loop over the rows, for what a loop reads is worked out once: written as one expression,
    the compiler would repeat the whole motion for every component of the result.
    """

    def row(weights):
        return sum(weights[k] * part for k, part in enumerate(components))

    return jax.lax.map(row, matrix).T


def _right_product(q: Float[Array, " 4"]) -> Float[Array, "4 4"]:
    """The matrix of ``p -> p q``."""
    w, x, y, z = q
    rows = ((w, -x, -y, -z), (x, w, z, -y), (y, -z, w, x), (z, y, -x, w))
    return jnp.stack([jnp.stack(row) for row in rows])
