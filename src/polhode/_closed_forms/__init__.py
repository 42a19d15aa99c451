"""Closed-form solutions as methods; ``CLOSED_FORMS`` in `polhode/_plan.py` lists them."""

from polhode._closed_forms._elementary import FixedAxis as FixedAxis, SymmetricTop as SymmetricTop
from polhode._closed_forms._free import ClosedForm as ClosedForm, free_motion as free_motion
from polhode._closed_forms._free_periods import (
    Mode as Mode,
    Periods as Periods,
    periods as periods,
    principal_periods as principal_periods,
)
from polhode._closed_forms._lagrange_top import LagrangeTop as LagrangeTop
