"""Stress suite of the closed-form free motion: largest errors of every family, printed and drawn.

    python -m benchmarks.stress [--quick] [--output stress.json]

Bodies: benchmarks/stress_families.py. References: tests/stress/stress_truth.json, computed with 50
digits. The motion is computed by ``ph.simulate(..., ph.ClosedForm())``, Euler angles are converted
by ``ph.State.from_euler``. Errors are in units of eps x max(1, angle), where angle [rad] is the
rotation angle of the body. They are those of the attitude [rad]; of the rates relative to their
size (for states given in Euler angles, relative to that of the angles' rates if these are larger
and cancel); and of the derivatives along two directions (a relative change of the inertia; a change
of attitude, rates and time), in forward and reverse mode, relative to the larger of the exact
derivative and the natural size (1 rad, the rate). The figure, written next to the output, is drawn
from the JSON file.
"""

import argparse
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import polhode as ph
from benchmarks import _figures, _report
from benchmarks.stress_families import Body, bodies

TRUTH = Path(__file__).resolve().parents[1] / "tests" / "stress" / "stress_truth.json"
COLUMNS = ("attitude", "rates", "forward", "reverse")


def load() -> list[tuple[Body, dict]]:
    """Bodies and their references."""
    table = {(c["family"], c["name"]): c for c in json.loads(TRUTH.read_text())}
    pairs = [(body, table[body.family, body.name]) for body in bodies()]
    for body, row in pairs:
        if row["inputs"] != body.inputs:
            raise ValueError(f"{body.family}, {body.name}: run tests/stress/make_stress_truth.py")
    return pairs


def _final(inertia: ph.Inertia, state: ph.State, t):
    ts = jnp.stack([jnp.zeros_like(t), t], axis=-1)
    record = ph.Record(final_only=True)
    done = ph.simulate(ph.Scene(inertia=inertia), state, ts, ph.ClosedForm(), record=record)
    return jnp.concatenate([done.wxyz[..., 0, :], done.omega_body[..., 0, :]], axis=-1)


def _tensor(x):
    xx, yy, zz, xy, xz, yz = (x[:, k] for k in range(6))
    rows = ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def final_states(inputs: dict) -> dict:
    """Attitude and rates (n, 7) of the bodies of each kind, from their inputs (n, k)."""
    plain, angles = inputs["diagonal"], inputs["euler"]
    given = ph.State.from_euler(angles[:, 3], angles[:, 4], angles[:, 5], rates=angles[:, 6:9])
    state = ph.State(
        jnp.concatenate([plain[:, 3:7], given.wxyz]),
        jnp.concatenate([plain[:, 7:10], given.omega_body]),
    )
    moments = jnp.concatenate([plain[:, :3], angles[:, :3]])
    t = jnp.concatenate([plain[:, -1], angles[:, -1]])
    both = _final(ph.Inertia(diagonal=moments), state, t)
    out = {"diagonal": both[: len(plain)], "euler": both[len(plain) :]}
    for kind in ("tensor", "axisymmetric", "spherical"):
        x = inputs[kind]
        if kind == "tensor":
            inertia = ph.Inertia(full=_tensor(x))
        elif kind == "axisymmetric":
            inertia = ph.Inertia.axisymmetric(x[:, 0], x[:, 1])
        else:
            inertia = ph.Inertia.spherical(x[:, 0])
        out[kind] = _final(inertia, ph.State(x[:, -8:-4], x[:, -4:-1]), x[:, -1])
    return out


def solve(inputs: dict, moves: dict, weights: dict, forward: bool, reverse: bool) -> tuple:
    """Final states, derivatives along the directions (2, n, k), and the reverse-mode derivative of
    a weighted sum.
    """
    values, ahead, back = None, None, None
    if reverse:
        values, pull = jax.vjp(final_states, inputs)
        (pulled,) = pull(weights)
        back = {kind: jnp.sum(pulled[kind][None] * moves[kind], axis=-1) for kind in moves}
    if forward:
        values, ahead = jax.vmap(
            lambda v: jax.jvp(final_states, (inputs,), (v,)), out_axes=(None, 0)
        )(moves)
    return final_states(inputs) if values is None else values, ahead, back


def _exact(words) -> np.ndarray:
    return np.array([[np.longdouble(x) for x in row] for row in words])


def _relative(error: np.ndarray, size) -> np.longdouble:
    """Relative error; infinite for any error of a vector that should vanish."""
    off = np.sqrt(np.sum(error**2))
    return np.longdouble(0) if off == 0 else off / size if size > 0 else np.longdouble(np.inf)


def measure(dtype, pairs: list, forward: bool = True, reverse: bool = True) -> list[dict]:
    """Errors of every body whose inputs the dtype represents, in units of eps x max(1, angle)."""
    pairs = [p for p in pairs if dtype == np.float64 or p[0].fits_single]
    kinds = {}
    for body, row in pairs:
        kinds.setdefault(body.kind, []).append((body, row))
    inputs, moves, weights = {}, {}, {}
    rng = np.random.default_rng(4)
    for kind, members in kinds.items():
        inputs[kind] = jnp.asarray(np.array([b.inputs for b, _ in members]), dtype)
        moves[kind] = jnp.asarray(np.array([b.moves() for b, _ in members]), dtype).swapaxes(0, 1)
        sizes = [_natural_rate(body, row) or 1.0 for body, row in members]
        weight = rng.normal(size=(len(members), 7)) / np.array([[1] * 4 + [s] * 3 for s in sizes])
        weights[kind] = jnp.asarray(weight.astype(dtype))
    program = jax.jit(solve, static_argnums=(3, 4))
    values, ahead, back = program(inputs, moves, weights, forward, reverse)
    scores = []
    for kind, members in kinds.items():
        for n, (body, row) in enumerate(members):
            found = np.asarray(values[kind][n]).astype(np.longdouble)
            rate = _natural_rate(body, row)
            score = dict(zip(COLUMNS, _value_errors(found, row, rate), strict=False))
            exact = _exact(row["slopes"])
            exact[:, :4] *= _sign(found, _exact([row["wxyz_t"]])[0])
            rate = rate or np.longdouble(1)
            if ahead is not None:
                score["forward"] = _forward_error(ahead[kind][:, n], exact, rate)
            if back is not None:
                score["reverse"] = _reverse_error(back[kind][:, n], exact, weights[kind][n], rate)
            unit = np.finfo(dtype).eps * max(1.0, row["angle"])
            score = {name: float(error / unit) for name, error in score.items()}
            scores.append({"family": body.family, "name": body.name, **score})
    return scores


def _size(vector: np.ndarray) -> np.longdouble:
    """Length of a vector; 1 for the zero vector."""
    return np.sqrt(np.sum(vector**2)) or np.longdouble(1)


def _sign(found, exact):
    return -1 if np.sum(found[:4] * exact) < 0 else 1


def _natural_rate(body: Body, row: dict) -> np.longdouble:
    """Size of the body rates; that of the rates of the Euler angles if it is larger, because these
    cancel.
    """
    rates = [row["omega_t"]] + ([body.rates] if body.kind == "euler" else [])
    return max(np.sqrt(np.sum(_exact([x])[0] ** 2)) for x in rates)


def _value_errors(found, row, rate):
    attitude, rates = _exact([row["wxyz_t"]])[0], _exact([row["omega_t"]])[0]
    turned = 2 * _relative(_sign(found, attitude) * found[:4] - attitude, 1)
    return turned, _relative(found[4:] - rates, rate)


def _sizes(exact, rate):
    """Sizes of the attitude and the rate part of a derivative, at least the natural sizes."""
    length = [np.sqrt(np.sum(part**2)) for part in (exact[:4], exact[4:])]
    return max(length[0], np.longdouble(1)), max(length[1], rate)


def _forward_error(found, exact, rate):
    errors = []
    for a, e in zip(np.asarray(found).astype(np.longdouble), exact, strict=True):
        attitude, rates = _sizes(e, rate)
        errors += [_relative(a[:4] - e[:4], attitude), _relative(a[4:] - e[4:], rates)]
    return np.max(errors)  # NaN propagates, unlike in max()


def _reverse_error(found, exact, weight, rate):
    weight = np.asarray(weight).astype(np.longdouble)
    errors = []
    for b, e in zip(np.asarray(found).astype(np.longdouble), exact, strict=True):
        attitude, rates = _sizes(e, rate)
        room = _size(weight[:4]) * attitude + _size(weight[4:]) * rates
        errors.append(abs(b - np.sum(weight * e)) / room)
    return np.max(errors)


def worst(scores: list[dict]) -> dict[str, dict]:
    """For each family the largest of each error (NaN counts as largest), and the body."""
    found = {}
    for score in scores:
        entry = found.setdefault(score["family"], {"bodies": 0})
        entry["bodies"] += 1
        for name in COLUMNS:
            old = entry.get(name, (-1.0, ""))[0]
            if name in score and not np.isnan(old) and not score[name] <= old:
                entry[name] = (score[name], score["name"])
    return found


def table(result: dict) -> list[dict]:
    """For each dtype and family the largest of each error, and the body with the largest error of
    the derivatives.
    """
    lines = []
    for dtype, scores in result.items():
        for family, entry in worst(scores).items():
            found = {name: entry[name][0] for name in COLUMNS if name in entry}
            last = list(found)[-1]
            lines.append(
                {
                    "dtype": dtype,
                    "family": family,
                    "bodies": entry["bodies"],
                    **found,
                    "worst body": entry[last][1],
                }
            )
    return lines


def draw(report: dict, path: Path) -> None:
    """Draw the errors of all bodies by family from the JSON file; rings mark the largest."""
    from matplotlib.figure import Figure

    result = report["numbers"]["bodies"]
    figure = Figure(figsize=(11, 7), layout="constrained")
    panels = figure.subplots(len(result), 1, sharex=True, squeeze=False)[:, 0]
    for panel, (dtype, scores) in zip(panels, result.items(), strict=True):
        families = list(dict.fromkeys(score["family"] for score in scores))
        for shift, name in enumerate(COLUMNS):
            x = np.array([families.index(s["family"]) + 0.18 * (shift - 1.5) for s in scores])
            y = np.array([max(s[name] or 0, 1e-2) for s in scores])
            (line,) = panel.plot(x, y, "_", alpha=0.5, markersize=9)
            top = [y[x == place].max() for place in np.unique(x)]
            label = "gradient, " + name if shift > 1 else name
            panel.plot(
                np.unique(x), top, "o", color=line.get_color(), fillstyle="none", label=label
            )
        panel.set_yscale("log")
        panel.set_xticks(range(len(families)), families)
        panel.set_ylabel("error [eps x max(1, angle)]")
        panel.set_title(dtype)
        panel.grid(axis="y", alpha=0.3)
    panels[0].legend(ncols=4, frameon=False)
    _figures.save(figure, path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--quick", action="store_true", help="values only, no derivatives")
    parser.add_argument("--output", type=Path, help="JSON of all errors; a figure goes beside it")
    given = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    pairs, result = load(), {}
    columns = COLUMNS[:2] if given.quick else COLUMNS
    print("worst errors in units of eps x max(1, angle turned)")
    for dtype in (np.float64, np.float32):
        scores = measure(dtype, pairs, not given.quick, not given.quick)
        result[dtype.__name__] = scores
        print(f"\n{dtype.__name__:<12}{'bodies':>7}" + "".join(f"{c:>10}" for c in columns))
        for family, entry in worst(scores).items():
            cells = "".join(f"{entry[c][0]:>10.2f}" for c in columns)
            print(f"{family:<12}{entry['bodies']:>7}{cells}   {entry[columns[-1]][1]}")
    path = _report.write("stress", {"worst": table(result), "bodies": result}, path=given.output)
    if not given.quick:
        draw(_report.read(path), path.with_suffix(".svg"))


if __name__ == "__main__":
    main()
