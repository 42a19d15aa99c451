"""Exact laws as methods: nothing is stepped. The table of them stands in `_table.py`."""

from polhode.methods.exact._elementary import FixedAxis as FixedAxis, SymmetricTop as SymmetricTop
from polhode.methods.exact._free import ClosedForm as ClosedForm
from polhode.methods.exact._lagrange import LagrangeTop as LagrangeTop
from polhode.methods.exact._periods import periods as periods
from polhode.methods.exact._table import LAWS as LAWS, Law as Law, lawful as lawful
