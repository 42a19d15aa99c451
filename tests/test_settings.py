"""The settings of the suite are active: annotations are checked, programs are compiled once."""

import inspect
import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import jaxtyping
import pytest
from checked import CHECKED
from contract import public_objects

import polhode as ph
from polhode.inertia import _physical

LEAST = "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"
PROGRAM = """
import jax, jax.numpy as jnp, numpy as np
met = []
jax.monitoring.register_event_listener(lambda name, **_: met.append(name.split("/")[-1]))

def program(x):
    for _ in range(40):
        x = jnp.sort(jnp.sin(x)[::-1] + x)
    return x

jax.jit(program)(np.arange(64.0))
print(met.count("cache_hits"), met.count("cache_misses"))
"""


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda: _physical.is_symmetric(jnp.ones((3, 2))), "tensor"),
        (lambda: _physical.pseudo_from_log_cholesky("0.5"), "parameters"),
        (lambda: _physical.pseudo_from_log_cholesky(jnp.ones(5)), "parameters"),
        (lambda: ph.hamiltonian(3.0), "inertia"),
    ],
)
def test_wrong_shapes_and_kinds_are_refused_by_the_annotations(call, said):
    with pytest.raises(jaxtyping.TypeCheckError, match=f"parameter '{said}'"):
        call()


def functions_of(value):
    """A function, or the functions and properties that a class of the package defines."""
    if not inspect.isclass(value):
        return [value]
    found = [getattr(x, "fget", None) or getattr(x, "__func__", x) for x in vars(value).values()]
    found = [inspect.unwrap(x) for x in found if callable(x)]
    named = f"{value.__qualname__}."
    return [x for x in found if getattr(x, "__qualname__", "").startswith(named)]


UNCHECKED = {
    *("_method", "_closed_forms", "_integrate", "_plan", "_trajectory", "_events", "_simulate"),
    *("_propagate", "_extras", "fit", "lightcurve", "plot", "files", "ensemble"),
}
"""Modules whose annotations are not checked while the tests run."""


def test_annotations_of_public_names_are_checked():
    seen, missing, unchecked = 0, [], set()
    for name, value in public_objects():
        for function in functions_of(value) if callable(value) else []:
            function = inspect.unwrap(function)
            package, _, module = function.__module__.partition(".")
            if package != "polhode" or not function.__annotations__:
                continue  # as __new__ of a named tuple
            if (module := module.partition(".")[0]) in UNCHECKED:
                unchecked.add(module)
                continue
            seen += 1
            if f"{function.__module__}.{function.__qualname__}" not in CHECKED:
                missing.append(f"{name}: {function.__module__}.{function.__qualname__}")
    assert seen > 150
    assert not missing, missing
    assert unchecked == UNCHECKED


def test_the_check_can_be_set_aside(unchecked):
    with pytest.raises(TypeError, match="needs the body"):
        ph.hamiltonian(3.0)


def test_another_process_finds_what_one_has_compiled(tmp_path):
    named = "JAX_COMPILATION_CACHE_DIR"
    assert os.environ[named] == jax.config.jax_compilation_cache_dir
    counts = []
    for _ in range(2):
        command, own = (
            [sys.executable, "-c", PROGRAM],
            os.environ | {named: str(tmp_path), LEAST: "0"},
        )
        counts.append(subprocess.run(command, env=own, capture_output=True, text=True, check=True))
    first, second = ([int(n) for n in done.stdout.split()] for done in counts)
    assert (first[0], second[0]) == (0, first[1])
    assert first[1] > 0


def test_wrong_input_meets_the_words_of_the_package():
    with pytest.raises(TypeError, match="needs the body"):
        ph.hamiltonian(3.0)
    with pytest.raises(jaxtyping.TypeCheckError):
        ph.hamiltonian(3.0)
