"""Script for tests, in its own process: fused kernels in which XLA simplifies parts to constants.

Prints a line for each: its name, and the largest difference from the plain function. If a kernel is
wrong, XLA ends the process. ``each``: one program per kernel, to identify the one that ends it;
``few``: only three of the transformations.
"""

import sys

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp
import numpy as np

from polhode._kernels import kernel

WIDE = np.linspace(0.0, 1.0, 5000)
X, Y, N = np.linspace(0.5, 2.5, 5), np.linspace(-1.0, 1.0, 5), np.arange(5)
NOTHING = np.zeros((0, 3))


def _nothing(a):
    return jnp.where(a < 1, 0.0, 0.0)


def _scan(a, length):
    return jax.lax.scan(lambda c, _: (2 * c, c), a, None, length=length)[0]


@jax.custom_vjp
def _odd_vjp(a):
    return 2 * a


_odd_vjp.defvjp(lambda a: (2 * a, None), lambda _, g: (3 * g,))


@jax.custom_jvp
def _odd_jvp(a):
    return 2 * a


_odd_jvp.defjvp(lambda p, t: (_odd_jvp(*p), 3 * t[0]))

UNITS = {
    "a constant": (lambda a: jnp.zeros(3), X),
    "constants beside a value": (lambda a: (jnp.zeros(3), a * 0 + 1, a - a), X),
    "its operand": (lambda a: a, X),
    "its operands": (lambda a, b: (a, b, a + b), X, X),
    "integers folded away": (lambda n: n * 0, N),
    "integers folded away beside floats": (lambda a, n: a + 0 * n.astype(float), X, N),
    "truth folded away": (lambda a, b: jnp.where(b & False, a, 2 * a), X, X > 1),
    "a known truth": (lambda b: b | True, X > 1),
    "nothing": (_nothing, X),
    "nothing in a loop": (
        lambda a, b: jax.lax.fori_loop(0, 3, lambda i, c: c + _nothing(b), a),
        X,
        Y,
    ),
    "arrays without entries": (lambda a, b: (a + 1, b * 2), X, NOTHING),
    "only arrays without entries": (lambda b: b * 2, NOTHING),
    "an unused operand": (lambda a, b: 2 * a, X, Y),
    "one array twice": (lambda a, b, c: a + b * c, X, X, X),
    "units inside": (lambda a: kernel(lambda b: b * 2 + 1)(a) + kernel(_nothing)(a), X),
    "a loop without turns": (lambda a, b: jax.lax.fori_loop(0, 0, lambda i, c: c + b, a), X, Y),
    "a scan of length 0": (lambda a: 0 * _scan(a, 0), X),
    "a branch known": (lambda a, b: jax.lax.cond(True, lambda a, b: a, lambda a, b: b, a, b), X, Y),
    "branches of nothing": (
        lambda a, b, n: jax.lax.switch(n[1], [lambda a, b: a * 0, lambda a, b: b * 0], a, b),
        X,
        Y,
        N,
    ),
    "a wide sum": (lambda a: jax.lax.fori_loop(0, 3, lambda i, c: c + jnp.sum(c) * 1e-7, a), WIDE),
    "a wide maximum": (
        lambda a: jax.lax.fori_loop(0, 3, lambda i, c: c + jnp.max(c) * 1e-7, a),
        WIDE,
    ),
    "a power of 0": (lambda a: a**0, X),
    "complex numbers": (lambda a: (a * 0).real, X + 1j),
    "two precisions": (lambda a, b: a.astype(float) + b, X.astype(np.float32), Y),
    "not a number": (lambda a, b: (a, 2 * b), np.array([np.nan, np.inf]), X),
    "a random key": (lambda a, k: a + jax.random.uniform(k, (5,)), X, jax.random.key(0)),
    "an unused random key": (lambda a, k: 2 * a, X, jax.random.key(0)),
    "a sum": (lambda a, n: jnp.sum(a) + jnp.sum(n), X, N),
    "a table": (lambda a: jnp.interp(a, jnp.arange(3.0), jnp.zeros(3)), X),
    "a sort": (lambda a: jnp.sort(-a), X),
    "a product of matrices": (lambda a, b: jnp.outer(a, b) @ b, X, Y),
    "its own reverse rule": (_odd_vjp, X),
    "its own forward rule": (_odd_jvp, X),
}


def _sum(tree):
    floats = [x for x in jax.tree.leaves(tree) if jnp.issubdtype(x.dtype, jnp.floating)]
    return sum((jnp.sum(jnp.sin(x)) for x in floats), jnp.array(0.0))


def _grad(fn):
    return lambda a, *rest: jax.grad(lambda a: _sum(fn(a, *rest)))(a)


def _twice(fn):
    return lambda a, *rest: jax.hessian(lambda a: _sum(fn(a, *rest)))(a)


WAYS = {
    "value": lambda fn: fn,
    "of an unknown constant": lambda fn: lambda a, *rest: fn(jnp.ones_like(a) * a[:1], *rest),
    "of a constant": lambda fn: lambda a, *rest: (a, fn(jnp.ones_like(a), *rest)),
    "a part of it": lambda fn: lambda *given: jax.tree.leaves(fn(*given))[0],
    "in a loop": lambda fn: (
        lambda *given: jax.lax.scan(lambda c, _: (c, fn(*given)), 0, None, length=2)
    ),
    "in a branch": lambda fn: (
        lambda a, *rest: jax.lax.cond(a.ravel()[0] > 0 if a.size else False, fn, fn, a, *rest)
    ),
}
SLOPES = {
    "gradient": _grad,
    "gradient of a batch": lambda fn: (
        lambda a, *rest: jax.vmap(_grad(fn), in_axes=(0, *[None] * len(rest)))(
            jnp.stack([a, a]), *rest
        )
    ),
    "kept little": lambda fn: _grad(jax.checkpoint(fn)),
    "second": _twice,
}


FEW = "value", "in a loop", "gradient"


def _away(a, b):
    if jnp.issubdtype(a.dtype, jax.dtypes.prng_key):
        a, b = jax.random.key_data(a), jax.random.key_data(b)
    same = (
        (a == b) | (jnp.isnan(a) & jnp.isnan(b)) if jnp.issubdtype(a.dtype, jnp.inexact) else a == b
    )
    return float(
        jnp.max(jnp.where(same, 0, jnp.abs(a - b if a.dtype != bool else a ^ b)), initial=0)
    )


def _runs(fn, given):
    """The transformations that apply to a kernel."""
    if given[0].size == 0 or given[0].ndim == 0:
        return {"value": WAYS["value"]}
    smooth = given[0].dtype == float and np.all(np.isfinite(given[0]))
    return WAYS | (SLOPES if smooth else {})


def main(each: bool, few: bool):
    units = {name: (fn, [jnp.asarray(x) for x in given]) for name, (fn, *given) in UNITS.items()}
    for way in FEW if few else (*WAYS, *SLOPES):
        for how in ("", "linearised", "repeated") if way == "gradient" else ("",):
            some = {name: u for name, u in units.items() if way in _runs(*u)}
            for names in [[name] for name in some] if each else [list(some)]:
                _compare({name: some[name] for name in names}, way, how)


def _compare(units, way, how):
    """One program for all kernels, since each would take a second to compile."""
    if len(units) == 1:
        print(f"{next(iter(units))}, {way}{how and f', {how}'}: ...", flush=True)
    of, refused = (WAYS | SLOPES)[way], {}

    def all_of(marked):
        found = {}
        for name, (fn, given) in units.items():
            try:
                unit = kernel(fn, **({how: True} if how else {})) if marked else fn
                found[name] = of(unit)(*(x if x.dtype != float else x * one for x in given))
            except (TypeError, ValueError, NotImplementedError) as error:
                refused[name] = type(error).__name__  # second derivatives of a reverse rule
        return found

    one = jnp.array(1.0)

    def both(unknown):
        nonlocal one
        one = unknown  # traced, so that XLA cannot evaluate everything during compilation
        return all_of(marked=True), all_of(marked=False)

    found, plain = jax.jit(both)(one)
    for name in units:
        label = f"{name}, {way}{how and f', {how}'}"
        if name in refused:
            print(f"{label}: {refused[name]}", flush=True)
            continue
        pairs = zip(*map(jax.tree.leaves, (found[name], plain[name])), strict=True)
        print(f"{label}: {max((_away(*pair) for pair in pairs), default=0.0)}", flush=True)


if __name__ == "__main__":
    main("each" in sys.argv, "few" in sys.argv)
