"""Inertia of rigid bodies: tensors, principal axes, mass properties (docs/equations.md, 003)."""

from polhode.inertia._inertia import (
    Inertia as Inertia,
    VariableInertia as VariableInertia,
    angular_acceleration as angular_acceleration,
    required_torque as required_torque,
)
from polhode.inertia._mass import MassProperties as MassProperties, compose as compose
from polhode.inertia._physical import (
    inertia_from_log_cholesky as inertia_from_log_cholesky,
    inertia_of_second_moments as inertia_of_second_moments,
    inertia_to_log_cholesky as inertia_to_log_cholesky,
    is_physical as is_physical,
    physical_margin as physical_margin,
    principal as principal,
    second_moments as second_moments,
)
from polhode.inertia._shapes import Symmetry as Symmetry
