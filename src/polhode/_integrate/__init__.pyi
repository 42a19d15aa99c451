"""Names of the integrators, imported at first use so that ``import polhode`` does not load
diffrax."""

from ._charts import (
    EulerChart as EulerChart,
    LiePoissonChart as LiePoissonChart,
    natural_rates as natural_rates,
)
from ._extrapolation import (
    Accuracy as Accuracy,
    Automatic as Automatic,
    Extrapolation as Extrapolation,
)
from ._field import GroupUnits as GroupUnits
from ._flow_adjoint import FlowAdjoint as FlowAdjoint
from ._loop import Search as Search
from ._methods import (
    CoarseSteps as CoarseSteps,
    EulerAngles as EulerAngles,
    LiePoisson as LiePoisson,
)
from ._stepped import AbstractIntegration as AbstractIntegration, may_jump as may_jump
