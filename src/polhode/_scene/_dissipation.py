"""Dissipation inside a body that keeps its angular momentum: the energy sink.

No torque acts from outside, so that R L does not change. The parts of the body that yield a little
turn its mean axes on by a slip s beside the rates omega = I^-1 L,

    dR/dt = R [omega + s]x,   dL/dt = L x (omega + s),   s = k (L x omega),

whatever s may be: d(R L)/dt = R ((omega + s) x L + L x (omega + s)) = 0. The kinetic energy
T = L . omega / 2 falls by

    dT/dt = omega . (L x s) = -k |L x omega|^2,

that is wherever the body does not turn about a principal axis, down to |L|^2 / (2 I_max), the only
stable end. This is the double bracket of A. M. Bloch, P. S. Krishnaprasad, J. E. Marsden,
T. S. Ratiu, The Euler-Poincare equations and double bracket dissipation, Commun. Math. Phys. 175
(1996) 1, with the attitude that belongs to it; as an energy sink: P. W. Likins, Effects of energy
dissipation on the free body motions of spacecraft, JPL TR 32-860 (1966).
"""

from collections.abc import Callable, Sequence

import jax.numpy as jnp
from jaxtyping import Array, Float

from polhode._checks import ArrayLike, as_positive
from polhode._hamiltonian import Attitude, Vector, cross, triple
from polhode._parts import Signature, shaped
from polhode._scene._torques import AbstractTorque, stacked

_RATE_LAW = Signature("EnergySink", {"momentum_body": (3,), "omega_body": (3,)})


class EnergySink(AbstractTorque):
    """Loss of kinetic energy inside the body at constant angular momentum in space.

    dT/dt = -k |L x omega|^2 [W], and no torque from outside: the body ends in a spin about its
    axis of largest moment. ``k`` (...) [s/(kg m^2)] is a rate law: a number, not negative, or a
    function ``fn(momentum_body, omega_body)`` of L (3,) [kg m^2/s] and omega (3,) [rad/s] of one
    body that returns one, stored and checked as those of ``BodyTorque``. A body of moments A, A, C
    with its angular momentum at the angle theta from the axis of C obeys, while k is constant,

        tan theta(t) = tan theta(0) exp(k |L|^2 (1/C - 1/A) t).

    ``omega_body`` of a trajectory is I^-1 L. The body rotates in addition by ``slip``, which is
    small where little energy is lost in a revolution; ``docs/how-to/dissipate_energy.md`` derives
    this and gives rate laws. It adds to torques and potentials that are weak against L x omega.

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
        return triple([jnp.zeros_like(omega[0])] * 3)  # nothing acts from outside

    def slip(self, t: Array | float, momentum: Sequence[Array], omega: Sequence[Array]) -> Vector:
        rate = self.k
        if callable(rate):
            rate = _RATE_LAW.mapped(rate, stacked(momentum), stacked(omega))
        return triple(rate * x for x in cross(momentum, omega))
