"""The public names of polhode, imported together when the first of them is asked for."""

from polhode import elliptic as elliptic, free as free, rotation as rotation, solvers as solvers
from polhode._propagate import Propagation as Propagation, propagate as propagate
from polhode._scene import Scene as Scene
from polhode._simulate import explain as explain, simulate as simulate
from polhode._state import State as State
from polhode.events import Crossings as Crossings, Event as Event, crossings as crossings
from polhode.fit import (
    fit_inertia as fit_inertia,
    fit_recordings as fit_recordings,
    fit_scene as fit_scene,
)
from polhode.frames import (
    RotatingFrame as RotatingFrame,
    accelerometer as accelerometer,
    gyroscope as gyroscope,
    simulate_particles as simulate_particles,
)
from polhode.free import Mode as Mode, Periods as Periods
from polhode.hamiltonian import (
    hamiltonian as hamiltonian,
    hamiltons_equations as hamiltons_equations,
)
from polhode.inertia import Inertia as Inertia, MassProperties as MassProperties
from polhode.methods import (
    AbstractMethod as AbstractMethod,
    EulerAngles as EulerAngles,
    LiePoisson as LiePoisson,
    Plan as Plan,
    Record as Record,
    SimulationError as SimulationError,
    Status as Status,
    choose as choose,
)
from polhode.methods.exact import (
    ClosedForm as ClosedForm,
    FixedAxis as FixedAxis,
    LagrangeTop as LagrangeTop,
    SymmetricTop as SymmetricTop,
    periods as periods,
)
from polhode.torques import (
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
    SpaceTorque as SpaceTorque,
    StateOrbit as StateOrbit,
    UniformGravity as UniformGravity,
    ViscousCoupling as ViscousCoupling,
)
from polhode.trajectory import Trajectory as Trajectory
