"""Operations that XLA removes on devices other than the one that runs the tests."""

import jax
import jax.numpy as jnp

from polhode._closed_forms._free_constants import _rounded_constants
from polhode._kernels import subjaxprs


def _conversions(jaxpr):
    """First and last dtype of every value that is converted twice in succession."""
    found, again = {}, []
    for equation in jaxpr.eqns:
        for inner in subjaxprs(equation):
            again += _conversions(inner)
        if equation.primitive.name == "convert_element_type":
            (given,), (made,) = equation.invars, equation.outvars
            found[made] = given.aval.dtype
            again += [(found[given], made.aval.dtype)] if given in found else []
    return again


def test_rates_are_not_rounded_by_a_conversion_there_and_back():
    """On a GPU XLA removes such a pair, and with it the digits beyond single precision."""
    double = (jnp.ones(2, jnp.float64),) * 3
    made = jax.make_jaxpr(_rounded_constants)(double, double, (*double, double[0]))
    there_and_back = jax.make_jaxpr(lambda x: x - x.astype(jnp.float32).astype(jnp.float64))
    assert _conversions(there_and_back(double[0]).jaxpr) == [(jnp.float64, jnp.float64)]
    assert _conversions(made.jaxpr) == []
