"""Exact laws as methods: nothing is stepped. The table of them stands in `_table.py`."""

from polhode._closed_forms._elementary import FixedAxis as FixedAxis, SymmetricTop as SymmetricTop
from polhode._closed_forms._free import ClosedForm as ClosedForm
from polhode._closed_forms._lagrange import LagrangeTop as LagrangeTop
from polhode._closed_forms._periods import periods as periods
from polhode._closed_forms._table import LAWS as LAWS, Law as Law, lawful as lawful
from polhode._closed_forms.free import Mode as Mode, Periods as Periods
