"""Double precision inside a program of single precision.

XLA supports double precision whether or not JAX's x64 mode is on. If a function were traced in that
mode inside a program without it, rules of JAX (``vmap``, lowering) would truncate its arrays to
single precision. Here it is one primitive, which is traced in x64 mode when it is lowered.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax.core import ShapedArray
from jax.experimental.xla_metadata import set_xla_metadata
from jax.extend.core import Primitive
from jax.interpreters import batching, mlir


def in_double(fn: Callable, *single: Any) -> Any:
    """``fn(*single)`` evaluated in float64, for trees of float32 arrays of one shape.

    ``fn`` is a module-level function (it is hashed), acts on each entry separately and returns
    float32 arrays, truth values or integers. There are no derivatives.
    """
    leaves, tree = jax.tree.flatten(jax.lax.stop_gradient(single))
    with jax.enable_x64(True):
        doubles = [jax.ShapeDtypeStruct(x.shape, jnp.float64) for x in leaves]
        result_tree = jax.tree.structure(jax.eval_shape(fn, *jax.tree.unflatten(tree, doubles)))
    return jax.tree.unflatten(result_tree, _double_p.bind(*leaves, fn=fn, tree=tree))


_double_p = Primitive("in_double")
_double_p.multiple_results = True


def _evaluated(*leaves, fn, tree):
    # the attributes of a unit belong to its call, not to calls inside it
    with jax.enable_x64(True), set_xla_metadata(xla_cpu_small_call=None, inlineable=None):
        doubles = [jax.lax.convert_element_type(x, jnp.float64) for x in leaves]
        return jax.tree.leaves(fn(*jax.tree.unflatten(tree, doubles)))


_double_p.def_impl(jax.jit(_evaluated, static_argnames=("fn", "tree")))


@_double_p.def_abstract_eval
def _shapes(*avals, fn, tree):
    shapes = jax.eval_shape(partial(_evaluated, fn=fn, tree=tree), *avals)
    return [ShapedArray(x.shape, x.dtype) for x in shapes]


def _batch(arrays, dims, *, fn, tree):
    size = next(x.shape[d] for x, d in zip(arrays, dims) if d is not None)
    arrays = [
        jnp.broadcast_to(x, (size, *x.shape)) if d is None else jnp.moveaxis(x, d, 0)
        for x, d in zip(arrays, dims)
    ]
    results = _double_p.bind(*arrays, fn=fn, tree=tree)
    return results, [0] * len(results)


batching.primitive_batchers[_double_p] = _batch
mlir.register_lowering(_double_p, mlir.lower_fun(_evaluated, multiple_results=True))
