"""The public names of polhode: the lazy import, the reference and type checkers read this list.

Signatures and annotations stand at the definitions. The order is that of the reference.
"""

# Simulation
# Namespaces
from . import (
    ensemble as ensemble,
    files as files,
    fit as fit,
    frames as frames,
    inertia as inertia,
    lightcurve as lightcurve,
    plot as plot,
    rotation as rotation,
)
from ._closed_forms import (
    ClosedForm as ClosedForm,
    FixedAxis as FixedAxis,
    LagrangeTop as LagrangeTop,
    Mode as Mode,
    Periods as Periods,
    SymmetricTop as SymmetricTop,
    periods as periods,
)
from ._events import Crossings as Crossings, Event as Event, crossings as crossings

# The Hamiltonian
from ._hamiltonian import (
    HamiltonianMatrices as HamiltonianMatrices,
    hamiltonian as hamiltonian,
    hamiltonian_matrices as hamiltonian_matrices,
    hamiltons_equations as hamiltons_equations,
)
from ._integrate import (
    EulerAngles as EulerAngles,
    Extrapolation as Extrapolation,
    FlowAdjoint as FlowAdjoint,
    LiePoisson as LiePoisson,
    Splitting as Splitting,
)

# Methods
from ._method import (
    AbstractMethod as AbstractMethod,
    Record as Record,
    SimulationError as SimulationError,
    Status as Status,
)
from ._plan import Plan as Plan
from ._propagate import Propagation as Propagation, propagate as propagate

# Potentials and orbits
# Torques and control
# Wheels
from ._scene import (
    LVLH as LVLH,
    AbstractCoupling as AbstractCoupling,
    AbstractOrbit as AbstractOrbit,
    AbstractPotential as AbstractPotential,
    AbstractRotor as AbstractRotor,
    AbstractTorque as AbstractTorque,
    BDot as BDot,
    BodyTorque as BodyTorque,
    CoulombFriction as CoulombFriction,
    DipoleField as DipoleField,
    EnergySink as EnergySink,
    FeedbackTorque as FeedbackTorque,
    GravityGradient as GravityGradient,
    KeplerOrbit as KeplerOrbit,
    LinearDamping as LinearDamping,
    MagneticDipole as MagneticDipole,
    Motor as Motor,
    Pointing as Pointing,
    Potential as Potential,
    Pulses as Pulses,
    QuadraticDamping as QuadraticDamping,
    RateDamping as RateDamping,
    RelativeTorque as RelativeTorque,
    Rotor as Rotor,
    Scene as Scene,
    SpaceTorque as SpaceTorque,
    State as State,
    StateOrbit as StateOrbit,
    UniformGravity as UniformGravity,
    ViscousCoupling as ViscousCoupling,
)
from ._simulate import explain as explain, simulate as simulate
from ._trajectory import Trajectory as Trajectory
from .fit import (
    fit_inertia as fit_inertia,
    fit_recordings as fit_recordings,
    fit_scene as fit_scene,
)

# Frames, sensors and fits
from .frames import (
    RotatingFrame as RotatingFrame,
    accelerometer as accelerometer,
    gyroscope as gyroscope,
)

# Bodies
from .inertia import Inertia as Inertia, MassProperties as MassProperties

__version__: str
