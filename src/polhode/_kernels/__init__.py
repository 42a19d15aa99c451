"""What makes XLA's CPU backend fast: one compiled unit, coefficients folded beforehand.

Nothing here changes a result by more than rounding. `README.md` beside this file says what each
part buys, ``polhode._policy`` where it is used and how all of it is switched off.
"""

from polhode._kernels._distinct import Distinct as Distinct, jit_distinct as jit_distinct
from polhode._kernels._fold import Specialised as Specialised, specialise as specialise
from polhode._kernels._linear import (
    attached as attached,
    is_slope as is_slope,
    linear as linear,
    spread as spread,
    zeros as zeros,
)
from polhode._kernels._single_call import (
    any_of as any_of,
    formula as formula,
    is_holdable as is_holdable,
    kernel as kernel,
    put as put,
)
from polhode._kernels._smooth import SMOOTH as SMOOTH, smooth as smooth
from polhode._kernels._stage import (
    computed_once as computed_once,
    opaque_ones as opaque_ones,
    staged as staged,
)
from polhode._kernels._undefined import (
    are_close as are_close,
    derivable_once as derivable_once,
    over_gap as over_gap,
    underivable as underivable,
)
