"""Where a field kinks or jumps, read from the field's own program.

``max``, ``clip``, ``where``, comparisons, ``floor``, ... of values that move with the state or the
time are the *switches* of a field. Each has a *level* (which side of a comparison, which integer of
a ``floor``), and with all levels held the field is smooth. The *margin* of a switch is positive as
long as its level is the right one, and falls through zero where the switch turns, so the levels of
a step can be held and the step ended where the first margin vanishes.
"""

from collections.abc import Callable, Sequence
from functools import reduce
from operator import or_
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Literal
from jaxtyping import Array

from polhode._kernels import SMOOTH, without_derivatives

_CALLS = frozenset(
    "jit pjit closed_call core_call custom_jvp_call custom_vjp_call remat2 checkpoint".split()  # noqa: SIM905
)
_ORDERED = frozenset(("gt", "ge", "lt", "le", "lt_to", "le_to"))  # ..._to: of searches in tables
_ROUNDED = frozenset(("floor", "ceil", "round", "rem"))
_OTHERS = frozenset(
    "max min abs sign clamp atan2 reduce_max reduce_min argmax argmin".split()  # noqa: SIM905
)
_SORTS = frozenset(("sort", "top_k", "cummax", "cummin"))
_NOT_DIFFERENTIABLE = frozenset(("while", "pure_callback", "io_callback", "ffi_call"))
"""Operations without a derivative of their own, that of a forward loop aside."""
_OPAQUE = _NOT_DIFFERENTIABLE | frozenset(
    "bitcast_convert_type nextafter approx_top_k reduce reduce_window reduce_window_max"  # noqa: SIM905
    " reduce_window_min select_and_gather_add scatter-max scatter-min".split()
)
"""Operations whose switches are not found: ``Switched.hidden_operations`` names them."""

_CONSTANT = frozenset(("eq", "ne", "is_finite"))
"""Comparisons that turn at single points of a motion, or in one that has failed: except with a
kink. ``max(x, 0) == 0`` holds on one side of it, as in the derivative of ``max``."""

_CONTINUED = frozenset(("log", "sqrt", "rsqrt", "pow"))
"""Functions of complex numbers that are continued over their branch cut, the negative axis."""

_BRANCHED = _CONTINUED | frozenset("log1p asin acos atan asinh acosh atanh".split())  # noqa: SIM905
"""Functions of complex numbers that jump at a branch cut."""

_PIVOTED = frozenset(("lu",))
"""Operations with integers among their results, of which what is solved with them is smooth."""

_COMPOSED = "call_hi_primitive"
"""Operations that are programs of others, as ``jnp.searchsorted`` from JAX 0.12 on."""

_SORTED = 16
"""Most numbers that are sorted by comparisons of pairs."""


class Switched(NamedTuple):
    """A program with its switches apart.

    ``frozen(levels, *args)``: results with the levels (K,) held, the margins (K,), and the level
    that each switch turns to where its margin falls below zero; ``levels(*args)``: those at a
    point, in the dtype of the state; ``jumps`` (K,): whether the results may jump there (else they
    kink); ``timed`` (K,): whether the margin moves with the time alone; ``hidden_operations``:
    those inside which there may be switches that were not found.
    """

    frozen: Callable[..., tuple[list[Any], Array, Array]]
    levels: Callable[..., Array]
    jumps: np.ndarray
    timed: np.ndarray
    hidden_operations: tuple[str, ...]

    @property
    def count(self) -> int:
        """The number K of switches."""
        return len(self.jumps)


STATE, TIME = 1, 2
"""What a value moves with: 3 with both, 0 with neither. The bits above these name the switches of
kinks (``_Walk.kinks``) that the value has passed."""


def switched(closed_jaxpr: ClosedJaxpr, varies: Sequence[int], dtype: Any) -> Switched:
    """The switches of a program; ``varies``: what each of its arguments moves with, ``STATE``,
    ``TIME`` or 0."""

    def run(args, chooser):
        walk = _Walk(chooser)
        outputs = walk.jaxpr(closed_jaxpr.jaxpr, closed_jaxpr.consts, list(zip(args, varies)))
        return [x for x, _ in outputs], walk

    def frozen(levels, *args):
        chooser = _Held(levels)
        out, _ = run(args, chooser)
        return out, *chooser.collect(dtype)

    def levels(*args):
        chooser = _Free(dtype)
        run(args, chooser)
        return chooser.collect()

    jumps: list[bool] = []
    timed: list[bool] = []
    hidden_operations: list[str] = []

    def note(*args):
        chooser = _Free(dtype)
        _, walk = run(args, chooser)
        jumps.extend(jump or k in walk.jumping for k, jump in enumerate(chooser.jumps))
        timed.extend(walk.timed)
        hidden_operations.extend(walk.hidden_operations)
        return chooser.collect()

    jax.eval_shape(
        note, *(jax.ShapeDtypeStruct(v.aval.shape, v.aval.dtype) for v in closed_jaxpr.jaxpr.invars)
    )
    return Switched(
        frozen,
        levels,
        np.array(jumps, bool),
        np.array(timed, bool),
        tuple(dict.fromkeys(hidden_operations)),
    )


def guarded(results: Any, hidden: tuple[str, ...]) -> Any:
    """``results``, whose derivatives raise where they would leave out jumps inside the operations
    ``hidden`` and these do not raise by themselves."""
    named = ", ".join(name for name in hidden if name not in _NOT_DIFFERENTIABLE)
    if not named:
        return results
    return without_derivatives(
        results,
        f"derivatives through {named} in a torque would leave out the times at which its result"
        " jumps. Write it with comparisons, jnp.where, jnp.searchsorted, jnp.argmax or jnp.sort of"
        " at most 16 numbers: steps end where these turn, and derivatives are right.",
    )


class _Rule(NamedTuple):
    """``level(u)`` of a switching function; ``margin(u, level)``; ``new_level(u,
    level)``: the level after the switch turns."""

    level: Callable[[Any], Any]
    margin: Callable[[Any, Any], Any]
    new_level: Callable[[Any, Any], Any]


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


# The program is walked through twice with the same order of choices: once with levels given
# (`_Held`), once deciding them (`_Free`). A level is known by its place in that order alone, so the
# walk must not depend on values; loops are unrolled and all branches of a `cond` evaluated for
# that reason.


class _Held:
    """Gives the levels one after another, and collects margins."""

    def __init__(self, levels):
        self.levels, self.place, self.margins, self.new_levels = levels, 0, [], []

    def choose(self, u, rule: _Rule, jumps: bool):
        # The margin keeps the slope of u: it is also what the place of the switch is differentiated
        # by, and a distance to the switch in any other measure would have to be differentiated too.
        u = jnp.asarray(u)
        level = self.levels[self.place : self.place + u.size].reshape(u.shape)
        self.place += u.size
        self.margins.append(rule.margin(u, level.astype(u.dtype)).reshape(-1))
        self.new_levels.append(rule.new_level(u, level.astype(u.dtype)).reshape(-1))
        return level

    def collect(self, dtype):
        no_values = jnp.zeros(0, dtype)
        return tuple(
            jnp.concatenate([x.astype(dtype) for x in parts]) if parts else no_values
            for parts in (self.margins, self.new_levels)
        )


class _Free:
    """Decides every level by its own function, and collects them."""

    def __init__(self, dtype):
        self.dtype, self.levels, self.jumps = dtype, [], []

    def choose(self, u, rule: _Rule, jumps: bool):
        u = jnp.asarray(u)
        level = rule.level(u).astype(self.dtype)
        self.levels.append(level.reshape(-1))
        self.jumps.extend([jumps] * u.size)
        return level

    def collect(self):
        return jnp.concatenate(self.levels) if self.levels else jnp.zeros(0, self.dtype)


def _may_switch(jaxpr, moves: int = 0) -> bool:
    """Whether a program holds an operation that may be a switch, or hide one, or of which kinks
    among what its operands have passed make jumps; ``moves``: of its operands."""
    for eqn in jaxpr.eqns:
        name = eqn.primitive.name
        if name in _CALLS and eqn.params.get("name") == SMOOTH:
            continue
        if name in _ORDERED | _ROUNDED | _OTHERS | _SORTS | _OPAQUE:
            return True
        if name == _COMPOSED or _is_step(eqn) or _is_branched(eqn):
            return True
        if moves > STATE | TIME and _is_equality(eqn):
            return True
        if name == "convert_element_type" and _to_integer(eqn):
            return True
        if any(_may_switch(subjaxpr, moves) for subjaxpr in _subjaxprs(eqn)):
            return True
    return False


def _subjaxprs(eqn):
    for value in jax.tree.leaves(list(eqn.params.values()), is_leaf=lambda v: hasattr(v, "eqns")):
        subjaxpr = getattr(value, "jaxpr", value)
        if hasattr(subjaxpr, "eqns"):
            yield subjaxpr


def _calls_back(jaxpr) -> bool:
    """Whether a program calls functions outside of JAX, which may raise or print."""
    return any(
        eqn.effects or "callback" in eqn.primitive.name or any(map(_calls_back, _subjaxprs(eqn)))
        for eqn in jaxpr.eqns
    )


def _is_float(x) -> bool:
    return jnp.issubdtype(x.aval.dtype, jnp.floating)


def _is_step(eqn) -> bool:
    """Whether an operation that is not known here makes integers of floats: it must jump."""
    if not any(v.aval.dtype == bool or _is_integer(v.aval.dtype) for v in eqn.outvars):
        return False
    name = eqn.primitive.name
    # a conversion to integers is known, and one to bool is as ``ne``
    if name == "convert_element_type" or name in _CONSTANT | _CALLS | _OPAQUE | _PIVOTED:
        return False
    return any(map(_is_float, eqn.invars)) and not any(True for _ in _subjaxprs(eqn))


def _is_branched(eqn) -> bool:
    return eqn.primitive.name in _BRANCHED and jnp.issubdtype(
        eqn.invars[0].aval.dtype, jnp.complexfloating
    )


def _is_equality(eqn) -> bool:
    """Whether an operation compares floats for equality; ``x != x`` is a test for NaN."""
    name, variables = eqn.primitive.name, eqn.invars
    if name not in _CONSTANT and name != "convert_element_type":
        return False
    is_nan_test = name in ("eq", "ne") and variables[0] is variables[1]
    to_bool = eqn.outvars[0].aval.dtype == bool
    return to_bool and any(map(_is_float, variables)) and not is_nan_test


def _to_integer(eqn) -> bool:
    return _is_float(eqn.invars[0]) and _is_integer(eqn.params["new_dtype"])


def _is_integer(dtype) -> bool:
    return jnp.issubdtype(dtype, jnp.integer)


class _Walk:
    """Goes through a program once; values are pairs (array, what it moves with)."""

    def __init__(self, chooser):
        self.chooser, self.hidden_operations = chooser, []
        self.moves, self.timed = 0, []  # of the operation at hand; of each switch
        self.kinks: list[range] = []  # the switches of each kink
        self.jumping: set[int] = set()  # those at which the results jump for a comparison after it

    def jaxpr(self, jaxpr, consts, args):
        env: dict[Any, Any] = {v: (c, 0) for v, c in zip(jaxpr.constvars, consts)}
        env.update(zip(jaxpr.invars, args))

        def read(v):
            return (v.val, 0) if isinstance(v, Literal) else env[v]

        for eqn in jaxpr.eqns:
            env.update(zip(eqn.outvars, self.equation(eqn, [read(v) for v in eqn.invars])))
        return [read(v) for v in jaxpr.outvars]

    def side(self, u, jumps: bool = False, rule: _Rule = _SIDE):
        """Whether ``u`` is not below zero, held within a step."""
        return self.choose(u, rule, jumps) > 0

    def choose(self, u, rule: _Rule, jumps: bool):
        begin = len(self.timed)
        self.timed.extend([self.moves & (STATE | TIME) == TIME] * jnp.size(u))
        if not jumps:
            self.kinks.append(range(begin, len(self.timed)))
        return self.chooser.choose(u, rule, jumps)

    def _kinks_jump(self, moves: int):
        """Kinks that a value has passed make what follows jump: it is compared for equality."""
        for k, places in enumerate(self.kinks):
            if moves >> (k + 2) & 1:
                self.jumping.update(places)

    def equation(self, eqn, operands):
        name, x = eqn.primitive.name, [value for value, _ in operands]
        self.moves = moves = reduce(or_, (m for _, m in operands), 0)
        if moves and name in _CALLS and eqn.params.get("name") != SMOOTH:
            for subjaxpr in _subjaxprs(eqn):
                if _may_switch(subjaxpr, moves):
                    return self._call(eqn, operands)
        if moves and name == "scan" and any(_may_switch(x, moves) for x in _subjaxprs(eqn)):
            return self._scan(eqn, operands)
        branches = list(_subjaxprs(eqn)) if moves and name == "cond" else []
        # a check (``eqx.error_if``) runs in its own branch alone
        switches = any(_may_switch(branch, moves) for branch in branches)
        if switches and not any(map(_calls_back, branches)):
            return self._cond(eqn, operands)
        if moves and name == _COMPOSED:
            return self._expanded(eqn, operands)
        if (
            moves
            and name in _OPAQUE
            and (name != "while" or any(map(_may_switch, _subjaxprs(eqn))))
        ):
            self.hidden_operations.append(name)
        first_var = next((v for v in eqn.invars if not isinstance(v, Literal)), None)
        if moves and eqn.outvars and first_var is not None and _is_float(first_var):
            kinks = len(self.kinks)
            outputs = self._switch(eqn, name, x)
            if outputs is not None:
                for k in range(kinks, len(self.kinks)):
                    moves |= 1 << (k + 2)
                return [(o, moves if m else 0) for o, m in outputs]
        if moves and _is_branched(eqn):
            if name in _CONTINUED:
                return [(self._continued(eqn, name, x), moves)]
            self.hidden_operations.append(name)
        if moves and _is_equality(eqn):
            self._kinks_jump(moves)
        if moves and _is_step(eqn):
            self.hidden_operations.append(name)
        out = _bind(eqn, x)
        is_constant = name in _CONSTANT
        return [(o, 0 if is_constant else moves) for o in out]

    def _switch(self, eqn, name, x):
        out = eqn.outvars[0].aval
        if name in ("max", "min"):
            a, b = (jnp.broadcast_to(jnp.asarray(v, out.dtype), out.shape) for v in x)
            return [(self._select_larger(a, b, name == "max"), True)]
        if name == "abs":
            return [(jnp.where(self.side(x[0]), x[0], -x[0]), True)]
        # Comparisons give numbers that do not move while their level is held: what follows of them
        # alone (a table index, a mask) needs no switch of its own.
        if name == "sign":
            one = jnp.ones((), out.dtype)
            return [(jnp.where(self.side(x[0], True), one, -one), False)]
        if name == "clamp":
            low, middle, high = (jnp.broadcast_to(jnp.asarray(v, out.dtype), out.shape) for v in x)
            return [
                (self._select_larger(low, self._select_larger(middle, high, False), True), True)
            ]
        if name in _ORDERED:
            a, b = jnp.asarray(x[0]), jnp.asarray(x[1])
            rule = _ABOVE if name in ("gt", "lt", "lt_to") else _SIDE
            above = self.side(a - b if name in ("gt", "ge") else b - a, True, rule)
            return [(jnp.broadcast_to(above, out.shape), False)]
        if name == "floor":
            return [(self._integer_level(x[0], _FLOOR, out), False)]
        if name == "ceil":
            return [(-self._integer_level(-x[0], _FLOOR, out), False)]
        if name == "round":
            return [(self._integer_level(x[0] + 0.5, _FLOOR, out), False)]
        if name == "rem":
            quotient = self._integer_level(jnp.asarray(x[0]) / jnp.asarray(x[1]), _TRUNC, out)
            return [(x[0] - x[1] * quotient, True)]
        if name == "convert_element_type" and _to_integer(eqn):
            return [
                (self._integer_level(x[0], _TRUNC, eqn.invars[0].aval).astype(out.dtype), False)
            ]
        if name == "atan2":
            return [(jnp.arctan2(*x) + self._turn(*x), True)]
        if name in ("reduce_max", "reduce_min"):
            value, _ = self._extreme(x[0], eqn.params["axes"], name == "reduce_max")
            return [(value, True)]
        if name in ("argmax", "argmin"):
            _, place = self._extreme(x[0], eqn.params["axes"], name == "argmax", jumps=True)
            return [(place.astype(out.dtype), False)]
        # Pairs are compared, n (n - 1) / 2 switches for n numbers. Beyond 16 that would be more
        # than most fields have, and the operation is opaque.
        if name == "sort" and eqn.params["num_keys"] == 1:
            axis = eqn.params["dimension"]
            if x[0].shape[axis] <= _SORTED:
                rows = self._sort([jnp.moveaxis(jnp.asarray(v), axis, 0) for v in x])
                moving = [_is_float(v) for v in eqn.invars]
                return [(jnp.moveaxis(v, 0, axis), m) for v, m in zip(rows, moving)]
        if name == "top_k":
            axis = eqn.params.get("axis", x[0].ndim - 1)
            if x[0].shape[axis] <= _SORTED:
                falling = -jnp.moveaxis(x[0], axis, 0)
                places = jnp.arange(len(falling)).reshape(-1, *[1] * (x[0].ndim - 1))
                values, places = self._sort([falling, jnp.broadcast_to(places, falling.shape)])
                values, places = (
                    jnp.moveaxis(v[: eqn.params["k"]], 0, axis) for v in (-values, places)
                )
                return [(values, True), (places.astype(eqn.outvars[1].aval.dtype), False)]
        if name in ("cummax", "cummin"):
            axis, larger = eqn.params["axis"], name == "cummax"
            rows = list(jnp.moveaxis(x[0], axis, 0))
            if len(rows) <= _SORTED:
                rows = rows[::-1] if eqn.params["reverse"] else rows
                for k in range(1, len(rows)):
                    rows[k] = self._select_larger(rows[k - 1], rows[k], larger)
                rows = rows[::-1] if eqn.params["reverse"] else rows
                return [(jnp.moveaxis(jnp.stack(rows), 0, axis), True)]
        if name in _SORTS:
            self.hidden_operations.append(name)
        return None

    def _turn(self, y, x):
        """What continues the angle of (x, y) over the negative axis, where it jumps by a turn: with
        the side of y held it goes on smoothly, and the jump is a switch."""
        y = jnp.asarray(y)
        is_upper, around = self.side(y, True), jnp.asarray(2 * np.pi, y.dtype)
        turn = jnp.where(is_upper & (y < 0), around, jnp.where(~is_upper & (y >= 0), -around, 0))
        return jnp.where(x < 0, turn, 0)

    def _continued(self, eqn, name, x):
        """A function of complex numbers on the sheet of the side that is held."""
        (principal,) = _bind(eqn, x)
        turn = self._turn(jnp.imag(x[0]), jnp.real(x[0]))
        if name in ("sqrt", "rsqrt"):
            return jnp.where(turn == 0, principal, -principal)
        change = jax.lax.complex(jnp.zeros_like(turn), turn)
        if name == "log":
            return principal + change
        return principal * jnp.exp(change * jnp.asarray(x[1], change.dtype))

    def _select_larger(self, a, b, larger: bool):
        """The larger (or the smaller) of two."""
        return jnp.where(self.side(a - b if larger else b - a), a, b)

    def _integer_level(self, u, rule, out):
        level = self.choose(jnp.broadcast_to(u, out.shape), rule, True)
        return level.astype(out.dtype)

    def _extreme(self, x, axes, larger: bool, jumps: bool = False):
        """The largest number along ``axes`` and its place, by comparisons of pairs."""
        axes = [a % x.ndim for a in axes]
        shape = [n for k, n in enumerate(x.shape) if k not in axes]
        rows = jnp.moveaxis(x, axes, range(len(axes))).reshape(-1, *shape)
        places = jnp.arange(rows.shape[0]).reshape(-1, *[1] * len(shape))
        places = jnp.broadcast_to(places, rows.shape)
        # A tournament of neighbours, of which the first wins where they are equal: as many
        # comparisons as a chain of them, but in log n turns of this loop, so that the program grows
        # with log n only.
        while rows.shape[0] > 1:
            even = rows.shape[0] // 2 * 2
            is_first = self.side(
                rows[:even:2] - rows[1:even:2] if larger else rows[1:even:2] - rows[:even:2], jumps
            )
            rows, places = (
                jnp.concatenate([jnp.where(is_first, x[:even:2], x[1:even:2]), x[even:]])
                for x in (rows, places)
            )
        return rows[0], places[0]

    def _sort(self, columns):
        """Columns (n, ...) by the first one in rising order: the place of a number is how many
        others come before it."""
        keys, jumps = columns[0], len(columns) > 1
        place = jnp.zeros(keys.shape, jnp.int32)
        for distance in range(1, len(keys)):
            in_order = self.side(keys[distance:] - keys[:-distance], jumps).astype(jnp.int32)
            place = place.at[distance:].add(in_order).at[:-distance].add(1 - in_order)
        order = jnp.arange(len(keys), dtype=place.dtype).reshape(-1, *[1] * keys.ndim)
        return [
            jnp.sum(jnp.where(place[None] == order, x[None], 0), axis=1, dtype=x.dtype)
            for x in columns
        ]

    def _call(self, eqn, operands):
        subjaxpr = eqn.params.get(
            "jaxpr", eqn.params.get("call_jaxpr", eqn.params.get("fun_jaxpr"))
        )
        if isinstance(subjaxpr, ClosedJaxpr) or hasattr(subjaxpr, "jaxpr"):
            return self.jaxpr(subjaxpr.jaxpr, subjaxpr.consts, operands)
        return self.jaxpr(subjaxpr, (), operands)

    def _expanded(self, eqn, operands):
        """The program that an operation stands for."""
        operation = eqn.params["_prim"]

        def program(*x):
            return jax.tree.leaves(operation.expand(*operation.in_tree.unflatten(x)))

        closed_jaxpr = jax.make_jaxpr(program)(*(value for value, _ in operands))
        return self.jaxpr(closed_jaxpr.jaxpr, closed_jaxpr.consts, operands)

    def _cond(self, eqn, operands):
        """All branches, of which the index picks one."""
        (index, moves), branch_operands = operands[0], operands[1:]
        branches = [self.jaxpr(b.jaxpr, b.consts, branch_operands) for b in eqn.params["branches"]]
        index = jnp.clip(jnp.asarray(index, jnp.int32), 0, len(branches) - 1)
        out = []
        for values in zip(*branches):
            value = values[0][0]
            for k, (branch_value, _) in enumerate(values[1:], 1):
                value = jnp.where(index == k, branch_value, value)
            out.append((value, reduce(or_, (m for _, m in values), moves)))
        return out

    def _scan(self, eqn, operands):
        """The turns of a loop one after another: its switches are those of all turns."""
        body, length = eqn.params["jaxpr"], eqn.params["length"]
        if "num_consts" in eqn.params:
            const_count, carry_count = eqn.params["num_consts"], eqn.params["num_carry"]
        else:  # from JAX 0.11 on
            const_count, carry_count, _ = (len(part.vals) for part in eqn.params["ft_in"].unpack())
        consts, carry, rows = (
            operands[:const_count],
            operands[const_count : const_count + carry_count],
            operands[const_count + carry_count :],
        )
        # Unrolled, since each turn has switches of its own. Only loops with switches come here.
        order = range(length)[::-1] if eqn.params["reverse"] else range(length)
        stacked: list[Any] = [None] * length
        for k in order:
            row = [(jnp.asarray(x)[k], m) for x, m in rows]
            out = self.jaxpr(body.jaxpr, body.consts, [*consts, *carry, *row])
            carry, stacked[k] = out[:carry_count], out[carry_count:]
        if not length:
            rows = (v.aval for v in eqn.outvars[carry_count:])
            return [*carry, *((jnp.zeros(x.shape, x.dtype), False) for x in rows)]
        sums = [
            (jnp.stack([x for x, _ in column]), reduce(or_, (m for _, m in column), 0))
            for column in zip(*stacked)
        ]
        return [*carry, *sums]


def _bind(eqn, x) -> Sequence[Any]:
    bind_params = eqn.primitive.get_bind_params(eqn.params)
    funs, params = (
        bind_params if isinstance(bind_params, tuple) else ((), bind_params)
    )  # as older versions of JAX
    out = eqn.primitive.bind(*funs, *x, **params)
    return out if eqn.primitive.multiple_results else [out]
