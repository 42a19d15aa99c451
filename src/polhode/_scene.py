"""What is in the scene: the body's inertia and what acts on it."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from polhode._checks import is_concrete
from polhode.hamiltonian import Hamiltonian, inverse_inertia
from polhode.inertia import Inertia
from polhode.torques import AbstractPotential, AbstractRotor, AbstractTorque, Wheels


class Scene(eqx.Module):
    """A rigid body and what acts on it; absent parts are None and cost nothing.

    **Arguments:** ``inertia``: ``ph.Inertia``; ``potential``: ``ph.AbstractPotential`` or None;
    ``torque``: ``ph.AbstractTorque`` or None; ``rotors``: ``ph.Rotor`` or a sum of such, or None
    (the inertia includes the wheels). Any leaf may carry leading batch axes; they broadcast
    together and with those of the state.

    Raises TypeError for a part of the wrong kind.
    """

    inertia: Inertia
    potential: AbstractPotential | None = None
    torque: AbstractTorque | None = None
    rotors: AbstractRotor | None = None

    def __check_init__(self):
        kinds = (
            ("inertia", Inertia, "ph.Inertia, for example ph.Inertia.from_moments([1., 2., 3.])"),
            ("potential", AbstractPotential | None, "a potential (ph.UniformGravity, ...) or None"),
            ("torque", AbstractTorque | None, "a torque (ph.BodyTorque, ...) or None"),
            ("rotors", AbstractRotor | None, "rotors (ph.Rotor, a sum of them) or None"),
        )
        for name, kind, wanted in kinds:
            value = getattr(self, name)
            if not isinstance(value, kind):
                raise TypeError(f"Scene {name} must be {wanted}, got {type(value).__name__}.")
        if self.rotors is not None and is_concrete(self.inertia, self.rotors):
            self.rotors.check_within(self.inertia)

    @property
    def is_free(self) -> bool:
        """Whether nothing acts on the body and nothing turns in it (static)."""
        return self.potential is None and self.torque is None and self.rotors is None

    def settled(self, state, start: Array) -> "Scene":
        """The scene with the motion of its wheels fixed by the state at the time ``start``."""
        if self.rotors is None:
            return self
        wheels = self.rotors.settle(state.omega_body, start)
        return Scene(self.inertia, self.potential, self.torque, wheels)

    @property
    def _wheels(self) -> Wheels | None:
        if self.rotors is None or isinstance(self.rotors, Wheels):
            return self.rotors
        raise ValueError(
            "the momentum of rotors follows from the state: use scene.settled(state, t) first."
        )

    @property
    def carrier(self) -> Inertia:
        """The inertia that turns with the body: without wheels that are not held at their speed."""
        return self.inertia if self._wheels is None else self._wheels.carrier(self.inertia)

    def wheel_momentum(self, t: Array | float) -> Array | None:
        """h(t) (..., 3) [kg m^2/s]: momentum L - (carrier) omega of the wheels; None without."""
        if self._wheels is None:
            return None
        return jnp.stack(jnp.broadcast_arrays(*self._wheels.body_momentum(t)), axis=-1)

    def momentum(self, omega: Array, t: Array | float) -> Array:
        """Body momentum (..., 3) [kg m^2/s] of body rates (..., 3) [rad/s], wheels included."""
        momentum = self.carrier.momentum(omega)
        wheels = self.wheel_momentum(t)
        return momentum if wheels is None else jnp.add(*_aligned(momentum, wheels))

    def rates(self, momentum: Array, t: Array | float) -> Array:
        """Body rates (..., 3) [rad/s] of body momenta (..., 3) [kg m^2/s], the inverse."""
        wheels = self.wheel_momentum(t)
        if wheels is not None:
            momentum = jnp.subtract(*_aligned(momentum, wheels))
        return self.carrier.rates(momentum)

    @property
    def hamiltonian(self) -> Hamiltonian:
        """The one Hamiltonian of this scene."""
        wheels = self._wheels
        carried = None if wheels is None else wheels.body_momentum
        return Hamiltonian(inverse_inertia(self.carrier), self.inertia, self.potential, carried)


def _aligned(a: Array, b: Array) -> tuple[Array, Array]:
    shape = jnp.broadcast_shapes(a.shape, b.shape)
    return jnp.broadcast_to(a, shape), jnp.broadcast_to(b, shape)
