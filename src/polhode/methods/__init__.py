"""Ways to move the bodies of a scene. Options are objects: a method is handed over whole."""

from polhode.methods._base import (
    AbstractMethod as AbstractMethod,
    Record as Record,
    Samples as Samples,
)
from polhode.methods._charts import (
    EulerChart as EulerChart,
    LiePoissonChart as LiePoissonChart,
    natural_rates as natural_rates,
)
from polhode.methods._inputs import (
    check_inputs as check_inputs,
    check_kinds as check_kinds,
    check_method as check_method,
    check_rtol as check_rtol,
    check_times as check_times,
    judged as judged,
    raise_on_failure as raise_on_failure,
)
from polhode.methods._options import check_options as check_options, made as made
from polhode.methods._plan import (
    Plan as Plan,
    Ways as Ways,
    choose as choose,
    plan as plan,
    ways_of as ways_of,
)
from polhode.methods._status import SimulationError as SimulationError, Status as Status
from polhode.methods._stepped import (
    EulerAngles as EulerAngles,
    LiePoisson as LiePoisson,
    Stepped as Stepped,
)
