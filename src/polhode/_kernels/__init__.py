"""Optimisations for XLA's CPU backend (fused kernels, partial evaluation) and derivative rules.

They change results by rounding at most. `README.md` in this folder describes each optimisation and
its gain; ``polhode._policy`` contains their thresholds and the switch that turns all of them off.
"""

from polhode._kernels._calls import Distinct as Distinct, jit_distinct as jit_distinct
from polhode._kernels._derivatives import (
    SMOOTH as SMOOTH,
    along_slopes as along_slopes,
    are_close as are_close,
    attached as attached,
    attached_to as attached_to,
    derivable_once as derivable_once,
    is_differentiated as is_differentiated,
    is_slope as is_slope,
    linear as linear,
    over_gap as over_gap,
    smooth as smooth,
    spread as spread,
    underivable as underivable,
    without_derivatives as without_derivatives,
    zeros as zeros,
)
from polhode._kernels._fold import (
    Specialised as Specialised,
    computed_once as computed_once,
    opaque_ones as opaque_ones,
    specialise as specialise,
    staged as staged,
)
from polhode._kernels._fused import (
    any_of as any_of,
    formula as formula,
    is_holdable as is_holdable,
    kernel as kernel,
    map_chunks as map_chunks,
    most_of as most_of,
    put as put,
)
from polhode._kernels._precision import in_double as in_double
