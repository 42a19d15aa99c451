"""One compiled unit for a piece of a program."""

from collections.abc import Callable
from contextvars import ContextVar
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero
from jax.experimental.xla_metadata import set_xla_metadata
from jax.extend.core import Literal
from jax.interpreters import ad, partial_eval

_PLAIN = frozenset(
    """abs add add_any and atan atan2 bitcast_convert_type broadcast_in_dim ceil clamp
     concatenate cond convert_element_type copy cos cosh custom_jvp_call div dynamic_slice
     dynamic_update_slice eq exp exp2 expm1 floor ge gt integer_pow iota is_finite jit le log
     log1p logistic lt max min mul ne neg not or pad pjit pow reduce_sum rem reshape round
     rsqrt scan select_n shift_right_arithmetic sign sin sinh slice split sqrt square squeeze
     stack stop_gradient sub tan tanh transpose unstack while xor""".split()  # noqa: SIM905
)
"""Operations that a single compiled unit may hold; anything else keeps the usual way."""


_CALLS = {"jit": "jaxpr", "pjit": "jaxpr", "custom_jvp_call": "call_jaxpr"}
"""Calls of functions, and the parameter that holds what is called."""

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


def kernel(fn: Callable, *, linearised: bool = False) -> Callable:
    """``fn`` compiled by XLA's CPU backend as one function instead of one task per array.

    A step is made of many short loops over the bodies. As separate tasks each costs a dispatch,
    and fusion across them repeats the work of one in the next; and a function for each takes
    longer to compile than one for all. The mark keeps the call and asks for a single function; it
    is a hint that changes no value. It is given on the CPU only, to plain arithmetic only, and the
    call carries no operand that goes unused: XLA requires both. ``fn`` must not close over traced
    values.

    Derivatives are those of ``fn``, unmarked; with ``linearised`` the value and all coefficients of
    its derivative are a unit again, and only the linear map that is left is not. That suits
    functions without loops of unknown length.
    """

    def call(*operands):
        if _ANALYSING.get() or jax.default_backend() != "cpu":
            return fn(*operands)
        leaves, tree = jax.tree.flatten(operands)
        return _unit(lambda *given: fn(*jax.tree.unflatten(tree, given)), linearised)(*leaves)

    return call


def apart(fn: Callable, *operands, when: jax.Array) -> Any:
    """``fn(*operands)``, worked out once even where many results of a ``kernel`` need it.

    XLA's CPU backend would form it again for each of them, but not what a branch returns. ``when``
    is true, which XLA must not know; ``fn`` returns arrays as its first operand.
    """
    if jax.default_backend() != "cpu":
        return fn(*operands)
    return jax.lax.cond(when, fn, lambda first, *_: first, *operands)


def _unit(flat: Callable, linearised: bool) -> Callable:
    @jax.custom_jvp
    def marked(*leaves):
        return _marked(flat, leaves)

    def derivative(leaves, tangents):
        # What has no tangent stays a constant: its derivative is not worked out at all.
        moving = [k for k, d in enumerate(tangents) if not isinstance(d, SymbolicZero)]

        def of_moving(whole, given):
            whole = dict(enumerate(whole)) | dict(zip(moving, given, strict=True))
            return flat(*whole.values())

        # A derivative of the coefficients takes twice as long to compile as one of the formulas.
        again = any(isinstance(x, ad.JVPTracer) for x in leaves)
        if again or not linearised:
            given = [leaves[k] for k in moving], [tangents[k] for k in moving]
            return jax.jvp(lambda *x: of_moving(leaves, x), *given)
        shape = []

        def known(*leaves):
            value, linear = jax.linearize(
                lambda *x: of_moving(leaves, x), *(leaves[k] for k in moving)
            )
            kept, tree = jax.tree.flatten(linear)
            shape[:] = [tree]
            return value, kept

        value, kept = _unit(known, linearised=False)(*leaves)
        # Not marked: transposed, it would carry operands that go unused.
        linear = jax.tree.unflatten(shape[0], kept)
        return value, linear(*(tangents[k] for k in moving))

    marked.defjvp(derivative, symbolic_zeros=True)
    return marked


def _marked(flat: Callable, leaves: tuple) -> Any:
    if not any(isinstance(leaf, jax.core.Tracer) for leaf in leaves):
        return flat(*leaves)  # run at once, the mark would reach every call inside as well
    analysing = _ANALYSING.set(True)
    try:
        closed, shape = jax.make_jaxpr(flat, return_shape=True)(*leaves)
    finally:
        _ANALYSING.reset(analysing)
    tree = jax.tree.structure(shape)
    if not _is_plain(closed.jaxpr):
        return flat(*leaves)
    # An operand may go unused inside of what is called only.
    closed = jax.make_jaxpr(partial(_inlined, closed.jaxpr, closed.consts))(*leaves)
    jaxpr = closed.jaxpr
    # Results that are operands or numbers stay outside.
    worked_out = [
        not isinstance(x, Literal) and x not in (*jaxpr.invars, *jaxpr.constvars)
        for x in jaxpr.outvars
    ]
    jaxpr, used = partial_eval.dce_jaxpr(jaxpr, worked_out)

    def needed(*given):
        with set_xla_metadata(xla_cpu_small_call=None, inlineable=None):  # the call's own only
            return _inlined(jaxpr, closed.consts, *given)

    # XLA moves a constant into what is called, whose operand then goes unused: it must not see one.
    operands = jax.lax.optimization_barrier([x for u, x in zip(used, leaves) if u])
    with set_xla_metadata(xla_cpu_small_call="true", inlineable="false"):
        found = iter(jax.jit(needed)(*operands))
    known = dict(zip((*closed.jaxpr.constvars, *closed.jaxpr.invars), (*closed.consts, *leaves)))
    out = [
        next(found) if inside else jnp.asarray(x.val) if isinstance(x, Literal) else known[x]
        for x, inside in zip(closed.jaxpr.outvars, worked_out, strict=True)
    ]
    return jax.tree.unflatten(tree, out)


def _inlined(jaxpr, consts, *given) -> list:
    """The program run with no call left in it; rules of derivatives are lost.

    What is taken out of arrays put together is taken from the parts: XLA sees as much later, when
    a part that nothing takes has become an operand that goes unused.
    """
    values = dict(zip((*jaxpr.constvars, *jaxpr.invars), (*consts, *given), strict=True))
    joined: dict[int, tuple[Any, Any, list]] = {}  # by the identity of a value that is kept in it

    def read(x):
        return x.val if isinstance(x, Literal) else values[x]

    for equation in jaxpr.eqns:
        name, params = equation.primitive.name, equation.params
        operands = [read(x) for x in equation.invars]
        inner = params.get(_CALLS.get(name))
        if inner is not None:
            out = _inlined(inner.jaxpr, inner.consts, *operands)
        elif name == "slice" and id(operands[0]) in joined:
            _, join, parts = joined[id(operands[0])]
            out = [_taken(operands[0], join, parts, params)]
        else:
            if name == "scan":
                body = params["jaxpr"]
                body = jax.make_jaxpr(partial(_inlined, body.jaxpr, body.consts))(*body.in_avals)
                params = {**params, "jaxpr": body}
            bound = equation.primitive.get_bind_params(params)
            functions, params = bound if isinstance(bound, tuple) else ((), bound)
            out = equation.primitive.bind(*functions, *operands, **params)
            out = out if equation.primitive.multiple_results else [out]
        if name in ("stack", "concatenate"):
            joined[id(out[0])] = (out[0], equation, operands)
        values.update(zip(equation.outvars, out, strict=True))
    return [read(x) for x in jaxpr.outvars]


def _taken(whole: jax.Array, join: Any, parts: list, params: dict) -> jax.Array:
    """A slice of joined parts, from the one part that it lies in if there is one."""
    starts, limits = list(params["start_indices"]), list(params["limit_indices"])
    stacked = join.primitive.name == "stack"
    axis = join.params["axis" if stacked else "dimension"]
    start = 0
    for part in parts:
        size = 1 if stacked else part.shape[axis]
        if start <= starts[axis] and limits[axis] <= start + size:
            whole = jax.lax.expand_dims(part, [axis]) if stacked else part
            starts[axis], limits[axis] = starts[axis] - start, limits[axis] - start
            break
        start += size
    return jax.lax.slice(whole, starts, limits, params["strides"])
