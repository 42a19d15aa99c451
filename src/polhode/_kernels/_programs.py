"""Operations on traced programs (jaxprs)."""

from collections.abc import Callable, Iterator, Sequence
from functools import partial, reduce
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray
from jax.extend.core import ClosedJaxpr, Literal, Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array

from polhode import _policy


def subjaxprs(equation: Any) -> Iterator[Any]:
    """The jaxprs among the parameters of an equation, such as the bodies of loops."""
    values = jax.tree.leaves(list(equation.params.values()), is_leaf=lambda v: hasattr(v, "eqns"))
    for value in values:
        subjaxpr = getattr(value, "jaxpr", value)
        if hasattr(subjaxpr, "eqns"):
            yield subjaxpr


def nested_jaxprs(jaxpr: Any) -> Iterator[Any]:
    """A jaxpr and all jaxprs nested in it."""
    yield jaxpr
    for equation in jaxpr.eqns:
        for subjaxpr in subjaxprs(equation):
            yield from nested_jaxprs(subjaxpr)


def dependent_results(jaxpr: Any, is_input: Sequence[bool]) -> list[bool]:
    """Whether each result of a program depends on any of the arguments with a true flag."""
    dependent = {v for v, flag in zip(jaxpr.invars, is_input) if flag}
    for equation in jaxpr.eqns:
        if any(not isinstance(v, Literal) and v in dependent for v in equation.invars):
            dependent.update(equation.outvars)
    return [not isinstance(v, Literal) and v in dependent for v in jaxpr.outvars]


def constants_as_operands(
    closed_jaxpr: ClosedJaxpr, is_operand: Callable[[Any], bool] = lambda _: True
) -> tuple[ClosedJaxpr, list[Any]]:
    """The program with its closed-over values as first operands, and these operands.

    Values for which ``is_operand`` is false stay constants of the program."""
    jaxpr = closed_jaxpr.jaxpr
    constants = list(zip(jaxpr.constvars, closed_jaxpr.consts, strict=True))
    operands = [(v, x) for v, x in constants if is_operand(x)]
    others = [(v, x) for v, x in constants if not is_operand(x)]
    names = jaxpr.debug_info.arg_names
    names = None if names is None else ("",) * len(operands) + (*names,)
    program = jaxpr.replace(
        constvars=[v for v, _ in others],
        invars=[*(v for v, _ in operands), *jaxpr.invars],
        debug_info=jaxpr.debug_info._replace(arg_names=names),
    )
    return ClosedJaxpr(program, [x for _, x in others]), [x for _, x in operands]


def binder(equation: Any) -> Callable[..., Any]:
    """A function of the operands of an equation that evaluates it."""
    parameters = equation.primitive.get_bind_params(equation.params)
    # older versions of JAX return functions too
    funs, params = parameters if isinstance(parameters, tuple) else ((), parameters)
    return lambda *operands: equation.primitive.bind(*funs, *operands, **params)


def operation_key(equation: Any) -> Any:
    """A key that equal operations share, operands not included; None if the operation has effects
    or its parameters cannot be hashed."""
    key = (equation.primitive.name, *sorted(equation.params.items()))
    try:
        hash(key)
    except TypeError:
        return None
    return None if equation.effects else key


def without_repeats(closed_jaxpr: ClosedJaxpr) -> ClosedJaxpr:
    """The program, in which equal operations on the same operands occur once.

    A control law that several wheels evaluate is thereby one law, and its switches are one set.
    """
    if not _policy.is_folded():
        return closed_jaxpr
    jaxpr = closed_jaxpr.jaxpr
    first_results: dict[Any, Any] = {}  # variables by operation and operands
    replacements: dict[Any, Any] = {}
    equations = []

    def current(v):
        return v if isinstance(v, Literal) else replacements.get(v, v)

    def name(v):
        # bits, because 0.0 and -0.0 are equal
        return (v.aval, np.asarray(v.val).tobytes()) if isinstance(v, Literal) else v

    for equation in jaxpr.eqns:
        operands = [current(v) for v in equation.invars]
        operation, results = operation_key(equation), equation.outvars
        if operation is not None:
            # the types, because an unused result is no variable (JAX's ``DropVar``)
            kinds = tuple((type(v), v.aval) for v in results)
            first = first_results.setdefault((operation, kinds, *map(name, operands)), results)
            if first is not results:
                replacements.update(zip(results, first))
                continue
        equations.append(equation.replace(invars=operands))
    outvars = [current(v) for v in jaxpr.outvars]
    return ClosedJaxpr(jaxpr.replace(eqns=equations, outvars=outvars), closed_jaxpr.consts)


# Operations on arrays of few entries that a fused kernel, or the kernel of its derivative, cannot
# contain, written as sums and selections. A control law with a matrix product compiles in two
# thirds of the time, its value takes a quarter of the time and its gradient a twelfth.


def fusible_binder(equation: Any) -> Callable[..., Any]:
    """``binder``; products of small matrices, indexing and cumulative sums of few entries are
    evaluated by sums and selections."""
    form = _FORMS.get(equation.primitive.name)
    if form is None or not _counts(equation.outvars[0].aval.dtype):
        return binder(equation)
    return form(equation) or binder(equation)


def _counts(dtype: Any) -> bool:
    """Whether the dtype represents the number of every entry exactly: half precision does not."""
    return dtype in (np.float32, np.float64)


def _product(equation: Any) -> Callable[..., Any] | None:
    dtypes = {v.aval.dtype for v in (*equation.invars, *equation.outvars)}
    if len(dtypes) > 1:
        return None
    # Few multiplications are a sum for any number of bodies: a library call takes longer, and on
    # some accelerators rounds the factors in single precision.
    size = _multiplications([v.aval for v in equation.invars], equation.params)
    form = _sum if 0 < size * _policy.LANES < _policy.KERNEL_SUM else _product_p.bind
    return lambda a, b: form(a, b, **equation.params)


# A product of matrices. How it is evaluated depends on its size with all bodies, which is known
# when the program is lowered.
_product_p = Primitive("product")


def is_small_product(equation: Any) -> bool:
    """Whether an equation is a product of matrices that is evaluated as a sum."""
    avals = [v.aval for v in equation.invars]
    return equation.primitive is _product_p and _is_small(avals, equation.params)


def _multiplications(operands: Sequence[Any], params: dict[str, Any]) -> int:
    a, b = operands
    (contracted, _), (batch, _) = params["dimension_numbers"]
    common = int(np.prod([a.shape[i] for i in (*contracted, *batch)]))
    return a.size * (b.size // max(common, 1))


def _is_small(operands: Sequence[Any], params: dict[str, Any]) -> bool:
    return 0 < _multiplications(operands, params) <= _policy.KERNEL_PRODUCT


def _evaluated_product(a: Array, b: Array, **params: Any) -> Array:
    is_small = _is_small([a, b], params)
    return (_sum if is_small else jax.lax.dot_general_p.bind)(a, b, **params)


def _sum(a: Array, b: Array, **params: Any) -> Array:
    """The product as a sum, in parts as large as a kernel can contain."""
    (contract_a, contract_b), (batch_a, batch_b) = params["dimension_numbers"]
    free_a = [i for i in range(a.ndim) if i not in (*contract_a, *batch_a)]
    free_b = [i for i in range(b.ndim) if i not in (*contract_b, *batch_b)]
    # axes: those of the batch, of a, of b, and one for the contracted ones
    count = int(np.prod([a.shape[i] for i in contract_a]))
    a, b = (
        jnp.transpose(x, (*batch, *free, *contracted)).reshape(
            *(x.shape[i] for i in (*batch, *free)), count
        )
        for x, batch, free, contracted in (
            (a, batch_a, free_a, contract_a),
            (b, batch_b, free_b, contract_b),
        )
    )
    first = len(batch_a) + len(free_a)
    a = jnp.expand_dims(a, range(first, first + len(free_b)))
    b = jnp.expand_dims(b, range(len(batch_a), first))
    results = int(np.prod(jnp.broadcast_shapes(a.shape, b.shape)[:-1]))
    step = max((_policy.KERNEL_SUM - 1) // results, 1)
    blocks = [slice(k, k + step) for k in range(0, count, step)]
    return reduce(jnp.add, [jnp.sum(a[..., k] * b[..., k], axis=-1) for k in blocks])


def _with_products(fn: Callable[..., Array], *operands: Array) -> Array:
    """A rule of JAX for ``dot_general``, with the primitive here in place of it."""
    jaxpr = jax.make_jaxpr(fn)(*operands).jaxpr
    values: dict[Any, Any] = dict(zip(jaxpr.invars, operands, strict=True))
    for equation in jaxpr.eqns:
        is_product = equation.primitive is jax.lax.dot_general_p
        bind = (_product(equation) if is_product else None) or binder(equation)
        values[equation.outvars[0]] = bind(*(values[v] for v in equation.invars))
    return values[jaxpr.outvars[0]]


@_product_p.def_abstract_eval
def _shape_of_product(a, b, **params):
    result = jax.eval_shape(partial(jax.lax.dot_general_p.bind, **params), a, b)
    return ShapedArray(result.shape, result.dtype)


def _product_jvp(primals, tangents, **params):
    (a, b), (da, db) = primals, tangents
    changes = [_product_p.bind(da, b, **params)] if type(da) is not ad.Zero else []
    changes += [_product_p.bind(a, db, **params)] if type(db) is not ad.Zero else []
    return _product_p.bind(a, b, **params), reduce(ad.add_jaxvals, changes)


def _product_transpose(cotangent, a, b, **params):
    is_first = ad.is_undefined_primal(a)
    unknown, known = (a.aval, b) if is_first else (b.aval, a)

    def transpose(cotangent, known):
        def of_unknown(x):
            operands = (x, known) if is_first else (known, x)
            return jax.lax.dot_general_p.bind(*operands, **params)

        return jax.linear_transpose(of_unknown, unknown)(cotangent)[0]

    change = (
        cotangent if type(cotangent) is ad.Zero else _with_products(transpose, cotangent, known)
    )
    return (change, None) if is_first else (None, change)


def _product_batch(arrays, dims, **params):
    of_one = partial(jax.lax.dot_general_p.bind, **params)
    return _with_products(jax.vmap(of_one, dims), *arrays), 0


_product_p.def_impl(_evaluated_product)
ad.primitive_jvps[_product_p] = _product_jvp
ad.primitive_transposes[_product_p] = _product_transpose
batching.primitive_batchers[_product_p] = _product_batch
mlir.register_lowering(_product_p, mlir.lower_fun(_evaluated_product, multiple_results=False))


def _ids(shape, dtype, first: int = 0) -> np.ndarray:
    """The numbers of entries, as floats of the dtype of the entries."""
    return np.arange(first, first + np.prod(shape, dtype=int)).astype(dtype).reshape(shape)


def _entries(values: Array, places: Array, first: int = 0) -> Array:
    """The entries of ``values`` whose numbers, from ``first``, are ``places``; 0 elsewhere."""
    shape = (*places.shape, values.size)
    hits = places[..., None] == jnp.broadcast_to(_ids(values.size, places.dtype, first), shape)
    return jnp.sum(jnp.where(hits, jnp.broadcast_to(values.reshape(-1), shape), 0), axis=-1)


def _indexing(equation: Any) -> Callable[..., Any] | None:
    values, result = equation.invars[0].aval, equation.outvars[0].aval
    if values.size * result.size > _policy.KERNEL_INDEX:
        return None

    @jax.custom_jvp
    def indexed(values, *indices):
        return binder(equation)(values, *indices)

    @indexed.defjvp
    def _(operands, tangents):
        # selections in the derivative only: the cotangent of an index would be a scatter
        values, *indices = operands
        places = binder(equation)(jnp.asarray(_ids(values.shape, values.dtype)), *indices)
        return indexed(*operands), _entries(tangents[0], places)

    return indexed


def _cumulative_sum(equation: Any) -> Callable[..., Any] | None:
    axis, count = equation.params["axis"], equation.invars[0].aval.shape[equation.params["axis"]]
    if equation.invars[0].aval.size * count > _policy.KERNEL_INDEX:
        return None
    mask = np.tri(count, dtype=bool)
    mask = mask.T if equation.params["reverse"] else mask

    def cumulative_sum(x):
        x = jnp.moveaxis(x, axis, -1)
        shape = (*x.shape, count)
        rows = jnp.broadcast_to(x[..., None, :], shape)
        sums = jnp.sum(jnp.where(jnp.broadcast_to(mask, shape), rows, 0), axis=-1)
        return jnp.moveaxis(sums, -1, axis)

    return cumulative_sum


_FORMS = {
    "dot_general": _product,
    "gather": _indexing,
    "dynamic_slice": _indexing,
    "cumsum": _cumulative_sum,
}


def has_form(equation: Any) -> bool:
    """Whether ``fusible_binder`` or ``update_form`` applies, if indices of updates are constant."""
    form = _FORMS.get(equation.primitive.name)
    if form is None:
        return _is_small_update(equation)
    if form is _product and not _is_small([v.aval for v in equation.invars], equation.params):
        return False
    return _counts(equation.outvars[0].aval.dtype) and form(equation) is not None


def _is_small_update(equation: Any) -> bool:
    name = equation.primitive.name
    # ``x.at[i].apply(fn)`` is a scatter whose ``update_jaxpr`` is the function
    is_plain = name == "scatter-add" or (
        name == "scatter" and equation.params["update_jaxpr"] is None
    )
    if not is_plain:
        return False
    values, _, updates = (v.aval for v in equation.invars)
    return values.size * updates.size <= _policy.KERNEL_INDEX and _counts(values.dtype)


def update_form(equation: Any, indices: Array) -> tuple[Callable[..., Any], Array] | None:
    """An update of few entries at ``indices`` that do not depend on the state: a function of the
    array, a second array, which is computed here, and the new values. None for other equations."""
    if not _is_small_update(equation):
        return None
    values, _, updates = (v.aval for v in equation.invars)
    if equation.primitive.name == "scatter":
        ids = (_ids(x.shape, values.dtype, k) for x, k in ((values, 0), (updates, values.size)))
        old, new = map(jnp.asarray, ids)
        places = binder(equation)(old, indices, new)

        def replaced(values, places, updates):
            return jnp.where(places < values.size, values, _entries(updates, places, values.size))

        return replaced, places

    units = jnp.eye(updates.size, dtype=values.dtype).reshape(-1, *updates.shape)
    zero = jnp.zeros(values.shape, values.dtype)
    counts = jax.vmap(lambda unit: binder(equation)(zero, indices, unit), out_axes=-1)(units)

    def added(values, counts, updates):
        new = jnp.broadcast_to(updates.reshape(-1), counts.shape)
        return values + jnp.sum(jnp.where(counts != 0, counts * new, 0), axis=-1)

    return added, counts
