"""Integrators made for rotating bodies, as solvers, controllers and adjoints of diffrax."""

from polhode._integrate._charts import (
    EulerChart as EulerChart,
    LiePoissonChart as LiePoissonChart,
    natural_rates as natural_rates,
)
from polhode._integrate._equal_steps import EqualSteps as EqualSteps, GivenTimes as GivenTimes
from polhode._integrate._extrapolation import Accuracy as Accuracy, Extrapolation as Extrapolation
from polhode._integrate._flow_adjoint import FlowAdjoint as FlowAdjoint
from polhode._integrate._splitting import Splitting as Splitting
from polhode._integrate._stepped import (
    EulerAngles as EulerAngles,
    LiePoisson as LiePoisson,
    Stepped as Stepped,
)
from polhode._integrate._units import GroupUnits as GroupUnits
