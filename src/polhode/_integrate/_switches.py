"""Where a field kinks or jumps, read from the field's own program.

``max``, ``clip``, ``where``, comparisons, ``floor``, ... of values that move with the state or the
time are the *switches* of a field. Each has a *level* (which side of a comparison, which integer of
a ``floor``), and with all levels held the field is smooth. The *margin* of a switch is positive as
long as its level is the right one, and falls through zero where the switch turns, so the levels of
a step can be held and the step ended where the first margin vanishes.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Literal
from jaxtyping import Array

from polhode._kernels import SMOOTH

_CALLS = frozenset(
    "jit pjit closed_call core_call custom_jvp_call custom_vjp_call remat2 checkpoint".split()  # noqa: SIM905
)
_ORDERED = frozenset(("gt", "ge", "lt", "le"))
_ROUNDED = frozenset(("floor", "ceil", "round", "rem"))
_OTHERS = frozenset(
    "max min abs sign clamp atan2 reduce_max reduce_min argmax argmin sort scan cond".split()  # noqa: SIM905
)
_OPAQUE = frozenset("while pure_callback io_callback cummax cummin".split())  # noqa: SIM905
"""Operations whose switches are not found: ``Switched.hidden`` names them."""

_SORTED = 16
"""Most numbers that are sorted by comparisons of pairs."""


class Switched(NamedTuple):
    """A program with its switches apart.

    ``frozen(levels, *args)``: results with the levels (K,) held, the margins (K,), and the level
    that each switch turns to where its margin falls below zero; ``levels(*args)``: those at a
    point, in the dtype of the state; ``jumps`` (K,): whether the results may jump there (else they
    kink); ``hidden``: operations inside which there may be switches that were not found.
    """

    frozen: Callable[..., tuple[list[Any], Array, Array]]
    levels: Callable[..., Array]
    jumps: np.ndarray
    hidden: tuple[str, ...]

    @property
    def count(self) -> int:
        """The number K of switches."""
        return len(self.jumps)


def switched(closed: ClosedJaxpr, moving: Sequence[bool], dtype: Any) -> Switched:
    """The switches of a program; ``moving``: which of its arguments change along a motion."""

    def run(args, chooser):
        walk = _Walk(chooser)
        found = walk.jaxpr(closed.jaxpr, closed.consts, list(zip(args, moving)))
        return [x for x, _ in found], walk

    def frozen(levels, *args):
        chooser = _Held(levels)
        out, _ = run(args, chooser)
        return out, *chooser.ended(dtype)

    def levels(*args):
        chooser = _Free(dtype)
        run(args, chooser)
        return chooser.ended()

    jumps: list[bool] = []
    hidden: list[str] = []

    def note(*args):
        chooser = _Free(dtype)
        _, walk = run(args, chooser)
        jumps.extend(chooser.jumps)
        hidden.extend(walk.hidden)
        return chooser.ended()

    jax.eval_shape(
        note, *(jax.ShapeDtypeStruct(v.aval.shape, v.aval.dtype) for v in closed.jaxpr.invars)
    )
    return Switched(frozen, levels, np.array(jumps, bool), tuple(dict.fromkeys(hidden)))


class _Rule(NamedTuple):
    """``level(u)`` of a switching function; ``margin(u, level)``; ``turned(u, level)``."""

    level: Callable[[Any], Any]
    margin: Callable[[Any, Any], Any]
    turned: Callable[[Any, Any], Any]


_SIDE = _Rule(
    lambda u: jnp.where(u >= 0, 1, 0),
    lambda u, level: jnp.where(level > 0, u, -u),
    lambda u, level: 1 - level,
)
_ABOVE = _SIDE._replace(level=lambda u: jnp.where(u > 0, 1, 0))
_FLOOR = _Rule(
    jnp.floor,
    lambda u, level: jnp.minimum(u - level, level + 1 - u),
    lambda u, level: jnp.where(u - level > 0.5, level + 1, level - 1),
)
_TRUNC = _Rule(
    jnp.trunc,
    lambda u, level: jnp.minimum(
        u - level + jnp.where(level <= 0, 1, 0).astype(u.dtype),
        level + jnp.where(level >= 0, 1, 0).astype(u.dtype) - u,
    ),
    lambda u, level: jnp.where(u > level, level + 1, level - 1),
)


class _Held:
    """Gives the levels one after another, and collects margins."""

    def __init__(self, levels):
        self.given, self.place, self.margins, self.turned = levels, 0, [], []

    def choose(self, u, rule: _Rule, jumps: bool):
        u = jnp.asarray(u)
        level = self.given[self.place : self.place + u.size].reshape(u.shape)
        self.place += u.size
        self.margins.append(rule.margin(u, level.astype(u.dtype)).reshape(-1))
        self.turned.append(rule.turned(u, level.astype(u.dtype)).reshape(-1))
        return level

    def ended(self, dtype):
        none = jnp.zeros(0, dtype)
        return tuple(
            jnp.concatenate([x.astype(dtype) for x in some]) if some else none
            for some in (self.margins, self.turned)
        )


class _Free:
    """Decides every level by its own function, and collects them."""

    def __init__(self, dtype):
        self.dtype, self.found, self.jumps = dtype, [], []

    def choose(self, u, rule: _Rule, jumps: bool):
        u = jnp.asarray(u)
        level = rule.level(u).astype(self.dtype)
        self.found.append(level.reshape(-1))
        self.jumps.extend([jumps] * u.size)
        return level

    def ended(self):
        return jnp.concatenate(self.found) if self.found else jnp.zeros(0, self.dtype)


def _may_switch(jaxpr) -> bool:
    """Whether a program holds an operation that may be a switch, or hide one."""
    for eqn in jaxpr.eqns:
        name = eqn.primitive.name
        if name in _CALLS and eqn.params.get("name") == SMOOTH:
            continue
        if name in _ORDERED | _ROUNDED | _OTHERS | _OPAQUE and name not in ("scan", "cond"):
            return True
        if name == "convert_element_type" and _to_integer(eqn):
            return True
        if any(_may_switch(inner) for inner in _inner(eqn)):
            return True
    return False


def _inner(eqn):
    for value in jax.tree.leaves(list(eqn.params.values()), is_leaf=lambda v: hasattr(v, "eqns")):
        inner = getattr(value, "jaxpr", value)
        if hasattr(inner, "eqns"):
            yield inner


def _is_float(x) -> bool:
    return jnp.issubdtype(x.aval.dtype, jnp.floating)


def _to_integer(eqn) -> bool:
    new = eqn.params["new_dtype"]
    return _is_float(eqn.invars[0]) and jnp.issubdtype(new, jnp.integer)


class _Walk:
    """Goes through a program once; values are pairs (array, whether it moves)."""

    def __init__(self, chooser):
        self.chooser, self.hidden = chooser, []

    def jaxpr(self, jaxpr, consts, args):
        env: dict[Any, Any] = {v: (c, False) for v, c in zip(jaxpr.constvars, consts)}
        env.update(zip(jaxpr.invars, args))

        def read(v):
            return (v.val, False) if isinstance(v, Literal) else env[v]

        for eqn in jaxpr.eqns:
            env.update(zip(eqn.outvars, self.equation(eqn, [read(v) for v in eqn.invars])))
        return [read(v) for v in jaxpr.outvars]

    def side(self, u, jumps: bool = False, rule: _Rule = _SIDE):
        """Whether ``u`` is not below zero, held within a step."""
        return self.chooser.choose(u, rule, jumps) > 0

    def equation(self, eqn, given):
        name, x = eqn.primitive.name, [value for value, _ in given]
        moves = any(m for _, m in given)
        if moves and name in _CALLS and eqn.params.get("name") != SMOOTH:
            for inner in _inner(eqn):
                if _may_switch(inner):
                    return self._call(eqn, given)
        if moves and name == "scan" and any(map(_may_switch, _inner(eqn))):
            return self._scan(eqn, given)
        if moves and name == "cond" and any(map(_may_switch, _inner(eqn))):
            return self._cond(eqn, given)
        if moves and name in _OPAQUE and (name != "while" or any(map(_may_switch, _inner(eqn)))):
            self.hidden.append(name)
        first = next((v for v in eqn.invars if not isinstance(v, Literal)), None)
        if moves and first is not None and _is_float(first):
            found = self._switch(eqn, name, x)
            if found is not None:
                return found
        out = _bind(eqn, x)
        held = name in ("eq", "ne", "is_finite")
        return [(o, moves and not held) for o in out]

    def _switch(self, eqn, name, x):
        out = eqn.outvars[0].aval
        if name in ("max", "min"):
            x = [jnp.broadcast_to(jnp.asarray(v, out.dtype), out.shape) for v in x]
            return [(self._larger(*x, name == "max"), True)]
        if name == "abs":
            return [(jnp.where(self.side(x[0]), x[0], -x[0]), True)]
        if name == "sign":
            one = jnp.ones((), out.dtype)
            return [(jnp.where(self.side(x[0], True), one, -one), False)]
        if name == "clamp":
            low, middle, high = (jnp.broadcast_to(jnp.asarray(v, out.dtype), out.shape) for v in x)
            return [(self._larger(low, self._larger(middle, high, False), True), True)]
        if name in _ORDERED:
            a, b = jnp.asarray(x[0]), jnp.asarray(x[1])
            rule = _ABOVE if name in ("gt", "lt") else _SIDE
            above = self.side(a - b if name in ("gt", "ge") else b - a, True, rule)
            return [(jnp.broadcast_to(above, out.shape), False)]
        if name == "floor":
            return [(self._whole(x[0], _FLOOR, out), False)]
        if name == "ceil":
            return [(-self._whole(-x[0], _FLOOR, out), False)]
        if name == "round":
            return [(self._whole(x[0] + 0.5, _FLOOR, out), False)]
        if name == "rem":
            whole = self._whole(jnp.asarray(x[0]) / jnp.asarray(x[1]), _TRUNC, out)
            return [(x[0] - x[1] * whole, True)]
        if name == "convert_element_type" and _to_integer(eqn):
            return [(self._whole(x[0], _TRUNC, eqn.invars[0].aval).astype(out.dtype), False)]
        if name == "atan2":
            y, x = x
            upper, around = self.side(y), jnp.asarray(2 * np.pi, out.dtype)
            turn = jnp.where(upper & (y < 0), around, jnp.where(~upper & (y >= 0), -around, 0))
            return [(jnp.arctan2(y, x) + jnp.where(x < 0, turn, 0), True)]
        if name in ("reduce_max", "reduce_min"):
            value, _ = self._extreme(x[0], eqn.params["axes"], name == "reduce_max")
            return [(value, True)]
        if name in ("argmax", "argmin"):
            _, place = self._extreme(x[0], eqn.params["axes"], name == "argmax")
            return [(place.astype(out.dtype), False)]
        if name == "sort":
            size = x[0].shape[eqn.params["dimension"]]
            if len(x) > 1 or size > _SORTED:
                self.hidden.append(name)
                return None
            return [(self._sorted(x[0], eqn.params["dimension"]), True)]
        return None

    def _larger(self, a, b, larger: bool):
        """The larger (or the smaller) of two."""
        return jnp.where(self.side(a - b if larger else b - a), a, b)

    def _whole(self, u, rule, out):
        level = self.chooser.choose(jnp.broadcast_to(u, out.shape), rule, True)
        return level.astype(out.dtype)

    def _extreme(self, x, axes, larger: bool):
        """The largest number along ``axes`` and its place, by comparisons of pairs."""
        axes = [a % x.ndim for a in axes]
        shape = [n for k, n in enumerate(x.shape) if k not in axes]
        rows = jnp.moveaxis(x, axes, range(len(axes))).reshape(-1, *shape)
        places = jnp.arange(rows.shape[0]).reshape(-1, *[1] * len(shape))
        places = jnp.broadcast_to(places, rows.shape)
        while rows.shape[0] > 1:
            half = rows.shape[0] // 2
            a, b, rest = rows[:half], rows[half : 2 * half], rows[2 * half :]
            first = self.side(a - b if larger else b - a)
            rows = jnp.concatenate([jnp.where(first, a, b), rest])
            pa, pb, rest = places[:half], places[half : 2 * half], places[2 * half :]
            places = jnp.concatenate([jnp.where(first, pa, pb), rest])
        return rows[0], places[0]

    def _sorted(self, x, axis: int):
        """In rising order, by an odd-even network."""
        rows = list(jnp.moveaxis(x, axis, 0))
        for turn in range(len(rows)):
            for k in range(turn % 2, len(rows) - 1, 2):
                a, b = rows[k], rows[k + 1]
                first = self.side(b - a)
                rows[k], rows[k + 1] = jnp.where(first, a, b), jnp.where(first, b, a)
        return jnp.moveaxis(jnp.stack(rows), 0, axis)

    def _call(self, eqn, given):
        inner = eqn.params.get("jaxpr", eqn.params.get("call_jaxpr", eqn.params.get("fun_jaxpr")))
        if isinstance(inner, ClosedJaxpr) or hasattr(inner, "jaxpr"):
            return self.jaxpr(inner.jaxpr, inner.consts, given)
        return self.jaxpr(inner, (), given)

    def _cond(self, eqn, given):
        """All branches, of which the index picks one."""
        (index, _), rest = given[0], given[1:]
        branches = [self.jaxpr(b.jaxpr, b.consts, rest) for b in eqn.params["branches"]]
        index = jnp.clip(jnp.asarray(index, jnp.int32), 0, len(branches) - 1)
        out = []
        for values in zip(*branches):
            value = values[0][0]
            for k, (other, _) in enumerate(values[1:], 1):
                value = jnp.where(index == k, other, value)
            out.append((value, True))
        return out

    def _scan(self, eqn, given):
        """The turns of a loop one after another: its switches are those of all turns."""
        inner, length = eqn.params["jaxpr"], eqn.params["length"]
        held, carried = eqn.params["num_consts"], eqn.params["num_carry"]
        fixed, carry, rows = given[:held], given[held : held + carried], given[held + carried :]
        order = range(length)[::-1] if eqn.params["reverse"] else range(length)
        stacked: list[Any] = [None] * length
        for k in order:
            row = [(jnp.asarray(x)[k], m) for x, m in rows]
            out = self.jaxpr(inner.jaxpr, inner.consts, [*fixed, *carry, *row])
            carry, stacked[k] = out[:carried], out[carried:]
        sums = [
            (jnp.stack([x for x, _ in column]), any(m for _, m in column))
            for column in zip(*stacked)
        ]
        return [*carry, *sums]


def _bind(eqn, x) -> Sequence[Any]:
    found = eqn.primitive.get_bind_params(eqn.params)
    funs, params = found if isinstance(found, tuple) else ((), found)  # as older versions of JAX
    out = eqn.primitive.bind(*funs, *x, **params)
    return out if eqn.primitive.multiple_results else [out]
