"""Torques: in body and space axes, feedback, damping, pulses, and an energy sink."""

import abc
import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from polhode._checks import (
    ArrayLike,
    as_float_array,
    as_positive,
    is_concrete,
    require,
    require_positive,
)
from polhode._hamiltonian import Attitude, Vector, components, cross, triple
from polhode._parts import AbstractPart, AbstractSum, Signature, shaped, terms_of
from polhode._scene._tables import check_kind


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
        """Rotation rates [rad/s] in addition to I^-1 L, due to dissipation inside the body.

        None for torques without; see ``EnergySink``.
        """
        return None

    def with_wheels(self, momentum: Sequence[Array]) -> "AbstractTorque":
        """The torque at an instant when the wheels of the scene have this momentum [kg m^2/s].

        A torque that contains another one passes the momentum on to it.
        """
        return self

    @property
    def edges(self) -> Array | None:
        """Times (k,) [s] at which the torque jumps and steps must end; None: none."""
        return None

    def during(self, t: Array | float) -> "AbstractTorque":
        """The torque between the two edges around the time ``t``."""
        return self

    def __add__(self, other: "AbstractTorque") -> "TorqueSum":
        return TorqueSum(terms_of("torque", AbstractTorque, self, other))


class TorqueSum(AbstractTorque, AbstractSum):
    """Sum of torques."""

    terms: tuple[AbstractTorque, ...]

    def body_components(self, t, attitude, omega):
        parts = zip(*(term.body_components(t, attitude, omega) for term in self.terms))
        return tuple(sum(rest, start=first) for first, *rest in parts)

    @property
    def edges(self):
        parts = [x for term in self.terms if (x := term.edges) is not None]
        return jnp.concatenate(parts) if parts else None

    def during(self, t):
        return TorqueSum(tuple(term.during(t) for term in self.terms))

    def with_wheels(self, momentum):
        return TorqueSum(tuple(term.with_wheels(momentum) for term in self.terms))

    def slip(self, t, momentum, omega):
        slips = (term.slip(t, momentum, omega) for term in self.terms)
        parts = list(zip(*(x for x in slips if x is not None)))
        return tuple(sum(rest, start=first) for first, *rest in parts) if parts else None


def stacked(parts: Sequence[Array]) -> Array:
    """An array (..., n) from its n components, which broadcast together."""
    return jnp.stack(jnp.broadcast_arrays(*parts), axis=-1)


def vector_of_time(name: str, n: Any) -> Array | Callable:
    """A constant vector (..., 3), or a function fn(t) -> (3,), checked by one call."""
    if not callable(n):
        return as_float_array(name, n, (3,))
    if isinstance(n, AbstractPart) and callable(n):
        check_kind(name, n, 3)
        return n
    return Signature(name, {"t": ()}, (3,)).checked(n)


def value_at(name: str, vector, t) -> tuple[Array, Array, Array]:
    """Components of a ``vector_of_time`` at ``t``; a function is mapped over an array of times."""
    if not callable(vector):
        return components(vector)
    if isinstance(vector, AbstractPart) and callable(vector):
        return components(vector(t))  # handles batch axes itself, such as KeplerOrbit
    return components(Signature(name, {"t": ()}, (3,)).mapped(vector, t))


class BodyTorque(AbstractTorque):
    """Torque given in body axes [N m]: constant (..., 3) or a function of time [s] -> (3,).

    The function may be discontinuous; for pulses at known times use ``ph.Pulses``, at whose edges
    steps end. A plain function is static data of the scene, not a leaf; the arrays of an
    ``eqx.Module`` are leaves.

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


def coefficients(name: str, c, hint: str = "a positive c takes energy away") -> Array:
    """Coefficients (..., 3) from one number or three; ``name``: of the argument."""
    c = as_float_array(name, c)
    if c.ndim == 0:
        c = jnp.broadcast_to(c, (3,))
    c = as_float_array(name, c, (3,))
    require_positive(name, c, zero=True, hint=hint)
    return c


class LinearDamping(AbstractTorque):
    """Linear damping N = -c omega, component by component in body axes.

    ``c`` (..., 3), or one number for the same about every axis [N m s]; it must not be negative.
    """

    c: Float[Array, "*#b 3"] = shaped(3)

    def __init__(self, c: ArrayLike):
        self.c = coefficients("LinearDamping c", c)

    def body_components(
        self, t: Array | float, attitude: Attitude, omega: Sequence[Array]
    ) -> tuple[Array, Array, Array]:
        return triple(-c * rate for c, rate in zip(components(self.c), omega))


class QuadraticDamping(AbstractTorque):
    """Quadratic damping N = -c |omega| omega, component by component in body axes.

    ``c`` (..., 3), or one number for the same about every axis [N m s^2]; it must not be negative.
    """

    c: Float[Array, "*#b 3"] = shaped(3)

    def __init__(self, c: ArrayLike):
        self.c = coefficients("QuadraticDamping c", c)

    def body_components(
        self, t: Array | float, attitude: Attitude, omega: Sequence[Array]
    ) -> tuple[Array, Array, Array]:
        square = omega[0] ** 2 + omega[1] ** 2 + omega[2] ** 2
        # at rest the derivative of the root is infinite, but that of the torque is zero
        turning = square > 0
        size = jnp.where(turning, jnp.sqrt(jnp.where(turning, square, 1)), 0)
        return triple(-c * size * rate for c, rate in zip(components(self.c), omega))


_FEEDBACK = Signature("FeedbackTorque", {"t": (), "wxyz": (4,), "omega_body": (3,)}, (3,))


class FeedbackTorque(AbstractTorque):
    """Torque as a function of time and state: ``fn(t, wxyz, omega_body)`` in body axes [N m].

    ``fn`` is called for one body: t [s], unit quaternion (4,) body -> space (of either sign), body
    rates (3,) [rad/s], and returns (3,); batches are mapped over it. Arrays of ``fn`` (an
    ``eqx.Module``) are leaves of the scene, shared by all bodies; a plain function is static.

    Raises TypeError or ValueError for a function that takes or returns something else.
    """

    fn: Callable

    def __init__(self, fn: Callable):
        self.fn = _FEEDBACK.checked(fn)

    def body_components(
        self, t: Array | float, attitude: Attitude, omega: Sequence[Array]
    ) -> tuple[Array, Array, Array]:
        arguments = t, stacked(attitude.wxyz), stacked(omega)
        return components(_FEEDBACK.mapped(self.fn, *arguments))


# Dissipation inside a body that conserves its angular momentum: the energy sink.
#
# No external torque acts, so that R L is constant. Deformations of the body add a slip s to the
# rates omega = I^-1 L of its mean axes,
#
#     dR/dt = R [omega + s]x,   dL/dt = L x (omega + s),   s = k (L x omega).
#
# R L is constant for any s: d(R L)/dt = R ((omega + s) x L + L x (omega + s)) = 0. The kinetic
# energy T = L . omega / 2 changes by
#
#     dT/dt = omega . (L x s) = -k |L x omega|^2.
#
# It decreases unless the body rotates about a principal axis, to |L|^2 / (2 I_max), the only stable
# equilibrium. This is the double bracket of A. M. Bloch, P. S. Krishnaprasad, J. E. Marsden, T. S.
# Ratiu, The Euler-Poincare equations and double bracket dissipation, Commun. Math. Phys. 175 (1996)
# 1, with the corresponding attitude; as an energy sink: P. W. Likins, Effects of energy dissipation
# on the free body motions of spacecraft, JPL TR 32-860 (1966).


_RATE_LAW = Signature("EnergySink", {"momentum_body": (3,), "omega_body": (3,)})


class EnergySink(AbstractTorque):
    """Loss of kinetic energy inside the body at constant angular momentum in space.

    dT/dt = -k |L x omega|^2 [W], without an external torque: the body ends in a rotation about its
    axis of largest moment. ``k`` (...) [s/(kg m^2)]: a number, not negative, or a function
    ``fn(momentum_body, omega_body)`` of L (3,) [kg m^2/s] and omega (3,) [rad/s] of one body that
    returns a number, stored and checked as those of ``BodyTorque``. With moments A, A, C and a
    constant k, the angle theta between the angular momentum and the axis of C obeys

        tan theta(t) = tan theta(0) exp(k |L|^2 (1/C - 1/A) t).

    ``omega_body`` of a trajectory is I^-1 L. The actual rates include ``slip`` as well, which is
    small if little energy is lost in a revolution; ``docs/how-to/dissipate_energy.md`` derives
    this and gives functions for k. Other torques and potentials may act as well, if they are small
    compared with |L x omega|.

        sink = ph.EnergySink(0.01)
        scene = ph.Scene(ph.Inertia.from_moments([1.0, 2.0, 3.0]), torque=sink)
        state = ph.State([1.0, 0, 0, 0], [1.0, 0.1, 0.1])
        end = ph.simulate(scene, state, [0.0, 4000.0])       # about body z, 1/3 rad/s

    Raises ValueError for a negative k, TypeError or ValueError for a function that takes or returns
    something else.
    """

    k: Float[Array, "*#b"] | Callable = shaped()

    def __init__(self, k: ArrayLike | Callable):
        if callable(k):
            self.k = _RATE_LAW.checked(k)
            return
        self.k = as_positive("EnergySink k", k, zero=True, hint="a positive k takes energy away")

    def body_components(
        self, t: Array | float, attitude: Attitude, omega: Sequence[Array]
    ) -> tuple[Array, Array, Array]:
        return triple([jnp.zeros_like(omega[0])] * 3)  # no external torque

    def slip(self, t: Array | float, momentum: Sequence[Array], omega: Sequence[Array]) -> Vector:
        rate = self.k
        if callable(rate):
            rate = _RATE_LAW.mapped(rate, stacked(momentum), stacked(omega))
        return triple(rate * x for x in cross(momentum, omega))


_COMMAND = dataclasses.replace(_FEEDBACK, name="SampledTorque")


class SampledTorque(AbstractTorque):
    """A sampled controller: its torque is computed once per period and constant in between.

    It models the zero-order hold of flight software. **Arguments:** ``fn(t, wxyz, omega_body)`` ->
    (3,): torque in body axes [N m], as for ``ph.FeedbackTorque``; ``period`` [s]: a number, not a
    leaf. ``fn`` is called at the first time of a simulation and after every ``period``, so that a
    simulation that continues another one should start at the end of a period. ``fn`` need not be
    smooth.

    Only ``ph.simulate`` integrates it, alone or as a term of a sum, without events and work; the
    times must be concrete (under ``jax.jit`` a list or a NumPy array), and ``Trajectory.at`` is not
    available. A simulation needs one integration for every period and every saved time. Derivatives
    with respect to the state and the arrays of ``fn`` are those of the sampled system.

        law = ph.SampledTorque(lambda t, wxyz, omega: -0.5 * omega, period=0.1)
        scene = ph.Scene(ph.Inertia.from_moments([1.0, 1.5, 2.0]), torque=law)

    Raises TypeError or ValueError for a function that takes or returns something else, ValueError
    for a period that is not positive.
    """

    fn: Callable
    period: float = eqx.field(static=True)

    def __init__(self, fn: Callable, period: float):
        self.fn = _COMMAND.checked(fn)
        if isinstance(period, bool) or not isinstance(period, (int, float)):
            raise TypeError(
                "SampledTorque period must be a number in seconds such as 0.1, got"
                f" {type(period).__name__}."
            )
        if not 0 < period < float("inf"):
            raise ValueError(f"SampledTorque period must be positive and finite, got {period}.")
        self.period = float(period)

    def command(self, t: Array, wxyz: Array, omega: Array) -> Array:
        """The torque (N, 3) [N m] of N bodies from the time ``t`` to the end of the period."""
        return _COMMAND.mapped(self.fn, t, wxyz, omega)

    def body_components(
        self, t: Array | float, attitude: Attitude, omega: Sequence[Array]
    ) -> tuple[Array, Array, Array]:
        raise ValueError(
            "SampledTorque holds a command that the state does not contain. It is for ph.simulate"
            " without events, as the torque of the scene or a term of its sum; what needs the"
            " torque at a state, such as ph.accelerometer, frames of a trajectory and ensembles,"
            " does not take it: use a ph.FeedbackTorque."
        )


# Pulses: torques that act between given times, such as those of thrusters; steps end at the edges.


class Pulses(AbstractTorque):
    """A torque that acts from each of ``starts`` to the corresponding one of ``ends``.

    **Arguments:** ``torque``: the torque during the pulses, such as ``ph.BodyTorque``; ``starts``,
    ``ends`` (k,) [s]: shared by all bodies, each end after its start. Steps end at every edge, so
    that even very short pulses are integrated, and derivatives with respect to starts and ends are
    exact. The torque of overlapping pulses is not added. A motion with k pulses is solved in
    2 k + 1 parts.

        burn = ph.Pulses(ph.BodyTorque([0.0, 0.0, 2.0]), [1.0, 5.0], [1.05, 5.001])
        scene = ph.Scene(ph.Inertia.from_moments([1.0, 1.5, 2.0]), torque=burn)
        state = ph.State([1.0, 0, 0, 0], [0.0, 0.0, 0.0])
        ph.simulate(scene, state, [0.0, 9.0]).omega_body[-1]     # (0, 0, 0.051)

    Raises TypeError unless it is a torque, ValueError for ends before starts or other shapes.
    """

    starts: Float[Array, " k"]
    ends: Float[Array, " k"]
    on: Array | None
    torque: AbstractTorque = shaped()

    def __init__(self, torque: AbstractTorque, starts: ArrayLike, ends: ArrayLike):
        if not isinstance(torque, AbstractTorque):
            raise TypeError(
                "Pulses takes a torque such as ph.BodyTorque([0., 0., 1.]), got"
                f" {type(torque).__name__}."
            )
        self.torque, self.on = torque, None
        self.starts, self.ends = (
            jnp.atleast_1d(as_float_array(f"Pulses {name}", x))
            for name, x in (("starts", starts), ("ends", ends))
        )
        if self.starts.ndim != 1 or self.starts.shape != self.ends.shape:
            raise ValueError(
                "Pulses starts and ends must be two lists of times of one length, got shapes"
                f" {self.starts.shape} and {self.ends.shape}; all bodies share them."
            )
        if is_concrete(self.starts, self.ends):
            require(
                np.asarray(self.ends) > np.asarray(self.starts),
                f"each pulse must end after it starts, got {starts} and {ends}.",
            )

    @property
    def input_conditions(self) -> tuple[Array, ...]:
        return (jnp.all(self.ends > self.starts),)

    @property
    def edges(self) -> Array | None:
        torque_edges = self.torque.edges
        times = [self.starts, self.ends] + ([] if torque_edges is None else [torque_edges])
        return jnp.concatenate(times)

    def during(self, t: Array | float) -> AbstractTorque:
        pulses = eqx.tree_at(lambda p: p.torque, self, self.torque.during(t))
        return eqx.tree_at(lambda p: p.on, pulses, self._acts(t), is_leaf=lambda x: x is None)

    def with_wheels(self, momentum: Sequence[Array]) -> AbstractTorque:
        return eqx.tree_at(lambda p: p.torque, self, self.torque.with_wheels(momentum))

    def _acts(self, t: Array | float) -> Array:
        """Whether a pulse acts at the times ``t`` (...): 1 or 0."""
        if self.on is not None:
            return self.on
        t = jnp.asarray(t, self.starts.dtype)
        starts, ends = (x.reshape((1,) * t.ndim + x.shape) for x in (self.starts, self.ends))
        among = (starts <= t[..., None]) & (t[..., None] < ends)
        return jnp.where(jnp.any(among, axis=-1), 1, 0).astype(self.starts.dtype)

    def body_components(
        self, t: Array | float, attitude: Attitude, omega: Sequence[Array]
    ) -> tuple[Array, Array, Array]:
        on = self._acts(t)
        return triple(on * x for x in self.torque.body_components(t, attitude, omega))

    def slip(
        self, t: Array | float, momentum: Sequence[Array], omega: Sequence[Array]
    ) -> Vector | None:
        slip = self.torque.slip(t, momentum, omega)
        return None if slip is None else triple(self._acts(t) * x for x in slip)
