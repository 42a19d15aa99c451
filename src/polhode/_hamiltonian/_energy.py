"""The Hamiltonian of the rigid body, written once. Whatever is stepped is a derivative of it.

Both charts (ZYZ Euler angles; quaternion and body momentum) and every energy the library
reports evaluate ``Hamiltonian.__call__``; nothing else in the package states the formula.
"""

from collections.abc import Callable, Sequence
from typing import Protocol, runtime_checkable

import equinox as eqx
import jax
from jaxtyping import Array

from polhode._hamiltonian._attitude import Attitude, Vector, components
from polhode.inertia import Inertia


@runtime_checkable
class EnergyOfAttitude(Protocol):
    """What the Hamiltonian asks of a potential (see ``polhode._scene.AbstractPotential``)."""

    def energy(self, attitude: Attitude, t: Array | float, inertia: Inertia) -> Array: ...


def inverse_components(tensor: Array) -> tuple[Array, ...]:
    """(xx, yy, zz, xy, xz, yz) of the inverse of a symmetric tensor of shape (..., 3, 3)."""
    a, b, c = tensor[..., 0, 0], tensor[..., 1, 1], tensor[..., 2, 2]
    d, e, f = tensor[..., 0, 1], tensor[..., 0, 2], tensor[..., 1, 2]
    xx, yy, zz = b * c - f * f, a * c - e * e, a * b - d * d
    xy, xz, yz = e * f - c * d, d * f - b * e, d * e - a * f
    scale = 1 / (a * xx + d * xy + e * xz)
    return tuple(scale * entry for entry in (xx, yy, zz, xy, xz, yz))


def inverse_inertia(inertia: Inertia) -> tuple[Array, ...]:
    """Entries of I^-1 [1/(kg m^2)]: three in principal body axes, else six (xx yy zz xy xz yz)."""
    if inertia.is_principal:
        return tuple(1 / moment for moment in components(inertia.moments))
    return inverse_components(inertia.tensor)


class Hamiltonian(eqx.Module):
    """H = (L - h) . I^-1 (L - h) / 2 + V(R, t), in joules (docs/equations.md, 000: 1).

    **Fields:** ``inverse`` entries of I^-1 (three or six component arrays), ``inertia`` handed on
    to the potential, ``potential`` or None, ``rotor_momentum`` or None: h(t) [kg m^2/s], body
    components of the momentum that wheels carry relative to the body, ``wheel_energy`` or None:
    energy [J] of their turning about their axes, a function of time alone that moves nothing.
    """

    inverse: tuple[Array, ...]
    inertia: Inertia
    potential: EnergyOfAttitude | None = None
    rotor_momentum: Callable[[Array | float], Vector] | None = None
    wheel_energy: Callable[[Array | float], Array] | None = None

    def __call__(
        self, momentum: Sequence[Array], attitude: Attitude | None, t: Array | float
    ) -> Array:
        """Energy [J] of body momentum components [kg m^2/s] at an attitude and time [s]."""
        if self.rotor_momentum is None:
            x, y, z = momentum
        else:
            x, y, z = (a - h for a, h in zip(momentum, self.rotor_momentum(t)))
        twice = self.inverse[0] * x * x + self.inverse[1] * y * y + self.inverse[2] * z * z
        if len(self.inverse) == 6:
            xy, xz, yz = self.inverse[3:]
            twice = twice + 2 * (xy * x * y + xz * x * z + yz * y * z)
        kinetic = twice / 2
        if self.potential is None:
            return kinetic
        return kinetic + self.potential.energy(attitude, t, self.inertia)

    def total(
        self, momentum: Sequence[Array], attitude: Attitude | None, t: Array | float
    ) -> Array:
        """H and the energy of the wheels [J]: what changes by work from outside only."""
        energy = self(momentum, attitude, t)
        return energy if self.wheel_energy is None else energy + self.wheel_energy(t)

    def rows_used(self, attitude: Attitude, t: Array | float) -> tuple[int, ...]:
        """Which rows of R the potential looks at (found by tracing it once; none without one)."""
        potential = self.potential
        if potential is None:
            return ()
        row = jax.eval_shape(lambda: attitude.compute(2))  # not kept: no leak
        used: tuple[int, ...] = ()

        def look(rows):
            nonlocal used
            seen = Attitude(lambda i: rows[i])
            energy = potential.energy(seen, t, self.inertia)
            used = seen.used
            return energy

        jax.eval_shape(look, dict.fromkeys(range(3), row))
        return used


def free_hamiltonian(inertia: Inertia, potential: EnergyOfAttitude | None = None) -> Hamiltonian:
    """The Hamiltonian of a body without rotors."""
    if not isinstance(inertia, Inertia):
        raise TypeError(
            "a Hamiltonian needs the body's ph.Inertia, such as ph.Inertia.from_moments([1., 2.,"
            f" 3.]), got {type(inertia).__name__}."
        )
    if potential is not None and not callable(getattr(potential, "energy", None)):
        raise TypeError(
            "the potential must be one of ph.UniformGravity, ph.Potential, ... or None, got"
            f" {type(potential).__name__}."
        )
    return Hamiltonian(inverse_inertia(inertia), inertia, potential)
