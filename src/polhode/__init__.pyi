"""The public names of polhode: the lazy import, the reference and type checkers read this list.

Signatures and annotations stand at the definitions. The order and the headings are those of the
reference.
"""

# Simulation
from ._simulate import simulate as simulate, explain as explain
from ._scene import Scene as Scene, State as State
from ._trajectory import Trajectory as Trajectory
from ._method import Record as Record, Status as Status, SimulationError as SimulationError
from ._plan import Plan as Plan
from ._propagate import propagate as propagate, Propagation as Propagation

# Events
from ._events import Event as Event, crossings as crossings, Crossings as Crossings

# Bodies
from .inertia import Inertia as Inertia, MassProperties as MassProperties
from ._closed_forms import periods as periods, Periods as Periods, Mode as Mode

# Potentials and orbits
from ._scene import (
    UniformGravity as UniformGravity,
    GravityGradient as GravityGradient,
    Potential as Potential,
    AbstractPotential as AbstractPotential,
    KeplerOrbit as KeplerOrbit,
    StateOrbit as StateOrbit,
    AbstractOrbit as AbstractOrbit,
    LVLH as LVLH,
)

# Torques and control
from ._scene import (
    BodyTorque as BodyTorque,
    SpaceTorque as SpaceTorque,
    FeedbackTorque as FeedbackTorque,
    RelativeTorque as RelativeTorque,
    Pulses as Pulses,
    LinearDamping as LinearDamping,
    QuadraticDamping as QuadraticDamping,
    EnergySink as EnergySink,
    RateDamping as RateDamping,
    Pointing as Pointing,
    MagneticDipole as MagneticDipole,
    BDot as BDot,
    DipoleField as DipoleField,
    AbstractTorque as AbstractTorque,
)

# Wheels
from ._scene import (
    Rotor as Rotor,
    Motor as Motor,
    ViscousCoupling as ViscousCoupling,
    CoulombFriction as CoulombFriction,
    AbstractRotor as AbstractRotor,
    AbstractCoupling as AbstractCoupling,
)

# Methods
from ._closed_forms import (
    ClosedForm as ClosedForm,
    SymmetricTop as SymmetricTop,
    FixedAxis as FixedAxis,
    LagrangeTop as LagrangeTop,
)
from ._integrate import (
    LiePoisson as LiePoisson,
    EulerAngles as EulerAngles,
    Extrapolation as Extrapolation,
    Splitting as Splitting,
    FlowAdjoint as FlowAdjoint,
)
from ._method import AbstractMethod as AbstractMethod

# The Hamiltonian
from ._hamiltonian import (
    hamiltonian as hamiltonian,
    hamiltons_equations as hamiltons_equations,
    hamiltonian_matrices as hamiltonian_matrices,
    HamiltonianMatrices as HamiltonianMatrices,
)

# Frames and sensors
from .frames import (
    RotatingFrame as RotatingFrame,
    accelerometer as accelerometer,
    gyroscope as gyroscope,
)

# Fits
from .fit import (
    fit_inertia as fit_inertia,
    fit_recordings as fit_recordings,
    fit_scene as fit_scene,
)

# Namespaces
from . import (
    rotation as rotation,
    inertia as inertia,
    frames as frames,
    fit as fit,
    lightcurve as lightcurve,
    plot as plot,
    files as files,
    ensemble as ensemble,
)

__version__: str
