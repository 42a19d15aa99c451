"""Integrators made for rotating bodies, as solvers, controllers and adjoints of diffrax."""

from polhode.solvers._equal_steps import EqualSteps as EqualSteps, GivenTimes as GivenTimes
from polhode.solvers._extrapolation import (
    Accuracy as Accuracy,
    Extrapolation as Extrapolation,
)
from polhode.solvers._flow_adjoint import FlowAdjoint as FlowAdjoint
from polhode.solvers._splitting import Splitting as Splitting
from polhode.solvers._units import GroupUnits as GroupUnits
