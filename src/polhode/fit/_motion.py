"""How the body moves between its first sample and the others: the model that a fit compares."""

import abc
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from polhode.free import free_motion
from polhode.inertia import Inertia, angular_acceleration, principal
from polhode.rotation import conjugate, multiply, rotate, to_matrix


class Motion(NamedTuple):
    """Rates, their derivatives (None: unknown) and, if asked for, attitudes at given times."""

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

    @abc.abstractmethod
    def __call__(
        self,
        tensor: Float[Array, "3 3"],
        omega: Float[Array, " 3"],
        wxyz: Float[Array, " 4"] | None,
        times: Float[Array, " t"],
        wheel: Float[Array, " t"] | None,
        unknown: Any,
    ) -> Motion:
        """Motion with the inertia ``tensor`` from ``omega`` and ``wxyz`` at ``times[0]``."""


class Drag(eqx.Module):
    """Torque ``-(linear + quadratic |omega|) omega`` of the air, isotropic."""

    linear: Array | float = 0.0
    quadratic: Array | float = 0.0


class SteppedMotion(AbstractMotion):
    """Flight with air drag and a wheel of known speed, by Runge-Kutta steps of order 4.

    The body momentum ``L = I omega + spin_inertia W(t - delay) axis`` obeys
    ``dL/dt = L x omega - drag``; I is the inertia with the wheel locked. ``steps`` steps are made
    between samples. What is None is absent; ``fit_...`` says which of the values are unknown.
    """

    spin_inertia: Array | float | None = None
    axis: tuple[float, float, float] = eqx.field(static=True, default=(0.0, 0.0, 1.0))
    delay: Array | float = 0.0
    drag: Drag | None = None
    fit_drag: bool = eqx.field(static=True, default=False)
    fit_delay: bool = eqx.field(static=True, default=False)
    steps: int = eqx.field(static=True, default=1)

    def start(self):
        return {
            "drag": self.drag if self.fit_drag else None,
            "delay": self.delay if self.fit_delay else None,
        }

    def fixes_scale(self):
        return self.spin_inertia is not None or (self.drag is not None and not self.fit_drag)

    def __call__(self, tensor, omega, wxyz, times, wheel, unknown):
        inertia = Inertia(full=tensor)
        drag = unknown["drag"] if self.fit_drag else self.drag
        delay = unknown["delay"] if self.fit_delay else self.delay
        h = jnp.diff(times) / self.steps
        halves = jnp.arange(2 * self.steps + 1, dtype=times.dtype)
        nodes = times[:-1, None] + h[:, None] * halves[None] / 2
        spin = self._spin(nodes, times, wheel, delay)

        def torque(rates):
            if drag is None:
                return jnp.zeros_like(rates)
            # the norm has no derivative at rest; there the quadratic drag vanishes
            square = jnp.sum(rates * rates)
            speed = jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1)), 0)
            return -(drag.linear + drag.quadratic * speed) * rates

        def rates_of(momentum, carried):
            return inertia.rates(momentum - carried)

        def field(state, carried):
            rates = rates_of(state[0], carried)
            turn = None if state[1] is None else _quaternion_rate(state[1], rates)
            return jnp.cross(state[0], rates) + torque(rates), turn

        def shifted(state, slope, by):
            return jax.tree.map(lambda a, b: a + by * b, state, slope)

        def interval(state, inputs):
            step, carried = inputs
            for k in range(self.steps):
                first, middle, last = carried[2 * k], carried[2 * k + 1], carried[2 * k + 2]
                k1 = field(state, first)
                k2 = field(shifted(state, k1, step / 2), middle)
                k3 = field(shifted(state, k2, step / 2), middle)
                k4 = field(shifted(state, k3, step), last)
                state = jax.tree.map(
                    lambda y, a, b, c, d, step=step: y + step / 6 * (a + 2 * b + 2 * c + d),
                    state,
                    k1,
                    k2,
                    k3,
                    k4,
                )
            return state, state

        initial = (inertia.momentum(omega) + spin[0, 0], wxyz)
        _, path = jax.lax.scan(interval, initial, (h, spin))
        momentum, attitude = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), initial, path)
        at_samples = jnp.concatenate([spin[:, 0], spin[-1:, -1]])
        rates = rates_of(momentum, at_samples)
        slope = jnp.gradient(at_samples, axis=0) / jnp.gradient(times)[:, None]
        push = jnp.cross(momentum, rates) + jax.vmap(torque)(rates) - slope
        if attitude is not None:
            attitude = attitude / jnp.sqrt(jnp.sum(attitude**2, axis=-1, keepdims=True))
        return Motion(rates, inertia.rates(push), attitude)

    def _spin(self, nodes, times, wheel, delay):
        """Body components of the wheel's momentum at the nodes (t, 2 steps + 1, 3)."""
        if self.spin_inertia is None:
            return jnp.zeros((*nodes.shape, 3), nodes.dtype)
        speed = jnp.interp((nodes - delay).ravel(), times, wheel).reshape(nodes.shape)
        return (
            self.spin_inertia * speed[..., None] * jnp.asarray(self.axis, nodes.dtype)[None, None]
        )


class FreeMotion(AbstractMotion):
    """Torque-free flight, exact: Jacobi elliptic functions, nothing is stepped."""

    def start(self):
        return None

    def fixes_scale(self):
        return False

    def __call__(self, tensor, omega, wxyz, times, wheel, unknown):
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
        path = _combined(to_matrix(axes), rates)
        if turned is not None:
            turned = _combined(_right_product(conjugate(axes)), turned)
        return Motion(path, angular_acceleration(Inertia(full=tensor), path), turned)


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


def _quaternion_rate(q, rates):
    w, x, y, z = q
    a, b, c = rates / 2
    return jnp.stack(
        [
            -x * a - y * b - z * c,
            w * a + y * c - z * b,
            w * b + z * a - x * c,
            w * c + x * b - y * a,
        ]
    )
