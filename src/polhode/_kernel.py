"""One compiled unit for a piece of a program."""

from collections.abc import Callable
from contextvars import ContextVar
from typing import Any

import jax
import jax.numpy as jnp
from jax import custom_derivatives
from jax.experimental.xla_metadata import set_xla_metadata
from jax.interpreters import partial_eval

_PLAIN = frozenset(
    """abs add add_any and atan atan2 bitcast_convert_type broadcast_in_dim ceil clamp concatenate
     convert_element_type copy cos cosh custom_jvp_call div dynamic_slice dynamic_update_slice eq exp
     exp2 expm1 floor ge gt integer_pow iota is_finite jit le log log1p logistic lt max min mul
     ne neg not or pad pjit pow reduce_sum rem reshape round rsqrt scan select_n
     shift_right_arithmetic sign sin sinh slice split sqrt square squeeze stack stop_gradient sub
     tan tanh transpose while xor""".split()  # noqa: SIM905
)
"""Operations that a single compiled unit may hold; anything else keeps the usual way."""


_ANALYSING = ContextVar("analysing", default=False)
"""Set while a unit is looked through: the units inside it then show what they are made of."""


def _is_plain(jaxpr) -> bool:
    for equation in jaxpr.eqns:
        if equation.primitive.name not in _PLAIN:
            return False
        for value in jax.tree.leaves(
            list(equation.params.values()), is_leaf=lambda v: hasattr(v, "eqns")
        ):
            nested = getattr(value, "jaxpr", value)
            if hasattr(nested, "eqns") and not _is_plain(nested):
                return False
    return True


def kernel(fn: Callable) -> Callable:
    """``fn`` compiled by XLA's CPU backend as one function instead of one task per array.

    A step is made of many short loops over the bodies. As separate tasks each costs a dispatch,
    and fusion across them repeats the work of one in the next. The mark keeps the call and asks
    for a single function; it is a hint that changes no value. It is given on the CPU only, to
    plain arithmetic only, and the call carries no operand that goes unused: XLA requires both.
    Derivatives are those of ``fn``, unmarked. ``fn`` must not close over traced values.
    """

    def call(*operands):
        if _ANALYSING.get() or jax.default_backend() != "cpu":
            return fn(*operands)
        leaves, tree = jax.tree.flatten(operands)

        @jax.custom_jvp
        def marked(*leaves):
            return _marked(lambda *given: fn(*jax.tree.unflatten(tree, given)), leaves)

        def derivative(leaves, tangents):
            # What has no tangent stays a constant: its derivative is not worked out at all.
            moving = [
                k for k, d in enumerate(tangents) if not isinstance(d, custom_derivatives.SymbolicZero)
            ]

            def of_moving(*given):
                whole = list(leaves)
                for k, x in zip(moving, given, strict=True):
                    whole[k] = x
                return fn(*jax.tree.unflatten(tree, whole))

            return jax.jvp(of_moving, *([x[k] for k in moving] for x in (leaves, tangents)))

        marked.defjvp(derivative, symbolic_zeros=True)
        return marked(*leaves)

    return call


def _marked(flat: Callable, leaves: tuple) -> Any:
    if not any(isinstance(leaf, jax.core.Tracer) for leaf in leaves):
        return flat(*leaves)  # run at once, the mark would reach every call inside as well
    analysing = _ANALYSING.set(True)
    try:
        closed = jax.make_jaxpr(flat)(*leaves)
    finally:
        _ANALYSING.reset(analysing)
    if not _is_plain(closed.jaxpr):
        return flat(*leaves)
    _, used = partial_eval.dce_jaxpr(closed.jaxpr, [True] * len(closed.jaxpr.outvars))

    def needed(*given):
        given = iter(given)
        full = (next(given) if u else jnp.zeros_like(x) for u, x in zip(used, leaves))
        with set_xla_metadata(xla_cpu_small_call=None, inlineable=None):  # the call's own only
            return flat(*full)

    with set_xla_metadata(xla_cpu_small_call="true", inlineable="false"):
        return jax.jit(needed)(*(x for u, x in zip(used, leaves) if u))
