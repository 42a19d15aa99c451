"""Settings by platform and measurement: one module, with a reason and a benchmark for each."""

import ast
import os
import subprocess
import sys
import tomllib
from pathlib import Path

import jax
import jax.numpy as jnp
import jaxlib.version
import numpy as np
import pytest

import polhode as ph
from polhode import _policy

ROOT = Path(__file__).resolve().parents[1]
SOURCE = ROOT / "src" / "polhode"
POLICY = SOURCE / "_policy.py"
INSPECTIONS = {"default_backend", "platform", "device_kind"}


def inspections(text: str) -> list[str]:
    """Attributes of the platform that a module reads, however it imports them."""
    tree = ast.parse(text)
    reads = [node.attr for node in ast.walk(tree) if isinstance(node, ast.Attribute)]
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom):
            reads += [name.name for name in node.names if (node.module or "").startswith("jax")]
    return [name for name in reads if name in INSPECTIONS]


@pytest.mark.parametrize(
    "text",
    [
        "import jax\nif jax.default_backend() == 'cpu': pass",
        "from jax import default_backend as b",
        "def f(device):\n    return device.platform",
    ],
)
def test_inspections_of_the_platform_are_recognised(text):
    assert inspections(text)


def test_the_platform_is_inspected_in_one_module():
    found = {
        str(path.relative_to(SOURCE)): names
        for path in SOURCE.rglob("*.py")
        if path != POLICY and (names := inspections(path.read_text(encoding="utf-8")))
    }
    assert not found


def rows(path: Path) -> dict[str, str]:
    """The constants of a module, each with the docstring below it."""
    body = ast.parse(path.read_text(encoding="utf-8")).body
    texts = {}
    for node, after in zip(body, [*body[1:], None]):
        if isinstance(node, ast.Assign):
            (name,) = node.targets
            is_text = isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant)
            texts[ast.unparse(name)] = after.value.value if is_text else ""
    return texts


def test_every_choice_has_a_unit_a_reason_and_a_benchmark():
    from benchmarks.policy import CASES

    texts = rows(POLICY)
    assert len(texts) > 20
    unexplained = [name for name, text in texts.items() if not text.startswith("[")]
    assert not unexplained
    assert {*texts} == {"FUSED_JAXLIB", *CASES}


def test_constants_of_the_error_control_have_a_unit_and_a_meaning():
    texts = rows(SOURCE / "_integrate" / "_error_control.py")
    assert len(texts) > 20
    assert not [name for name, text in texts.items() if not text.startswith("[")]


def test_the_upper_bound_of_jax_is_the_newest_version_tested():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    (needed,) = [need for need in project["dependencies"] if need.startswith("jax>")]
    lowest, below = needed.removeprefix("jax>=").split(",<")
    tested = [tuple(map(int, version.split("."))) for version in _policy.FUSED_JAXLIB]
    assert tuple(map(int, below.split("."))) == (max(tested)[0], max(tested)[1] + 1)
    assert tuple(map(int, lowest.split("."))) == min(tested)[:2]
    assert jaxlib.version.__version__ in _policy.FUSED_JAXLIB


@pytest.mark.parametrize(
    ("variable", "version", "reason"),
    [
        (None, "0.10.2", None),
        (None, "99.0.0", "jaxlib 99.0.0 is not among the tested versions"),
        ("0", "99.0.0", None),
        ("1", "0.10.2", "POLHODE_PLAIN is set"),
    ],
)
def test_optimisations_follow_the_table_and_the_variable(monkeypatch, variable, version, reason):
    monkeypatch.setattr(jaxlib.version, "__version__", version)
    if variable is None:
        monkeypatch.delenv("POLHODE_PLAIN", raising=False)
    else:
        monkeypatch.setenv("POLHODE_PLAIN", variable)
    plan = ph.explain(ph.Scene(ph.Inertia.spherical(1.0)), STATE, [0.0, 1.0])
    switches = (
        _policy.is_fused(),
        _policy.is_folded(),
        _policy.is_staged(),
        _policy.is_refilled(10**6),
        _policy.is_time_loop(10**6, 10),
    )
    if reason is None:
        assert all(switches)
        assert plan.plain is None
        assert "plain" not in str(plan)
    else:
        assert not any(switches)
        assert reason in plan.plain
        assert reason in str(plan)


STATE = ph.State([0.5, 0.5, 0.5, -0.5], [0.5, -1.0, 0.75])


def test_a_program_is_for_the_default_device(monkeypatch):
    """On a machine with an accelerator, the default device may be the CPU."""
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert not _policy.is_cpu()
    assert not _policy.is_fused()
    for device in (jax.devices("cpu")[0], "cpu"):
        with jax.default_device(device):
            assert _policy.is_cpu()


def loops(run) -> int:
    """Number of loops in the program for 20,000 bodies minus that in the program for 4."""
    counts = []
    for n in (20_000, 4):
        omega = jax.ShapeDtypeStruct((n, 3), float)
        counts.append(str(jax.make_jaxpr(run)(omega)).count("scan["))
    return counts[0] - counts[1]


@pytest.mark.slow  # it clears the programs of all earlier tests
def test_an_accelerator_moves_a_batch_side_by_side(monkeypatch):
    """Sequential chunks, as on a CPU, took a hundred times as long on a GPU."""
    body, axial = ph.Inertia.from_moments([1.0, 1.5, 2.0]), ph.Inertia.axisymmetric(1.0, 0.5)
    clipped = ph.FeedbackTorque(lambda t, wxyz, omega: jnp.clip(-omega, -0.1, 0.1))
    scenes = (
        (ph.Scene(body), None),
        (ph.Scene(axial, ph.UniformGravity.axial(1.0, 0.5)), None),
        (ph.Scene(axial, torque=ph.LinearDamping(0.1)), ph.SymmetricTop()),
        (ph.Scene(body, torque=clipped), None),
    )

    def run(scene, method):
        def rates(omega):
            wxyz = jnp.broadcast_to(jnp.array([0.5, 0.5, 0.5, -0.5]), (omega.shape[0], 4))
            record = ph.Record(final_only=True, attitude=not isinstance(method, ph.SymmetricTop))
            state = ph.State(wxyz, omega)
            return ph.simulate(scene, state, [0.0, 1.0], method, record=record).omega_body

        return rates

    on_cpu = [loops(run(*case)) for case in scenes]
    assert min(on_cpu) >= 1
    monkeypatch.setattr(_policy, "platform", lambda: "gpu")
    jax.clear_caches()
    on_gpu = [loops(run(*case)) for case in scenes]
    jax.clear_caches()
    assert on_gpu == [0] * len(scenes)


def scene_values() -> list[np.ndarray]:
    """Values and gradients of some scenes: closed forms and integrated motions. Each scene has
    either one body or more bodies than SIMD lanes, to limit compilation.
    """
    gravity = ph.UniformGravity(1.0, [0.0, 0.1, 0.5])
    body = ph.Inertia.from_moments([1.0, 1.5, 2.0])
    scenes = {
        "free": ph.Scene(body),
        "Lagrange's top": ph.Scene(
            ph.Inertia.axisymmetric(1.0, 0.5), ph.UniformGravity.axial(1.0, 0.5)
        ),
        "damped": ph.Scene(body, gravity, ph.LinearDamping(0.1)),
    }
    rng = np.random.default_rng(1)
    many = np.concatenate([np.ones((70, 1)), rng.normal(size=(70, 2))], axis=1)
    values = []
    cases = ("free", many), ("Lagrange's top", many[0]), ("damped", many[0]), ("damped", many)
    for name, omega in cases:

        def end(omega, scene=scenes[name]):
            state = ph.State([0.5, 0.5, 0.5, -0.5], omega)
            found = ph.simulate(scene, state, [0.0, 0.5, 1.0], rtol=1e-9)
            return (found.wxyz[..., 1:, :] ** 3).sum(), found.omega_body

        (_, rates), slope = jax.jit(jax.value_and_grad(end, has_aux=True))(omega)
        values += [np.asarray(rates), np.asarray(slope)]
    return values


@pytest.mark.slow
def test_plain_programs_agree_with_optimised_ones(tmp_path):
    """Each in its own process, because the variable is read during tracing."""
    results = []
    for variable in ("0", "1"):
        path = tmp_path / f"{variable}.npz"
        ran = subprocess.run(
            [sys.executable, __file__, path],
            env={**os.environ, "POLHODE_PLAIN": variable},
            capture_output=True,
            text=True,
        )
        assert ran.returncode == 0, ran.stderr[-2000:]
        with np.load(path) as file:
            results.append([file[name] for name in file.files])
    assert len(results[0]) == len(results[1]) == 8
    for optimised, plain in zip(*results):
        np.testing.assert_allclose(plain, optimised, rtol=1e-7, atol=1e-7)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    np.savez(sys.argv[1], *scene_values())
