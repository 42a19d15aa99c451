"""Every benchmark runs at a tiny size and scores correctly; pages agree with the stored results."""

import ast
import dataclasses
import importlib.util
import json
import math
import pkgutil
import platform
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

import benchmarks
import polhode as ph
from benchmarks import (
    __main__ as command,
    _figures,
    _page,
    _report,
    cold_tasks,
    problems,
    truth,
)
from benchmarks.problems import PROBLEMS, SATELLITE

FREE = PROBLEMS["free"]
KNOWN = PROBLEMS | {SATELLITE.name: SATELLITE}


def test_only_a_benchmark_that_is_run_takes_one_core():
    """If an import restricted the process to one core, all further tests, on all workers, would run
    on that core.
    """
    for path in Path(_report.__file__).parent.glob("*.py"):
        for line in ast.parse(path.read_text()).body:
            if isinstance(line, ast.Expr) and isinstance(line.value, ast.Call):
                assert "one_thread()" not in ast.unparse(line), path.name


# Truth and scores


@pytest.mark.filterwarnings("ignore:Descending:DeprecationWarning")
@pytest.mark.parametrize("name", ["near_symmetric", "heavy_top", "gradient"])
def test_truth_is_what_another_taylor_series_gives(name):
    from mpmath import mp, mpf
    from systems import taylor
    from systems.table import System

    problem = PROBLEMS[name]
    acts = {}
    if problem.weight:
        acts["gravity"] = (problem.weight, (0.0, 0.0, 1.0))
    if problem.gradient:
        acts["gradient"] = (problem.gradient, problems.DIRECTION)
    wxyz, omega = (x[0] for x in problem.states(1))
    system = System(name, problem.moments, tuple(wxyz), tuple(omega), (0, 1), acts)
    field = taylor.body(problem.moments, system.torque(problem.moments))
    with mp.workdps(50):
        q = [mpf(x) for x in wxyz]
        size = mp.sqrt(sum(x * x for x in q))
        other = taylor.integrate(field, [*map(mpf, omega), *(x / size for x in q)], 0, 1, 4)
        found = truth.motion(problem, wxyz, omega, [1.0])[0]
        apart = max(abs(a - b) for a, b in zip(found, [*other[3:], *other[:3]]))
    # (0.6, 0, 0.8) is a unit vector only up to rounding
    assert apart < mpf(10) ** (-16 if problem.gradient else -24)


def test_long_motion_in_whole_periods_is_the_motion_step_by_step():
    import mpmath as mp

    for flip in (FREE, PROBLEMS["separatrix"]):
        wxyz, omega = (x[0] for x in flip.states(1))
        far = truth.motion(flip, wxyz, omega, [60.0])[0]
        with mp.workdps(50):
            moments = [mp.mpf(m) for m in flip.moments]
            q = [mp.mpf(float(x)) for x in wxyz]
            size = mp.sqrt(mp.fdot(q, q))
            q, w = [x / size for x in q], [mp.mpf(float(x)) for x in omega]
            by_periods = truth._long(moments, q, w, mp.mpf(60), truth.DIGITS)
            assert max(abs(a - b) for a, b in zip(far, by_periods)) < mp.mpf(10) ** -28


@pytest.mark.parametrize("name", KNOWN)
def test_saved_truth_is_scored_at_the_last_time_and_belongs_to_the_bodies(name):
    problem, exact = KNOWN[name], truth.truth(KNOWN[name])
    assert exact["index"][-1] == problem.saves - 1
    assert exact["wxyz"].shape == (truth.BODIES, len(exact["index"]), 4)
    np.testing.assert_allclose(np.linalg.norm(exact["wxyz"], axis=-1), 1, atol=1e-15)
    _, omega = problem.states(truth.BODIES)
    moments = np.array(problem.moments)
    if problem.free:
        energy = np.sum(moments * omega**2, axis=-1)
        later = np.sum(moments * exact["omega"] ** 2, axis=-1)
        np.testing.assert_allclose(later, np.broadcast_to(energy[:, None], later.shape), rtol=1e-14)


def test_errors_are_angles_and_a_failure_counts_as_one():
    q = np.array([[[1.0, 0, 0, 0]], [[1.0, 0, 0, 0]], [[1.0, 0, 0, 0]]])
    exact = {"index": np.array([0]), "wxyz": q, "omega": np.ones((3, 1, 3))}
    turned = q.copy()
    turned[1, 0] = [-math.cos(1e-9), -math.sin(1e-9), 0, 0]  # the other sign, off by 2e-9 rad
    found = problems.errors(exact, turned, np.ones((3, 1, 3)) * 1.5)
    assert found["attitude_worst"] == pytest.approx(2e-9, rel=1e-6)
    assert found["attitude_median"] == 0
    assert found["rate_worst"] == pytest.approx(0.5)
    assert found["failed"] == 0
    turned[2] = np.nan
    found = problems.errors(exact, turned, None)
    assert (found["failed"], found["attitude_worst"]) == (1, math.pi)
    turned[2, 0] = [0, 0, 1, 0]
    assert problems.errors(exact, turned, None)["attitude_worst"] == pytest.approx(math.pi)


# Other programs simulate the same bodies


@pytest.mark.parametrize("name", [name for name in KNOWN if name != "long"])
def test_peers_are_given_the_equations_of_the_truth(name):
    from mpmath import mp

    from benchmarks.peers import rigid_body

    problem, short = KNOWN[name], 1e-12
    wxyz, omega = (x[0] for x in problem.states(1))
    wxyz = wxyz / np.linalg.norm(wxyz)
    found = np.array(rigid_body(problem, wxyz, omega, 0.0))
    with mp.workdps(40):
        ends = [truth.motion(problem, wxyz, omega, [t])[0] for t in (short / 2, short)]
        slope = [float((b - a) / (mp.mpf(short) / 2)) for a, b in zip(*ends)]
    np.testing.assert_allclose(found, slope, rtol=0, atol=1e-10 * np.abs(slope).max())


@pytest.mark.parametrize("name", ["free", "near_symmetric", "extreme", "dense", "long"])
def test_scipy_closed_form_is_exact(name):
    from benchmarks.peers import scipy_closed_form

    (program,) = scipy_closed_form.programs(PROBLEMS[name], 20, np.float64, [], True)
    found = problems.errors(truth.truth(PROBLEMS[name]), *program.call())
    assert found["attitude_median"] < (1e-10 if name == "long" else 1e-11)
    assert found["rate_median"] < (1e-10 if name == "long" else 1e-11)


@pytest.mark.slow
def test_stock_diffrax_moves_the_same_bodies_in_both_charts():
    from benchmarks.peers import stock_diffrax

    problem = dataclasses.replace(PROBLEMS["heavy_top"], horizon=2.0)
    wxyz, omega = problem.states(3)
    exact = [truth.motion(problem, *s, [2.0], 20)[0] for s in zip(wxyz, omega)]
    exact = np.array([[[float(x) for x in state]] for state in exact])
    exact = {"index": np.array([0]), "wxyz": exact[..., :4], "omega": exact[..., 4:]}
    for program in stock_diffrax.programs(problem, 1, np.float64, [1e-9], True):
        assert problems.errors(exact, *program.call())["attitude_worst"] < 1e-6


def test_every_installed_peer_is_in_the_table_and_the_others_are_named():
    from benchmarks import peers

    installed, missing = peers.load()
    assert len(installed) + len(missing) == len(peers.MODULES)
    assert {"diffrax", "SciPy solve_ivp", "SciPy closed form"} <= set(installed)
    assert all("not installed" in why for why in missing.values())


# The benchmarks themselves


PEERS = {"mujoco", "numba", "heyoka"}  # in the dependency group `bench`


def test_every_benchmark_can_be_imported():
    lost = set()
    for module in pkgutil.walk_packages(benchmarks.__path__, "benchmarks."):
        try:
            importlib.import_module(module.name)
        except ModuleNotFoundError as error:
            lost.add(error.name)
    assert lost <= PEERS


PRIVATE_IMPORTS = {
    "_figures.py": "the style of figures, and whole files or none",
    "_report.py": "whole files or none",
    "error_control.py": "one step of the extrapolated midpoint rule",
    "free_body.py": "the solution of the free body without lanes and planner",
    "identification.py": "the start of a fit, which a peer is given as well",
    "light_curves.py": "parts of the search for spin states",
    "policy.py": "the rows of the policy",
    "scale.py": "one block of an ensemble",
}
"""Benchmarks that import private modules, and what they measure or use there."""


def test_benchmarks_use_public_names():
    root, found = Path(benchmarks.__file__).parent, set()
    for path in root.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                names = [f"{node.module}.{alias.name}" for alias in node.names]
            else:
                continue
            parts = [name.split(".") for name in names]
            if any(p[0] == "polhode" and any(x.startswith("_") for x in p[1:]) for p in parts):
                found.add(str(path.relative_to(root)))
    assert found == set(PRIVATE_IMPORTS)


def test_every_benchmark_that_runs_with_the_others_takes_an_output():
    for name in {**command.QUICK, **command.FULL}:
        source = Path(_report.__file__).with_name(f"{name}.py").read_text(encoding="utf-8")
        assert '"--output"' in source, name


def test_times_of_imports_are_written_and_shown(tmp_path):
    from benchmarks import imports

    rows = imports.measure({"nothing": "pass"}, 1)
    assert rows[0]["seconds"] > 0
    path = _report.write("imports", {"runs": 1, "rows": rows}, path=tmp_path / "imports.json")
    assert any("| nothing |" in line for line in _page.section("imports", _report.read(path)))


def test_the_operations_of_a_scene_are_counted():
    from benchmarks import scene_cost

    row, call = scene_cost.build("free, spherical, final state", 4)
    assert row["flops"] > 0
    assert call() is not None


@pytest.mark.slow
def test_work_precision_times_and_scores_polhode():
    from benchmarks.peers import polhode_own

    for name, n, bound in (("dense", 20, 1e-12), ("heavy_top", 1, 1e-4)):
        program = polhode_own.programs(PROBLEMS[name], n, np.float64, [1e-7], True)[-1]
        found = problems.errors(truth.truth(PROBLEMS[name]), *program.call())
        assert found["attitude_median"] < bound
        assert found["scored"] == (3 if n == 1 else n)
        assert program.compile_s > 0


def test_without_an_accelerator_its_benchmark_says_so(monkeypatch, capsys, tmp_path):
    from benchmarks import accelerator

    path = tmp_path / "accelerator.json"
    monkeypatch.setattr("sys.argv", ["accelerator", "--quick", "--output", str(path)])
    monkeypatch.setattr(
        accelerator.jax, "devices", lambda: [accelerator.jax.local_devices(backend="cpu")[0]]
    )
    accelerator.main()
    assert capsys.readouterr().out.startswith("not run")
    report = _report.read(path)
    assert "no accelerator" in report["numbers"]["not_run"]
    assert any("- not run: " in line for line in _page.section("accelerator", report))


@pytest.mark.slow
def test_satellites_of_the_accelerator_benchmark_beside_diffrax():
    from benchmarks import accelerator

    peak = {"bytes_per_s": 1e9, "flop_per_s": 1e9}
    row = accelerator.measure("satellite", 20, "float64", peak)
    assert row["attitude_worst"] < 1e-8
    assert row["samples_per_s"] > 0
    other = accelerator.measure_diffrax("satellite", 20, "float64", 1e-5)
    assert other["equal_error"]
    assert other["attitude_median"] < 1e-5
    worse = accelerator.measure_diffrax("satellite", 20, "float32", 1e-12)
    assert not worse["equal_error"]


def test_tables_take_turns_and_keep_error_beside_time(monkeypatch):
    from benchmarks import peers, work_precision
    from benchmarks.peers import polhode_own, scipy_closed_form

    closed = {"SciPy closed form": scipy_closed_form}
    monkeypatch.setattr(peers, "load", lambda: (closed, {}))
    monkeypatch.setattr(polhode_own, "programs", lambda *a: [])
    rows = work_precision.table("free", 1, "float64", (1e-6,), True, repeats=2, budget=0.05)
    assert [row["peer"] for row in rows] == ["SciPy closed form"]
    assert rows[0]["ns_per_body"] > 0
    assert rows[0]["attitude_worst"] < 1e-12


@pytest.mark.slow
def test_gradients_are_scored_against_high_precision(monkeypatch):
    from benchmarks import gradients

    problem = dataclasses.replace(PROBLEMS["lagrange"], horizon=1.0)
    exact = truth.slopes(problem, 2, gradients.WEIGHTS, 30)
    made = gradients.stock(problem, 2, 1e-9, chunk=2)
    row = gradients.measure_jax("diffrax", made, problem, 2, "1e-09", exact)
    assert row["error_worst"] < 1e-6
    assert row["ratio"] > 1


def test_the_least_time_to_an_error_is_of_the_tolerances_that_reach_it():
    from benchmarks import controllers

    kind = {"activation": "tanh", "bodies": 4, "dtype": "float64"}
    rows = [
        kind | {"program": name, "error": error, "seconds": seconds}
        for name, error, seconds in [
            ("a", 1e-3, 1.0),
            ("a", 1e-5, 3.0),
            ("a", 1e-7, 2.0),
            ("b", None, 0.1),
            ("b", 1e-2, 0.5),
        ]
    ]
    a, b = controllers.time_to_error(rows)
    assert a == kind | {
        "program": "a",
        "ms_to_1e-02": 1e3,
        "ms_to_1e-03": 1e3,
        "ms_to_1e-04": 2e3,
        "ms_to_1e-06": 2e3,
    }
    assert (b["ms_to_1e-02"], b["ms_to_1e-04"]) == (500, None)


@pytest.mark.slow
def test_gradients_through_controllers_are_timed_and_scored(tmp_path, monkeypatch):
    from benchmarks import controllers

    path = tmp_path / "controllers.json"
    monkeypatch.setattr("sys.argv", ["controllers", "--quick", "--output", str(path)])
    controllers.main()
    numbers = _report.read(path)["numbers"]
    errors = {(row["program"], row["tolerance"]): row["error"] for row in numbers["rows"]}
    assert errors["polhode", 1e-6] < 1e-4
    assert errors["diffrax Dopri8", 1e-6] < 1e-2  # the same motion, but integrated across kinks
    (check,) = numbers["checks"]
    assert max(check["along"], check["across"]) < 1e-5
    assert all(row["seconds"] > 0 and row["compile_s"] > 0 for row in numbers["rows"])
    assert numbers["kinds"][0]["error"] < 1e-5


@pytest.mark.slow
def test_scaling_and_scene_cost_run():
    from benchmarks import scaling, scene_cost

    rows = scaling.measure("free", 8, 1, (1.0, 100.0), budget=0.01)
    assert [row["horizon"] for row in rows] == [1.0, 100.0]
    assert all(row["ns_per_body"] > 0 and row["memory_MB"] > 0 for row in rows)
    (row,) = scene_cost.measure(["free, spherical, final state"], 4, repeats=1)
    assert row["ns"] > 0
    assert row["flops"] > 0
    base, saved = scene_cost.measure_parts(["momentum saved in place of states"], (1,), repeats=1)
    assert base["ratio"] == 1
    assert saved["steps"] == base["steps"] > 60


@pytest.mark.slow
def test_every_satellite_of_the_table_of_parts_is_integrated():
    from benchmarks import scene_cost

    assert next(iter(scene_cost.satellites())) == scene_cost.BASE
    for name, satellite in scene_cost.satellites().items():
        plan = ph.explain(satellite.scene, scene_cost.satellite_states(2), [0.0, 60.0], rtol=1e-6)
        assert isinstance(plan.method, ph.LiePoisson), name


def test_reading_of_bodies_from_files_is_timed():
    from benchmarks import scene_cost

    rows = scene_cost.measure_files(repeats=1)
    assert rows[0]["file"].startswith("URDF")
    assert all(row["first_read_s"] >= 0 and row["later_read_ms"] > 0 for row in rows)


@pytest.fixture
def free_bodies(monkeypatch):
    """The benchmark of free bodies, with the reference of eight bodies after 2 s."""
    from benchmarks import free_body

    assert FREE.moments == free_body.CASES["A"]
    states = zip(*free_body.bodies("A", 8))
    exact = [truth.motion(FREE, *s, [2.0], 20)[0] for s in states]
    exact = np.array([[[float(x), 0.0] for x in state] for state in exact])
    monkeypatch.setattr(free_body, "truth", lambda case, count, t: exact[:count])
    return free_body


def test_exact_free_motion_is_scored(free_bodies):
    row = free_bodies.final_state("A", 8, 2.0, 8)
    assert row["attitude_worst"] < 1e-14
    assert row["ns_per_body"] > 0


def test_heyoka_moves_the_same_free_bodies(free_bodies):
    pytest.importorskip("heyoka")
    assert free_bodies.heyoka_final("A", 8, 2.0, 1e-9)["attitude_worst"] < 1e-7


# Results, comparisons, pages


def test_a_result_comes_back_and_holds_no_number_that_json_lacks(tmp_path, monkeypatch):
    monkeypatch.setattr("sys.argv", ["x", "--quick", "--output", "/somewhere/a.json"])
    numbers = {"rows": [{"ns": np.float64(1.23456789), "error": math.nan, "n": np.int64(3)}]}
    path = _report.write("thing", numbers, path=tmp_path / "new" / "a.json", packages=("absent",))
    report = _report.read(path)
    assert report["numbers"] == {"rows": [{"ns": 1.2346, "error": None, "n": 3}]}
    assert report["command"] == "python -m benchmarks.thing --quick"
    assert report["versions"]["absent"] is None
    assert report["versions"]["polhode"]
    path.write_text(json.dumps({"numbers": []}))
    with pytest.raises(ValueError, match="lacks"):
        _report.read(path)


def test_programs_take_turns_and_slow_ones_are_run_less_often(monkeypatch):
    """With a clock that the programs themselves advance."""
    now, calls = [0.0], []
    monkeypatch.setattr(_report.time, "perf_counter", lambda: now[0])

    def call(name, span):
        calls.append(name)
        now[0] += span

    found = _report.in_turn(
        {"quick": lambda: call("quick", 1e-4), "slow": lambda: call("slow", 0.02)},
        repeats=5,
        least=1e-3,
        budget=0.015,
    )
    assert found["quick"].median == pytest.approx(1e-4)
    assert found["slow"].median == pytest.approx(0.02)
    assert found["quick"].repeats == 5
    assert calls.count("slow") == 2
    last = len(calls) - 1 - calls[::-1].index("slow")
    assert "quick" in calls[last:]  # the fast program is still run


def _table(times, errors=(1e-4, 1e-8, 1e-12)):
    def row(peer, program, time, error):
        return {
            "peer": peer,
            "program": program,
            "setting": "exact" if peer == "polhode" else f"{error:.0e}",
            "ns_per_body": time,
            "spread": 0.01,
            "attitude_median": error,
            "attitude_worst": 10 * error,
            "failed": 0,
            "compile_s": None,
        }

    rows = [row("other", "stepper", t, e) for t, e in zip(times, errors)]
    return {
        "family": "free",
        "title": "free",
        "bodies": 1000,
        "dtype": "float64",
        "rows": [row("polhode", "default: ClosedForm", 50.0, 1e-14), *rows],
    }


def test_time_at_a_level_is_interpolated_and_never_extrapolated():
    from benchmarks.work_precision import time_at

    rows = _table((100.0, 400.0, 1600.0))["rows"][1:]
    assert time_at(rows, 1e-3) == 100  # the cheapest setting that was run
    assert time_at(rows, 1e-6) == pytest.approx(200)
    assert time_at(rows, 1e-12) == 1600
    assert time_at(rows, 1e-13) is None
    assert time_at(rows, 1e-6, "attitude_worst") > 200
    rows[1]["failed"] = 1
    assert time_at(rows, 1e-8) == pytest.approx(100 * 16**0.5)


def test_the_fastest_peer_is_named_with_its_time_over_that_of_the_default():
    from benchmarks.work_precision import derived

    levels = "to_1e-03_rad", "to_1e-06_rad", "to_1e-09_rad", "to_1e-12_rad"
    slow, fast = (derived([_table(t)]) for t in ((100.0, 400.0, 1600.0), (10.0, 40.0, 60.0)))
    ours, other = slow["time_to_error_median_body"]
    assert (ours["program"], other["program"]) == ("polhode", "other")
    assert [ours[f"us_{level}"] for level in levels] == [0.05] * 4
    assert [other[f"us_{level}"] for level in levels] == pytest.approx([0.1, 0.2, 0.566, 1.6], 1e-3)
    (line,) = slow["fastest_peer_median_body"]
    assert [line[level] for level in levels] == [
        "2 x other",
        "4 x other",
        "11.3 x other",
        "32 x other",
    ]
    (line,) = fast["fastest_peer_median_body"]
    assert line["to_1e-03_rad"] == "0.2 x other"
    (line,) = slow["fastest_peer_worst_body"]
    assert line["to_1e-12_rad"] == "only polhode"
    assert slow["default_errors"] == []  # a closed form


def _result(times, **more):
    numbers = {"tables": [_table(times)], **more}
    return {"name": "work_precision", "numbers": numbers}


def test_numbers_are_shown_by_their_keys():
    """Entries with common keys are rows of a table; a short list of numbers fits into a cell."""
    lines = _page.by_keys("", {"speed_of": {"a": {"ns": 1.5, "m": [1, 2]}, "b": {"ns": None}}})
    assert lines == [
        "**speed of**",
        "",
        "|  | ns | m |",
        "|---|---:|---:|",
        "| a | 1.5 | 1, 2 |",
        "| b | – | – |",
        "",
    ]
    assert _page.by_keys("x", {"n": 1200, "rows": []}) == ["**x**", "", "- n: 1,200", ""]


def test_long_tables_are_folded():
    rows = [{"n": n} for n in range(_page.FOLDED_ROWS + 1)]
    assert _page.by_keys("x", rows[1:])[0] == "**x**"
    lines = _page.by_keys("x", rows)
    assert lines[0] == f"<details><summary>x, {len(rows)} rows</summary>"
    assert lines[-2] == "</details>"


def test_parts_of_another_run_are_named():
    made = {"date": "2026-01-02", "commit": "0123456789" * 4}
    numbers = {"a": 1, "b_c": 2, "origin": {"b_c": made | {"command": "python -m x"}, "a": made}}
    assert _page.origins({"numbers": numbers}) == [
        "- b c: `python -m x`, 2026-01-02, commit `0123456`.",
        "- a: 2026-01-02, commit `0123456`.",
    ]
    assert not any("origin" in line for line in _page.by_keys("", numbers))


def test_figures_are_drawn_from_results(tmp_path):
    import matplotlib

    matplotlib.use("agg")
    path = tmp_path / "work_precision.json"
    path.write_text(
        json.dumps(
            {**_result((100.0, 400.0, 1600.0)), "command": "", "versions": {}, "machine": {}}
        )
    )
    (made,) = _figures.draw([path], tmp_path)
    text = made.read_text()
    assert "<svg" in text
    assert made.read_text() == (_figures.draw([path], tmp_path)[0]).read_text()


def test_engines_are_scored_by_attitude_energy_and_momentum():
    from benchmarks import engines

    body = engines.bodies()[0]
    half = 0.5e-6
    turn = np.array([math.cos(half), math.sin(half), 0, 0])  # a rotation in space by 1e-6 rad
    w, x, y, z = body["wxyz"]
    turned = np.array(
        [
            turn[0] * w - turn[1] * x,
            turn[0] * x + turn[1] * w,
            turn[0] * y - turn[1] * z,
            turn[0] * z + turn[1] * y,
        ]
    )
    exact = np.stack([body["wxyz"]] * 2)
    found = engines.score(
        body, [1, 2], exact, np.stack([-turned, exact[1]]), np.stack([1.5 * body["omega"]] * 2)
    )
    np.testing.assert_allclose(found["attitude"], [1e-6, 0], rtol=1e-9)
    np.testing.assert_allclose(found["energy"], 1.25)
    np.testing.assert_allclose(found["momentum"], 0.5, rtol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["MuJoCo RK4", "Bullet"])
def test_engines_are_given_the_same_body(name):
    from benchmarks import engines

    runs = engines.engines()
    if name not in runs:
        pytest.skip("not installed")
    for body in engines.bodies():
        saves = [10, 20]
        row = engines.score(body, saves, engines.exact(body, saves), *runs[name][1](body, saves))
        assert max(row["attitude"]) < 1e-2  # steps of order 1, 0.02 rad each


def test_engines_are_shown_after_the_revolutions_that_were_run():
    from benchmarks import engines

    turns = [0.25, 1.05, 9.8]
    row = {"body": "a", "engine": "b", "us_per_step": 2.0, "turns": turns}
    (found,) = engines.after_turns([row | {"attitude": [1, 2, 3], "energy": [4, 5, 6]}])
    assert found == {
        "body": "a",
        "engine": "b",
        "rad_after_1": 2,
        "rad_after_10": 3,
        "energy_after_1": 5,
        "energy_after_10": 6,
        "us_per_step": 2.0,
    }


def test_conversions_are_shown_by_their_worst_and_euler_sequences_together():
    from benchmarks.rotation_stress import worst_by_conversion

    def row(name, value):
        worst = {"value": value, "first": 2.0, "second": 3.0}
        return {"conversion": name, "dtype": "float64", **worst}

    rows = [row("Euler ZYZ -> wxyz", 1.0), row("Euler XYZ -> wxyz", 4.0), row("a -> wxyz", 5.0)]
    euler, other = worst_by_conversion(rows)
    assert euler["conversion"] == "Euler (any sequence) -> wxyz"
    assert (euler["float64_value"], euler["float64_first"], other["float64_value"]) == (4, 2, 5)


def test_errors_over_the_tolerance_are_shown_by_scene():
    from benchmarks.torqued import over_tolerance

    def row(horizon, kind, median, worst):
        scene = {"scene": "top", "dtype": "float64", "rtol": 1e-5, "horizon": horizon, "kind": kind}
        return scene | {"over_median": median, "over_worst": worst, "tame": 20, "flagged": 1}

    rows = [row(1.0, "batch", 0.1, 2.0), row(1.0, "alone", 0.2, 1.0), row(16.0, "batch", 0.1, None)]
    (found,) = over_tolerance(rows)
    assert found["median"] == 0.2
    assert (found["worst_t_1"], found["worst_t_16"]) == (2.0, None)
    assert (found["bodies_counted"], found["flagged"]) == (20, 3)


def test_a_result_holds_its_derived_tables():
    """The stored tables equal those that the benchmark derives from the stored rows."""
    from benchmarks import controllers, engines, rotation_stress, torqued, work_precision

    derived = {
        "cold_tasks": lambda n: {"side_by_side": cold_tasks.side_by_side(n["rows"])},
        "controllers": lambda n: {"time_to_error": controllers.time_to_error(n["rows"])},
        "engines": lambda n: {"after_turns": engines.after_turns(n["rows"])},
        "rotation_stress": lambda n: {
            "worst_by_conversion": rotation_stress.worst_by_conversion(n["rows"])
        },
        "torqued": lambda n: {"over_tolerance": torqued.over_tolerance(n["rows"])},
        **{
            path.stem: lambda n: work_precision.derived(n["tables"])
            for path in _report.RESULTS.glob("work_precision*.json")
        },
    }
    for name, derive in derived.items():
        numbers = _report.read(name)["numbers"]
        for key, rows in derive(numbers).items():
            for row, own in zip(numbers[key], rows, strict=True):
                assert row.keys() == own.keys(), (name, key)
                for column, value in row.items():
                    if isinstance(value, float):  # rows are rounded when they are written
                        assert value == pytest.approx(own[column], rel=1e-3), (name, key, column)
                    elif value is None:
                        assert own[column] is None, (name, key, column)


WRITE = "run: python -m benchmarks page"


def test_the_results_page_holds_the_numbers_of_the_committed_results():
    text = (_page.ROOT / "benchmarks" / "README.md").read_text(encoding="utf-8")
    assert text == _page.page(), WRITE


def test_links_to_the_results_page_name_its_sections():
    text = (_page.ROOT / "benchmarks" / "README.md").read_text(encoding="utf-8")
    titles = re.findall(r"^## (.*)$", text, re.MULTILINE)
    anchors = {re.sub(r"[^\w -]", "", title.lower()).replace(" ", "-") for title in titles}
    links = [
        (path.name, anchor)
        for path in (_page.ROOT / "docs").rglob("*.md")
        for anchor in re.findall(
            r"benchmarks/README\.md#([\w-]+)", path.read_text(encoding="utf-8")
        )
    ]
    assert links
    assert not [link for link in links if link[1] not in anchors]


def readme() -> str:
    return (_page.ROOT / "README.md").read_text(encoding="utf-8")


def test_the_tables_of_the_readme_are_those_of_the_committed_results():
    text = readme()
    assert [match[1] for match in _page.MARK.finditer(text)] == list(_page.BLOCKS)
    assert text.count("<!-- result: ") == text.count("<!-- end -->") == len(_page.BLOCKS)
    assert _page.fill(text) == text, WRITE


def test_a_changed_number_in_a_table_of_the_readme_is_found():
    text = readme()
    for match in _page.MARK.finditer(text):
        digit = max(k for k, letter in enumerate(match[2]) if letter.isdigit()) + match.start(2)
        changed = text[:digit] + str(9 - int(text[digit])) + text[digit + 1 :]
        assert _page.fill(changed) == text != changed, match[1]


HASH = re.compile(r"[0-9a-f]{40}")


def git(*words: str, folder: Path = _report.ROOT) -> str | None:
    """Output of a git command; None if it fails or git is not installed."""
    try:
        done = subprocess.run(["git", *words], cwd=folder, capture_output=True, text=True)
    except FileNotFoundError:
        return None
    return done.stdout if done.returncode == 0 else None


@pytest.mark.parametrize("path", sorted(_report.RESULTS.glob("*.json")), ids=lambda p: p.stem)
def test_a_committed_result_names_its_commit(path):
    report = _report.read(path)
    assert ("commit" in report) != ("committed_with" in report)
    assert HASH.fullmatch(report.get("commit") or report["committed_with"])
    for part in report["numbers"].get("origin", {}).values():
        assert HASH.fullmatch(part.get("commit") or part["committed_with"])


def holds(now: object, then: object) -> bool:
    """Whether every number of ``then`` is in ``now``, which may have further keys."""
    if isinstance(then, dict):
        return isinstance(now, dict) and all(k in now and holds(now[k], then[k]) for k in then)
    return now == then


def test_numbers_that_were_changed_or_removed_are_found():
    then = {"rows": [{"a": 1}], "b": {"c": 2}}
    assert holds(then | {"table": [], "b": {"c": 2, "d": 3}}, then)
    assert not holds({"rows": [{"a": 1}], "b": {}}, then)
    assert not holds({"rows": [{"a": 2}], "b": {"c": 2}}, then)
    assert not holds({"rows": [], "b": {"c": 2}}, then)


@pytest.mark.parametrize("path", sorted(_report.RESULTS.glob("*.json")), ids=lambda p: p.stem)
def test_the_commit_named_holds_the_same_numbers(path):
    """Checked as far as the clone contains the history. The later file may have additional derived
    tables.
    """
    report = _report.read(path)
    parts = dict(report["numbers"].pop("origin", {}))
    origins = {None: report, **parts}
    for part, origin in origins.items():
        if "committed_with" not in origin:
            continue
        text = git("show", f"{origin['committed_with']}:benchmarks/results/{path.name}")
        if text is None:
            pytest.skip("a clone without that commit")
        then = json.loads(text)["numbers"]
        then.pop("origin", None)
        if part is None:
            assert holds(report["numbers"], then)
        else:
            assert then[part] == report["numbers"][part], part


def test_a_result_names_the_commit_and_the_machine_that_made_it(tmp_path):
    path = _report.write("thing", {"ns": 1.0}, path=tmp_path / "a.json")
    report = _report.read(path)
    head = git("rev-parse", "HEAD")
    assert report["commit"] is None if head is None else report["commit"][:40] == head.strip()
    assert {"model", "cores"} <= set(report["machine"])
    assert {"python", "polhode", "jax", "jaxlib"} <= set(report["versions"])
    text = path.read_text()
    assert platform.node() not in report["machine"].values()
    assert str(_report.ROOT) not in text


@pytest.fixture
def checkout(tmp_path, monkeypatch):
    """A repository with another package named polhode."""
    package = tmp_path / "src" / "polhode" / "__init__.py"
    result = tmp_path / "benchmarks" / "results" / "a.json"
    for file in (package, result):
        file.parent.mkdir(parents=True)
        file.write_text("1\n")
    if git("init", "-q", folder=tmp_path) is None:
        pytest.skip("needs git")
    git("add", ".", folder=tmp_path)
    who = ("-c", "user.name=a", "-c", "user.email=a@example.org", "-c", "commit.gpgsign=false")
    assert git(*who, "commit", "-q", "-m", "a", folder=tmp_path) is not None
    spec = importlib.util.spec_from_file_location("polhode", package)
    monkeypatch.setattr(_report.importlib.util, "find_spec", lambda name: spec)
    monkeypatch.setattr(_report, "ROOT", tmp_path)
    return tmp_path


def test_changed_code_marks_the_commit_and_changed_results_do_not(checkout):
    head = _report.commit()
    assert HASH.fullmatch(head)
    (checkout / "benchmarks" / "results" / "a.json").write_text("2\n")
    assert _report.commit() == head
    for name in ("src/polhode/new.py", "benchmarks/new.py", "src/polhode/__init__.py"):
        file, before = checkout / name, None
        before = file.read_text() if file.exists() else None
        file.write_text("2\n")
        assert _report.commit() == f"{head}-dirty", name
        file.unlink() if before is None else file.write_text(before)
        assert _report.commit() == head


def test_no_commit_is_named_for_a_package_from_elsewhere(checkout, monkeypatch, tmp_path_factory):
    elsewhere = tmp_path_factory.mktemp("site") / "__init__.py"
    spec = importlib.util.spec_from_file_location("polhode", elsewhere)
    monkeypatch.setattr(_report.importlib.util, "find_spec", lambda name: spec)
    assert _report.commit() is None


def test_pages_say_where_the_commit_is_from():
    made = {"date": "2026-01-02", "commit": "0123456789" * 4}
    assert _page.source(made) == "2026-01-02, commit `0123456`"
    dirty = {**made, "commit": made["commit"] + "-dirty"}
    assert _page.source(dirty) == "2026-01-02, commit `0123456` with uncommitted changes"
    old = {"date": "2026-01-02", "committed_with": made["commit"]}
    assert _page.source(old) == "2026-01-02, committed with `0123456`"
    assert _page.source({**made, "commit": None}) == "2026-01-02, commit unknown"


@pytest.mark.parametrize(
    "change", [{"date": "2026-01-01"}, {"commit": "a" * 40}, {"machine": {"cores": 1}}], ids=str
)
def test_one_table_is_of_one_commit_machine_and_day(tmp_path, monkeypatch, change):
    for path in _report.RESULTS.glob("work_precision*.json"):
        shutil.copy(path, tmp_path)
    monkeypatch.setattr(_page, "RESULTS", tmp_path)
    assert _page.merged() is not None
    path = tmp_path / "work_precision_free.json"
    path.write_text(json.dumps({**_report.read(path), **change}))
    with pytest.raises(ValueError, match="several commits, machines or days"):
        _page.merged()


@pytest.mark.slow
def test_cold_tasks_are_shown_side_by_side():
    name = next(iter(cold_tasks.TASKS))
    ours = {"first": 2.0, "second": 0.001, "cached": 1.0, "memory": 300.0, "error": 1e-11}
    peer = {"first": 0.7, "second": 0.3, "memory": 90.0, "error": 2e-8}
    alone = {key: value for key, value in ours.items() if key != "error"}
    rows = [
        {"task": name, "peer": peer, "polhode": ours},
        {"task": "flyby of 500", "peer": "", "polhode": alone},
    ]
    lines = _page.table(cold_tasks.side_by_side(rows))
    assert lines[2] == (
        f"| {name} | SciPy | 2 | 0.7 | 1.0e-03 | 0.3 | 1 | 300 | 90 | 1.0e-11 | 2.0e-08 |"
    )
    assert lines[3].startswith("| flyby of 500 | – | 2 | – |")
