"""External torques in body or space axes, constant, of time or of the state; damping."""

import abc
from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from polhode._checks import as_float_array, is_concrete, require
from polhode.hamiltonian import Attitude, components


class AbstractTorque(eqx.Module):
    """Base of all torques; they add with ``+``.

    ``body_components(t, attitude, omega)`` returns the torque [N m] as three body components,
    ``omega`` three components of the body rates [rad/s]. ``core_ranks`` names the array fields
    with their ranks without batch axes.
    """

    core_ranks: eqx.AbstractClassVar[dict[str, int]]

    @abc.abstractmethod
    def body_components(
        self, t: Array | float, attitude: Attitude, omega: Sequence[Array]
    ) -> tuple[Array, Array, Array]:
        """Torque in body axes [N m]."""

    def __add__(self, other: "AbstractTorque") -> "TorqueSum":
        if not isinstance(other, AbstractTorque):
            raise TypeError(f"a torque adds to another torque, not to {type(other).__name__}")
        return TorqueSum((*_terms(self), *_terms(other)))


def _terms(torque: AbstractTorque) -> tuple[AbstractTorque, ...]:
    return torque.terms if isinstance(torque, TorqueSum) else (torque,)


class TorqueSum(AbstractTorque):
    """Sum of torques."""

    terms: tuple[AbstractTorque, ...]

    core_ranks = {}  # noqa: RUF012

    def body_components(self, t, attitude, omega):
        parts = zip(*(term.body_components(t, attitude, omega) for term in self.terms))
        return tuple(sum(rest, start=first) for first, *rest in parts)


def _constant_or_function(name: str, n):
    return n if callable(n) else as_float_array(name, n, (3,))


def _value(n, t):
    return components(jnp.asarray(n(t)) if callable(n) else n)


class BodyTorque(AbstractTorque):
    """Torque given in body axes [N m]: constant (..., 3) or a function of time [s] -> (3,).

    The function may jump. A pulse far shorter than a step can be missed: put its times among those
    that are simulated, which are stepped to.
    """

    n: Float[Array, "*#b 3"] | Callable

    core_ranks = {"n": 1}  # noqa: RUF012

    def __init__(self, n):
        self.n = _constant_or_function("BodyTorque n", n)

    def body_components(self, t, attitude, omega):
        return _value(self.n, t)


class SpaceTorque(AbstractTorque):
    """Torque given in space axes [N m]: constant (..., 3) or a function of time [s] -> (3,)."""

    n: Float[Array, "*#b 3"] | Callable

    core_ranks = {"n": 1}  # noqa: RUF012

    def __init__(self, n):
        self.n = _constant_or_function("SpaceTorque n", n)

    def body_components(self, t, attitude, omega):
        return attitude.to_body(_value(self.n, t))


def _coefficients(name: str, c) -> Array:
    """Damping about three axes, from one number or three."""
    given, c = c, as_float_array(f"{name} c", c)
    if c.ndim == 0:
        c = jnp.broadcast_to(c, (3,))
    c = as_float_array(f"{name} c", c, (3,))
    if is_concrete(c):
        require(
            np.asarray(c) >= 0,
            f"{name} c must not be negative, got {given}: a positive c takes energy away.",
        )
    return c


class LinearDamping(AbstractTorque):
    """Linear damping N = -c omega, component by component in body axes.

    ``c`` (..., 3), or (...) for the same about every axis [N m s]; it must not be negative.
    """

    c: Float[Array, "*#b 3"]

    core_ranks = {"c": 1}  # noqa: RUF012

    def __init__(self, c):
        self.c = _coefficients("LinearDamping", c)

    def body_components(self, t, attitude, omega):
        return tuple(-c * rate for c, rate in zip(components(self.c), omega))


class QuadraticDamping(AbstractTorque):
    """Quadratic damping N = -c |omega| omega, component by component in body axes.

    ``c`` (..., 3), or (...) for the same about every axis [N m s^2]; it must not be negative.
    """

    c: Float[Array, "*#b 3"]

    core_ranks = {"c": 1}  # noqa: RUF012

    def __init__(self, c):
        self.c = _coefficients("QuadraticDamping", c)

    def body_components(self, t, attitude, omega):
        square = omega[0] ** 2 + omega[1] ** 2 + omega[2] ** 2
        turning = square > 0  # the slope of the root is infinite at rest, that of the torque is 0
        size = jnp.where(turning, jnp.sqrt(jnp.where(turning, square, 1)), 0)
        return tuple(-c * size * rate for c, rate in zip(components(self.c), omega))


class FeedbackTorque(AbstractTorque):
    """Torque as a function of time and state: ``fn(t, wxyz, omega_body)`` in body axes [N m].

    ``fn`` sees one body: t [s], unit quaternion (4,) body -> space (of either sign), body rates
    (3,) [rad/s], and returns (3,); batches are mapped over it. Arrays that ``fn`` carries (an
    ``eqx.Module``) are shared by all bodies.
    """

    fn: Callable

    core_ranks = {}  # noqa: RUF012

    def __init__(self, fn: Callable):
        if not callable(fn):
            raise TypeError(
                "FeedbackTorque takes a function fn(t, wxyz, omega_body), got"
                f" {type(fn).__name__}; for a constant torque use ph.BodyTorque."
            )
        self.fn = fn

    def body_components(self, t, attitude, omega):
        wxyz = jnp.stack(jnp.broadcast_arrays(*attitude.wxyz), axis=-1)
        rates = jnp.stack(jnp.broadcast_arrays(*omega), axis=-1)
        one = self.fn
        for _ in range(rates.ndim - 1):
            one = jax.vmap(one, in_axes=(None, 0, 0))
        return components(jnp.asarray(one(t, wxyz, rates)))
