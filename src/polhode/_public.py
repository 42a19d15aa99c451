"""The public names of polhode, imported together when the first of them is asked for."""

from polhode import _integrate, rotation as rotation
from polhode._closed_forms import (
    ClosedForm as ClosedForm,
    FixedAxis as FixedAxis,
    LagrangeTop as LagrangeTop,
    SymmetricTop as SymmetricTop,
    elliptic as elliptic,
    free as free,
    periods as periods,
)
from polhode._closed_forms.free import Mode as Mode, Periods as Periods
from polhode._events import Crossings as Crossings, Event as Event, crossings as crossings
from polhode._hamiltonian import (
    hamiltonian as hamiltonian,
    hamiltons_equations as hamiltons_equations,
)
from polhode._integrate import EulerAngles as EulerAngles, LiePoisson as LiePoisson
from polhode._method import (
    AbstractMethod as AbstractMethod,
    Record as Record,
    SimulationError as SimulationError,
    Status as Status,
)
from polhode._plan import Plan as Plan, choose as choose
from polhode._propagate import Propagation as Propagation, propagate as propagate
from polhode._scene import (
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
from polhode._simulate import explain as explain, simulate as simulate
from polhode._trajectory import Trajectory as Trajectory
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
from polhode.inertia import Inertia as Inertia, MassProperties as MassProperties

solvers = _integrate
