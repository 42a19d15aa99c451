"""Names of the integrators, imported at first use: diffrax loads with the first of them."""

from ._automatic import Automatic as Automatic
from ._charts import (
    EulerChart as EulerChart,
    LiePoissonChart as LiePoissonChart,
    natural_rates as natural_rates,
)
from ._extrapolation import Accuracy as Accuracy, Extrapolation as Extrapolation
from ._flow_adjoint import FlowAdjoint as FlowAdjoint
from ._search import Search as Search
from ._stepped import (
    AbstractIntegration as AbstractIntegration,
    EulerAngles as EulerAngles,
    LiePoisson as LiePoisson,
)
from ._units import GroupUnits as GroupUnits
