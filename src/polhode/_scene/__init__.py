"""Scenes and states, and what they are made of: potentials, torques, damping, rotors."""

from polhode._scene._couplings import (
    AbstractCoupling as AbstractCoupling,
    CoulombFriction as CoulombFriction,
    Motor as Motor,
    ViscousCoupling as ViscousCoupling,
)
from polhode._scene._dissipation import EnergySink as EnergySink
from polhode._scene._frames import LVLH as LVLH, RelativeTorque as RelativeTorque
from polhode._scene._laws import (
    BDot as BDot,
    DipoleField as DipoleField,
    MagneticDipole as MagneticDipole,
    Pointing as Pointing,
    RateDamping as RateDamping,
)
from polhode._scene._orbit import (
    AbstractOrbit as AbstractOrbit,
    HyperbolicOrbit as HyperbolicOrbit,
    KeplerOrbit as KeplerOrbit,
)
from polhode._scene._potentials import (
    AbstractPotential as AbstractPotential,
    AlongZ as AlongZ,
    GravityGradient as GravityGradient,
    Potential as Potential,
    PotentialSum as PotentialSum,
    UniformGravity as UniformGravity,
)
from polhode._scene._pulses import Pulses as Pulses
from polhode._scene._rotor import Rotor as Rotor
from polhode._scene._rotors import (
    AbstractRotor as AbstractRotor,
    RotorSum as RotorSum,
    Wheels as Wheels,
)
from polhode._scene._scene import Scene as Scene, check_scene as check_scene
from polhode._scene._specialise import (
    constructors as constructors,
    narrower as narrower,
    specialise as specialise,
)
from polhode._scene._state import State as State
from polhode._scene._torques import (
    AbstractTorque as AbstractTorque,
    BodyTorque as BodyTorque,
    FeedbackTorque as FeedbackTorque,
    LinearDamping as LinearDamping,
    QuadraticDamping as QuadraticDamping,
    SpaceTorque as SpaceTorque,
    TorqueSum as TorqueSum,
)
