"""How a frame turns: attitude, angular velocity and its derivative as functions of time.

All rates are components along the rotating axes (docs/equations.md, 003: 5-12).
"""

import abc
from collections.abc import Callable

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from polhode.rotation import conjugate, matrix_to_wxyz, multiply, normalise, rotation_vector_to_wxyz
from polhode.rotation._components import wxyz_rate

Rates = tuple[Float[Array, "3"], Float[Array, "3"] | None]


def rate_of_change(function: Callable, t: Array) -> tuple[Array, Array]:
    """A function of time and its time derivative, by forward-mode differentiation."""
    return jax.jvp(function, (t,), (jnp.ones_like(t),))


class AbstractTurning(eqx.Module):
    """Attitude and angular velocity of a frame at one time ``t`` (a scalar)."""

    @abc.abstractmethod
    def rates(self, t: Array) -> Rates:
        """Angular velocity and its derivative [rad/s, rad/s^2]; None where it is always zero."""

    @abc.abstractmethod
    def attitude(self, t: Array) -> Float[Array, "4"]:
        """Unit quaternion, rotating axes -> space axes."""


class ConstantRate(AbstractTurning):
    """Constant angular velocity; attitude ``start`` at time ``t0``, in closed form."""

    omega_body: Float[Array, "3"]
    start: Float[Array, "4"]
    t0: Float[Array, ""]

    def rates(self, t):
        return self.omega_body, None

    def attitude(self, t):
        return multiply(self.start, rotation_vector_to_wxyz(self.omega_body * (t - self.t0)))


class VariableRate(AbstractTurning):
    """Angular velocity as a function of time; attitude ``start`` at ``t0``, by integration."""

    omega_body: Callable[[Array], Float[Array, "3"]]
    start: Float[Array, "4"]
    t0: Float[Array, ""]

    def rates(self, t):
        return rate_of_change(self.omega_body, t)

    def attitude(self, t):
        """One adaptive integration from ``t0``, at about 50 times the rounding error per step."""
        accuracy = 50 * float(jnp.finfo(self.start.dtype).eps)
        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(lambda s, wxyz, _: wxyz_rate(wxyz, self.omega_body(s))),
            diffrax.Dopri8(),
            self.t0,
            t,
            None,
            self.start,
            stepsize_controller=diffrax.PIDController(rtol=0.0, atol=accuracy),
            max_steps=2**14,
            adjoint=diffrax.RecursiveCheckpointAdjoint(),
        )
        (path,) = jax.tree.leaves(solution.ys)
        return normalise(path[-1])


class PrescribedAttitude(AbstractTurning):
    """Attitude as a function of time, a matrix (3, 3) or a quaternion (4,) of any scale."""

    function: Callable[[Array], Array]

    def rates(self, t):
        return rate_of_change(self._omega, t)

    def _omega(self, t):
        value, slope = rate_of_change(self.function, t)
        if value.ndim == 2:
            turn = value.T @ slope
            return (
                jnp.stack(
                    [turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]
                )
                / 2
            )
        return 2 * multiply(conjugate(value), slope)[1:] / jnp.sum(value * value)

    def attitude(self, t):
        value = self.function(t)
        return matrix_to_wxyz(value) if value.ndim == 2 else normalise(value)
