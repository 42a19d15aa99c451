"""The public interface: one list of names, nothing else public, complete annotations."""

import importlib.util
import inspect
import subprocess
import sys
from collections.abc import Callable, Iterator

import pytest
from contract import namespaces, public_objects, stub_names

import polhode as ph

DUNDERS = ("__init__", "__call__", "__add__", "__getitem__")
FIRST_CALLS = [
    "H = ph.hamiltonian(ph.Inertia.from_moments([1, 2, 3])); H([0.1, 0.8, 0.3], [1, 2, 3])",
    "ph.simulate; ph.fit.Recording; ph.hamiltonian(ph.Inertia.from_moments([1, 2, 3]))",
    "ph.hamiltonian_matrices(ph.Inertia.from_moments([1, 2, 3]), [0.1, 0.8, 0.3]).V",
    "ph.periods(ph.Inertia.from_moments([1, 2, 3]), ph.State([1, 0, 0, 0], [0.1, 1, 0.1]))",
    "dq, dp = ph.hamiltons_equations(ph.hamiltonian(ph.Inertia.from_moments([1, 2, 3])))("
    "[0.1, 0.8, 0.3], [1, 2, 3.0]); assert dq.shape == dp.shape == (3,)",
    "from polhode import crossings, propagate, fit_scene; assert callable(crossings)",
    "import polhode.rotation, polhode.plot; assert callable(ph.plot.polhode)",
]


def test_the_stub_lists_the_public_names_and_nothing_else_is_public():
    names = stub_names()
    assert len(names) > 50
    assert len(set(names)) == len(names)
    assert sorted(names) == sorted(dir(ph)) == sorted(ph.__all__)
    with pytest.raises(AttributeError):
        ph.Any  # noqa: B018 - an internal import of the module


def test_no_public_name_is_also_a_module():
    wanted = "rotation inertia frames fit lightcurve plot files ensemble"
    assert set(namespaces()) == set(wanted.split())
    for name in set(stub_names()) - set(namespaces()):
        assert importlib.util.find_spec(f"polhode.{name}") is None, name
    for name, _ in public_objects():
        space, _, last = name.partition(".")
        if last:
            assert importlib.util.find_spec(f"polhode.{space}.{last}") is None, name


@pytest.mark.parametrize("call", FIRST_CALLS)
def test_a_fresh_process_finds_the_names(call):
    program = f"import polhode as ph\n{call}"
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr[-2000:]


FREE = """
import sys, jax
before = dict(jax.config.values)
import polhode as ph
assert before == dict(jax.config.values)
assert not jax.config.jax_enable_x64
scene = ph.Scene(ph.Inertia.from_moments([1.0, 2.0, 3.0]))
ph.simulate(scene, ph.State([1, 0, 0, 0], [0.1, 1.0, 0.1]), [0.0, 1.0])
ph.crossings, ph.propagate, ph.Trajectory
heavy = ("diffrax", "optimistix", "lineax", "pydantic", "scipy", "matplotlib", "xarray", "typer")
applications = [f"polhode.{x}" for x in ("fit", "lightcurve", "plot", "files", "ensemble", "cli")]
other_scenes = [f"polhode.{x}" for x in ("_scene._control", "_scene._plates", "_integrate._loop")]
print([name for name in (*heavy, *applications, *other_scenes) if name in sys.modules])
ph.LiePoisson()
print("diffrax" in sys.modules)
"""


def test_a_free_body_loads_no_integrator_control_law_or_application():
    """And the import changes no setting of JAX."""
    result = subprocess.run([sys.executable, "-c", FREE], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr[-2000:]
    assert result.stdout.split("\n")[:2] == ["[]", "True"]


CONSTRUCTED = """
import jax, numpy as np, polhode as ph
compiled = []
jax.monitoring.register_event_duration_secs_listener(
    lambda name, seconds, **_: compiled.append(name) if "backend_compile" in name else None
)
state = ph.State([1, 0, 0, 0.2], np.deg2rad(5.0) * np.ones(3))
box = ph.Inertia.from_box(12.0, [0.2263, 0.1, 0.366])
body = ph.Inertia.from_moments([1.0, 2.0, 3.0])
gravity = ph.UniformGravity(1.0, [0, 0, 0.5], [0, 0, -9.8])
scene = ph.Scene(body, gravity, ph.LinearDamping([0.1, 0.1, 0.2]))
assert bool(body.is_possible)
ph.Scene(ph.Inertia.from_tensor([[1, 0.1, 0], [0.1, 2, 0], [0, 0, 2.5]]))
ph.Inertia.axisymmetric(1, 1.5)
orbit = ph.KeplerOrbit(4e14, 7e6, inclination=1.7)
rods = ph.MagneticDipole(
    ph.BDot(2e4, max_moment=0.2), ph.DipoleField([0, 0, -7.8e22]), orbit
)
motor = ph.Motor(lambda t, wxyz, omega, speed: 0.02 * omega[1], max_torque=1e-3, max_speed=600.0)
wheel = ph.Rotor([0, 1, 1], 2e-5, speed=0.0, coupling=motor + ph.ViscousCoupling(1e-7))
ph.Scene(box, ph.GravityGradient(4e14, orbit), rods, wheel)
ph.explain(scene, state, [0.0, 1.0])
print(len(compiled))
jax.numpy.ones(3) * 2
print(len(compiled) > 0)
"""


def test_a_scene_is_described_without_compiling():
    """Compiling one array operation takes as long as a thousand NumPy operations."""
    result = subprocess.run([sys.executable, "-c", CONSTRUCTED], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr[-2000:]
    # exceptions: identity for Python numbers, decay rates for explain
    assert result.stdout.split() == ["2", "True"]


def members(kind: type) -> Iterator[tuple[str, Callable, bool]]:
    """Public methods and properties of a class and its bases here: (name, function, bound)."""
    for base in kind.__mro__:
        if not base.__module__.startswith("polhode"):
            continue
        for name, value in vars(base).items():
            if name.startswith("_") and name not in DUNDERS:
                continue
            where = f"{base.__module__}.{base.__qualname__}.{name}"
            if isinstance(value, property):
                yield where, value.fget, True
            elif isinstance(value, staticmethod):
                yield where, value.__func__, False
            elif isinstance(value, classmethod):
                yield where, value.__func__, True
            elif inspect.isfunction(value) or hasattr(value, "__wrapped__"):
                yield where, value, True


def unannotated(name: str, function: Callable, bound: bool) -> Iterator[str]:
    signature = inspect.signature(inspect.unwrap(function))
    for parameter in list(signature.parameters.values())[bound:]:
        if parameter.annotation is parameter.empty:
            yield f"{name}({parameter.name})"
    if signature.return_annotation is signature.empty and not name.endswith("__init__"):
        yield f"{name} -> ?"


def test_annotations_of_public_names_are_complete():
    missing: dict[str, None] = {}
    for name, value in public_objects():
        if inspect.isclass(value):
            for member in members(value):
                missing |= dict.fromkeys(unannotated(*member))
        elif callable(value):
            missing |= dict.fromkeys(unannotated(name, value, False))
    assert not missing, list(missing)


@pytest.mark.parametrize("bound", [False, True])
def test_a_missing_annotation_is_found(bound):
    def function(first, second: int = 0):
        return first

    found = list(unannotated("f", function, bound))
    assert found == (["f -> ?"] if bound else ["f(first)", "f -> ?"])
