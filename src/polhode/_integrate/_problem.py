"""The equations of motion of a scene as a program for one body, its switches, and the arrays of all
bodies."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun
from jaxtyping import Array

from polhode._integrate._explicit_step import Motion
from polhode._integrate._switches import STATE, TIME, SwitchedProgram, switches_of
from polhode._integrate._tableau import Tableau
from polhode._kernels import (
    Distinct,
    constants_as_operands,
    dependent_results,
    formula,
    is_fusible,
    specialise,
    without_repeats,
)

TermOf = Callable[[Any], tuple[Any, Any]]
"""From the parts of a scene, with the arrays of one body (lane axis of length 1), to the diffrax
term of its equations and the term's arguments."""


class Problem(NamedTuple):
    """The field of one body as a program of arrays.

    - ``closed_jaxpr``: rates (and signs of event functions) as a function of ``arrays``, the time
      and the components of the state;
    - ``arrays``: (B, ...) for B bodies where ``lanes`` is true, otherwise common to all;
    - ``switches``: of the program; the last ``events`` of them are events;
    - ``passed_switches``: number of switches at which steps do not end (``ph.CoarseSteps``);
    - ``specialised``: the programs traced by ``motion``, once it has been called.
    """

    closed_jaxpr: ClosedJaxpr
    arrays: list[Any]
    lanes: tuple[bool, ...]
    switches: SwitchedProgram
    events: int
    components: int
    dtype: Any
    passed_switches: int
    specialised: list["_Specialised"]

    @classmethod
    def of(
        cls,
        term_of: TermOf,
        parts: Any,
        is_lane: Any,
        y0: Any,
        t: Array,
        evaluate_events: Any = None,
        located: bool = True,
    ):
        """``parts``: arrays of all bodies; ``is_lane``: a tree of truth values, whether each has a
        lane axis; ``y0``: a state with components (B,); ``evaluate_events(parts, t, y)``: values
        (E,) of the event functions of one body; ``located``: whether steps end at switches; if not,
        they are only counted."""
        # An array that occurs in several parts of the scene (an orbit in potential and torque) is
        # one operand; otherwise values that depend on it would be computed several times.
        parts_and_lanes = jax.tree.map(_LeafAndLane, parts, is_lane)
        leaves, tree = jax.tree.flatten(
            parts_and_lanes, is_leaf=lambda x: isinstance(x, _LeafAndLane)
        )
        arrays = [x.value for x in leaves if eqx.is_array(x.value)]
        lanes = [bool(x.lane) for x in leaves if eqx.is_array(x.value)]
        distinct = Distinct(arrays)
        distinct_arrays = distinct.leaves
        first_places = {place: k for k, place in reversed(list(enumerate(distinct.places)))}
        flags = [lanes[first_places[i]] for i in range(len(distinct_arrays))]
        components, state_tree = jax.tree.flatten(y0)
        events = 0

        def equations(*operands):
            nonlocal events
            t, *y = operands[len(distinct_arrays) :]
            y = jax.tree.unflatten(state_tree, y)
            ordered_arrays = iter([operands[i] for i in distinct.places])
            values = [
                (next(ordered_arrays)[None] if x.lane else next(ordered_arrays))
                if eqx.is_array(x.value)
                else x.value
                for x in leaves
            ]
            parts = jax.tree.unflatten(tree, values)
            term, args = term_of(parts)
            rates = jax.tree.leaves(term.vf(t, y, args))
            if evaluate_events is None:
                return rates
            event_values = evaluate_events(parts, t, y)
            events = event_values.size
            # A comparison, so that events are located as switches are. The term 0 * t makes it
            # vary with the time, even if the event function does not.
            return [*rates, jnp.where(event_values + 0 * t >= 0, 1, 0)]

        single_lane = [x[0] if lane else x for x, lane in zip(distinct_arrays, flags)]
        dtype = jnp.result_type(*components)
        closed_jaxpr = formula(equations, *single_lane, t, *(jnp.ravel(x)[:1] for x in components))
        closed_jaxpr, consts = constants_as_operands(without_repeats(closed_jaxpr))
        varies = [
            *[0] * (len(closed_jaxpr.jaxpr.invars) - 1 - len(components)),
            TIME,
            *[STATE] * len(components),
        ]
        switches = switches_of(closed_jaxpr, varies, dtype)
        passed_switches = 0 if located else switches.count
        if not located:
            switches = switches_of(closed_jaxpr, [0] * len(varies), dtype)
        return cls(
            closed_jaxpr,
            [*consts, *distinct_arrays],
            (*[False] * len(consts), *flags),
            switches,
            events,
            len(components),
            dtype,
            passed_switches,
            [],
        )

    @property
    def note_bytes(self) -> int:
        """Memory of the record of one body and one iteration of the loop (``Note``)."""
        number = jnp.dtype(self.dtype).itemsize
        level = number if self.switches.jumps.any() else 1
        return number * (self.components + 1) + level * self.switches.count

    def motion(
        self,
        arrays: Sequence[Any],
        units: Callable[..., Any],
        unit_data: Any,
        rule: Tableau,
        differentiable: bool,
    ) -> Motion:
        """Equations of motion for the loop; ``units(unit_data, y, rates)``: see ``Motion``;
        ``differentiable``: whether JAX differentiates the loop itself."""
        size, count = self.components, self.switches.count
        if not self.specialised:  # traced once: derivatives call ``motion`` with other arrays
            self.specialised.append(self._specialised())
        prepared, field, levels_program, kinds = self.specialised[0]
        prepare, run = jaxpr_as_fun(prepared), jaxpr_as_fun(field)
        run_levels = jaxpr_as_fun(levels_program)
        # If JAX differentiates the loop, arrays are not stacked: a tangent of one of them would
        # become one of the whole stack.
        stacks = _Stacks([(*kind, i) for i, kind in enumerate(kinds)] if differentiable else kinds)

        def coefficients_of(*parameters):
            return stacks.stack(prepare(*parameters))

        # Values that are the same for all bodies are computed once and get no batch axis: the
        # weights of a network would otherwise be copied for every body.
        axes = [0 if lane else None for lane in self.lanes]
        lane_axes = [0 if is_lane else None for is_lane, *_ in stacks.kinds]
        coefficients = (
            jax.vmap(coefficients_of, in_axes=tuple(axes), out_axes=lane_axes)(*arrays)
            if arrays
            else coefficients_of()
        )

        # `vmap` of the field of one body, rather than the field written for lanes, makes one matrix
        # product for all bodies of a chunk out of a product in a user's function.
        def of_one(coefficients, levels, t, y):
            *rates, margins, new_levels = run(
                *stacks.unstack(coefficients), levels, t, *(y[i][None] for i in range(size))
            )
            return jnp.concatenate(rates), margins, new_levels

        def rates(coefficients, levels, t, y):
            return jax.vmap(of_one, in_axes=(lane_axes, -1, 0, -1), out_axes=-1)(
                coefficients, levels, t, y
            )

        def levels_of_one(constants, t, y):
            return run_levels(*constants, t, *(y[i][None] for i in range(size)))[0]

        def levels(constants, t, y):
            if not count:
                return jnp.zeros((0, t.shape[0]), self.dtype)
            return jax.vmap(levels_of_one, in_axes=(axes, 0, -1), out_axes=-1)(
                list(constants), t, y
            )

        jumps = *self.switches.jumps[: count - self.events].tolist(), *[False] * self.events
        resolved_switches = self.switches.jumps | self.switches.timed
        resolved_switches[count - self.events :] = True
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
            jumps if any(jumps) else (),
            tuple(np.flatnonzero(resolved_switches).tolist()),
            is_fusible(field.jaxpr),
        )

    def _specialised(self) -> "_Specialised":
        """The program of one body, divided into the part that is constant during the motion and the
        part that depends on levels, time and state."""
        size = self.components
        avals = self.closed_jaxpr.in_avals[: -1 - size]
        fixed_count = len(avals)

        def frozen(*operands):
            constants, (levels, t, *y) = operands[:fixed_count], operands[fixed_count:]
            out, margins, new_levels = self.switches.frozen(levels, *constants, t, *y)
            return [*out[:size], margins, new_levels]

        single_lane = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in avals]
        t, y = jnp.zeros((), self.dtype), [jnp.zeros(1, self.dtype)] * size
        variables = [jnp.zeros(self.switches.count, self.dtype), t, *y]
        closed_jaxpr = formula(frozen, *single_lane, *variables)
        fields: list[ClosedJaxpr] = []

        def coefficients_of(*parameters):
            specialised = specialise(closed_jaxpr, parameters)
            shapes = [
                jax.ShapeDtypeStruct(x.shape, x.dtype)
                for x in (*specialised.coefficients, *variables)
            ]
            size = len(specialised.coefficients)
            # traced as a program of its own: ``run`` closes over the traced coefficients
            fields.append(jax.make_jaxpr(lambda *x: specialised.run(x[:size], *x[size:]))(*shapes))
            return list(specialised.coefficients)

        prepared = jax.make_jaxpr(coefficients_of)(*single_lane)
        levels = formula(self.switches.levels, *single_lane, t, *y)

        def staged_levels(*operands):
            specialised = specialise(levels, [])  # only stages the values that levels share
            return specialised.run(specialised.coefficients, *operands)

        levels_program = jax.make_jaxpr(staged_levels)(*single_lane, t, *y)
        depends = dependent_results(prepared.jaxpr, self.lanes)
        kinds = [(is_lane, x.shape, x.dtype) for is_lane, x in zip(depends, prepared.out_avals)]
        return _Specialised(prepared, fields[0], levels_program, kinds)


class _Specialised(NamedTuple):
    """``prepared``: from the arrays of one body to the coefficients, which are constant during the
    motion; ``field``: from the coefficients, levels, time and state to rates, margins and new
    levels; ``levels``: from the arrays of one body, time and state to the levels; ``kinds``: for
    each coefficient, whether it differs between bodies, its shape and dtype."""

    prepared: ClosedJaxpr
    field: ClosedJaxpr
    levels: ClosedJaxpr
    kinds: list[tuple]


class _LeafAndLane(NamedTuple):
    value: Any
    lane: Any


class _Stacks:
    """Stacks of arrays of the same kind: the loop carries a few arrays instead of fifty, and XLA
    compiles it in less time."""

    def __init__(self, kinds: Sequence[Any]):
        self.kinds = list(dict.fromkeys(kinds))
        self.members = [[i for i, x in enumerate(kinds) if x == kind] for kind in self.kinds]
        self.count = len(kinds)

    def stack(self, arrays: Sequence[Any]) -> list[Any]:
        """One stack for each kind; a single array of its kind is not stacked."""
        return [
            jnp.stack([arrays[i] for i in members]) if len(members) > 1 else arrays[members[0]]
            for members in self.members
        ]

    def unstack(self, stacks: Sequence[Any]) -> list[Any]:
        """The arrays in their order."""
        arrays: list[Any] = [None] * self.count
        for stack, members in zip(stacks, self.members, strict=True):
            # The cotangent of a split is one concatenation; that of indexing is one padded array
            # for each index.
            parts = (
                [x[0] for x in jax.lax.split(stack, [1] * len(members))]
                if len(members) > 1
                else [stack]
            )
            for i, part in zip(members, parts, strict=True):
                arrays[i] = part
        return arrays
