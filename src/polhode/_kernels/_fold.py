"""Partial evaluation of a traced function: terms that do not depend on the state are computed once.

A program made by automatic differentiation contains sums with zero, products with one and products
of parameters. They would be evaluated again in every call and, since XLA computes each output array
in a loop of its own, for every component. Here they are folded into few coefficients before the
integration loop, and values that several results share are staged. Results differ from those of the
original function by rounding, because products are reassociated.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import ShapedArray
from jax.extend.core import ClosedJaxpr, Literal, Primitive, jaxpr_as_fun
from jax.extend.mlir.dialects import stablehlo
from jax.interpreters import ad, batching, mlir, partial_eval
from jaxtyping import Array

from polhode import _policy
from polhode._kernels._programs import binder, fusible_binder, operation_key, update_form

# Staging: values that XLA computes once, and not again in every loop that uses them.


def opaque_ones(x: Array) -> Array:
    """Ones of the shape of x that XLA does not recognise as ones, but LLVM does.

    A truth value shifted right by one bit is zero, which XLA does not simplify. It therefore keeps
    divisions by these ones, and does not repeat them; LLVM, which runs later, removes the division.
    """
    if not _policy.is_staged():
        return jnp.ones_like(x)
    half = (jax.lax.stop_gradient(x) > 0).astype(jnp.int32) >> 1
    return 1 + half.astype(x.dtype)


def staged(values: Any, *ones: Array) -> Any:
    """The same values, each divided by the ``ones`` of its shape (see ``opaque_ones``).

    XLA repeats cheap arithmetic in every fused loop that needs its result, but never a division.
    Optimisation barriers do not prevent this, since XLA removes them on the CPU before it fuses
    loops. The ones must have every axis of the value, even for one body: XLA converts a division by
    a broadcast scalar to a multiplication. Conditions are staged as numbers; integers are returned
    unchanged.
    """

    if not _policy.is_staged():
        return values

    def divided(x):
        if x.dtype == bool:
            return divided(x.astype(ones[0].dtype)) > 0
        if not jnp.issubdtype(x.dtype, jnp.inexact):
            return x
        one = next((one for one in ones if one.shape == x.shape), ones[0])
        x, one = jnp.broadcast_arrays(x, one) if one.ndim >= x.ndim else (x, one)
        return _stage_p.bind(x, jnp.broadcast_to(one, x.shape))

    return jax.tree.map(divided, values)


# A division whose divisor has every axis of the value under ``jax.vmap`` as well. In a derivative
# in many directions only the tangent has the axis of the directions; JAX would broadcast the ones.
_stage_p = Primitive("stage")
_stage_p.def_impl(jax.lax.div)
_stage_p.def_abstract_eval(lambda x, _: ShapedArray(x.shape, x.dtype))


def _stage_jvp(primals, tangents):
    change = tangents[0]
    if type(change) is not ad.Zero:
        change = _stage_p.bind(change, primals[1])
    return _stage_p.bind(*primals), change


def _stage_transpose(cotangent, _, one):
    return (cotangent if type(cotangent) is ad.Zero else _stage_p.bind(cotangent, one)), None


def _stage_batch(arrays, dims):
    (x, one), size = arrays, next(a.shape[d] for a, d in zip(arrays, dims) if d is not None)
    x, one = (
        jnp.broadcast_to(a, (size, *a.shape)) if d is None else jnp.moveaxis(a, d, 0)
        for a, d in zip((x, one), dims)
    )
    if dims[1] is None:
        # ones that XLA does not recognise as ones, along the new axis
        axis = 1 + (jax.lax.broadcasted_iota(jnp.int32, one.shape, 0) >> 31).astype(one.dtype)
        one = one * axis
    return _stage_p.bind(x, one), 0


mlir.register_lowering(_stage_p, lambda _, x, one: [stablehlo.divide(x, one)])
ad.primitive_jvps[_stage_p] = _stage_jvp
ad.primitive_transposes[_stage_p] = _stage_transpose
batching.primitive_batchers[_stage_p] = _stage_batch


def computed_once(values: Any) -> Any:
    """The same values behind an optimisation barrier: XLA does not repeat the arithmetic before it.

    The barrier affects the passes before fusion only; ``staged`` affects fusion.
    """
    return jax.lax.optimization_barrier(values) if _policy.is_staged() else values


_FOLDS = {
    "add": np.add,
    "add_any": np.add,
    "sub": np.subtract,
    "mul": np.multiply,
    "div": np.divide,
    "neg": np.negative,
}
"""Operations that NumPy evaluates if all operands are numbers known while tracing."""

_ELEMENTWISE = frozenset(
    (*_FOLDS, *"integer_pow square sqrt rsqrt sin cos exp log abs sign max min copy".split())  # noqa: SIM905
)
_BY_ENTRY = _ELEMENTWISE | frozenset(
    """acos acosh and asin asinh atan atan2 atanh cbrt ceil convert_element_type cosh eq erf erfc
     exp2 expm1 floor ge gt is_finite le log1p logistic lt ne not or pow rem round select_n sinh
     stop_gradient tan tanh""".split()  # noqa: SIM905
)
"""Operations on arrays of one shape that act on each entry separately."""

_REARRANGEMENTS = frozenset(
    """broadcast_in_dim convert_element_type copy gather reshape slice split squeeze stop_gradient
    unstack""".split()  # noqa: SIM905
)
_CALLS = frozenset(("jit", "pjit", "closed_call"))


class _Constant(NamedTuple):
    """A value that does not depend on the state: an array, or a number broadcast to an array."""

    value: Any

    @property
    def number(self) -> Any:
        """The value if it is known while tracing, else None."""
        return self.value if isinstance(self.value, np.generic) else None

    @property
    def key(self):
        return id(self.value) if self.number is None else ("number", self.number)


class _LoopValue(NamedTuple):
    """A value that depends on the state: value number ``index`` of the loop times ``sign``, times
    ``scale`` if there is one.

    ``factors``: if the value is a product and the scale comes from one of its two factors, the
    numbers of the factor without a scale and of the one with it.
    """

    index: int
    aval: Any
    scale: _Constant | None = None
    sign: int = 1
    factors: tuple[int, int] | None = None


MIXED = (-1,)
"""In place of a shape, for a coefficient that an operation does not combine with the state entry by
entry, such as a matrix."""


class Specialised(NamedTuple):
    """A partially evaluated program.

    - ``coefficients``: arrays computed before the loop;
    - ``run(coefficients, *state_leaves)``: the results;
    - ``shapes``: for each coefficient, the shapes to which the loop broadcasts it, and ``MIXED`` if
      an operation mixes its entries. A coefficient with one shape only may be replaced by an array
      of that shape, with a value for each entry of the state;
    - ``by_entry``: whether every operation acts on each entry of the state separately, so that
      ``run`` accepts arrays of any length.
    """

    coefficients: tuple[Any, ...]
    run: Callable[..., list[Any]]
    shapes: tuple[frozenset[tuple[int, ...]], ...]
    by_entry: bool


class _LoopOperation(NamedTuple):
    """An operation of the loop. ``operands``: for each the number of a loop value or a
    ``_Constant``, its aval, and the shape to which it is broadcast."""

    outputs: list[int]
    bind: Any
    name: str
    operands: list[tuple[Any, Any, tuple[int, ...]]]

    @property
    def by_entry(self) -> bool:
        """Whether it acts on each entry separately."""
        return self.name in _BY_ENTRY


def specialise(
    closed_jaxpr: ClosedJaxpr, arguments: Sequence[Any], *, fold: bool = True, stage: bool = True
) -> Specialised:
    """Compute the part of ``closed_jaxpr`` that depends on its first ``arguments`` alone.

    The remaining inputs of the program are the state. Without ``fold`` the arguments are only
    sliced and reshaped, without arithmetic. Without ``stage`` no values are staged: for a program
    that is specialised again later.
    """
    if _policy.is_plain():
        shapes = tuple(frozenset([jnp.shape(x), MIXED]) for x in arguments)
        return Specialised(
            tuple(arguments),
            lambda coefficients, *state: jaxpr_as_fun(closed_jaxpr)(*coefficients, *state),
            shapes,
            False,
        )
    # ``instantiate=True`` keeps unused operands, because the arguments are identified by position
    jaxpr, _ = partial_eval.dce_jaxpr(
        closed_jaxpr.jaxpr, [True] * len(closed_jaxpr.out_avals), True
    )
    evaluator = _PartialEvaluator(fold and _policy.is_folded())
    arguments = [_Constant(x) for x in arguments]
    state_values = [evaluator.new_loop_value(v.aval) for v in jaxpr.invars[len(arguments) :]]
    results = evaluator.evaluate_jaxpr(jaxpr, closed_jaxpr.consts, [*arguments, *state_values])
    avals: list[Any] = [v.aval for v in jaxpr.outvars]
    outputs = [(evaluator.operand(x), aval, aval.shape) for x, aval in zip(results, avals)]
    operations = _operations_of_results(evaluator.operations, outputs)
    coefficients: dict[int, Any] = {}
    shapes_of: dict[int, set[tuple[int, ...]]] = {}
    for x, _, shape in (*(o for operation in operations for o in operation.operands), *outputs):
        if isinstance(x, _Constant) and x.number is None:
            coefficients[x.key] = x.value
            shapes_of.setdefault(x.key, set()).add(tuple(shape))
    for x, *_ in (
        o for operation in operations if not operation.by_entry for o in operation.operands
    ):
        if isinstance(x, _Constant) and x.number is None:
            shapes_of[x.key].add(MIXED)
    positions = {key: position for position, key in enumerate(coefficients)}
    # If every operation acts on each entry separately, and every array is a number or has the shape
    # of the state, the program traced for one shape can be run for any other.
    lane_shape = state_values[-1].aval.shape
    by_entry = all(operation.by_entry for operation in operations)
    for _, aval, _ in (*(o for operation in operations for o in operation.operands), *outputs):
        by_entry = by_entry and aval.shape == lane_shape
    by_entry = by_entry and all(np.shape(x) in ((), lane_shape) for x in coefficients.values())
    shared = _shared(operations, outputs) if stage and _policy.is_staged() else frozenset()

    def run(coefficients, *state):
        values = dict(enumerate(state))

        def read(operand):
            x, aval, _ = operand
            if not isinstance(x, _Constant):
                return values[x]
            value = coefficients[positions[x.key]] if x.number is None else x.number
            shape = jnp.shape(state[-1]) if by_entry else aval.shape
            shape = np.broadcast_shapes(np.shape(value), shape)
            return jnp.broadcast_to(jnp.asarray(value, aval.dtype), shape)

        for operation in operations:
            results = operation.bind(*(read(o) for o in operation.operands))
            for i, x in zip(
                operation.outputs, results if isinstance(results, list | tuple) else [results]
            ):
                values[i] = staged(x, opaque_ones(x)) if i in shared else x
        return [read(o) for o in outputs]

    return Specialised(
        tuple(coefficients.values()), run, tuple(map(frozenset, shapes_of.values())), by_entry
    )


def _operations_of_results(operations: list[_LoopOperation], outputs) -> tuple[_LoopOperation, ...]:
    """The operations on which the results depend, and those with side effects (prints, checks)."""
    values = {x for x, *_ in outputs if not isinstance(x, _Constant)}
    needed_operations = []
    for operation in reversed(operations):
        if not operation.outputs or values.intersection(operation.outputs):
            needed_operations.append(operation)
            values.update(x for x, *_ in operation.operands if not isinstance(x, _Constant))
    return tuple(reversed(needed_operations))


def _shared(operations: Sequence[_LoopOperation], outputs) -> frozenset[int]:
    """Values that several results depend on and that take enough operations to be staged."""
    # XLA fuses one loop for each result: a value is repeated for each result that depends on it,
    # not for each operation that uses it. A value is therefore staged only if it has several of
    # both. The work that staging saves is the number of operations between a value and the nearest
    # staged values before it (``repeated_operations``).
    producers = {i: k for k, operation in enumerate(operations) for i in operation.outputs}

    def loop_inputs(operands):
        return {i for i, *_ in operands if not isinstance(i, _Constant) and i in producers}

    # XLA computes each operand of a concatenation in a loop of its own: each is a result
    results = []
    for operand in outputs:
        producer = operations[producers[operand[0]]] if loop_inputs([operand]) else None
        if producer is not None and producer.name == "concatenate":
            results += producer.operands
        else:
            results.append(operand)
    use_counts = dict.fromkeys(producers, 0)
    dependent_results: dict[int, set[int]] = {i: set() for i in producers}
    for k, operand in enumerate(results):
        for i in loop_inputs([operand]):
            use_counts[i] += 1
            dependent_results[i].add(k)
    for operation in reversed(operations):
        for i in loop_inputs(operation.operands):
            use_counts[i] += len(operation.outputs)
            dependent_results[i].update(
                *(dependent_results[output] for output in operation.outputs)
            )
    shared: set[int] = set()
    # for each value the operations that a fused loop repeats to compute it
    repeated_operations: dict[int, set[int]] = {}
    for k, operation in enumerate(operations):
        work = {k}.union(
            *(repeated_operations[i] for i in loop_inputs(operation.operands) - shared)
        )
        for i in operation.outputs:
            repeated_operations[i] = work
            if (
                min(use_counts[i], len(dependent_results[i])) > 1
                and len(work) >= _policy.STAGE_WORK
            ):
                shared.add(i)
    return frozenset(shared)


def _shaped(operation: Any, avals) -> Any:
    """The key of an operation together with the shapes of its inputs.

    A broadcast number is stored as one number; the result of a sum or a concatenation depends on
    the shape to which it is broadcast."""
    return None if operation is None else (operation, *(aval.shape for aval in avals))


class _PartialEvaluator:
    """One pass over a jaxpr: evaluates operations that do not depend on the state, and records the
    others."""

    def __init__(self, fold: bool):
        self.fold = fold
        self.operations: list[_LoopOperation] = []
        self.count = 0
        self.scaled: dict[Any, int] = {}
        self.results: dict[Any, list[Any]] = {}  # results by operation and inputs
        self.referenced: list[Any] = []  # arrays whose ids are in the keys above

    def new_loop_value(self, aval) -> _LoopValue:
        self.count += 1
        return _LoopValue(self.count - 1, aval)

    def cached(self, key, inputs, outs, compute: Callable[[], list[Any]]) -> list[Any]:
        """The result of ``compute``, cached by operation and inputs (common subexpressions).

        ``key`` identifies the operation and the shapes of its inputs; it is None for an operation
        that cannot be hashed. Arrays that several parts of a scene share, such as an orbit, are
        thereby evaluated once.
        """
        if key is None:
            return compute()
        # Arrays are compared by identity, as their numbers may be traced. ``referenced`` keeps a
        # reference to each, because the id of a deleted object may be used again.
        names = (_key_of(x) if isinstance(x, _Constant) else x for x in inputs)
        key = key, *names, *((aval.shape, aval.dtype) for aval in outs)
        if key not in self.results:
            self.referenced += [x.value for x in inputs if isinstance(x, _Constant)]
            self.results[key] = compute()
        return self.results[key]

    def emit(self, bind, inputs, avals, outs, key, name="mul") -> list[_LoopValue]:
        shapes = [(outs[0] if name in _ELEMENTWISE else aval).shape for aval in avals]
        operands = [(self.operand(x), aval, s) for x, aval, s in zip(inputs, avals, shapes)]

        def append_operation():
            loop_values = [self.new_loop_value(aval) for aval in outs]
            self.operations.append(
                _LoopOperation([s.index for s in loop_values], bind, name, operands)
            )
            return loop_values

        return self.cached(_shaped(key, avals), [x for x, *_ in operands], outs, append_operation)

    def operand(self, x) -> Any:
        """A value as an operand: a ``_Constant``, or the number of a value of the loop."""
        if isinstance(x, _Constant):
            self.referenced.append(x.value)
            return x
        index = self.unsigned(x)
        if x.sign > 0:
            return index
        return self.emit(lax.neg, [_LoopValue(index, x.aval)], [x.aval], [x.aval], "neg")[0].index

    def unsigned(self, x: _LoopValue) -> int:
        """The number of a value with its scale, but without its sign."""
        # Scales and signs are multiplied out only when an operation needs the value itself. Until
        # then products of parameters are combined before the loop, and a sign changes a sum to a
        # difference at no cost.
        if x.scale is None:
            return x.index
        key = (x.index, x.scale.key)
        if key not in self.scaled:
            self.referenced.append(x.scale.value)
            a, b = _LoopValue(x.index, x.aval), x.scale
            if x.factors is not None:  # other products are likely to use the scaled factor as well
                a, scaled_factor = (_LoopValue(index, x.aval) for index in x.factors)
                b = _LoopValue(self.unsigned(scaled_factor._replace(scale=x.scale)), x.aval)
            self.scaled[key] = self.emit(lax.mul, [a, b], [x.aval] * 2, [x.aval], "mul")[0].index
        return self.scaled[key]

    def evaluate_jaxpr(self, jaxpr, consts, inputs) -> Sequence[_Constant | _LoopValue]:
        env: dict[Any, Any] = dict(zip(jaxpr.constvars, map(_Constant, consts)))
        env.update(zip(jaxpr.invars, inputs))

        def read(v):
            if not isinstance(v, Literal):
                return env[v]
            return _Constant(np.asarray(v.val, cast(ShapedArray, v.aval).dtype)[()])

        for eqn in jaxpr.eqns:
            operands = [read(v) for v in eqn.invars]
            env.update(zip(eqn.outvars, self.process_equation(eqn, operands)))
        return [read(v) for v in jaxpr.outvars]

    def process_equation(self, eqn, operands) -> Sequence[_Constant | _LoopValue]:
        name = eqn.primitive.name
        if name in _CALLS:
            inner = eqn.params.get("jaxpr", eqn.params.get("call_jaxpr"))
            return self.evaluate_jaxpr(inner.jaxpr, inner.consts, operands)
        # Operations with effects, such as checks, stay in the loop.
        if not eqn.effects and all(isinstance(x, _Constant) for x in operands):
            numbers = all(x.number is not None for x in operands)
            if self.fold or numbers or name in _REARRANGEMENTS:
                avals, outs = ([v.aval for v in vs] for vs in (eqn.invars, eqn.outvars))
                key = _shaped(operation_key(eqn), avals)
                return self.cached(
                    key, operands, outs, lambda: self.evaluate_equation(eqn, operands)
                )
        elif self.fold and len(eqn.outvars) == 1:
            simple = self.simplify(name, operands, eqn.outvars[0].aval)
            if simple is not None:
                return [simple]
        avals, outs = ([v.aval for v in vs] for vs in (eqn.invars, eqn.outvars))
        bind = fusible_binder(eqn)
        if name.startswith("scatter") and isinstance(operands[1], _Constant):
            update = update_form(eqn, jnp.broadcast_to(operands[1].value, avals[1].shape))
            if update is not None:
                bind, places = update
                operands = [operands[0], _Constant(places), operands[2]]
                avals[1] = ShapedArray(places.shape, places.dtype)
        return self.emit(bind, operands, avals, outs, operation_key(eqn), name)

    def evaluate_equation(self, eqn, operands) -> list[_Constant]:
        """The results of an equation that does not depend on the state, as numbers if possible."""
        name, out = eqn.primitive.name, eqn.outvars[0].aval
        # Only NumPy numbers can be compared with 0 and 1 while tracing, and thereby remove an
        # operation. A broadcast number is stored as one number, so that no array has to be read.
        single = all(np.ndim(x.value) == 0 for x in operands)
        if operands and single and name == "broadcast_in_dim":
            return operands
        if single and name in _FOLDS and all(x.number is not None for x in operands):
            return [_Constant(out.dtype.type(_FOLDS[name](*(x.number for x in operands))))]
        if single and name in _ELEMENTWISE and len(eqn.outvars) == 1:
            return [_Constant(binder(eqn)(*(jnp.asarray(x.value) for x in operands)))]
        operand_arrays = [
            jnp.broadcast_to(x.value, v.aval.shape) for x, v in zip(operands, eqn.invars)
        ]
        results = binder(eqn)(*operand_arrays)
        return [_Constant(x) for x in (results if isinstance(results, list | tuple) else [results])]

    def simplify(self, name, operands, aval) -> _Constant | _LoopValue | None:
        """An operation with a zero or a factor that does not depend on the state, simplified; None
        if it cannot be."""
        if not jnp.issubdtype(aval.dtype, jnp.floating):  # complex numbers have no sign
            return None
        if any(isinstance(x, _LoopValue) and x.aval.shape != aval.shape for x in operands):
            return None  # a scalar that depends on the state is broadcast to an array
        if name == "neg":
            return self.times(operands[0], _Constant(aval.dtype.type(-1)), aval)
        if name in ("add", "add_any", "sub"):
            a, b = operands
            if name == "sub":
                b = self.times(b, _Constant(aval.dtype.type(-1)), aval)
            return self.sum(a, b, aval)
        if name == "mul":
            a, b = operands
            if isinstance(a, _Constant):
                a, b = b, a
            return self.times(a, b, aval) if isinstance(b, _Constant) else self.product(a, b, aval)
        if name == "div" and isinstance(operands[1], _Constant) and operands[1].number is not None:
            # The reciprocal of a power of two is exact. With any other reciprocal the product has
            # one rounding error more than the quotient.
            mantissa, _ = np.frexp(operands[1].number)
            if abs(mantissa) == 0.5:
                return self.times(
                    operands[0], _Constant(aval.dtype.type(1 / operands[1].number)), aval
                )
        return None

    def sum(self, a, b, aval) -> _Constant | _LoopValue:
        """The sum of two values, of which at least one depends on the state."""
        if isinstance(a, _Constant):
            a, b = b, a
        if isinstance(b, _Constant):
            if b.number == 0:
                return a
            unsigned_slot = _LoopValue(self.unsigned(a), aval)
            if a.sign > 0:
                return self.emit(lax.add, [unsigned_slot, b], [aval] * 2, [aval], "add")[0]
            return self.emit(lax.sub, [b, unsigned_slot], [aval] * 2, [aval], "sub")[0]
        if a.index == b.index:  # p x + q x = (p + q) x, with the sum taken before the loop
            p, q = (_Constant(aval.dtype.type(1)) if x.scale is None else x.scale for x in (a, b))
            scale = self.combine("add" if a.sign == b.sign else "sub", p, q, aval)
            return self.times(_LoopValue(a.index, a.aval, None, a.sign), scale, aval)
        key = [None if x.scale is None else x.scale.key for x in (a, b)]
        if key[0] == key[1]:  # one multiplication for both
            scale, parts = a.scale, [_LoopValue(x.index, aval) for x in (a, b)]
        else:
            scale, parts = None, [_LoopValue(self.unsigned(x), aval) for x in (a, b)]
        name, bind = ("add", lax.add) if a.sign == b.sign else ("sub", lax.sub)
        (total,) = self.emit(bind, parts, [aval] * 2, [aval], name)
        return total._replace(scale=scale, sign=a.sign)

    def product(self, a: _LoopValue, b: _LoopValue, aval) -> _Constant | _LoopValue:
        """The product of two values that depend on the state; it takes over their scales."""
        # sorted, so that x y and y x are one product
        unscaled = [_LoopValue(index, aval) for index in sorted((a.index, b.index))]
        (result,) = self.emit(lax.mul, unscaled, [aval] * 2, [aval], "mul")
        product: Any = result._replace(sign=a.sign * b.sign)
        for x in (a, b):
            if x.scale is not None:
                product = self.times(product, x.scale, aval)
        if isinstance(product, _LoopValue) and (a.scale is None) != (b.scale is None):
            factors = (a.index, b.index) if a.scale is None else (b.index, a.index)
            product = product._replace(factors=factors)
        return product

    def combine(self, name: str, a: _Constant, b: _Constant, aval) -> _Constant:
        """Sum, difference or product of two values that do not depend on the state (cached)."""
        if a.number is not None and b.number is not None:
            return _Constant(aval.dtype.type(_FOLDS[name](a.number, b.number)))

        def compute():
            first, second = (jnp.asarray(x.value, aval.dtype) for x in (a, b))
            return [_Constant(getattr(jnp, _NUMPY_NAMES[name])(first, second))]

        return self.cached(("combined", name), [a, b], [aval], compute)[0]

    def times(self, x, factor: _Constant, aval) -> _Constant | _LoopValue:
        """``x`` times a factor that does not depend on the state, stored as a scale and a sign."""
        if isinstance(x, _Constant):
            return self.combine("mul", x, factor, aval)
        number = factor.number
        if number is not None:
            if number == 0:  # zero even if x is not finite: the term is absent
                return factor
            if number < 0:
                x, factor = x._replace(sign=-x.sign), _Constant(aval.dtype.type(-number))
            if abs(number) == 1:
                return x
        if x.scale is not None:
            factor = self.combine("mul", x.scale, factor, aval)
        return x._replace(scale=None if factor.number == 1 else factor)


_NUMPY_NAMES = {"add": "add", "sub": "subtract", "mul": "multiply"}


def _key_of(x: _Constant) -> Any:
    """The identity of an array, or the bits of a number: 0.0 and -0.0 are different keys."""
    return id(x.value) if x.number is None else (x.number.dtype, x.number.tobytes())
