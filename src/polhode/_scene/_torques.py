"""External torques in body or space axes, constant, of time or of the state; damping."""

import abc
from collections.abc import Callable, Sequence
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from polhode._checks import ArrayLike, as_float_array, require_positive
from polhode._hamiltonian import Attitude, Vector, components, triple
from polhode._parts import AbstractPart, Signature, shaped, terms_of


class AbstractTorque(AbstractPart):
    """Base of all torques; they add with ``+``.

    ``body_components(t, attitude, omega)`` returns the torque [N m] as three body components,
    ``omega`` three components of the body rates [rad/s].
    """

    @abc.abstractmethod
    def body_components(
        self, t: Array | float, attitude: Attitude, omega: Sequence[Array]
    ) -> tuple[Array, Array, Array]:
        """Torque in body axes [N m]."""

    def slip(
        self, t: Array | float, momentum: Sequence[Array], omega: Sequence[Array]
    ) -> Vector | None:
        """Rates [rad/s] of the rotation in addition to I^-1 L in a body that loses energy inside.

        None where there are none; see ``EnergySink``.
        """
        return None

    @property
    def edges(self) -> Array | None:
        """Times (k,) [s] at which the torque jumps and steps have to end; None without such."""
        return None

    def during(self, t: Array | float) -> "AbstractTorque":
        """What acts between the edges beside the time ``t``."""
        return self

    def __add__(self, other: "AbstractTorque") -> "TorqueSum":
        return TorqueSum(terms_of("torque", AbstractTorque, TorqueSum, self, other))


class TorqueSum(AbstractTorque):
    """Sum of torques."""

    terms: tuple[AbstractTorque, ...]

    def body_components(self, t, attitude, omega):
        parts = zip(*(term.body_components(t, attitude, omega) for term in self.terms))
        return tuple(sum(rest, start=first) for first, *rest in parts)

    @property
    def edges(self):
        found = [x for term in self.terms if (x := term.edges) is not None]
        return jnp.concatenate(found) if found else None

    def during(self, t):
        return TorqueSum(tuple(term.during(t) for term in self.terms))

    def slip(self, t, momentum, omega):
        found = (term.slip(t, momentum, omega) for term in self.terms)
        parts = list(zip(*(x for x in found if x is not None)))
        return tuple(sum(rest, start=first) for first, *rest in parts) if parts else None


def stacked(parts: Sequence[Array]) -> Array:
    """An array (..., n) of its n components, broadcast together."""
    return jnp.stack(jnp.broadcast_arrays(*parts), axis=-1)


def vector_of_time(name: str, n: Any) -> Array | Callable:
    """A constant vector (..., 3), or a function fn(t) -> (3,) after a look at what it returns."""
    if not callable(n):
        return as_float_array(name, n, (3,))
    if isinstance(n, AbstractPart) and callable(n):
        return n
    return Signature(name, {"t": ()}, (3,)).checked(n)


def value_at(name: str, vector, t) -> tuple[Array, Array, Array]:
    """Components of such a vector; ``t`` may be an array of times: a function is mapped over it."""
    if not callable(vector):
        return components(vector)
    if isinstance(vector, AbstractPart) and callable(vector):
        return components(vector(t))  # carries the batch axes itself, such as KeplerOrbit
    return components(Signature(name, {"t": ()}, (3,)).mapped(vector, t))


class BodyTorque(AbstractTorque):
    """Torque given in body axes [N m]: constant (..., 3) or a function of time [s] -> (3,).

    The function may jump; for pulses at known times use ``ph.Pulses``, at whose edges steps end. A
    plain function is static data of the scene, not a leaf; an ``eqx.Module`` has its arrays as
    leaves.

    Raises TypeError or ValueError for a function that takes or returns something else.
    """

    n: Float[Array, "*#b 3"] | Callable = shaped(3)

    def __init__(self, n: ArrayLike | Callable):
        self.n = vector_of_time("BodyTorque", n)

    def body_components(
        self, t: Array | float, attitude: Attitude, omega: Sequence[Array]
    ) -> tuple[Array, Array, Array]:
        return value_at("BodyTorque", self.n, t)


class SpaceTorque(AbstractTorque):
    """Torque given in space axes [N m]: constant (..., 3) or a function of time [s] -> (3,).

    Functions are stored and checked as those of ``BodyTorque``.
    """

    n: Float[Array, "*#b 3"] | Callable = shaped(3)

    def __init__(self, n: ArrayLike | Callable):
        self.n = vector_of_time("SpaceTorque", n)

    def body_components(
        self, t: Array | float, attitude: Attitude, omega: Sequence[Array]
    ) -> tuple[Array, Array, Array]:
        return attitude.to_body(value_at("SpaceTorque", self.n, t))


def coefficients(name: str, c) -> Array:
    """Damping about three axes, from one number or three."""
    c = as_float_array(f"{name} c", c)
    if c.ndim == 0:
        c = jnp.broadcast_to(c, (3,))
    c = as_float_array(f"{name} c", c, (3,))
    require_positive(f"{name} c", c, zero=True, hint="a positive c takes energy away")
    return c


class LinearDamping(AbstractTorque):
    """Linear damping N = -c omega, component by component in body axes.

    ``c`` (..., 3), or (...) for the same about every axis [N m s]; it must not be negative.
    """

    c: Float[Array, "*#b 3"] = shaped(3)

    def __init__(self, c: ArrayLike):
        self.c = coefficients("LinearDamping", c)

    def body_components(
        self, t: Array | float, attitude: Attitude, omega: Sequence[Array]
    ) -> tuple[Array, Array, Array]:
        return triple(-c * rate for c, rate in zip(components(self.c), omega))


class QuadraticDamping(AbstractTorque):
    """Quadratic damping N = -c |omega| omega, component by component in body axes.

    ``c`` (..., 3), or (...) for the same about every axis [N m s^2]; it must not be negative.
    """

    c: Float[Array, "*#b 3"] = shaped(3)

    def __init__(self, c: ArrayLike):
        self.c = coefficients("QuadraticDamping", c)

    def body_components(
        self, t: Array | float, attitude: Attitude, omega: Sequence[Array]
    ) -> tuple[Array, Array, Array]:
        square = omega[0] ** 2 + omega[1] ** 2 + omega[2] ** 2
        turning = square > 0  # the slope of the root is infinite at rest, that of the torque is 0
        size = jnp.where(turning, jnp.sqrt(jnp.where(turning, square, 1)), 0)
        return triple(-c * size * rate for c, rate in zip(components(self.c), omega))


_FEEDBACK = Signature("FeedbackTorque", {"t": (), "wxyz": (4,), "omega_body": (3,)}, (3,))


class FeedbackTorque(AbstractTorque):
    """Torque as a function of time and state: ``fn(t, wxyz, omega_body)`` in body axes [N m].

    ``fn`` sees one body: t [s], unit quaternion (4,) body -> space (of either sign), body rates
    (3,) [rad/s], and returns (3,); batches are mapped over it. Arrays that ``fn`` carries (an
    ``eqx.Module``) are leaves of the scene, shared by all bodies; a plain function is static.

    Raises TypeError or ValueError for a function that takes or returns something else.
    """

    fn: Callable

    def __init__(self, fn: Callable):
        self.fn = _FEEDBACK.checked(fn)

    def body_components(
        self, t: Array | float, attitude: Attitude, omega: Sequence[Array]
    ) -> tuple[Array, Array, Array]:
        given = t, stacked(attitude.wxyz), stacked(omega)
        return components(_FEEDBACK.mapped(self.fn, *given))
