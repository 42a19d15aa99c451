"""A traced function with everything done beforehand that does not depend on the state.

What automatic differentiation writes down holds sums with zero, products with one and products of
parameters, all of which would be worked out again in every evaluation and, as XLA gives every
output array its own loop, for every component. Here they are folded into few coefficients before
the loop. The result differs from the plain function by rounding (products are reassociated).
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend.core import ClosedJaxpr, Literal
from jax.interpreters import partial_eval

_FOLDS = {
    "add": np.add, "add_any": np.add, "sub": np.subtract, "mul": np.multiply,
    "div": np.divide, "neg": np.negative,
}  # fmt: skip
"""Operations on numbers that are known while tracing."""

_ELEMENTWISE = frozenset(
    (*_FOLDS, *"integer_pow square sqrt rsqrt sin cos exp log abs sign max min copy".split())  # noqa: SIM905
)
_CALLS = frozenset(("jit", "pjit", "closed_call"))


class _Held(NamedTuple):
    """A value known before the loop: an array, or one number that stands for a whole array."""

    value: Any

    @property
    def number(self):
        """The value if it is known while tracing, else None."""
        return self.value if isinstance(self.value, np.generic) else None


class _Slot(NamedTuple):
    """A value of the loop: that of number ``index``, times ``scale`` where there is one."""

    index: int
    aval: Any
    scale: _Held | None = None


class Specialised(NamedTuple):
    """``held``: arrays computed before the loop; ``run(held, *state_leaves)`` does the rest."""

    held: tuple[Any, ...]
    run: Callable[..., list[Any]]


def specialise(closed: ClosedJaxpr, known: Sequence[Any]) -> Specialised:
    """Takes the part of ``closed`` that needs only its first arguments, ``known``, out of it."""
    jaxpr, _ = partial_eval.dce_jaxpr(closed.jaxpr, [True] * len(closed.out_avals), True)
    work = _Work()
    known = [_Held(x) for x in known]
    free = [work.slot(v.aval) for v in jaxpr.invars[len(known) :]]
    found = work.walk(jaxpr, closed.consts, [*known, *free])
    out = [(work.operand(x), v.aval) for x, v in zip(found, jaxpr.outvars)]
    steps = tuple(work.steps)

    def run(held, *state):
        values = dict(enumerate(state))

        def read(operand, aval):
            kind, at = operand
            if kind == "slot":
                return values[at]
            value = held[at] if kind == "held" else at
            return jnp.broadcast_to(jnp.asarray(value, aval.dtype), aval.shape)

        for made, bind, operands in steps:
            found = bind(*(read(*o) for o in operands))
            values.update(zip(made, found if isinstance(found, list | tuple) else [found]))
        return [read(*o) for o in out]

    return Specialised(tuple(work.held), run)


class _Work:
    """Goes through a jaxpr once: computes what is known, notes down what is not."""

    def __init__(self):
        self.held: list[Any] = []
        self.steps: list[tuple[Any, Any, list[Any]]] = []
        self.count = 0
        self.scaled: dict[tuple[int, int], int] = {}
        self.products: dict[tuple[int, int], _Slot] = {}
        self.places: dict[int, int] = {}
        self.alive: list[Any] = []  # whose ids are keys above

    def slot(self, aval) -> _Slot:
        self.count += 1
        return _Slot(self.count - 1, aval)

    def emit(self, bind, inputs, avals, outs) -> list[_Slot]:
        made = [self.slot(aval) for aval in outs]
        operands = [(self.operand(x), aval) for x, aval in zip(inputs, avals)]
        self.steps.append(([s.index for s in made], bind, operands))
        return made

    def operand(self, x) -> tuple[str, Any]:
        """Where the loop finds a value: a slot, a place among what is held, or a number."""
        if isinstance(x, _Slot):
            return "slot", x.index if x.scale is None else self.multiplied(x)
        if x.number is not None:
            return "number", x.number
        if id(x.value) not in self.places:
            self.alive.append(x.value)
            self.places[id(x.value)] = len(self.held)
            self.held.append(x.value)
        return "held", self.places[id(x.value)]

    def multiplied(self, x: _Slot) -> int:
        key = (x.index, id(x.scale.value))
        if key not in self.scaled:
            self.alive.append(x.scale.value)
            plain = _Slot(x.index, x.aval)
            if x.scale.number == -1:
                (made,) = self.emit(lax.neg, [plain], [x.aval], [x.aval])
            else:
                (made,) = self.emit(lax.mul, [plain, x.scale], [x.aval] * 2, [x.aval])
            self.scaled[key] = made.index
        return self.scaled[key]

    def walk(self, jaxpr, consts, inputs) -> list[_Held | _Slot]:
        env = dict(zip(jaxpr.constvars, map(_Held, consts)))
        env.update(zip(jaxpr.invars, inputs))

        def read(v):
            return _Held(np.asarray(v.val, v.aval.dtype)[()]) if isinstance(v, Literal) else env[v]

        for eqn in jaxpr.eqns:
            given = [read(v) for v in eqn.invars]
            env.update(zip(eqn.outvars, self.equation(eqn, given)))
        return [read(v) for v in jaxpr.outvars]

    def equation(self, eqn, given) -> list[_Held | _Slot]:
        name = eqn.primitive.name
        if name in _CALLS:
            inner = eqn.params.get("jaxpr", eqn.params.get("call_jaxpr"))
            return self.walk(inner.jaxpr, inner.consts, given)
        if not eqn.effects and all(isinstance(x, _Held) for x in given):
            return self.known(eqn, given)
        if len(eqn.outvars) == 1:
            simple = self.simplified(name, given, eqn.outvars[0].aval)
            if simple is not None:
                return [simple]
        avals = [v.aval for v in eqn.invars]
        return self.emit(_binder(eqn), given, avals, [v.aval for v in eqn.outvars])

    def known(self, eqn, given) -> list[_Held]:
        """An equation before the loop; numbers stay numbers as long as they can."""
        name, out = eqn.primitive.name, eqn.outvars[0].aval
        single = all(np.ndim(x.value) == 0 for x in given)
        if given and single and name == "broadcast_in_dim":
            return given
        if single and name in _FOLDS and all(x.number is not None for x in given):
            return [_Held(out.dtype.type(_FOLDS[name](*(x.number for x in given))))]
        if single and name in _ELEMENTWISE and len(eqn.outvars) == 1:
            return [_Held(_binder(eqn)(*(jnp.asarray(x.value) for x in given)))]
        full = [jnp.broadcast_to(x.value, v.aval.shape) for x, v in zip(given, eqn.invars)]
        found = _binder(eqn)(*full)
        return [_Held(x) for x in (found if isinstance(found, list | tuple) else [found])]

    def simplified(self, name, given, aval) -> _Held | _Slot | None:
        """What becomes of an operation with a known zero or factor; None where nothing does."""
        if not jnp.issubdtype(aval.dtype, jnp.inexact):
            return None
        if any(isinstance(x, _Slot) and x.aval.shape != aval.shape for x in given):
            return None  # one number of the loop meets an array
        if name == "neg":
            return self.times(given[0], _Held(aval.dtype.type(-1)), aval)
        if name in ("add", "add_any", "sub"):
            a, b = given
            if isinstance(b, _Held) and b.number == 0:
                return a
            if isinstance(a, _Held) and a.number == 0:
                return b if name != "sub" else self.times(b, _Held(aval.dtype.type(-1)), aval)
            if isinstance(a, _Slot) and isinstance(b, _Slot) and a.index == b.index:
                one = _Held(aval.dtype.type(1))
                p, q = (one if x.scale is None else x.scale for x in given)
                return self.times(_Slot(a.index, a.aval), self.sum(p, q, name, aval), aval)
            return None
        if name == "mul":
            a, b = given
            if isinstance(a, _Held):
                a, b = b, a
            if isinstance(b, _Held):
                return self.times(a, b, aval)
            key = (min(a.index, b.index), max(a.index, b.index))
            if key not in self.products:
                plain = [_Slot(x.index, x.aval) for x in (a, b)]
                (self.products[key],) = self.emit(lax.mul, plain, [aval] * 2, [aval])
            product = self.products[key]
            for x in (a, b):
                if x.scale is not None:
                    product = self.times(product, x.scale, aval)
            return product
        if name == "div" and isinstance(given[1], _Held) and given[1].number is not None:
            mantissa, _ = np.frexp(given[1].number)
            if abs(mantissa) == 0.5:  # a power of two: the reciprocal is exact
                return self.times(given[0], _Held(aval.dtype.type(1 / given[1].number)), aval)
        return None

    def sum(self, a: _Held, b: _Held, name: str, aval) -> _Held:
        if a.number is None or b.number is None:
            return _Held(a.value - b.value if name == "sub" else a.value + b.value)
        return _Held(aval.dtype.type(_FOLDS[name](a.number, b.number)))

    def times(self, x: _Slot, factor: _Held, aval) -> _Held | _Slot:
        """``x`` times a known factor, kept as a scale as long as possible."""
        if factor.number == 0:
            return factor
        if factor.number == 1:
            return x
        if x.scale is None:
            return _Slot(x.index, x.aval, factor)
        a, b = x.scale, factor
        if a.number is not None and b.number is not None:
            product = aval.dtype.type(a.number * b.number)
            return _Slot(x.index, x.aval, None if product == 1 else _Held(product))
        return _Slot(x.index, x.aval, _Held(a.value * b.value))


def _binder(eqn):
    found = eqn.primitive.get_bind_params(eqn.params)
    funs, params = found if isinstance(found, tuple) else ((), found)  # as older versions of JAX
    return lambda *operands: eqn.primitive.bind(*funs, *operands, **params)
