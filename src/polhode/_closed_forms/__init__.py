"""Closed-form solutions as methods; `_table.py` lists the scenes for which each holds."""

from polhode._closed_forms._elementary import FixedAxis as FixedAxis, SymmetricTop as SymmetricTop
from polhode._closed_forms._free import ClosedForm as ClosedForm, free_motion as free_motion
from polhode._closed_forms._free_periods import (
    Mode as Mode,
    Periods as Periods,
    periods as periods,
    principal_periods as principal_periods,
)
from polhode._closed_forms._lagrange_top import LagrangeTop as LagrangeTop
from polhode._closed_forms._table import (
    CLOSED_FORMS as CLOSED_FORMS,
    Solution as Solution,
    choose_closed_form as choose_closed_form,
)
