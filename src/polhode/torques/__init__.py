"""Potentials, external torques, damping and rotors: one small class each."""

from polhode.torques._couplings import (
    AbstractCoupling as AbstractCoupling,
    CoulombFriction as CoulombFriction,
    Motor as Motor,
    ViscousCoupling as ViscousCoupling,
)
from polhode.torques._dissipation import EnergySink as EnergySink
from polhode.torques._frames import LVLH as LVLH, RelativeTorque as RelativeTorque
from polhode.torques._laws import (
    BDot as BDot,
    DipoleField as DipoleField,
    MagneticDipole as MagneticDipole,
    Pointing as Pointing,
    RateDamping as RateDamping,
)
from polhode.torques._orbit import (
    AbstractOrbit as AbstractOrbit,
    KeplerOrbit as KeplerOrbit,
    StateOrbit as StateOrbit,
    eccentric_anomaly as eccentric_anomaly,
)
from polhode.torques._potentials import (
    AbstractPotential as AbstractPotential,
    GravityGradient as GravityGradient,
    Potential as Potential,
    PotentialSum as PotentialSum,
    UniformGravity as UniformGravity,
)
from polhode.torques._pulses import Pulses as Pulses
from polhode.torques._rotor import Rotor as Rotor
from polhode.torques._rotors import (
    AbstractRotor as AbstractRotor,
    RotorSum as RotorSum,
    Wheels as Wheels,
)
from polhode.torques._torques import (
    AbstractTorque as AbstractTorque,
    BodyTorque as BodyTorque,
    FeedbackTorque as FeedbackTorque,
    LinearDamping as LinearDamping,
    QuadraticDamping as QuadraticDamping,
    SpaceTorque as SpaceTorque,
    TorqueSum as TorqueSum,
)
