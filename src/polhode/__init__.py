"""polhode: rotating rigid bodies in JAX (simulate, differentiate, identify)."""

from polhode import rotation as rotation
from polhode._closed_form import ClosedForm as ClosedForm
from polhode._methods import (
    AbstractMethod as AbstractMethod,
    EulerAngles as EulerAngles,
    LiePoisson as LiePoisson,
    Record as Record,
)
from polhode._plan import Plan as Plan, choose as choose
from polhode._scene import Scene as Scene
from polhode._simulate import explain as explain, simulate as simulate
from polhode._state import State as State
from polhode._status import SimulationError as SimulationError, Status as Status
from polhode._trajectory import Trajectory as Trajectory
from polhode.hamiltonian import (
    hamiltonian as hamiltonian,
    hamiltons_equations as hamiltons_equations,
)
from polhode.inertia import Inertia as Inertia, MassProperties as MassProperties
from polhode.torques import (
    AbstractPotential as AbstractPotential,
    AbstractTorque as AbstractTorque,
    BodyTorque as BodyTorque,
    GravityGradient as GravityGradient,
    LinearDamping as LinearDamping,
    Potential as Potential,
    SpaceTorque as SpaceTorque,
    UniformGravity as UniformGravity,
)

__version__ = "0.1.0"
