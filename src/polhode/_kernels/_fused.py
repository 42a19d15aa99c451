"""Fused kernels: parts of a program that XLA's CPU backend compiles as one machine function each.

A fused kernel is called a *unit* in this package, after its primitive. ``README.md`` describes the
attributes of XLA that make one, and why every operand of a unit must be used.
"""

from collections.abc import Callable, Sequence
from contextvars import ContextVar
from functools import reduce
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray, Tracer
from jax.custom_batching import custom_vmap
from jax.custom_derivatives import SymbolicZero
from jax.experimental.xla_metadata import set_xla_metadata
from jax.extend.core import ClosedJaxpr, Primitive, jaxpr_as_fun
from jax.interpreters import ad, batching, mlir, partial_eval
from jax.sharding import AxisType

from polhode import _policy
from polhode._kernels._derivatives import is_nonzero_tangent, linear
from polhode._kernels._programs import (
    constants_as_operands,
    dependent_results,
    has_form,
    is_small_product,
    nested_jaxprs,
)

_FUSIBLE_OPERATIONS = frozenset(
    """abs acos acosh add add_any and asin asinh atan atan2 atanh attached bitcast_convert_type
     broadcast_in_dim cbrt ceil clamp concatenate cond convert_element_type copy cos cosh
     custom_jvp_call custom_vmap_call div dynamic_slice dynamic_update_slice eq erf erf_inv erfc
     exp exp2 expm1 floor gather ge gt in_double integer_pow iota is_finite jit le linear_map log
     log1p logistic lt max min mul ne neg not optimization_barrier or pad pjit pow reduce_and
     reduce_max reduce_min reduce_or reduce_prod reduce_sum rem reshape rev round rsqrt scan
     select_n shift_right_arithmetic sign sin sinh slice split sqrt square squeeze stack stage
     stop_gradient sub tan tanh transpose unit unstack while xor""".split()  # noqa: SIM905
)
"""Operations that a unit can contain; functions with others are compiled as usual."""

_ANALYSING: ContextVar[list[Callable] | None] = ContextVar("analysing", default=None)
"""While a function is traced for analysis, with its units inlined: the units found; else None."""


def kernel(
    fn: Callable, *, linearised: bool = False, repeated: bool = False, of_units: bool = False
) -> Callable:
    """``fn`` compiled by XLA's CPU backend as one function (a unit) instead of one task per array.

    A step of an integration consists of many short loops over the bodies. If each is a task of its
    own, each takes the time of a dispatch, XLA repeats the arithmetic of one in the next, and the
    many functions take longer to compile than one. An attribute of the call requests a single
    function. It is a hint that does not change values, and is set on the CPU only and for plain
    arithmetic only.

    By default, derivatives are those of ``fn`` without a unit.

    - ``linearised``: the value and the coefficients of its derivative are one unit; only the linear
      map of the tangents is outside. For functions without loops of unknown length.
    - ``repeated``: tangents are one unit and cotangents another. Each evaluates the function again,
      so that only the operands are stored. Where the derivative has hundreds of coefficients, this
      is several times as fast, to compile as well. ``fn`` has to write its broadcasts over many
      bodies or times as ``spread``.
    - ``of_units``: units inside ``fn`` stay units within the outer one, in its derivatives and
      under ``vmap``.
    """

    linearised = linearised and (_policy.linearises_units() or not of_units)

    def call(*operands):
        outer = _ANALYSING.get()
        if outer is not None:
            outer.append(fn)
        if outer is not None or not _uses_kernels():
            return fn(*operands)
        leaves, tree = jax.tree.flatten(operands)
        if not any(isinstance(leaf, Tracer) for leaf in leaves):
            return fn(*operands)  # outside of jit, calls inside would inherit the attributes
        # Units inside are inlined, so that ``is_fusible`` sees their operations. With ``of_units``
        # they stay units, and remain so in a derivative, which is not one unit as a whole.
        inner: list[Callable] = []
        analysing = _ANALYSING.set(None if of_units else inner)
        try:
            closed_jaxpr, shape = jax.make_jaxpr(
                lambda *flat: fn(*jax.tree.unflatten(tree, flat)), return_shape=True
            )(*leaves)
        finally:
            _ANALYSING.reset(analysing)
        if not is_fusible(closed_jaxpr.jaxpr):
            if not inner:  # no units were inlined: the traced program is that of ``fn``
                return jax.tree.unflatten(
                    jax.tree.structure(shape), jaxpr_as_fun(closed_jaxpr)(*leaves)
                )
            return fn(*operands)
        program, constants = constants_as_operands(closed_jaxpr, _is_kernel_operand)
        results = _unit(jaxpr_as_fun(program), linearised, program, 0, repeated, of_units)(
            *constants, *leaves
        )
        return jax.tree.unflatten(jax.tree.structure(shape), results)

    return call


def formula(fn: Callable, *operands: Any) -> ClosedJaxpr:
    """The jaxpr of ``fn``, with the units inside it inlined."""
    analysing = _ANALYSING.set([])
    try:
        return jax.make_jaxpr(fn)(*operands)
    finally:
        _ANALYSING.reset(analysing)


@custom_vmap
def any_of(values: jax.Array) -> jax.Array:
    """Whether any entry is not zero, under ``vmap`` in the whole batch.

    As the condition of a ``while_loop`` it is one for the whole batch. With a condition for each
    body JAX would select between the old and the new carry of each body in every iteration.
    """
    return jnp.sum(jnp.where(values != 0, 1, 0)) > 0


@any_of.def_vmap
def _any_of_whole_batch(size, batched, values):
    del size, batched
    return any_of(values), False


@custom_vmap
def max_over_batch(count: jax.Array) -> jax.Array:
    """``count``, under ``vmap`` the largest one of the batch: a loop bound common to all bodies."""
    return count


@max_over_batch.def_vmap
def _max_over_whole_batch(size, batched, count):
    del size, batched
    return max_over_batch(jnp.max(count)), False


@jax.custom_jvp
def put(rows: jax.Array, places: jax.Array, values: jax.Array) -> jax.Array:
    """``rows`` (S, C) with ``values`` (n, C) written at the row indices ``places`` (n,).

    Of equal indices the last one counts. On the CPU the rows are written one after another, since a
    unit cannot contain a scatter. There is no reverse-mode derivative.
    """
    return _put_each(rows, places, values)


@put.defjvp
def _put_jvp(primals, tangents):
    """An explicit rule: the one that JAX derives from the batching rule confuses batch axes."""
    (rows, places, values), (rows_, _, values_) = primals, tangents
    return put(rows, places, values), put(rows_, places, values_)


@custom_vmap
def _put_each(rows, places, values):
    return _put(rows, places, values)


def _put(rows: jax.Array, places: jax.Array, values: jax.Array) -> jax.Array:
    if places.size == 0 or not _policy.is_fused():
        return rows.at[places].set(values)

    def write_row(i, rows):
        place = places[i].astype(i.dtype)
        return jax.lax.dynamic_update_slice(rows, values[i][None], (place, jnp.zeros_like(i)))

    return jax.lax.fori_loop(0, places.size, write_row, rows)


@_put_each.def_vmap
def _put_all(size, batched, *operands):
    """A batch as one array with all its rows."""
    rows, places, values = (
        x if b else jnp.broadcast_to(x, (size, *x.shape)) for x, b in zip(operands, batched)
    )
    places = places + rows.shape[1] * jnp.arange(size, dtype=places.dtype)[:, None]
    # not ``_put``: a second ``vmap`` would turn its updates of slices into a scatter
    flat = _put_each(_flat(rows), places.reshape(-1), _flat(values))
    return flat.reshape(rows.shape), True


def _flat(x: jax.Array) -> jax.Array:
    return x.reshape(-1, x.shape[-1])


def _is_kernel_operand(constant: Any) -> bool:
    """Whether a value over which a function closes becomes an operand of its unit: traced values,
    since they may be differentiated, and large arrays.

    Small arrays, such as the tables of a Runge-Kutta method, stay inside: as operands they would be
    carried through every loop."""
    return isinstance(constant, Tracer) or np.size(constant) > _policy.KERNEL_TABLE


def _uses_kernels() -> bool:
    """Whether units are used: on a CPU, unless XLA partitions arrays, which it cannot in a unit."""
    if not _policy.is_fused():
        return False
    # Within ``jax.shard_map`` each device runs a program of its own, which XLA does not partition.
    kinds = jax.sharding.get_abstract_mesh().axis_types
    by_hand = len(kinds) > 0 and all(kind is AxisType.Manual for kind in kinds)
    return by_hand or jax.device_count() == 1


def is_fusible(jaxpr: Any, batched: bool = False) -> bool:
    """Whether a unit can contain this program; ``batched``: it was made by ``vmap``."""
    return _consists_of(jaxpr, lambda x: is_small_product(x) or (batched and _updates_slice(x)))


def becomes_fusible(jaxpr: Any) -> bool:
    """Whether units are used, and one can contain what ``specialise`` makes of this program."""
    return _uses_kernels() and _consists_of(jaxpr, has_form)


def _consists_of(jaxpr: Any, others: Callable[[Any], bool]) -> bool:
    """Whether a program consists of operations that a unit can contain, and of ``others``."""
    return not _has_large_reduction(jaxpr) and all(
        all(x.primitive.name in _FUSIBLE_OPERATIONS or others(x) for x in program.eqns)
        and all(_is_numeric(v.aval.dtype) for v in (*program.invars, *program.constvars))
        for program in nested_jaxprs(jaxpr)
    )


def _updates_slice(equation: Any) -> bool:
    """Whether it is the scatter to which ``vmap`` converts an update of a slice at the same index
    for the whole batch. XLA converts it back, so that a unit can contain it."""
    return equation.primitive.name == "scatter" and equation.invars[1].aval.ndim == 1


def _has_large_reduction(jaxpr: Any) -> bool:
    """Whether a reduction has so many floats that XLA calls a library, which a unit cannot."""
    return any(
        equation.primitive.name.startswith("reduce_")
        and jnp.issubdtype(equation.invars[0].aval.dtype, jnp.inexact)
        and equation.invars[0].aval.size >= _policy.KERNEL_SUM
        for program in nested_jaxprs(jaxpr)
        for equation in program.eqns
    )


def _is_numeric(dtype) -> bool:
    """Whether arrays are numbers or truth values: neither random keys nor tangents of integers."""
    return isinstance(dtype, np.dtype) and dtype != jax.dtypes.float0


def _unit(
    flat: Callable,
    linearised: bool,
    traced: ClosedJaxpr | None = None,
    exempt_count: int = 0,
    repeated: bool = False,
    of_units: bool = False,
) -> Callable:
    """``flat``, a function of arrays with a list of results, as one differentiable unit.

    ``traced``: the jaxpr of ``flat`` if it exists already; ``exempt_count``: see ``_unit_call``;
    other arguments as in ``kernel``.
    """

    @jax.custom_jvp
    def unit(*leaves):
        closed_jaxpr = traced or jax.make_jaxpr(flat)(*leaves)
        if traced is None and not is_fusible(closed_jaxpr.jaxpr):
            return _with_common_batch_axes(jaxpr_as_fun(closed_jaxpr)(*leaves), leaves)
        return _unit_call(closed_jaxpr, leaves, exempt_count, of_units)

    def derivative(leaves, tangents):
        # Operands without a tangent are constants: derivatives by them are not computed.
        active_places = [k for k, d in enumerate(tangents) if not isinstance(d, SymbolicZero)]

        def of_active(operands, values):
            operands = dict(enumerate(operands)) | dict(zip(active_places, values, strict=True))
            return flat(*operands.values())

        if repeated:
            value = unit(*leaves)
            return value, _tangents_by_units(of_active, active_places, leaves, tangents, value)

        def without_units():
            arguments = [leaves[k] for k in active_places], [tangents[k] for k in active_places]
            values, value_tangents = jax.jvp(lambda *x: of_active(leaves, x), *arguments)
            return _with_common_batch_axes(values, leaves), value_tangents

        # For second derivatives, ``fn`` is differentiated twice: to differentiate the coefficients
        # of its linearisation takes twice as long to compile.
        is_higher_order = any(isinstance(x, ad.JVPTracer) for x in leaves)
        if is_higher_order or not linearised:
            return without_units()
        # ``jax.linearize`` within the unit, which returns values and coefficients. The linear map
        # is evaluated outside, where JAX can transpose it.
        shape = []

        def value_and_coefficients(*leaves):
            value, linear_map = jax.linearize(
                lambda *x: of_active(leaves, x), *(leaves[k] for k in active_places)
            )
            coefficients, tree = jax.tree.flatten(linear_map)
            shape[:] = [tree, len(value)]
            return [*value, *coefficients, jnp.zeros((), jnp.float32)]

        linearisation = jax.make_jaxpr(value_and_coefficients)(*leaves)
        if not is_fusible(linearisation.jaxpr):  # a custom rule may contain, for example, a sort
            return without_units()
        tree, count = shape
        coefficient_count = len(linearisation.out_avals) - 1 - count
        of_all = _unit(
            jaxpr_as_fun(linearisation), False, linearisation, coefficient_count, of_units=of_units
        )
        *results, zero = of_all(*leaves)
        # Not a unit: its transpose would have operands that are not used.
        linear_map = jax.tree.unflatten(tree, results[count:])
        return results[:count], linear_map(
            *(_selected_if_zero(zero, tangents[k]) for k in active_places)
        )

    unit.defjvp(derivative, symbolic_zeros=True)
    return unit


def _with_common_batch_axes(results: Sequence[jax.Array], leaves: Sequence[Any]) -> list[jax.Array]:
    """``results``, each with the batch axes of all ``leaves``.

    Under ``vmap`` all results of a unit are batched, even those that depend on no batched operand.
    JAX requires the same batch axes of the values that a custom derivative returns. Here every
    result is selected by a condition that reads all leaves."""
    first_entries = [x[(0,) * x.ndim] for x in map(jnp.asarray, leaves) if x.size]
    always_true = reduce(jnp.logical_or, (x == x for x in first_entries), True)
    return [jax.lax.select(jnp.broadcast_to(always_true, x.shape), x, x) for x in results]


def _tangents_by_units(
    of_active: Callable, active_places: Sequence[int], leaves, tangents, like
) -> list[Any]:
    """Tangents of ``of_active``: the linear map is one unit and its transpose another.

    Either is computed from the operands alone. This evaluates the function once more, and avoids
    storing and reading hundreds of coefficients. ``like``: arrays with the dtypes of the results.
    """
    count = len(leaves)
    floats = {k: x for k, x in enumerate(like) if jnp.issubdtype(x.dtype, jnp.inexact)}

    def tangents_of(leaves, active_tangents):
        primals = [leaves[k] for k in active_places]
        results = jax.jvp(lambda *x: of_active(leaves, x), primals, list(active_tangents))[1]
        return [results[k] for k in floats]

    def pushforward(*arrays):
        return tangents_of(arrays[:count], arrays[count:])

    def pullback(*arrays):
        leaves, cotangents = arrays[:count], list(arrays[count:])
        # ``jax.vjp`` would take 1.5 times as long to trace.
        transpose = jax.linear_transpose(
            lambda *d: tangents_of(leaves, d), *(leaves[k] for k in active_places)
        )
        return list(transpose(cotangents))

    def forward(constants, active_tangents):
        return _unit(pushforward, False, repeated=True)(*constants, *active_tangents)

    def backward(constants, cotangents):
        return _unit(pullback, False, repeated=True)(*constants, *cotangents)

    active_tangents = [tangents[k] for k in active_places]
    by_place = dict(
        zip(floats, linear(forward, backward, leaves, active_tangents, list(floats.values())))
    )
    float0_tangents = {
        k: np.zeros(x.shape, jax.dtypes.float0) for k, x in enumerate(like) if k not in floats
    }
    return [(by_place | float0_tangents)[k] for k in range(len(like))]


def _selected_if_zero(zero: jax.Array, tangent: jax.Array) -> jax.Array:
    """The tangent, selected on the condition that ``zero`` is 0, which is always true: it makes
    ``zero`` a used result of its unit."""
    if tangent.dtype == jax.dtypes.float0:
        return tangent
    always_true = jnp.broadcast_to(zero == 0, tangent.shape)
    return jax.lax.select(always_true, tangent, jnp.zeros_like(tangent))


def _unit_call(
    closed_jaxpr: ClosedJaxpr, arguments: Sequence[Any], exempt_count: int, of_units: bool
) -> list[jax.Array]:
    """The call of a unit, made such that every operand is used.

    XLA ends the process if an operand of such a call is unused, and it removes uses that it can
    simplify. An additional operand therefore contains two zeros whose values XLA cannot know. Every
    result is selected on the condition that the first zero is zero or that any operand has a first
    entry other than zero. The ``exempt_count`` results before the last one are exempt, since the
    selection would copy each of them in a loop of its own; they are used only together with the
    last result, which is selected.
    """
    jaxpr, is_used = partial_eval.dce_jaxpr(
        closed_jaxpr.jaxpr, [True] * len(closed_jaxpr.out_avals)
    )
    arrays = [jnp.asarray(x) for x, is_kept in zip(arguments, is_used, strict=True) if is_kept]
    operands = [x for x in arrays if x.size]
    if not operands:
        return jaxpr_as_fun(closed_jaxpr)(*arguments)
    empty_arrays = {k: (x.shape, x.dtype) for k, x in enumerate(arrays) if not x.size}
    # behind a barrier: XLA would move constants into the called function
    zeros, *operands = jax.lax.optimization_barrier([jnp.zeros(2, jnp.float32), *operands])

    def program(zeros, *operands):
        # the attributes belong to the call of the unit, not to calls inside it
        with set_xla_metadata(xla_cpu_small_call=None, inlineable=None):
            all_operands = list(operands)
            for k, (shape, dtype) in empty_arrays.items():
                all_operands.insert(k, jnp.zeros(shape, dtype))
            results = jaxpr_as_fun(ClosedJaxpr(jaxpr, closed_jaxpr.consts))(*all_operands)
            # the first entry of each operand is read, even if XLA folds all its uses in the program
            first_entries = (x[(0,) * x.ndim].astype(bool) for x in operands)
            always_true = reduce(jnp.logical_or, first_entries, zeros[0] == 0)
            # XLA does not repeat a division; without it, it evaluated the condition again for each
            # result, which made up a quarter of the program
            always_true = jnp.where(always_true, 1, 0) / (1 - zeros[1]) > 0
            conditional = {*range(len(results) - 1 - exempt_count), len(results) - 1}
            alternatives = {
                k: jnp.broadcast_to(zeros[1].astype(results[k].dtype), results[k].shape)
                for k in conditional
            }
            return [
                jax.lax.select(always_true, x, alternatives[k]) if k in conditional else x
                for k, x in enumerate(results)
            ]

    shapes = tuple((x.shape, x.dtype, x.weak_type) for x in closed_jaxpr.out_avals)
    return _unit_p.bind(zeros, *operands, program=program, shapes=shapes, of_units=of_units)


# A primitive hides the program of the unit from partial evaluation. Otherwise the derivative of a
# loop around the call would move constants out of the unit and pass them as operands, which might
# not be used.
_unit_p = Primitive("unit")
_unit_p.multiple_results = True


@_unit_p.def_impl
def _unit_at_once(*arrays, program, shapes, of_units):
    return list(program(*arrays))


@_unit_p.def_abstract_eval
def _unit_shapes(*_, program, shapes, of_units):
    return [ShapedArray(shape, dtype, weak_type) for shape, dtype, weak_type in shapes]


def _unit_lowered(*arrays, program, shapes, of_units):
    with set_xla_metadata(xla_cpu_small_call="true", inlineable="false"):
        return jax.jit(program)(*arrays)


def map_chunks(fn: Callable[[Any], Any], lanes: Any, n: int, size: int) -> Any:
    """``fn`` over chunks of at most ``size`` of the ``n`` lanes, one after the other.

    The memory is limited to that of one chunk, whose arrays stay in the cache. All chunks have the
    same size; the last one is padded with copies of the last lane, whose results are dropped.
    """
    if n <= size:
        return fn(lanes)
    count = -(-n // size)
    size = -(-n // count)

    def split(x):
        fill = jnp.broadcast_to(x[-1:], (count * size - n, *x.shape[1:]))
        return jnp.concatenate([x, fill]).reshape(count, size, *x.shape[1:])

    chunks = jax.lax.map(fn, jax.tree.map(split, lanes))
    # -1 would be ambiguous for arrays without elements
    return jax.tree.map(lambda x: x.reshape(count * size, *x.shape[2:])[:n], chunks)


def _unit_batch(arrays, dims, *, program, shapes, of_units):
    """Under ``vmap``: a unit for a small batch, a loop over such units for a larger one.

    Outside of a unit the same arithmetic takes a hundred times as long, because XLA repeats values
    that several results share."""
    if of_units:  # the units inside are batched, each by this rule
        out_axes = [0 if x else None for x in _batched_results(program, arrays, dims)]
        return jax.vmap(program, list(dims), out_axes)(*arrays), out_axes
    size = next(x.shape[d] for x, d in zip(arrays, dims) if d is not None)
    places = [k for k, d in enumerate(dims) if d is not None]

    def unit_of_one(lane):
        all_arrays = dict(enumerate(arrays)) | dict(zip(places, lane))
        return _unit_p.bind(*all_arrays.values(), program=program, shapes=shapes, of_units=False)

    def unit_of(lanes):
        all_arrays = list(arrays)
        for k, x in zip(places, lanes):
            all_arrays[k] = x
        count = lanes[0].shape[0]
        in_axes = [0 if k in places else None for k in range(len(arrays))]
        closed_jaxpr = jax.make_jaxpr(jax.vmap(program, in_axes))(*all_arrays)
        batch = jaxpr_as_fun(closed_jaxpr)
        if _has_large_reduction(closed_jaxpr.jaxpr):
            return batch(*all_arrays)
        # where bodies write slices at different indices, ``vmap`` makes a scatter of the writes
        if not is_fusible(closed_jaxpr.jaxpr, batched=True):
            return jax.lax.map(unit_of_one, lanes)

        def batched_program(*arrays):
            with set_xla_metadata(xla_cpu_small_call=None, inlineable=None):
                return batch(*arrays)

        of_batch = tuple(((count, *shape), *kind) for shape, *kind in shapes)
        return _unit_p.bind(*all_arrays, program=batched_program, shapes=of_batch, of_units=False)

    lanes = [jnp.moveaxis(arrays[k], dims[k], 0) for k in places]
    return map_chunks(unit_of, lanes, size, _policy.KERNEL_BATCH), [0] * len(shapes)


def _batched_results(
    program: Callable, arrays: Sequence[Any], dims: Sequence[int | None]
) -> list[bool]:
    """Which results of a program depend on arrays that have a batch axis.

    The others, such as times common to all bodies, get no batch axis: if each body had times of its
    own, each would take steps of its own in the adjoint integration."""
    lanes = [jnp.shape(x) if d is None else np.delete(x.shape, d) for x, d in zip(arrays, dims)]
    lanes = [jax.ShapeDtypeStruct(tuple(shape), x.dtype) for shape, x in zip(lanes, arrays)]
    jaxpr = jax.make_jaxpr(program)(*lanes).jaxpr
    return dependent_results(jaxpr, [d is not None for d in dims])


def _unit_jvp(arrays, tangents, *, program, **_):
    """The derivative of a unit is that of its program.

    The custom derivative of ``_unit`` comes first. This rule is used where that derivative has been
    traced already and JAX differentiates the result once more, as in a loop."""
    at = [k for k, x in enumerate(tangents) if is_nonzero_tangent(x)]

    def of_active(*values):
        return list(program(*(dict(enumerate(arrays)) | dict(zip(at, values))).values()))

    values, value_tangents = jax.jvp(of_active, [arrays[k] for k in at], [tangents[k] for k in at])
    zero = [ad.Zero(jax.typeof(x).to_tangent_aval()) for x in values]
    return values, [x if is_nonzero_tangent(x) else z for x, z in zip(value_tangents, zero)]


ad.primitive_jvps[_unit_p] = _unit_jvp
mlir.register_lowering(_unit_p, mlir.lower_fun(_unit_lowered, multiple_results=True))
batching.primitive_batchers[_unit_p] = _unit_batch
