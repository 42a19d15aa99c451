"""Ways to move the bodies of a scene. Options are objects: a method is handed over whole."""

from polhode.methods._base import (
    AbstractMethod as AbstractMethod,
    Record as Record,
    Samples as Samples,
)
from polhode.methods._charts import (
    EulerChart as EulerChart,
    LiePoissonChart as LiePoissonChart,
)
from polhode.methods._options import check_options as check_options, made as made
from polhode.methods._stepped import (
    EulerAngles as EulerAngles,
    LiePoisson as LiePoisson,
    Stepped as Stepped,
)
