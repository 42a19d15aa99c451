"""Optimisations for XLA's CPU backend (fused kernels, partial evaluation) and derivative rules.

They change results by rounding at most. `README.md` in this folder describes each optimisation and
its gain; ``polhode._policy`` contains their thresholds and the switch that turns all of them off.
"""

from polhode._kernels._calls import Distinct as Distinct, jit_distinct as jit_distinct
from polhode._kernels._derivatives import (
    SMOOTH as SMOOTH,
    are_close as are_close,
    derivable_once as derivable_once,
    is_differentiated as is_differentiated,
    is_nonzero_tangent as is_nonzero_tangent,
    jvp_of_nonzero as jvp_of_nonzero,
    linear as linear,
    over_gap as over_gap,
    smooth as smooth,
    spread as spread,
    underivable as underivable,
    with_derivative_rule as with_derivative_rule,
    with_derivatives_of as with_derivatives_of,
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
    becomes_fusible as becomes_fusible,
    formula as formula,
    is_fusible as is_fusible,
    kernel as kernel,
    map_chunks as map_chunks,
    max_over_batch as max_over_batch,
    put as put,
)
from polhode._kernels._precision import in_double as in_double
from polhode._kernels._programs import (
    binder as binder,
    constants_as_operands as constants_as_operands,
    dependent_results as dependent_results,
    subjaxprs as subjaxprs,
    without_repeats as without_repeats,
)
