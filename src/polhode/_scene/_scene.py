"""What is in the scene: the body's inertia and what acts on it."""

from collections.abc import Sequence
from functools import reduce
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from polhode._checks import is_concrete
from polhode._hamiltonian import Dynamics, Hamiltonian, inverse_inertia, lie_poisson_field
from polhode._parts import check_fields
from polhode._scene._potentials import AbstractPotential
from polhode._scene._rotors import AbstractRotor, Wheels
from polhode._scene._state import State
from polhode._scene._torques import AbstractTorque
from polhode.inertia import Inertia
from polhode.inertia._inertia import check_form


class Scene(eqx.Module):
    """A rigid body and what acts on it; absent parts are None and add nothing to the program.

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
        _check_kinds(self)
        if self.rotors is not None and is_concrete(self.inertia, self.rotors):
            self.rotors.check_within(self.inertia)

    @property
    def is_free(self) -> bool:
        """Whether there is no potential, torque or wheel (static)."""
        return self.potential is None and self.torque is None and self.rotors is None

    def settled(self, state: State, start: Array) -> "Scene":
        """The scene with the motion of its wheels fixed by the state at the time ``start``."""
        if self.rotors is None:
            return self
        wheels = self.rotors.settle(state.omega_body, start, state.wheel_speed)
        return Scene(self.inertia, self.potential, self.torque, wheels)

    @property
    def is_possible(self) -> Bool[Array, "*#b"]:
        """Whether (...) a body can have this inertia and these wheels, also while traced."""
        wheels = self.rotors
        if not isinstance(wheels, Wheels) or wheels.is_constant:
            return self.inertia.is_possible
        found = self.inertia.is_possible, self.carrier.is_possible, wheels.is_possible
        return reduce(jnp.logical_and, jnp.broadcast_arrays(*found))

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
        return momentum if wheels is None else jnp.add(*jnp.broadcast_arrays(momentum, wheels))

    def rates(self, momentum: Array, t: Array | float) -> Array:
        """Body rates (..., 3) [rad/s] of body momenta (..., 3) [kg m^2/s], the inverse."""
        wheels = self.wheel_momentum(t)
        if wheels is not None:
            momentum = jnp.subtract(*jnp.broadcast_arrays(momentum, wheels))
        return self.carrier.rates(momentum)

    def acceleration(self, wxyz: Array | None, omega: Array, t: Array | float) -> Array:
        """Derivative (..., 3) of the body rates [rad/s^2] by the equations of motion.

        ``wxyz`` (..., 4): attitude, None where nothing acts; ``omega`` (..., 3): body rates
        [rad/s]; ``t``: time [s]. Leading axes of all broadcast, those of the parts included. Of
        coupled wheels see ``with_spins``.
        """
        return self.changes(wxyz, omega, t)[0]

    def changes(
        self, wxyz: Array | None, omega: Array, t: Array | float
    ) -> tuple[Array, tuple[Array, ...]]:
        """The acceleration, and the torques (...) [N m] on the wheels that are coupled."""
        t = jnp.asarray(t, omega.dtype)
        if wxyz is None:
            wxyz = jnp.zeros((*omega.shape[:-1], 4), omega.dtype).at[..., 0].set(1)
        momentum = self.momentum(omega, t)
        state = (tuple(momentum[..., i] for i in range(3)), tuple(wxyz[..., i] for i in range(4)))
        dynamics = self.dynamics
        spins = dynamics.wheels.spins if dynamics.coupled else ()
        push, _, *moved = lie_poisson_field(t, (*state, spins) if spins else state, dynamics)
        rate = jnp.stack(jnp.broadcast_arrays(*push), axis=-1)
        turned = tuple(moved[0]) if spins else ()

        def carried(t, spins):
            return self.with_spins(spins).wheel_momentum(t)

        if self.rotors is not None:  # what the wheels take up does not turn the body
            _, taken = jax.jvp(carried, (t, spins), (jnp.ones_like(t), turned))
            rate = rate - jnp.broadcast_to(taken, rate.shape)
        return self.carrier.rates(rate), turned

    @property
    def dynamics(self) -> Dynamics:
        """The field of the equations of motion."""
        wheels = self._wheels
        loose = None if wheels is None or wheels.is_constant else wheels
        return Dynamics(self.hamiltonian, self.torque, wheels=loose)

    def with_spins(self, spins: Sequence[Array] = ()) -> "Scene":
        """The scene at a moment when its coupled wheels have these momenta [kg m^2/s]."""
        wheels = self._wheels
        if wheels is None or not spins:
            return self
        return Scene(self.inertia, self.potential, self.torque, wheels.at(spins))

    @property
    def hamiltonian(self) -> Hamiltonian:
        """The Hamiltonian of this scene."""
        wheels = self._wheels
        carried = None if wheels is None else wheels.body_momentum
        spinning = None if wheels is None or wheels.is_constant else wheels.energy
        inverse = inverse_inertia(self.carrier)
        return Hamiltonian(inverse, self.inertia, self.potential, carried, spinning)


def places_of(scene: Scene, free: Any) -> tuple[int, ...]:
    """Which leaves of the scene ``free`` points at, in its order: unlike a function, places tell a
    compiled program whether it is the one asked for. TypeError or ValueError with the cure.
    """
    if not callable(free):
        raise TypeError(
            "free must be a function of the scene that returns arrays of it, such as"
            f" lambda s: [s.torque.c], got {type(free).__name__}."
        )
    leaves, tree = jax.tree.flatten(scene)
    marks = [object() for _ in leaves]
    wanted = "free must point at arrays that the scene holds, such as s.torque.c"
    try:
        places = tuple(marks.index(x) for x in jax.tree.leaves(free(tree.unflatten(marks))))
    except (AttributeError, TypeError, ValueError, IndexError) as error:
        raise TypeError(f"{wanted}, neither a part of one nor made from it: {error}.") from error
    if not places or not all(
        jnp.issubdtype(jnp.result_type(leaves[i]), jnp.floating) for i in places
    ):
        raise TypeError(f"{wanted}: one or more of real numbers.")
    if len(set(places)) < len(places):
        raise ValueError("free points at the same array twice.")
    return places


_KINDS = {
    "inertia": (Inertia, "ph.Inertia, for example ph.Inertia.from_moments([1., 2., 3.])"),
    "potential": (AbstractPotential, "a potential (ph.UniformGravity, ...) or None"),
    "torque": (AbstractTorque, "a torque (ph.BodyTorque, ...) or None"),
    "rotors": (AbstractRotor, "rotors (ph.Rotor, a sum of them) or None"),
}


def _check_kinds(scene: Scene) -> None:
    for name, (kind, expected) in _KINDS.items():
        value = getattr(scene, name)
        if not (isinstance(value, kind) or (value is None and name != "inertia")):
            raise TypeError(f"Scene {name} must be {expected}, got {type(value).__name__}.")
    check_form(scene.inertia)


def check_scene(scene: Scene) -> None:
    """TypeError or ValueError, naming the field, for a scene that an edit has left in disorder."""
    _check_kinds(scene)
    for name in _KINDS:
        part = getattr(scene, name)
        if part is not None:
            check_fields(part, f"scene.{name}")
