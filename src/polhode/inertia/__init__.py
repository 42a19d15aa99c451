"""Inertia of rigid bodies: tensors, principal axes, mass properties (document 003)."""

from polhode.inertia._eigen import principal as principal
from polhode.inertia._inertia import Inertia as Inertia, Symmetry as Symmetry
