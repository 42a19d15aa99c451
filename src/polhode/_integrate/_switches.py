"""Switches of a field: the operations of its jaxpr at which it may have a kink or a jump.

``max``, ``clip``, ``where``, comparisons, ``floor``, ... of values that vary with the state or the
time are the *switches* of a field. Each has a *level*: the side of a comparison, or the integer of
a ``floor``. With all levels fixed the field is smooth. The *margin* of a switch is positive as long
as its level is correct, and falls through zero where the switch flips. A step is therefore
integrated with fixed levels, and ends where the first margin vanishes.
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

from polhode._kernels import SMOOTH, binder, subjaxprs, without_derivatives

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
"""Operations whose derivatives JAX refuses, in reverse mode at least (``while``)."""
_OPAQUE = _NOT_DIFFERENTIABLE | frozenset(
    "bitcast_convert_type nextafter approx_top_k reduce reduce_window reduce_window_max"  # noqa: SIM905
    " reduce_window_min select_and_gather_add scatter-max scatter-min".split()
)
"""Operations whose switches cannot be located: ``SwitchedProgram.hidden_operations`` lists them."""

_CONSTANT = frozenset(("eq", "ne", "is_finite"))
"""Comparisons that change at isolated points of a motion only, or in one that has failed: they are
not switches. They change the effect of kinks before them: ``max(x, 0) == 0``, which the derivative
of ``max`` contains, holds on one side of the kink."""

_CONTINUED = frozenset(("log", "sqrt", "rsqrt", "pow"))
"""Complex functions that are continued over their branch cut, the negative real axis."""

_BRANCHED = _CONTINUED | frozenset("log1p asin acos atan asinh acosh atanh".split())  # noqa: SIM905
"""Complex functions that jump at a branch cut."""

_PIVOTED = frozenset(("lu",))
"""Operations that return integers (pivots), although solutions computed with them are smooth."""

_COMPOSED = "call_hi_primitive"
"""Operations that expand to other operations, as ``jnp.searchsorted`` from JAX 0.12 on."""

_SORTED = 16
"""Largest number of values that are sorted by pairwise comparisons."""


class SwitchedProgram(NamedTuple):
    """A program and its K switches.

    - ``frozen(levels, *args)``: the results with fixed levels (K,), the margins (K,), and the level
      to which each switch changes when its margin falls below zero;
    - ``levels(*args)``: the levels at a point, in the dtype of the state;
    - ``jumps`` (K,): whether the results may jump at the switch (otherwise they have a kink);
    - ``timed`` (K,): whether the margin varies with the time alone;
    - ``hidden_operations``: operations that may contain switches that cannot be located.
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
"""What a value varies with: the state, the time, both (3) or neither (0). Higher bits are set for
the kinks (``_Interpreter.kinks``) that the value depends on."""


def switches_of(closed_jaxpr: ClosedJaxpr, varies: Sequence[int], dtype: Any) -> SwitchedProgram:
    """The switches of a program; ``varies``: for each of its arguments ``STATE``, ``TIME`` or 0."""

    def run(args, level_source):
        interpreter = _Interpreter(level_source)
        outputs = interpreter.jaxpr(
            closed_jaxpr.jaxpr, closed_jaxpr.consts, list(zip(args, varies))
        )
        return [x for x, _ in outputs], interpreter

    def frozen(levels, *args):
        level_source = _FixedLevels(levels)
        out, _ = run(args, level_source)
        return out, *level_source.collect(dtype)

    def levels(*args):
        level_source = _ComputedLevels(dtype)
        run(args, level_source)
        return level_source.collect()

    jumps: list[bool] = []
    timed: list[bool] = []
    hidden_operations: list[str] = []

    def collect_properties(*args):
        level_source = _ComputedLevels(dtype)
        _, interpreter = run(args, level_source)
        jumps.extend(x or k in interpreter.jumping for k, x in enumerate(level_source.jumps))
        timed.extend(interpreter.timed)
        hidden_operations.extend(interpreter.hidden_operations)
        return level_source.collect()

    jax.eval_shape(
        collect_properties,
        *(jax.ShapeDtypeStruct(v.aval.shape, v.aval.dtype) for v in closed_jaxpr.jaxpr.invars),
    )
    return SwitchedProgram(
        frozen,
        levels,
        np.array(jumps, bool),
        np.array(timed, bool),
        tuple(dict.fromkeys(hidden_operations)),
    )


def raising_on_hidden_switches(results: Any, hidden: tuple[str, ...]) -> Any:
    """``results``, whose derivatives raise NotImplementedError if they would omit jumps inside the
    ``hidden`` operations. Operations that JAX itself refuses to differentiate are not named."""
    named = ", ".join(name for name in hidden if name not in _NOT_DIFFERENTIABLE)
    if not named:
        return results
    return without_derivatives(
        results,
        f"derivatives through {named} in a torque would leave out the times at which its result"
        " jumps. Write it with comparisons, jnp.where, jnp.searchsorted, jnp.argmax or jnp.sort of"
        " at most 16 numbers: steps end where these change, and derivatives are right.",
    )


class _Rule(NamedTuple):
    """Functions of the argument u of a switch: its ``level(u)``, its ``margin(u, level)``, and
    ``new_level(u, level)``, the level after it flips."""

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


# The jaxpr is interpreted with fixed levels (`_FixedLevels`), or to compute the levels
# (`_ComputedLevels`). A level is identified only by the order in which the interpreter reaches its
# switch, so this order must not depend on values: loops are unrolled, and all branches of a `cond`
# are evaluated.


class _FixedLevels:
    """Returns fixed levels one after another, and collects the margins."""

    def __init__(self, levels):
        self.levels, self.place, self.margins, self.new_levels = levels, 0, [], []

    def level_of(self, u, rule: _Rule, jumps: bool):
        # The margin has the derivatives of u (up to its sign), because the time of the switch is
        # differentiated through it; a normalised margin would add derivatives of its scale.
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


class _ComputedLevels:
    """Computes every level from its argument, and collects the levels."""

    def __init__(self, dtype):
        self.dtype, self.levels, self.jumps = dtype, [], []

    def level_of(self, u, rule: _Rule, jumps: bool):
        u = jnp.asarray(u)
        level = rule.level(u).astype(self.dtype)
        self.levels.append(level.reshape(-1))
        self.jumps.extend([jumps] * u.size)
        return level

    def collect(self):
        return jnp.concatenate(self.levels) if self.levels else jnp.zeros(0, self.dtype)


def _may_switch(jaxpr, variation: int = 0) -> bool:
    """Whether a program contains an operation that may be a switch or contain one, or that turns
    kinks of its operands into jumps; ``variation``: of the operands."""
    for eqn in jaxpr.eqns:
        name = eqn.primitive.name
        if name in _CALLS and eqn.params.get("name") == SMOOTH:
            continue
        if name in _ORDERED | _ROUNDED | _OTHERS | _SORTS | _OPAQUE:
            return True
        if name == _COMPOSED or _is_step(eqn) or _is_branched(eqn):
            return True
        if variation > STATE | TIME and _is_equality(eqn):
            return True
        if name == "convert_element_type" and _to_integer(eqn):
            return True
        if any(_may_switch(subjaxpr, variation) for subjaxpr in subjaxprs(eqn)):
            return True
    return False


def _calls_back(jaxpr) -> bool:
    """Whether a program calls functions outside of JAX, which may raise or print."""
    return any(
        eqn.effects or "callback" in eqn.primitive.name or any(map(_calls_back, subjaxprs(eqn)))
        for eqn in jaxpr.eqns
    )


def _is_float(x) -> bool:
    return jnp.issubdtype(x.aval.dtype, jnp.floating)


def _is_step(eqn) -> bool:
    """Whether an operation not listed above converts floats to integers: its result must jump."""
    if not any(v.aval.dtype == bool or _is_integer(v.aval.dtype) for v in eqn.outvars):
        return False
    name = eqn.primitive.name
    # conversions to integers are handled in ``_switch``, and one to bool is equivalent to ``ne``
    if name == "convert_element_type" or name in _CONSTANT | _CALLS | _OPAQUE | _PIVOTED:
        return False
    return any(map(_is_float, eqn.invars)) and not any(True for _ in subjaxprs(eqn))


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


def _kinks_differ(operands) -> bool:
    (_, a), (_, b) = operands
    return a ^ b > STATE | TIME


def _to_integer(eqn) -> bool:
    return _is_float(eqn.invars[0]) and _is_integer(eqn.params["new_dtype"])


def _is_integer(dtype) -> bool:
    return jnp.issubdtype(dtype, jnp.integer)


class _Interpreter:
    """An interpreter of jaxprs; values are pairs of an array and what it varies with."""

    def __init__(self, level_source):
        self.level_source, self.hidden_operations = level_source, []
        # ``variation``: what the current operation varies with; ``timed``: for each switch
        self.variation, self.timed = 0, []
        self.kinks: list[range] = []  # the switches of each kink
        self.jumping: set[int] = set()  # switches of kinks that a later comparison turns into jumps

    def jaxpr(self, jaxpr, consts, args):
        env: dict[Any, Any] = {v: (c, 0) for v, c in zip(jaxpr.constvars, consts)}
        env.update(zip(jaxpr.invars, args))

        def read(v):
            return (v.val, 0) if isinstance(v, Literal) else env[v]

        for eqn in jaxpr.eqns:
            env.update(zip(eqn.outvars, self.equation(eqn, [read(v) for v in eqn.invars])))
        return [read(v) for v in jaxpr.outvars]

    def is_nonnegative(self, u, jumps: bool = False, rule: _Rule = _SIDE):
        """A switch: whether ``u`` is not negative, constant within a step."""
        return self.level_of(u, rule, jumps) > 0

    def level_of(self, u, rule: _Rule, jumps: bool):
        first = len(self.timed)
        self.timed.extend([self.variation & (STATE | TIME) == TIME] * jnp.size(u))
        if not jumps:
            self.kinks.append(range(first, len(self.timed)))
        return self.level_source.level_of(u, rule, jumps)

    def _mark_jumps(self, variation: int):
        """A value is compared for equality: the result jumps at the kinks that it depends on."""
        for k, switches in enumerate(self.kinks):
            if variation >> (k + 2) & 1:
                self.jumping.update(switches)

    def equation(self, eqn, operands):
        name, x = eqn.primitive.name, [value for value, _ in operands]
        self.variation = variation = reduce(or_, (m for _, m in operands), 0)
        if variation and name in _CALLS and eqn.params.get("name") != SMOOTH:
            for subjaxpr in subjaxprs(eqn):
                if _may_switch(subjaxpr, variation):
                    return self._call(eqn, operands)
        if variation and name == "scan" and any(_may_switch(j, variation) for j in subjaxprs(eqn)):
            return self._scan(eqn, operands)
        branches = list(subjaxprs(eqn)) if variation and name == "cond" else []
        switches = any(_may_switch(branch, variation) for branch in branches)
        # a check (``eqx.error_if``) must be evaluated in its own branch only
        if switches and not any(map(_calls_back, branches)):
            return self._cond(eqn, operands)
        if variation and name == _COMPOSED:
            return self._expanded(eqn, operands)
        if (
            variation
            and name in _OPAQUE
            and (name != "while" or any(map(_may_switch, subjaxprs(eqn))))
        ):
            self.hidden_operations.append(name)
        first_var = next((v for v in eqn.invars if not isinstance(v, Literal)), None)
        if variation and eqn.outvars and first_var is not None and _is_float(first_var):
            first_kink = len(self.kinks)
            outputs = self._switch(eqn, name, x)
            if outputs is not None:
                for k in range(first_kink, len(self.kinks)):
                    variation |= 1 << (k + 2)
                return [(o, variation if m else 0) for o, m in outputs]
        if variation and _is_branched(eqn):
            if name in _CONTINUED:
                return [(self._continued(eqn, name, x), variation)]
            self.hidden_operations.append(name)
        if variation and _is_equality(eqn):
            self._mark_jumps(variation)
        if variation and _is_step(eqn):
            self.hidden_operations.append(name)
        out = _bind(eqn, x)
        # Of equal values with different kinks, such as u - clip(u), the difference may be the
        # rounding of a product, which compilers round in one of them only (FMA).
        if name == "sub" and _is_float(eqn.outvars[0]) and _kinks_differ(operands):
            limit = jnp.finfo(out[0].dtype).eps * jnp.maximum(jnp.abs(x[0]), jnp.abs(x[1]))
            rounding = jnp.where(jnp.abs(out[0]) <= limit, out[0], 0)
            out = [out[0] - jax.lax.stop_gradient(rounding)]
        is_constant = name in _CONSTANT
        return [(o, 0 if is_constant else variation) for o in out]

    def _switch(self, eqn, name, x):
        out = eqn.outvars[0].aval
        if name in ("max", "min"):
            a, b = (jnp.broadcast_to(jnp.asarray(v, out.dtype), out.shape) for v in x)
            return [(self._select_larger(a, b, name == "max"), True)]
        if name == "abs":
            return [(jnp.where(self.is_nonnegative(x[0]), x[0], -x[0]), True)]
        # The second entry: whether the result varies while the levels are fixed. The result of a
        # comparison does not, so that values computed from it alone (a table index, a mask) have no
        # switches.
        if name == "sign":
            one = jnp.ones((), out.dtype)
            return [(jnp.where(self.is_nonnegative(x[0], True), one, -one), False)]
        if name == "clamp":
            low, operand, high = (jnp.broadcast_to(jnp.asarray(v, out.dtype), out.shape) for v in x)
            return [
                (self._select_larger(low, self._select_larger(operand, high, False), True), True)
            ]
        if name in _ORDERED:
            a, b = jnp.asarray(x[0]), jnp.asarray(x[1])
            rule = _ABOVE if name in ("gt", "lt", "lt_to") else _SIDE
            above = self.is_nonnegative(a - b if name in ("gt", "ge") else b - a, True, rule)
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
            return [(jnp.arctan2(*x) + self._branch_jump(*x), True)]
        if name in ("reduce_max", "reduce_min"):
            value, _ = self._extreme(x[0], eqn.params["axes"], name == "reduce_max")
            return [(value, True)]
        if name in ("argmax", "argmin"):
            _, place = self._extreme(x[0], eqn.params["axes"], name == "argmax", jumps=True)
            return [(place.astype(out.dtype), False)]
        # Pairs are compared: n (n - 1) / 2 switches for n numbers. For more than 16 these would
        # outnumber all others, and the operation is treated as opaque.
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

    def _branch_jump(self, y, x):
        """Difference between the continued and the principal angle of (x, y). On the negative x
        axis the principal angle jumps by 2 pi: with the sign of y fixed the angle continues
        smoothly, and the jump becomes a switch."""
        y = jnp.asarray(y)
        is_upper, two_pi = self.is_nonnegative(y, True), jnp.asarray(2 * np.pi, y.dtype)
        jump = jnp.where(is_upper & (y < 0), two_pi, jnp.where(~is_upper & (y >= 0), -two_pi, 0))
        return jnp.where(x < 0, jump, 0)

    def _continued(self, eqn, name, x):
        """A complex function, continued over the branch cut from the side of the fixed level."""
        (principal,) = _bind(eqn, x)
        jump = self._branch_jump(jnp.imag(x[0]), jnp.real(x[0]))
        if name in ("sqrt", "rsqrt"):
            return jnp.where(jump == 0, principal, -principal)
        change = jax.lax.complex(jnp.zeros_like(jump), jump)
        if name == "log":
            return principal + change
        return principal * jnp.exp(change * jnp.asarray(x[1], change.dtype))

    def _select_larger(self, a, b, larger: bool):
        """The larger (or the smaller) of two."""
        return jnp.where(self.is_nonnegative(a - b if larger else b - a), a, b)

    def _integer_level(self, u, rule, out):
        level = self.level_of(jnp.broadcast_to(u, out.shape), rule, True)
        return level.astype(out.dtype)

    def _extreme(self, x, axes, larger: bool, jumps: bool = False):
        """The largest or smallest number along ``axes`` and its index, by pairwise comparisons."""
        axes = [a % x.ndim for a in axes]
        shape = [n for k, n in enumerate(x.shape) if k not in axes]
        rows = jnp.moveaxis(x, axes, range(len(axes))).reshape(-1, *shape)
        places = jnp.arange(rows.shape[0]).reshape(-1, *[1] * len(shape))
        places = jnp.broadcast_to(places, rows.shape)
        # A tournament of neighbours; the first of two equal ones wins. It has as many comparisons
        # as a chain, but log n iterations of this loop, so that the program grows with log n only.
        while rows.shape[0] > 1:
            even = rows.shape[0] // 2 * 2
            is_first = self.is_nonnegative(
                rows[:even:2] - rows[1:even:2] if larger else rows[1:even:2] - rows[:even:2], jumps
            )
            rows, places = (
                jnp.concatenate([jnp.where(is_first, x[:even:2], x[1:even:2]), x[even:]])
                for x in (rows, places)
            )
        return rows[0], places[0]

    def _sort(self, columns):
        """Columns (n, ...) sorted by the first one in ascending order: the new index of a number is
        the number of others that come before it."""
        keys, jumps = columns[0], len(columns) > 1
        position = jnp.zeros(keys.shape, jnp.int32)
        for distance in range(1, len(keys)):
            in_order = self.is_nonnegative(keys[distance:] - keys[:-distance], jumps).astype(
                jnp.int32
            )
            position = position.at[distance:].add(in_order).at[:-distance].add(1 - in_order)
        order = jnp.arange(len(keys), dtype=position.dtype).reshape(-1, *[1] * keys.ndim)
        return [
            jnp.sum(jnp.where(position[None] == order, x[None], 0), axis=1, dtype=x.dtype)
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
        """Interpret the program to which a composed operation expands."""
        operation = eqn.params["_prim"]

        def program(*x):
            return jax.tree.leaves(operation.expand(*operation.in_tree.unflatten(x)))

        closed_jaxpr = jax.make_jaxpr(program)(*(value for value, _ in operands))
        return self.jaxpr(closed_jaxpr.jaxpr, closed_jaxpr.consts, operands)

    def _cond(self, eqn, operands):
        """All branches are evaluated, and the index selects the results of one."""
        (index, variation), branch_operands = operands[0], operands[1:]
        branches = [self.jaxpr(b.jaxpr, b.consts, branch_operands) for b in eqn.params["branches"]]
        index = jnp.clip(jnp.asarray(index, jnp.int32), 0, len(branches) - 1)
        out = []
        for values in zip(*branches):
            value = values[0][0]
            for k, (branch_value, _) in enumerate(values[1:], 1):
                value = jnp.where(index == k, branch_value, value)
            out.append((value, reduce(or_, (m for _, m in values), variation)))
        return out

    def _scan(self, eqn, operands):
        """The loop unrolled: each iteration has switches of its own. Only loops with switches are
        interpreted here."""
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
    out = binder(eqn)(*x)
    return out if eqn.primitive.multiple_results else [out]
