"""What is in the scene: the body's inertia and what acts on it."""

import equinox as eqx

from polhode.hamiltonian import Hamiltonian, inverse_inertia
from polhode.inertia import Inertia
from polhode.torques import AbstractPotential, AbstractTorque


class Scene(eqx.Module):
    """A rigid body and what acts on it; absent parts are None and cost nothing.

    **Arguments:** ``inertia``: ``ph.Inertia``; ``potential``: ``ph.AbstractPotential`` or None;
    ``torque``: ``ph.AbstractTorque`` or None. Any leaf may carry leading batch axes; they
    broadcast together and with those of the state.

    Raises TypeError for a part of the wrong kind.
    """

    inertia: Inertia
    potential: AbstractPotential | None = None
    torque: AbstractTorque | None = None

    def __check_init__(self):
        kinds = (
            ("inertia", Inertia, "ph.Inertia, for example ph.Inertia.from_moments([1., 2., 3.])"),
            ("potential", AbstractPotential | None, "a potential (ph.UniformGravity, ...) or None"),
            ("torque", AbstractTorque | None, "a torque (ph.BodyTorque, ...) or None"),
        )
        for name, kind, wanted in kinds:
            value = getattr(self, name)
            if not isinstance(value, kind):
                raise TypeError(f"Scene {name} must be {wanted}, got {type(value).__name__}.")

    @property
    def is_free(self) -> bool:
        """Whether nothing acts on the body (static)."""
        return self.potential is None and self.torque is None

    @property
    def hamiltonian(self) -> Hamiltonian:
        """The one Hamiltonian of this scene."""
        return Hamiltonian(inverse_inertia(self.inertia), self.inertia, self.potential)
