"""Splitting methods under ``LiePoisson``: what they can move, and equal steps between samples."""

from functools import partial

import diffrax
import jax
import jax.numpy as jnp
from jax.interpreters import partial_eval

from polhode._scene import Scene
from polhode.hamiltonian import from_quaternion
from polhode.torques import AbstractTorque


def check_split(method, scene: Scene, record) -> None:
    """Raises ValueError, saying what to do, unless ``Splitting`` can move the scene as asked."""
    name = f"ph.{type(method).__name__}(Splitting(...))"

    def require(good: bool, message: str) -> None:
        if not good:
            raise ValueError(f"{name} {message}")

    require(method.momenta[0], "does not exist: the flows are those of ph.LiePoisson.")
    require(
        method.dt0 is not None
        and (method.controller is None or isinstance(method.controller, diffrax.ConstantStepSize)),
        "has no error estimate: give the longest step, dt0=..., and no controller.",
    )
    require(method.adjoint is not None, "needs a diffrax adjoint: leave adjoint as it is.")
    require(not record.work, "does not integrate the work: drop work=True, or use Extrapolation.")
    require(
        scene.carrier.is_principal,
        "needs principal body axes: state the body in them (Inertia.principal_axes), wheels that"
        " are not held along them.",
    )
    require(
        scene.torque is None or not _depends_on_rates(scene.torque),
        "moves bodies under torques of attitude and time only; for damping and other torques of"
        " the rates use Extrapolation, or leave the method to the library.",
    )
    require(
        scene.rotors is None or method.solver.moser_veselov is None,
        "with moser_veselov moves bodies without rotors: leave it out.",
    )


def _depends_on_rates(torque: AbstractTorque) -> bool:
    one = jnp.ones((1,))

    def push(omega, wxyz):
        return torque.body_components(jnp.zeros(()), from_quaternion(wxyz), omega)

    with jax.numpy_dtype_promotion("standard"):
        jaxpr = jax.make_jaxpr(push)((one,) * 3, (one,) * 4).jaxpr
    _, used = partial_eval.dce_jaxpr(jaxpr, [True] * len(jaxpr.outvars))
    return any(used[:3])


def equally(solve, field, args, longest, ts, y0, final_only):
    """Samples (components, N, T), last state, result and steps: from each time to the next in
    equal steps no longer than ``longest``."""
    times = ts[jnp.array([0, -1])] if final_only else ts
    good = diffrax.RESULTS.successful
    solve = partial(solve, diffrax.ODETerm(field), args=args)
    control = diffrax.ConstantStepSize()

    def across(carry, interval):
        y, result, steps = carry
        start, end = interval
        end = jnp.where(result == good, end, start)
        count = jnp.ceil(abs(end - start) / abs(longest) * (1 - 8 * jnp.finfo(times.dtype).eps))
        width = (end - start) / jnp.maximum(count, 1)
        solution = solve(t0=start, t1=end, dt0=width, y0=y, stepsize_controller=control)
        result = diffrax.RESULTS.where(result == good, solution.result, result)
        new = jax.tree.map(lambda x: jnp.where(result == good, x[-1], jnp.nan), solution.ys)
        return (new, result, steps + solution.stats["num_steps"]), new

    (_, result, steps), path = jax.lax.scan(
        across, (y0, good, jnp.array(0)), (times[:-1], times[1:])
    )
    path = jnp.stack(
        [jnp.concatenate([a[None], b]) for a, b in zip(*map(jax.tree.leaves, (y0, path)))]
    )
    path = jnp.moveaxis(path, 1, -1)
    return path[..., -1:] if final_only else path, path[..., -1:], result, steps
