"""A scene as the motion of single bodies: the field of one body, its switches, and all arrays."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.extend.core import ClosedJaxpr, Literal, jaxpr_as_fun
from jaxtyping import Array

from polhode._integrate._explicit_step import Motion
from polhode._integrate._switches import Switched, switched
from polhode._integrate._tableau import Tableau
from polhode._kernels import Distinct, formula, specialise

Pose = Callable[[Any], tuple[Any, Any]]
"""From the parts of one body, arrays with one lane, to the term of its equations and arguments."""


class Problem(NamedTuple):
    """The field of one body as a program of arrays.

    ``closed``: rates (and sides of events) of ``arrays``, the time and the components of the state;
    ``arrays``: those of B bodies (B, ...) where ``lanes`` says so, else shared; ``switches``;
    ``events``: how many of the last switches are events; ``passed``: how many switches the steps
    pass without an end.
    """

    closed: ClosedJaxpr
    arrays: list[Any]
    lanes: tuple[bool, ...]
    switches: Switched
    events: int
    components: int
    dtype: Any
    passed: int = 0

    @classmethod
    def of(
        cls,
        pose: Pose,
        parts: Any,
        is_lane: Any,
        y0: Any,
        t: Array,
        watch: Any = None,
        located: bool = True,
    ):
        """``parts``: arrays of all bodies, ``is_lane``: a tree of which have a lane axis; ``y0``: a
        state, components (B,); ``watch(parts, t, y)``: values (E,) of events, of one body;
        ``located``: False: the switches are passed, and only counted."""
        marked = jax.tree.map(_Marked, parts, is_lane)
        leaves, tree = jax.tree.flatten(marked, is_leaf=lambda x: isinstance(x, _Marked))
        arrays = [x.value for x in leaves if eqx.is_array(x.value)]
        lanes = [bool(x.lane) for x in leaves if eqx.is_array(x.value)]
        distinct = Distinct(arrays)
        once = distinct.leaves
        first = {place: k for k, place in reversed(list(enumerate(distinct.places)))}
        flags = [lanes[first[i]] for i in range(len(once))]
        components, state_tree = jax.tree.flatten(y0)
        events = 0

        def one(t, *given):
            nonlocal events
            y = jax.tree.unflatten(state_tree, given[: len(components)])
            found = iter([given[len(components) :][i] for i in distinct.places])
            values = [
                (next(found)[None] if x.lane else next(found)) if eqx.is_array(x.value) else x.value
                for x in leaves
            ]
            parts = jax.tree.unflatten(tree, values)
            term, args = pose(parts)
            rates = jax.tree.leaves(term.vf(t, y, args))
            if watch is None:
                return rates
            seen = watch(parts, t, y)
            events = seen.size
            return [*rates, jnp.where(seen + 0 * t >= 0, 1, 0)]

        bare = [x[0] if lane else x for x, lane in zip(once, flags)]
        dtype = jnp.result_type(*components)
        closed = formula(one, t, *(jnp.ravel(x)[:1] for x in components), *bare)
        closed, consts = _opened(closed, 1 + len(components))
        moving = [
            *[False] * (len(closed.jaxpr.invars) - 1 - len(components)),
            *[True] * (1 + len(components)),
        ]
        found = switched(closed, moving, dtype)
        passed = 0 if located else found.count
        if not located:
            found = switched(closed, [False] * len(moving), dtype)
        return cls(
            closed,
            [*consts, *once],
            (*[False] * len(consts), *flags),
            found,
            events,
            len(components),
            dtype,
            passed,
        )

    def motion(
        self, arrays: Sequence[Any], units: Callable[..., Any], unit_data: Any, rule: Tableau
    ) -> Motion:
        """Equations of motion for the loop; ``units(unit_data, y, rates)``: see ``Motion``."""
        size, count = self.components, self.switches.count
        fixed_count = len(arrays)

        def frozen(*given):
            fixed, (levels, t, *y) = given[:fixed_count], given[fixed_count:]
            out, margins, turned = self.switches.frozen(levels, *fixed, t, *y)
            return [*out[:size], margins, turned]

        bare = [x[0] if lane else x for x, lane in zip(arrays, self.lanes)]
        t, y = jnp.zeros((), self.dtype), [jnp.zeros(1, self.dtype)] * size
        free = [jnp.zeros(count, self.dtype), t, *y]
        closed = formula(frozen, *bare, *free)
        program: list[Any] = []

        def coefficients_of(*some):
            folded = specialise(closed, some)
            shapes = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in (*folded.held, *free)]
            size = len(folded.held)
            # traced as a program of its own: ``run`` closes over the traced coefficients
            program[:] = [jax.make_jaxpr(lambda *x: folded.run(x[:size], *x[size:]))(*shapes)]
            return list(folded.held)

        axes = [0 if lane else None for lane in self.lanes]
        depends = _depends(jax.make_jaxpr(coefficients_of)(*bare).jaxpr, self.lanes)
        out = [0 if moves else None for moves in depends]
        coefficients = (
            jax.vmap(coefficients_of, in_axes=tuple(axes), out_axes=out)(*arrays)
            if arrays
            else coefficients_of()
        )
        run = jaxpr_as_fun(program[0])

        def of_one(coefficients, levels, t, y):
            *rates, margins, turned = run(
                *coefficients, levels, t, *(y[i][None] for i in range(size))
            )
            return jnp.concatenate(rates), margins, turned

        def rates(coefficients, levels, t, y):
            return jax.vmap(of_one, in_axes=(out, -1, 0, -1), out_axes=-1)(
                coefficients, levels, t, y
            )

        def levels_of_one(fixed, t, y):
            return self.switches.levels(*fixed, t, *(y[i][None] for i in range(size)))

        def levels(fixed, t, y):
            if not count:
                return jnp.zeros((0, t.shape[0]), self.dtype)
            return jax.vmap(levels_of_one, in_axes=(axes, 0, -1), out_axes=-1)(list(fixed), t, y)

        jumps = bool(self.switches.jumps[: count - self.events].any())
        return Motion(
            rates,
            levels,
            units,
            coefficients,
            list(arrays),
            unit_data,
            rule,
            count,
            self.events,
            jumps,
        )


class _Marked(NamedTuple):
    value: Any
    lane: Any


def _opened(closed: ClosedJaxpr, moving: int) -> tuple[ClosedJaxpr, list[Any]]:
    """The program of (what it closes over, arrays, what moves), and what it closes over."""
    jaxpr = closed.jaxpr
    given = [*jaxpr.constvars, *jaxpr.invars[moving:], *jaxpr.invars[:moving]]
    names = jaxpr.debug_info._replace(arg_names=("",) * len(given))
    return ClosedJaxpr(jaxpr.replace(constvars=[], invars=given, debug_info=names), []), list(
        closed.consts
    )


def _depends(jaxpr, flags: Sequence[bool]) -> list[bool]:
    """Which results of a program rest on the arguments with a flag."""
    seen = {v for v, flag in zip(jaxpr.invars, flags) if flag}
    for eqn in jaxpr.eqns:
        if any(not isinstance(v, Literal) and v in seen for v in eqn.invars):
            seen.update(eqn.outvars)
    return [not isinstance(v, Literal) and v in seen for v in jaxpr.outvars]
