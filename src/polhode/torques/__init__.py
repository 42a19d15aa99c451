"""Potentials, external torques, damping and rotors: one small class each."""

from polhode.torques._potentials import (
    AbstractPotential as AbstractPotential,
    GravityGradient as GravityGradient,
    Potential as Potential,
    PotentialSum as PotentialSum,
    UniformGravity as UniformGravity,
)
from polhode.torques._torques import (
    AbstractTorque as AbstractTorque,
    BodyTorque as BodyTorque,
    LinearDamping as LinearDamping,
    SpaceTorque as SpaceTorque,
    TorqueSum as TorqueSum,
)
