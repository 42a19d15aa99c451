"""Mutation tests of the formulas: ``python tests/mutations.py [--only WORD ...] [--jobs N]``.

Each mutant is a copy of the package in which one formula is changed (a sign, a factor, an index).
At least one of the tests named with it must fail; if all pass, the tests of ``WIDER`` run. The
result is a table; the exit code is 1 if a mutant survives, and 2 if one cannot be run.
``--unmutated`` runs the same tests on an unchanged copy, where all must pass.
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "src" / "polhode"
WIDER = ("systems", "hamiltonian", "free", "tops", "torques", "solvers", "rotation", "inertia")
WIDER += ("frames", "test_simulate.py", "test_events.py", "test_propagate.py", "test_published.py")


class Mutant(NamedTuple):
    """One changed formula: ``old`` occurs once in ``file`` (of ``src/polhode``)."""

    file: str
    old: str
    new: str
    effect: str
    tests: Sequence[str]
    """Files, or tests of files (``file::test``), below ``tests``: the fastest first."""


H, FIELD = "_hamiltonian/_energy.py", "_hamiltonian/_lie_poisson.py"
ANGLES, COSTATE = "_hamiltonian/_euler_angles.py", "_hamiltonian/_lie_poisson.py"
FREE, TOP = "_closed_forms/_free_motion.py", "_closed_forms/_lagrange_top.py"
CONSTANTS = "_closed_forms/_free_constants.py"
ELEMENTARY, PERIODS = "_closed_forms/_elementary.py", "_closed_forms/_free_periods.py"
TANGENT = "_closed_forms/_free_tangent.py"
ORBIT, WHEELS, FRAME = "_scene/_orbits.py", "_scene/_wheels.py", "frames/_frame.py"
LAWS, LVLH = "_scene/_control.py", "_scene/_orbits.py"
STEPS, LOOP = "_integrate/_step_derivative.py", "_integrate/_loop.py"
ITERATION = "_integrate/_iteration.py"
FLOW, FOUND = "_integrate/_flow_derivative.py", "_integrate/_switch_location.py"
SEARCH, RESIDUALS = "_events/_search.py", "fit/_residuals.py"
LIGHT, PROPAGATE = "lightcurve/_brightness.py", "_propagate.py"
MOMENTS, QUATERNION = "inertia/_physical.py", "rotation/_quaternion.py"

FAILED, CHARTS, HELD = "_failed.py", "_integrate/_charts.py", "_sampled.py"

OTHERS = "test_failed.py::test_a_gradient_is_that_of_the_bodies_that_finished[batch-"
BALANCE = "torques/test_energy_balance.py::test_energy_grows_by_the_power_from_outside"

MUTANTS = (
    # the Hamiltonian, its coordinates and the adjoint equations
    Mutant(
        H,
        "(a - h for a, h in zip(momentum, self.rotor_momentum(t)))",
        "(a + h for a, h in zip(momentum, self.rotor_momentum(t)))",
        "the momentum of wheels acts with the wrong sign",
        ("torques/test_rotors.py::test_euler_equation_with_wheels",),
    ),
    Mutant(
        H,
        "twice = twice + 2 * (xy * x * y",
        "twice = twice + (xy * x * y",
        "products of inertia count half",
        ("inertia/test_euler_equation.py",),
    ),
    Mutant(
        H,
        "xy, xz, yz = e * f - c * d, d * f - b * e",
        "xy, xz, yz = c * d - e * f, d * f - b * e",
        "one entry of the inverse inertia has the wrong sign",
        ("inertia/test_euler_equation.py",),
    ),
    Mutant(
        H,
        "return ct * sf * cp + cf * sp, -ct * sf * sp + cf * cp, st * sf",
        "return ct * sf * cp + cf * sp, -ct * sf * sp - cf * cp, st * sf",
        "one entry of the attitude matrix of the Euler angles has the wrong sign",
        ("hamiltonian/test_charts.py::test_attitude_of_angles_and_quaternion_agree",),
    ),
    Mutant(
        FIELD,
        "torques = [cross(rows[i], by_row[i]) for i in rows]",
        "torques = [cross(by_row[i], rows[i]) for i in rows]",
        "the torque of a potential has the wrong sign",
        ("hamiltonian/test_charts.py::test_gravity_gradient_torque_is_three_mu_over_r_cubed",),
    ),
    Mutant(
        FIELD,
        "power = power if potential_torque is None else power - dot(potential_torque, slip)",
        "power = power if potential_torque is None else power + dot(potential_torque, slip)",
        "the power lost by slip against a potential has the wrong sign",
        (f"{BALANCE}[energy sink under gravity]",),
    ),
    Mutant(
        ANGLES,
        "return s * p_theta - c * across, c * p_theta + s * across, p_psi",
        "return s * p_theta - c * across, c * p_theta - s * across, p_psi",
        "the momentum of the canonical coordinates is wrong",
        ("hamiltonian/test_document_000.py::test_twenty_digit_vectors",),
    ),
    Mutant(
        ANGLES,
        "coordinate_rates = angle_rates_from_rates(q, slip), cross(momentum, slip)",
        "coordinate_rates = angle_rates_from_rates(q, slip), cross(slip, momentum)",
        "an energy sink does not keep the momentum in Euler angles",
        ("torques/test_dissipation.py::test_an_energy_sink_keeps_the_momentum_in_euler_angles",),
    ),
    Mutant(
        COSTATE,
        "turn_rate = tuple(a - b for a, b in zip(cross(turn, omega), energy_by_turn))",
        "turn_rate = tuple(a + b for a, b in zip(cross(turn, omega), energy_by_turn))",
        "the adjoint of the attitude ignores the curvature of the potential",
        ("systems/test_systems.py::test_state_and_gradient[planner gravity]",),
    ),
    # rotations and inertia
    Mutant(
        QUATERNION,
        "w * b + z * a - x * c,\n        w * c + x * b - y * a,\n    )",
        "w * b + z * a + x * c,\n        w * c + x * b - y * a,\n    )",
        "the rate of a quaternion is not that of a rotation",
        ("hamiltonian/test_charts.py::test_both_charts_give_the_same_motion",),
    ),
    Mutant(
        MOMENTS,
        "(-second(y, z), -second(z, x), -second(x, y)))",
        "(-second(y, z), second(z, x), -second(x, y)))",
        "a product of inertia of points has the wrong sign",
        ("inertia/test_mass_properties.py::test_points_about_origin_and_about_their_centre",),
    ),
    # closed forms
    Mutant(
        FREE,
        "(l1 * C - k * (polhode.r * l2 * l3) * S * N) * denominator",
        "(l1 * C + k * (polhode.r * l2 * l3) * S * N) * denominator",
        "the momentum of a free body circles the wrong way about one axis",
        ("free/test_free_motion.py::test_states",),
    ),
    Mutant(
        FREE,
        "a = mu * (1 + N) * (1 + y) * (1 + w) + (1 - mu) * (1 + N + y + w)",
        "a = mu * (1 + N) * (1 + y) * (1 + w) + (1 + mu) * (1 + N + y + w)",
        "the addition theorem of the angle about the momentum is wrong",
        ("free/test_free_motion.py::test_states",),
    ),
    Mutant(
        CONSTANTS,
        "half_rate = start_rate + polhode.rate * (polhode.sense * slope - beta / polhode.log_nome)",
        "half_rate = start_rate + polhode.rate * (polhode.sense * slope + beta / polhode.log_nome)",
        "the mean precession of free bodies near the separatrix is wrong",
        ("free/test_free_motion.py::test_states",),
    ),
    Mutant(
        TANGENT,
        "(-S * (S * C + x * N * first) / 2, -x * S * N * second / 2)",
        "(-S * (S * C - x * N * first) / 2, -x * S * N * second / 2)",
        "the derivative of the free motion by its parameters is wrong",
        ("free/test_free_motion.py::test_derivatives",),
    ),
    Mutant(
        PERIODS,
        "drate = jnp.where(\n        permanent,\n        (2 * energy - rate * dlength) / length",
        "drate = jnp.where(\n        permanent,\n        (2 * energy + rate * dlength) / length",
        "derivatives of the period of a permanent rotation are wrong",
        ("free/test_periods.py::test_derivative_of_the_period_of_a_permanent_rotation",),
    ),
    Mutant(
        PERIODS,
        "dP_psi = jnp.where(permanent, unmoved, 4 * dquarter / rate_unit)",
        "dP_psi = jnp.where(permanent, unmoved, 2 * dquarter / rate_unit)",
        "derivatives of the period about the long axis are half",
        ("free/test_periods.py::test_derivatives", "free/test_periods.py"),
    ),
    Mutant(
        ELEMENTARY,
        "phase = phase + (wheel_momentum / transverse)[:, None] * elapsed",
        "phase = phase - (wheel_momentum / transverse)[:, None] * elapsed",
        "the wheel of a symmetric body acts with the wrong sign",
        ("tops/test_elementary_tops.py::test_exact_against_integration",),
    ),
    Mutant(
        ELEMENTARY,
        "* jnp.where(is_small, _series(x, 2)",
        "* jnp.where(is_small, _series(x, 1)",
        "the angle of a weakly damped driven body is twice too large",
        ("tops/test_elementary_tops.py::test_decay_on_both_sides_of_the_series",),
    ),
    Mutant(
        TOP,
        "inverse_tilt = (tilt[0], -tilt[1], -tilt[2])",
        "inverse_tilt = (tilt[0], -tilt[1], tilt[2])",
        "Lagrange's top under gravity in any direction is wrong",
        ("tops/test_lagrange_top.py::test_any_direction_of_gravity_and_wheels_on_the_axis",),
    ),
    Mutant(
        TOP,
        "angle = angle / (size * size)[:, None]",
        "angle = angle / size[:, None]",
        "the derivative of Lagrange's top by a weight that is zero is wrong",
        ("tops/test_at_rest.py::test_bodies_at_rest_among_others",),
    ),
    # orbits, gradients and orbit frames
    Mutant(
        ORBIT,
        "return u * (1 - u * (second - u * (2 * second * second - third)))",
        "return u * (1 - u * (second - u * (second * second - third)))",
        "the last correction of Kepler's equation is of a lower order",
        ("torques/test_kepler_equation.py",),
    ),
    Mutant(
        ORBIT,
        "u, v = cw * along - sw * across, sw * along + cw * across",
        "u, v = cw * along + sw * across, sw * along + cw * across",
        "the argument of periapsis does not rotate the orbit",
        (
            "torques/test_orbit.py::test_an_orbit_through_a_state_is_a_kepler_orbit",
            "torques/test_orbit.py",
        ),
    ),
    Mutant(
        ORBIT,
        "g = (bound * sine + b * turn) / n",
        "g = (bound * sine - b * turn) / n",
        "orbits from a state that is not at an apsis are wrong",
        ("torques/test_kepler_equation.py::test_orbits_by_a_state",),
    ),
    Mutant(
        "_scene/_potentials.py",
        "return -mu / 2 * inverse * inverse * inverse * (trace - 3 * project)",
        "return -mu / 2 * inverse * inverse * inverse * (trace - 2 * project)",
        "the gravity gradient is two thirds of what it is",
        ("hamiltonian/test_charts.py::test_gravity_gradient_torque_is_three_mu_over_r_cubed",),
    ),
    Mutant(
        LVLH,
        "rates = jnp.concatenate([zero, -size / distance**2, yawing], axis=-1)",
        "rates = jnp.concatenate([zero, size / distance**2, yawing], axis=-1)",
        "the local vertical frame rotates the wrong way",
        ("torques/test_orbit_frames.py::test_the_frame_is_where_its_definition_puts_it",),
    ),
    # torques and wheels
    Mutant(
        LAWS,
        "field = 1e-7 * (3 * n * jnp.sum(n * self.moment) - self.moment)",
        "field = 1e-7 * (2 * n * jnp.sum(n * self.moment) - self.moment)",
        "the magnetic field of a dipole is wrong away from its equator",
        ("torques/test_machines.py::test_a_dipole_in_a_field_of_place_and_time",),
    ),
    Mutant(
        LAWS,
        "error = (sign * (a * y - w * x - z) for x, y, z in zip(b, v, b_cross_v))",
        "error = (sign * (a * y - w * x + z) for x, y, z in zip(b, v, b_cross_v))",
        "pointing at a target is wrong for large angles about another axis",
        (
            "torques/test_machines.py::test_pointing_and_rate_damping",
            "torques/test_torques_of_state.py",
        ),
    ),
    Mutant(
        WHEELS,
        "return spin_rate - dot(tuple(self.axes[..., i, k] for k in range(3)), omega)",
        "return spin_rate + dot(tuple(self.axes[..., i, k] for k in range(3)), omega)",
        "the speed of a wheel relative to the body is wrong",
        ("torques/test_rotors.py::test_a_wheel_against_newton",),
    ),
    Mutant(
        WHEELS,
        "parts = [self.axial_momentum(i, t) ** 2 / (2 * self.inertia[..., i]) for i in self.loose]",
        "parts = [self.axial_momentum(i, t) ** 2 / self.inertia[..., i] for i in self.loose]",
        "the energy of wheels counts twice",
        ("torques/test_rotors.py::test_euler_equation_with_wheels",),
    ),
    Mutant(
        WHEELS,
        "return momentum + self.torque[..., i] * (t - self.start)",
        "return momentum - self.torque[..., i] * (t - self.start)",
        "a motor with a constant torque runs the wrong way",
        ("torques/test_rotors.py::test_a_wheel_against_newton",),
    ),
    Mutant(
        LAWS,
        "low = -self.max_torque * jnp.clip(1 + share, 0, 1)",
        "low = -self.max_torque * jnp.clip(1 - share, 0, 1)",
        "the braking torque of a motor falls with its speed",
        ("torques/test_machines.py::test_a_motor_within_its_limits",),
    ),
    # frames and sensors
    Mutant(
        FRAME,
        "_sum(2 * vectors_like(carried, ",
        "_sum(vectors_like(carried, ",
        "the Coriolis acceleration is half",
        ("frames/test_rotating_frame.py::test_transformations_against_differentiated_paths",),
    ),
    Mutant(
        FRAME,
        "return 2 * multiply(conjugate(value), slope)[1:] / jnp.sum(value * value)",
        "return 2 * multiply(slope, conjugate(value))[1:] / jnp.sum(value * value)",
        "the angular velocity of a prescribed attitude is along space axes",
        ("frames/test_rotating_frame.py::test_attitude_as_matrix_or_as_quaternion_of_any_scale",),
    ),
    Mutant(
        "frames/_frame.py",
        "reading = reading + jnp.cross(acceleration, lever)",
        "reading = reading - jnp.cross(acceleration, lever)",
        "the tangential acceleration of an accelerometer has the wrong sign",
        ("frames/test_sensors.py::test_sensors_read_what_a_differentiated_path_tells",),
    ),
    # integration: error control, switches, events and derivatives
    Mutant(
        ITERATION,
        "* options.rtol.astype(error.dtype) * angle / (total_angle * drift)",
        "* options.rtol.astype(error.dtype)",
        "each step may have the error of the whole motion",
        ("solvers/test_switches.py::test_states_through_switches",),
    ),
    Mutant(
        ITERATION,
        "error = error + control.SIXTH_DIFFERENCE * length_of",
        "error = error + 0 * length_of",
        "a step that passes something narrow measures its error by chance",
        (
            "solvers/test_error_control.py"
            "::test_a_wheel_keeps_the_tolerance_through_its_band_of_friction",
        ),
    ),
    Mutant(
        ITERATION,
        "rises = jnp.where(switch.levels[row] > 0, 1, -1) * sign",
        "rises = jnp.where(switch.levels[row] > 0, -1, 1) * sign",
        "the direction of an event is the opposite",
        ("test_events.py::test_events_of_a_simulation_in_order_of_time",),
    ),
    Mutant(
        "_integrate/_switch_location.py",
        "kink = jnp.minimum(LOCATED_KINK * rtol, LOCATED_ROOT * jnp.sqrt(rtol))",
        "kink = LOCATED_ROOT * jnp.sqrt(rtol)",
        "kinks are located to the root of the tolerance, and so are derivatives through them",
        ("solvers/test_switches.py::test_the_gradient_through_a_kink_keeps_a_tight_tolerance",),
    ),
    Mutant(
        CONSTANTS,
        "low = rate - jax.lax.reduce_precision(rate, exponent_bits=8, mantissa_bits=23)",
        "low = 0 * rate",
        "phases in single precision lose eps times the angle",
        ("free/test_free_motion.py::test_single_precision_keeps_its_digits_over_long_times",),
    ),
    Mutant(
        FAILED,
        "nothing = jnp.where(any_finished, 0, jnp.nan)",
        "nothing = jnp.where(any_finished, 0, 0.0)",
        "a gradient of zero where all bodies failed",
        (OTHERS + "kinks, overflow]",),
    ),
    Mutant(
        CHARTS,
        "numbers(jnp.stack(group, axis=-1), 1.0) for group in y",
        "jnp.stack(group, axis=-1) for group in y",
        "a failed body makes the gradient by the moments NaN",
        (OTHERS + "kinks, overflow]",),
    ),
    Mutant(
        FLOW,
        "jnp.where(is_finite, x, r) for x, r in zip(end, state_at_rest)",
        "x for x in end",
        "a failed body makes gradients through a matrix NaN",
        (OTHERS + "steps too short, a matrix]",),
    ),
    Mutant(
        FLOW,
        "(jnp.where(is_finite, x, 0) + zero_or_nan for x in start_costate)",
        "(x + zero_or_nan for x in start_costate)",
        "a failed body makes gradients of a batch NaN",
        (OTHERS + "weight, overflow]",),
    ),
    Mutant(
        STEPS,
        "jnp.where(any_finished, x, jnp.sum(zero_or_nan).astype(x.dtype))",
        "jnp.where(any_finished, x, 0.0)",
        "a gradient of zero where all bodies failed",
        (OTHERS + "kinks, overflow]",),
    ),
    Mutant(
        HELD,
        "is_used = is_defined | ~is_differentiated([wxyz, omega])",
        "is_used = is_defined | True",
        "a command that is not defined makes the gradient of the law NaN",
        (OTHERS + "undefined at a command]",),
    ),
    Mutant(
        ITERATION,
        "snap_time = jnp.where(is_moved, snap_time, 0)",
        "snap_time = jnp.where(is_moved, 0.0, 0)",
        "a switch turns where the field of its other side is undefined",
        ("solvers/test_switches.py::test_roots_of_a_size_that_passes_zero",),
    ),
    Mutant(
        ITERATION,
        "proposed = jnp.where(snaps, snap_time, proposed)",
        "proposed = jnp.where(snaps, guess, proposed)",
        "the first step from a point of infinite slope is long, and derivatives are wrong",
        ("solvers/test_switches.py::test_roots_of_a_size_that_passes_zero",),
    ),
    Mutant(
        STEPS,
        "weight = jnp.sum(cotangent * (rates_after - rates_before), axis=0)",
        "weight = jnp.sum(cotangent * (rates_before - rates_after), axis=0)",
        "the jump of the costate at a switch has the wrong sign",
        ("solvers/test_switches.py::test_a_gradient_through_a_jump",),
    ),
    Mutant(
        LOOP,
        "record = count + 1, with_row(notes, count, note_of(motion, progress))",
        "record = count + 1, with_row(notes, count + 1, note_of(motion, progress))",
        "steps are recorded one place too late",
        ("solvers/test_switches.py::test_a_gradient_through_a_jump",),
    ),
    Mutant(
        STEPS,
        "bars = bars + (h[None] * change)[None] * table[0][i][:, None, None]",
        "bars = bars + (h[None] * change)[None] * table[0][i - 1][:, None, None]",
        "the derivative of a Runge-Kutta step uses the wrong row of its table",
        ("solvers/test_switches.py::test_a_gradient_through_a_jump",),
    ),
    Mutant(
        "_integrate/_explicit_step.py",
        "([rounded, remainder] if remainder.any() else [rounded])",
        "[rounded]",
        "the weights of a Runge-Kutta step are rounded in single precision",
        (
            "solvers/test_switches.py::test_single_precision_turns_no_switch_late_and_rounds_no_weight",
        ),
    ),
    Mutant(
        FOUND,
        "tolerance = 4 * eps * jnp.maximum(1, time_spacing / 16)",
        "tolerance = 4 * eps * jnp.maximum(1, time_spacing)",
        "switches turn late, by a few units of rounding of the time",
        (
            "solvers/test_switches.py::test_single_precision_turns_no_switch_late_and_rounds_no_weight",
        ),
    ),
    Mutant(
        FLOW,
        "dy = [a - dt0 * f for a, f in zip(dy, self.field(c, t0, y))]",
        "dy = [a + dt0 * f for a, f in zip(dy, self.field(c, t0, y))]",
        "the derivative by the first time has the wrong sign",
        ("solvers/test_flow_adjoint.py::test_slopes_by_saved_times_are_the_field",),
    ),
    Mutant(
        "_integrate/_diffrax_solve.py",
        "rows = jnp.where(goes_back, number * parts, number + (number > 0) * between.size)",
        "rows = jnp.where(goes_back, number, number + (number > 0) * between.size)",
        "the gradient of a damped batch is that of an earlier state",
        ("solvers/test_flow_adjoint.py::test_a_damped_batch_is_followed_back",),
    ),
    Mutant(
        FOUND,
        "change = jnp.where(hit, -value(fraction) / margin_rate, 0)",
        "change = jnp.where(hit, value(fraction) / margin_rate, 0)",
        "derivatives by the place of a switch have the wrong sign",
        ("solvers/test_switches.py::test_derivatives_through_a_table[argmax-forward]",),
    ),
    Mutant(
        SEARCH,
        "use, auxiliary = jax.tree.map(lambda x: x[-2], of_passes)",
        "use, auxiliary = jax.tree.map(lambda x: x[-1], of_passes)",
        "events between two samples are those of a pass that did not know their turning points",
        ("test_events.py::test_pairs_of_events_that_no_sample_shows_have_their_states",),
    ),
    Mutant(
        SEARCH,
        "bracket = kernel(_update)(bracket, jnp.where(is_turning, derivatives, values), values)",
        "bracket = kernel(_update)(bracket, values, values)",
        "turning points between two samples are not found",
        ("test_events.py::test_bodies_that_go_either_way_stop_each_at_its_first_event",),
    ),
    Mutant(
        "fit/_solve.py",
        "limit = jnp.where(same_optimum, _BAD, _GOOD) ** 2 * expected",
        "limit = jnp.where(same_optimum, jnp.inf, _GOOD) ** 2 * expected",
        "two starts that end in one local minimum end the search of a fit",
        ("fit/test_fit_recordings.py::test_noisy_attitudes_alone_give_the_body",),
    ),
    Mutant(
        SEARCH,
        "c, d = 3 * jump - 2 * b - b_end, b + b_end - 2 * jump",
        "c, d = 3 * jump + 2 * b - b_end, b + b_end - 2 * jump",
        "tangencies of an event function between two samples are misjudged",
        ("test_events.py::test_intervals_with_a_minimum_near_zero_are_searched",),
    ),
    Mutant(
        PROPAGATE,
        "angles = 2 * rotation.multiply(back, turns)[..., 1:]",
        "angles = rotation.multiply(back, turns)[..., 1:]",
        "the attitude error of a filter is half",
        ("test_propagate.py::test_jacobian_and_noise_are_those_of_the_motion",),
    ),
    # fits and light curves
    Mutant(
        RESIDUALS,
        "omega = omega - delay * slope + delay**2 / 2 * bend",
        "omega = omega - delay * slope - delay**2 / 2 * bend",
        "the delay of a gyroscope is wrong to second order",
        ("fit/test_gyroscope.py::test_a_delayed_gyroscope_fits_its_own_motion",),
    ),
    Mutant(
        RESIDUALS,
        "residual = jnp.where(side > 0, jnp.maximum(residual, 0), residual)",
        "residual = jnp.where(side > 0, jnp.minimum(residual, 0), residual)",
        "saturated readings pull the fit the wrong way",
        ("fit/test_gyroscope.py::test_a_saturated_reading_is_a_bound_beside_errors_of_scale",),
    ),
    Mutant(
        LIGHT,
        "square = (axes**2) @ (normals**2).T",
        "square = axes @ (normals**2).T",
        "the facets of an ellipsoid are those of another body",
        ("lightcurve/test_scattering.py::test_facets_of_ellipsoid_and_of_harmonics",),
    ),
    Mutant(
        LIGHT,
        "(1 - first - second) * c)",
        "(1 - first + second) * c)",
        "the phase function of H, G1, G2 is wrong",
        ("lightcurve/test_phase.py",),
    ),
)


def mutated_text(mutant: Mutant, package: Path = PACKAGE) -> str:
    """The file with its formula changed; ValueError unless it contains ``old`` exactly once."""
    path = package / mutant.file
    if not path.exists():
        raise ValueError(f"{mutant.file} does not exist: name the file that holds {mutant.old!r}")
    text = path.read_text(encoding="utf-8")
    if (count := text.count(mutant.old)) != 1:
        raise ValueError(f"{mutant.file} holds {mutant.old!r} {count} times, expected once")
    return text.replace(mutant.old, mutant.new)


class Outcome(NamedTuple):
    """``state``: killed, survived or not run; ``detail``: the test that failed, or the reason."""

    state: str
    detail: str
    seconds: float = 0.0


def run_tests(source: Path, tests: Sequence[str]) -> tuple[int, str]:
    """Exit status of pytest with the package in ``source``, and the first failed test.

    Of a file only the tests that are not slow run; a test given by name runs in any case.
    """
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:xdist"]
    command += [] if all("::" in test for test in tests) else ["-m", "not slow"]
    command += ["-p", "no:cacheprovider", *(str(ROOT / "tests" / test) for test in tests)]
    environment = os.environ | {"PYTHONPATH": str(source)}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    lines = [x for x in done.stdout.splitlines() if x.startswith(("FAILED", "ERROR"))]
    last = (done.stdout or done.stderr).strip().splitlines()[-1:]
    return done.returncode, (lines or last or [""])[0]


def copied(folder: Path) -> Path:
    """Copy the package to an empty folder; returns its path."""
    shutil.copytree(PACKAGE, folder / "polhode", ignore=shutil.ignore_patterns("__pycache__"))
    return folder


def outcome_of(mutant: Mutant) -> Outcome:
    """Run the tests of a mutant and, if they pass, those of ``WIDER``."""
    begin = time.monotonic()
    try:
        text = mutated_text(mutant)
    except ValueError as error:
        return Outcome("not run", str(error))
    with tempfile.TemporaryDirectory() as folder:
        source = copied(Path(folder))
        (source / "polhode" / mutant.file).write_text(text, encoding="utf-8")
        code, detail = run_tests(source, mutant.tests)
        if code == 0:
            code, detail = run_tests(source, WIDER)
            detail = f"only by the wider tests: {detail}"
    seconds = time.monotonic() - begin
    if code == 0:
        return Outcome("survived", mutant.effect, seconds)
    return Outcome("killed" if code == 1 else "not run", detail, seconds)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--only", nargs="+", default=[], help="words of file, formula or effect")
    parser.add_argument("--jobs", type=int, default=1, help="mutants run at a time")
    parser.add_argument("--unmutated", action="store_true", help="run the tests unchanged")
    options = parser.parse_args()
    if options.unmutated:
        tests = dict.fromkeys(test for mutant in MUTANTS for test in mutant.tests)
        with tempfile.TemporaryDirectory() as folder:
            code, detail = run_tests(copied(Path(folder)), list(tests))
        print(detail)
        return code
    chosen = [m for m in MUTANTS if all(word in " ".join(m[:4]) for word in options.only)]
    if not chosen:
        print("no mutant holds these words")
        return 2
    states = []
    with ThreadPoolExecutor(options.jobs) as pool:
        for mutant, found in zip(chosen, pool.map(outcome_of, chosen)):
            states.append(found.state)
            print(f"{found.state:8} {found.seconds:5.0f} s  {mutant.file:36} {mutant.effect}")
            print(f"{'':18}{found.detail}", flush=True)
    killed = states.count("killed")
    print(f"{killed} of {len(states)} mutants killed, {states.count('survived')} survived")
    return 1 if "survived" in states else 2 if "not run" in states else 0


if __name__ == "__main__":
    sys.exit(main())
