"""Counts of the operations of a program."""

from collections import Counter


def operations(jaxpr) -> Counter:
    """Numbers of the primitives of a ``jaxpr`` and of those nested in it, by name."""
    total = Counter()
    for eqn in jaxpr.eqns:
        total[eqn.primitive.name] += 1
        for value in eqn.params.values():
            for inner in value if isinstance(value, tuple | list) else [value]:
                inner = getattr(inner, "jaxpr", inner)
                if hasattr(inner, "eqns"):
                    total += operations(inner)
    return total
