"""Operations on traced programs (jaxprs)."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
from jax.extend.core import ClosedJaxpr, Literal


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
