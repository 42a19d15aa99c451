"""Names of the parts of scenes, imported at first use."""

from ._control import (
    BDot as BDot,
    ControlMomentGyro as ControlMomentGyro,
    DipoleField as DipoleField,
    MagneticDipole as MagneticDipole,
    MomentumDumping as MomentumDumping,
    Motor as Motor,
    Pointing as Pointing,
    RateDamping as RateDamping,
    wheel_cluster as wheel_cluster,
)
from ._orbits import (
    LVLH as LVLH,
    AbstractOrbit as AbstractOrbit,
    HyperbolicOrbit as HyperbolicOrbit,
    KeplerOrbit as KeplerOrbit,
    RelativeTorque as RelativeTorque,
)
from ._plates import (
    Drag as Drag,
    Eclipse as Eclipse,
    Plates as Plates,
    SolarPressure as SolarPressure,
)
from ._potentials import (
    AbstractPotential as AbstractPotential,
    AlongZ as AlongZ,
    GravityGradient as GravityGradient,
    Potential as Potential,
    PotentialSum as PotentialSum,
    UniformGravity as UniformGravity,
)
from ._scene import (
    Scene as Scene,
    State as State,
    check_scene as check_scene,
    constructors as constructors,
    narrower as narrower,
    specialise as specialise,
)
from ._tables import Table as Table
from ._torques import (
    AbstractTorque as AbstractTorque,
    BodyTorque as BodyTorque,
    EnergySink as EnergySink,
    FeedbackTorque as FeedbackTorque,
    LinearDamping as LinearDamping,
    Pulses as Pulses,
    QuadraticDamping as QuadraticDamping,
    SampledTorque as SampledTorque,
    SpaceTorque as SpaceTorque,
    TorqueSum as TorqueSum,
)
from ._wheels import (
    AbstractCoupling as AbstractCoupling,
    AbstractRotor as AbstractRotor,
    CoulombFriction as CoulombFriction,
    Rotor as Rotor,
    RotorSum as RotorSum,
    ViscousCoupling as ViscousCoupling,
    Wheels as Wheels,
)
