"""Exact laws as methods: nothing is stepped."""

from polhode.methods.exact._free import ClosedForm as ClosedForm
from polhode.methods.exact._periods import periods as periods
from polhode.methods.exact._tops import (
    AbstractTopMethod as AbstractTopMethod,
    FixedAxis as FixedAxis,
    LagrangeTop as LagrangeTop,
    SymmetricTop as SymmetricTop,
    exact_top as exact_top,
)
