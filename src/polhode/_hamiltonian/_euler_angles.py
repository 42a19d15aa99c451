"""Canonical coordinates (docs/equations.md, 000): ZYZ angles (phi, theta, psi) and their momenta.

H(q, p) is the Hamiltonian of ``_energy.py`` with the body momentum as a function of (q, p);
Hamilton's equations are its derivatives by ``jax.grad``. They require sin(theta) != 0.
"""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from polhode._checks import ArrayLike, as_floats, as_vectors
from polhode._hamiltonian._energy import (
    EnergyOfAttitude,
    Hamiltonian,
    Vector,
    components,
    cross,
    free_hamiltonian,
    from_euler_angles,
)
from polhode._hamiltonian._lie_poisson import Dynamics, spin_rates
from polhode.inertia import Inertia


def momentum_from_canonical(q: Sequence[Array], p: Sequence[Array]) -> Vector:
    """Body components of the angular momentum [kg m^2/s] from angles and momenta."""
    _, theta, psi = q
    p_phi, p_theta, p_psi = p
    s, c, st = jnp.sin(psi), jnp.cos(psi), jnp.sin(theta)
    across = (p_phi - jnp.cos(theta) * p_psi) / st
    return s * p_theta - c * across, c * p_theta + s * across, p_psi


def canonical_from_momentum(q: Sequence[Array], momentum: Sequence[Array]) -> Vector:
    """Canonical momenta (p_phi, p_theta, p_psi) = B^T L of body momentum components.

    The same map takes a body torque to its generalised force.
    """
    _, theta, psi = q
    x, y, z = momentum
    s, c, st = jnp.sin(psi), jnp.cos(psi), jnp.sin(theta)
    return st * (s * y - c * x) + jnp.cos(theta) * z, s * x + c * y, z


class CanonicalHamiltonian(eqx.Module):
    """H(q, p[, t]) in joules: q = (phi, theta, psi) [rad], p [kg m^2/s], arrays (..., 3)."""

    energy: Hamiltonian

    def __call__(
        self, q: Float[ArrayLike, "*#b 3"], p: Float[ArrayLike, "*#b 3"], t: Array | float = 0.0
    ) -> Float[Array, "*b"]:
        q, p = as_vectors("q", q), as_vectors("p", p)
        return self.of_components(components(q), components(p), t)

    def of_components(self, q: Sequence[Array], p: Sequence[Array], t: Array | float) -> Array:
        """The same on triples of component arrays (structure of arrays)."""
        return self.energy(momentum_from_canonical(q, p), from_euler_angles(*q), t)


def hamiltonian(
    inertia: Inertia, potential: EnergyOfAttitude | None = None
) -> CanonicalHamiltonian:
    """``hamiltonian(inertia, potential)(q, p)`` in ZYZ Euler angles (docs/equations.md).

    ``q`` (..., 3): phi, theta, psi in rad; ``p`` (..., 3) in kg m^2/s; the result (...) in J.
    """
    return CanonicalHamiltonian(free_hamiltonian(inertia, potential))


def hamiltons_equations(
    H: Callable[..., Array],
) -> Callable[..., tuple[Float[Array, "*b 3"], Float[Array, "*b 3"]]]:
    """Hamilton's equations of any ``H(q, p, ...)`` by ``jax.grad`` (docs/equations.md: 2, 3).

    Returns ``equations(q, p, *args) -> (dq/dt, dp/dt)``. Leading batch axes broadcast, including
    those that only H has (a batch of inertias); H must treat the entries of a batch separately.
    Lists and integers are converted to arrays of floats.
    """

    def equations(q, p, *args):
        if not _are_components(q, p):
            q, p = as_floats(finite=False, q=(q, ()), p=(p, ()))
            energies = jax.eval_shape(lambda q, p: H(q, p, *args), q, p).shape
            batch = jnp.broadcast_shapes(energies, q.shape[:-1], p.shape[:-1])
            q, p = (jnp.broadcast_to(x, (*batch, x.shape[-1])) for x in (q, p))
        slope_q, slope_p = jax.grad(lambda q, p: jnp.sum(H(q, p, *args)), argnums=(0, 1))(q, p)
        return slope_p, jax.tree.map(jnp.negative, slope_q)

    return equations


def _are_components(*values: Any) -> bool:
    """Whether values are tuples of component arrays, which need not be converted."""
    return all(isinstance(v, tuple) and all(isinstance(x, Array) for x in v) for v in values)


def rates_from_angle_rates(q: Sequence[Array], rates: Sequence[Array]) -> Vector:
    """Body rates omega = B dq/dt [rad/s] on component triples."""
    _, theta, psi = q
    phi_dot, theta_dot, psi_dot = rates
    s, c, st = jnp.sin(psi), jnp.cos(psi), jnp.sin(theta)
    return (
        s * theta_dot - st * c * phi_dot,
        st * s * phi_dot + c * theta_dot,
        jnp.cos(theta) * phi_dot + psi_dot,
    )


def angle_rates_from_rates(q: Sequence[Array], omega: Sequence[Array]) -> Vector:
    """Angle rates dq/dt = B^-1 omega [rad/s] on component triples."""
    _, theta, psi = q
    x, y, z = omega
    s, c = jnp.sin(psi), jnp.cos(psi)
    phi_dot = (s * y - c * x) / jnp.sin(theta)
    return phi_dot, s * x + c * y, z - jnp.cos(theta) * phi_dot


def euler_angle_field(t, y, dynamics: Dynamics):
    """The canonical vector field on ``y = (q, p)``, two triples of component arrays.

    With coupled wheels a third group, their momenta.
    """
    q, p, *spins = y
    dynamics = dynamics.at(*spins)
    chart = CanonicalHamiltonian(dynamics.hamiltonian)
    rate_q, rate_p = hamiltons_equations(chart.of_components)(q, p, t)
    attitude, omega = from_euler_angles(*q), rates_from_angle_rates(q, rate_q)
    if dynamics.torque is not None:
        push = dynamics.torque_at(t).body_components(t, attitude, omega)
        rate_p = tuple(a + b for a, b in zip(rate_p, canonical_from_momentum(q, push)))
        momentum = momentum_from_canonical(q, p)
        slip = dynamics.torque.slip(t, momentum, omega)
        if slip is not None:  # the axes rotate by the slip while the space momentum is constant
            coordinate_rates = angle_rates_from_rates(q, slip), cross(momentum, slip)
            _, momentum_change = jax.jvp(canonical_from_momentum, (q, momentum), coordinate_rates)
            rate_q = tuple(a + b for a, b in zip(rate_q, coordinate_rates[0]))
            rate_p = tuple(a + b for a, b in zip(rate_p, momentum_change))
    coordinate_rates = rate_q, rate_p
    return (
        (*coordinate_rates, spin_rates(t, attitude, omega, dynamics)) if spins else coordinate_rates
    )
