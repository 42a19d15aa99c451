"""Derivative rules that JAX does not provide.

Two primitives: ``linear``, a linear map with a separate program for its transpose, as in
``spread``; and ``with_derivative_rule``, which attaches a derivative rule to values computed
elsewhere. Also values whose derivatives are not known, so that derivatives are NaN or raise an
error, and functions that are smooth although they contain comparisons.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray
from jax.experimental.xla_metadata import set_xla_metadata
from jax.extend.core import ClosedJaxpr, Primitive, jaxpr_as_fun
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array

from polhode import _policy

Map = Callable[[Sequence[Any], Sequence[Any]], Sequence[Any]]


def linear(
    forward: Map,
    backward: Map | None,
    constants: Sequence[Any],
    operands: Sequence[Any],
    like: Sequence[Any],
    compiled: Callable[[Callable], Callable] | None = None,
    reverse_error: str = "",
) -> list[Any]:
    """``forward(constants, operands)``, linear in ``operands``; ``backward(constants, out)`` is its
    transpose.

    All arguments and results are lists of arrays. Neither function may close over traced values.
    Unlike ``jax.custom_vjp`` this permits forward mode, and unlike
    ``jax.custom_derivatives.linear_call`` it permits ``vmap`` and derivatives with respect to
    ``constants``.

    - ``like``: arrays with the shapes and dtypes of the result.
    - ``compiled``: a transformation such as ``kernel``, applied to either function when it is
      lowered, and not when it is differentiated.
    - ``reverse_error``: message of the NotImplementedError of reverse mode with respect to
      ``constants``, for functions with loops of unknown length, which JAX cannot transpose. The
      transpose of a map whose ``backward`` is None raises it as well.
    """
    shapes = tuple((tuple(x.shape), x.dtype) for x in like)
    return _linear_p.bind(
        *constants,
        *operands,
        forward=forward,
        backward=backward,
        count=len(constants),
        shapes=shapes,
        compiled=compiled,
        reverse_error=reverse_error,
    )


_linear_p = Primitive("linear_map")
_linear_p.multiple_results = True


@_linear_p.def_impl
def _compute(*arrays, forward, backward, count, shapes, compiled, reverse_error):
    return list(forward(arrays[:count], arrays[count:]))


def _lowered(*arrays, compiled, **params):
    # the attributes of a unit belong to its call, not to calls inside it
    with set_xla_metadata(xla_cpu_small_call=None, inlineable=None):
        compute = functools.partial(_compute, compiled=None, **params)
        return (compute if compiled is None else compiled(compute))(*arrays)


@_linear_p.def_abstract_eval
def _shapes(*_, forward, backward, count, shapes, compiled, reverse_error):
    return [ShapedArray(shape, dtype) for shape, dtype in shapes]


def _jvp(arrays, tangents, *, count, **params):
    # The map is linear in its operands and any function of the constants. Its tangent is the map of
    # the tangents plus the derivative by the constants, for which JAX differentiates ``forward``.
    out = _linear_p.bind(*arrays, count=count, **params)
    constants, operands = arrays[:count], arrays[count:]
    operand_tangents = tangents[count:]
    changes: list[Any] = []
    if not all(isinstance(x, ad.Zero) for x in operand_tangents):
        operand_tangents = [zeros(x) if isinstance(x, ad.Zero) else x for x in operand_tangents]
        changes = _linear_p.bind(*constants, *operand_tangents, count=count, **params)
    if any(is_nonzero_tangent(x) for x in tangents[:count]):
        constant_changes = _by_constants(constants, operands, tangents[:count], out, **params)
        changes = (
            [a + b for a, b in zip(changes, constant_changes)] if changes else constant_changes
        )
    return out, changes


def _by_constants(constants, operands, tangents, out, *, forward, reverse_error, **_):
    """Tangents of the map along the tangents of its constants."""
    if not reverse_error:
        return jvp_of_nonzero(lambda inputs: forward(inputs, operands), constants, tangents)
    at = [i for i, x in enumerate(tangents) if is_nonzero_tangent(x)]
    size = len(constants)

    def changes(arrays, constant_tangents):
        all_tangents = [ad.Zero(jax.typeof(x).to_tangent_aval()) for x in arrays[:size]]
        for i, x in zip(at, constant_tangents):
            all_tangents[i] = x
        return jvp_of_nonzero(
            lambda inputs: forward(inputs, arrays[size:]), arrays[:size], all_tangents
        )

    return linear(
        changes, None, [*constants, *operands], [tangents[i] for i in at], out, None, reverse_error
    )


def is_nonzero_tangent(x: Any) -> bool:
    """Whether a tangent is an array of floats: neither a symbolic zero nor that of an integer."""
    return not isinstance(x, ad.Zero) and x.dtype != jax.dtypes.float0


def zeros(x: Any) -> Any:
    """The zeros that a symbolic zero stands for."""
    return jnp.zeros(x.aval.shape, x.aval.dtype)


def _transpose(cotangents, *arrays, forward, backward, count, shapes, compiled, reverse_error):
    if backward is None:
        raise NotImplementedError(reverse_error)
    constants, operands = arrays[:count], arrays[count:]
    unknown = [ad.is_undefined_primal(x) for x in operands]
    avals = [x.aval if u else x for u, x in zip(unknown, operands)]
    cotangents = [zeros(x) if isinstance(x, ad.Zero) else x for x in cotangents]
    # the same primitive with both programs exchanged: its transpose is the map itself again
    operand_cotangents = linear(
        backward, forward, constants, cotangents, avals, compiled, reverse_error
    )
    return [None] * count + [x if u else None for u, x in zip(unknown, operand_cotangents)]


def _batch(arrays, dims, *, forward, backward, count, shapes, compiled, reverse_error):
    # All operands get the axis, batched or not, because the transpose has to return cotangents of
    # the same shapes. The constants have no cotangents here; only batched ones have the axis.
    size = next(x.shape[d] for x, d in zip(arrays, dims) if d is not None)
    constant_dims, operands = dims[:count], []
    for x, d in zip(arrays[count:], dims[count:]):
        batched_operand = (
            jnp.broadcast_to(x, (size, *x.shape)) if d is None else jnp.moveaxis(x, d, 0)
        )
        operands.append(batched_operand)

    def batched(fn):
        return lambda constants, operands: jax.vmap(
            lambda *leaves: list(fn(leaves[: len(constants)], leaves[len(constants) :])),
            in_axes=(*constant_dims, *[0] * len(operands)),
        )(*constants, *operands)

    out = _linear_p.bind(
        *arrays[:count],
        *operands,
        forward=batched(forward),
        backward=None if backward is None else batched(backward),
        count=count,
        shapes=tuple(((size, *shape), dtype) for shape, dtype in shapes),
        compiled=None,
        reverse_error=reverse_error,
    )
    return out, [0] * len(out)


ad.primitive_jvps[_linear_p] = _jvp
ad.primitive_transposes[_linear_p] = _transpose
batching.primitive_batchers[_linear_p] = _batch
mlir.register_lowering(_linear_p, mlir.lower_fun(_lowered, multiple_results=True))


def spread(values: Any, axis: int, count: int) -> Any:
    """Every array of a tree, repeated ``count`` times along a new axis.

    Unlike in ``jnp.broadcast_to``, cotangents are summed in a loop, which a unit can contain. XLA
    computes the sum of a large array by a library call, which a unit cannot contain.
    """
    leaves, tree = jax.tree.flatten(values)
    floats = {k: x for k, x in enumerate(leaves) if jnp.issubdtype(x.dtype, jnp.inexact)}

    def repeat(x):
        x = jnp.expand_dims(x, axis)
        return jnp.broadcast_to(
            x, [count if k == axis % x.ndim else n for k, n in enumerate(x.shape)]
        )

    def forward(_, arrays):
        return [repeat(x) for x in arrays]

    def backward(_, cotangents):
        def row(i):
            return [jax.lax.dynamic_index_in_dim(x, i, axis % x.ndim, False) for x in cotangents]

        def add(i, total):
            return [a + b for a, b in zip(total, row(i))]

        if count <= _policy.SUM_ROWS:
            return functools.reduce(lambda total, i: add(i, total), range(1, count), row(0))
        return jax.lax.fori_loop(1, count, add, row(0))

    if not _policy.is_fused():
        return jax.tree.map(repeat, values)
    like = jax.eval_shape(lambda: forward(None, floats.values()))
    repeated_floats = dict(zip(floats, linear(forward, backward, [], list(floats.values()), like)))
    results = [
        repeated_floats[k] if k in repeated_floats else repeat(x) for k, x in enumerate(leaves)
    ]
    return jax.tree.unflatten(tree, results)


Rule = Callable[[Sequence[Any], Sequence[Any], Sequence[Any]], Sequence[Any]]


def with_derivative_rule(
    rule: Rule,
    operands: Sequence[Any],
    values: Sequence[Any],
    recompute: Callable[[Sequence[Any]], tuple[Sequence[Any], Any]] | None = None,
) -> list[Any]:
    """``values``, a function of ``operands`` that was computed elsewhere, with a derivative rule.

    ``rule(operands, tangents, values)`` returns the tangents of the values, or of the first few
    values if the others have none. Tangents of operands may be symbolic zeros
    (``is_nonzero_tangent``). The rule may not close over traced values. It is given the values with
    this rule attached, so that it can be differentiated again. Loops replace a ``jax.custom_jvp``
    by the function itself before second derivatives are taken; this primitive is never replaced.

    ``recompute(operands)``: if given, a program that computes derivatives computes the values by
    this function instead. It also returns auxiliary data, the fourth argument of the rule.
    """
    return _attached_p.bind(*operands, *values, rule=rule, count=len(operands), recompute=recompute)


def jvp_of_nonzero(function: Callable, operands: Sequence[Any], tangents: Sequence[Any]) -> Any:
    """Tangents of ``function(operands)``; ``tangents`` may contain symbolic zeros."""
    at = [i for i, x in enumerate(tangents) if is_nonzero_tangent(x)]

    def of_active(*parameters):
        inputs = list(operands)
        for i, x in zip(at, parameters):
            inputs[i] = x
        return function(inputs)

    return jax.jvp(of_active, [operands[i] for i in at], [tangents[i] for i in at])[1]


def with_derivatives_of(
    function: Callable[..., Sequence[Array]], arguments: Any, values: Sequence[Array]
) -> list[Array]:
    """``values`` of ``function(*arguments)``, computed in another way, with the derivatives of
    ``function``, which is evaluated for derivatives only. It may close over traced values."""
    leaves, tree = jax.tree.flatten(arguments)
    closed = jax.make_jaxpr(lambda *x: list(function(*jax.tree.unflatten(tree, x))))(*leaves)
    size = len(closed.consts)

    def of_operands(inputs):
        return jaxpr_as_fun(ClosedJaxpr(closed.jaxpr, inputs[:size]))(*inputs[size:])

    def rule(operands, tangents, values):
        return jvp_of_nonzero(of_operands, operands, tangents)

    return with_derivative_rule(rule, [*map(jnp.asarray, closed.consts), *leaves], values)


_attached_p = Primitive("attached")
_attached_p.multiple_results = True


@_attached_p.def_impl
def _values(*arrays, rule, count, recompute):
    return list(arrays[count:])


@_attached_p.def_abstract_eval
def _shapes_of_values(*avals, rule, count, recompute):
    return list(avals[count:])


def _attached_jvp(arrays, tangents, *, rule, count, recompute):
    # The rule is given ``out``, the values with their derivative rule, so that differentiating the
    # rule gives second derivatives. Tangents of ``values`` are dropped: they are the derivatives of
    # the program that computed the values.
    operands, values, auxiliary_data = arrays[:count], arrays[count:], []
    has_tangent = any(is_nonzero_tangent(x) for x in tangents[:count])
    if has_tangent and recompute is not None:
        values, *auxiliary_data = recompute(jax.lax.stop_gradient(operands))
    out = _attached_p.bind(*operands, *values, rule=rule, count=count, recompute=recompute)
    changes = list(rule(operands, tangents[:count], out, *auxiliary_data)) if has_tangent else []
    return out, changes + [ad.Zero(jax.typeof(x).to_tangent_aval()) for x in out[len(changes) :]]


def _attached_batch(arrays, dims, *, rule, count, recompute):
    # Operands common to the batch, such as the weights of a network, are not broadcast; all values
    # get the axis.
    size = next(x.shape[d] for x, d in zip(arrays, dims) if d is not None)
    axes = [None if d is None else 0 for d in dims[:count]]
    operands = [x if d is None else jnp.moveaxis(x, d, 0) for x, d in zip(arrays, dims[:count])]
    values = [
        jnp.broadcast_to(x, (size, *x.shape)) if d is None else jnp.moveaxis(x, d, 0)
        for x, d in zip(arrays[count:], dims[count:])
    ]

    def batched(operands, tangents, values, *auxiliary_data):
        at = [i for i, x in enumerate(tangents) if is_nonzero_tangent(x)]

        def rule_of_one(operands, present_tangents, values, *auxiliary_data):
            all_tangents = [ad.Zero(jax.typeof(x).to_tangent_aval()) for x in operands]
            for i, x in zip(at, present_tangents):
                all_tangents[i] = x
            return [
                zeros(x) if isinstance(x, ad.Zero) else x
                for x in rule(operands, all_tangents, values, *auxiliary_data)
            ]

        in_axes = axes, [axes[i] for i in at], *[0] * (1 + len(auxiliary_data))
        return jax.vmap(rule_of_one, in_axes, axis_size=size)(
            list(operands), [tangents[i] for i in at], list(values), *auxiliary_data
        )

    def batched_recompute(operands):
        assert recompute is not None
        return jax.vmap(recompute, (axes,), axis_size=size)(list(operands))

    of_batch = None if recompute is None else batched_recompute
    out = _attached_p.bind(*operands, *values, rule=batched, count=count, recompute=of_batch)
    return out, [0] * len(out)


ad.primitive_jvps[_attached_p] = _attached_jvp
batching.primitive_batchers[_attached_p] = _attached_batch
mlir.register_lowering(_attached_p, mlir.lower_fun(_values, multiple_results=True))


def is_differentiated(arrays: Sequence[Any]) -> Array:
    """False; True in a program that computes a derivative along any of ``arrays``, in the
    computation of its value as well."""
    return _is_differentiated_p.bind(*arrays)


_is_differentiated_p = Primitive("is_differentiated")


@_is_differentiated_p.def_impl
def _not_differentiated(*arrays):
    return jnp.zeros((), bool)


@_is_differentiated_p.def_abstract_eval
def _shape_of_flag(*avals):
    return ShapedArray((), np.dtype(bool))


def _is_differentiated_jvp(arrays, tangents):
    flag = _is_differentiated_p.bind(*arrays)
    if any(is_nonzero_tangent(x) for x in tangents):
        flag = jnp.ones((), bool)
    return flag, ad.Zero(jax.typeof(flag).to_tangent_aval())


def _is_differentiated_batch(arrays, dims):
    return _is_differentiated_p.bind(*arrays), None  # not mapped


ad.primitive_jvps[_is_differentiated_p] = _is_differentiated_jvp
batching.primitive_batchers[_is_differentiated_p] = _is_differentiated_batch
mlir.register_lowering(
    _is_differentiated_p, mlir.lower_fun(_not_differentiated, multiple_results=False)
)


# Values whose derivatives are not known: the derivatives are NaN rather than wrong numbers.


@jax.custom_jvp
def underivable(x: Array, where: Array) -> Array:
    """``x``, whose derivatives are NaN where the mask ``where`` (of the shape of x) is true.

    Tangents and cotangents that are zero stay zero, so that derivatives in other directions are not
    affected.
    """
    del where
    return x


@underivable.defjvp
def _underivable_rule(primals, tangents):
    x, where = primals
    return underivable(x, where), linear(_nan_tangents, _nan_tangents, [where], [tangents[0]], [x])[
        0
    ]


def _nan_tangents(constants: Any, tangents: Any) -> list[Array]:
    # Zero tangents stay zero: in a Jacobian by ``vmap``, and in batches, ``x`` does not change in
    # most of the directions.
    (where,), (tangent,) = constants, tangents
    return [jnp.where(where & (tangent != 0), np.nan, tangent)]


def without_derivatives(tree: Any, message: str) -> Any:
    """The same arrays, whose derivatives raise NotImplementedError with this ``message``."""

    @jax.custom_jvp
    def identity(x):
        return x

    @identity.defjvp
    def rule(primals, tangents):
        raise NotImplementedError(message)

    return jax.tree.map(lambda x: identity(x) if jnp.issubdtype(x.dtype, jnp.inexact) else x, tree)


def are_close(first: Array, second: Array) -> Array:
    """Where two numbers agree to half of their digits (relative difference of sqrt(eps))."""
    limit = jnp.finfo(first.dtype).eps ** 0.5
    return jnp.abs(first - second) <= limit * jnp.maximum(jnp.abs(first), jnp.abs(second))


def over_gap(entry: Array, first: Array, second: Array) -> Array:
    """``entry / (first - second)`` for an ``entry`` whose value is zero; all of one shape.

    The value is zero; only the derivative with respect to ``entry`` matters. It is NaN where the
    two numbers agree to half of their digits, because the difference has lost the other half.
    """
    is_close = are_close(first, second)
    return underivable(entry, is_close) / jnp.where(is_close, 1, first - second)


@jax.custom_jvp
def derivable_once(x: Array, where: Array) -> Array:
    """``x`` (..., n) with its first derivatives; second derivatives by any two entries of the last
    axis are NaN where the mask ``where`` is true."""
    del where
    return x


@derivable_once.defjvp
def _once_rule(primals, tangents):
    x, where = primals
    # The value is one, and its derivative by any entry of the axis is NaN. As a factor of the
    # tangents it makes their derivatives NaN.
    one = 1 + jnp.sum(underivable(x, where) - x, axis=-1, keepdims=True)
    return derivable_once(x, where), tangents[0] * one


# Functions that are smooth although they contain comparisons.


SMOOTH = "smooth_function"
"""Name of the calls of such functions, in which the search for switches finds none."""


def smooth(fn: Callable) -> Callable:
    """``fn``, whose comparisons choose between formulas of equal value and make no kink."""

    def smooth_function(*args):
        return fn(*args)

    return jax.jit(smooth_function)
