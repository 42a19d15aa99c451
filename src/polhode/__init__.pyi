"""The public names of polhode: the lazy import, the reference and type checkers read this list.

Signatures and annotations stand at the definitions. The order and the headings are those of the
reference.
"""

# Simulation: a scene, an initial state and times give a trajectory.
from ._simulate import simulate as simulate, explain as explain
from ._scene import Scene as Scene, State as State, specialise as specialise
from ._trajectory import (
    Events as Events,
    Trajectory as Trajectory,
    successful_mean as successful_mean,
)
from ._method import (
    Record as Record,
    Status as Status,
    StepCounts as StepCounts,
    SimulationError as SimulationError,
)
from ._plan import Plan as Plan
from ._propagate import propagate as propagate, Propagation as Propagation

# Events: when a function of attitude, rates and time crosses zero.
from ._events import Event as Event, crossings as crossings, Crossings as Crossings

# Bodies: inertia, mass properties, and the periods of the free motion.
from .inertia import (
    Inertia as Inertia,
    MassProperties as MassProperties,
    VariableInertia as VariableInertia,
)
from ._closed_forms import periods as periods, Periods as Periods, Mode as Mode

# Potentials and orbits: conservative parts of a scene; potentials add with `+`.
from ._scene import (
    UniformGravity as UniformGravity,
    GravityGradient as GravityGradient,
    Potential as Potential,
    AbstractPotential as AbstractPotential,
    KeplerOrbit as KeplerOrbit,
    HyperbolicOrbit as HyperbolicOrbit,
    AbstractOrbit as AbstractOrbit,
    LVLH as LVLH,
)

# Torques and control: external torques, damping and control laws; they add with `+`.
from ._scene import (
    BodyTorque as BodyTorque,
    SpaceTorque as SpaceTorque,
    FeedbackTorque as FeedbackTorque,
    SampledTorque as SampledTorque,
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
    Plates as Plates,
    Drag as Drag,
    SolarPressure as SolarPressure,
    Eclipse as Eclipse,
    Table as Table,
    MomentumDumping as MomentumDumping,
    ControlMomentGyro as ControlMomentGyro,
    AbstractTorque as AbstractTorque,
)

# Wheels: reaction and momentum wheels, with motors and bearings; they add with `+`.
from ._scene import (
    Rotor as Rotor,
    wheel_cluster as wheel_cluster,
    Motor as Motor,
    ViscousCoupling as ViscousCoupling,
    CoulombFriction as CoulombFriction,
    AbstractRotor as AbstractRotor,
    AbstractCoupling as AbstractCoupling,
)

# Methods: chosen by the library unless one of them is passed to `simulate`.
from ._closed_forms import (
    ClosedForm as ClosedForm,
    SymmetricTop as SymmetricTop,
    FixedAxis as FixedAxis,
    LagrangeTop as LagrangeTop,
)
from ._integrate import (
    LiePoisson as LiePoisson,
    EulerAngles as EulerAngles,
    CoarseSteps as CoarseSteps,
    Extrapolation as Extrapolation,
    FlowAdjoint as FlowAdjoint,
)
from ._method import AbstractMethod as AbstractMethod

# The Hamiltonian: in ZYZ Euler angles, its equations of motion and their matrices.
from ._hamiltonian import (
    hamiltonian as hamiltonian,
    hamiltons_equations as hamiltons_equations,
    hamiltonian_matrices as hamiltonian_matrices,
    HamiltonianMatrices as HamiltonianMatrices,
)

# Frames and sensors: rotating frames and sensor models; more in `polhode.frames`.
from .frames import (
    RotatingFrame as RotatingFrame,
    accelerometer as accelerometer,
    gyroscope as gyroscope,
)

# Fits: inertia and other numbers from recordings; more in `polhode.fit`.
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
