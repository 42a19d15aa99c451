"""``fit_scene``: any arrays of a scene from recordings of its motion."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from polhode._batch import PARTS, batch_shapes
from polhode._checks import ArrayLike, as_float_array, require, require_positive
from polhode._method import AbstractMethod
from polhode._scene import Scene
from polhode._scene._scene import places_of
from polhode.fit._fit import each, together
from polhode.fit._options import FitOptions, check_usable, checked_options
from polhode.fit._parameters import NoInertia
from polhode.fit._recording import Recording, stack
from polhode.fit._result import Fit, checked_fit, conclude_scene
from polhode.fit._scene_motion import LeafMotion


def fit_scene(
    scene: Scene,
    data: Recording | Sequence[Recording],
    free: Callable[[Any], Any],
    *,
    bounds: Sequence[tuple[ArrayLike | None, ArrayLike | None] | None] | None = None,
    prior_std: Sequence[ArrayLike | None] | None = None,
    attitude: ArrayLike | None = None,
    method: AbstractMethod | None = None,
    rtol: float | None = None,
    options: FitOptions | None = None,
    throw: bool = True,
) -> Fit:
    """Numbers of a scene, with standard deviations, from recordings of its motion.

    **Arguments:**

    - ``scene``: with starting values, one body.
    - ``data``: a ``ph.fit.Recording``, whose leading axes are bodies that are fitted one by one; or
      a list of recordings of the same body.
    - ``free``: function of the scene that returns the array or the list of arrays to fit (of a
      part: all its arrays). The initial rates of each recording, and its initial attitude where
      attitudes were recorded, are always fitted too.
    - ``bounds``: for each array of ``free`` a pair of its lower and upper bound, numbers or arrays
      of its shape, None where there is none; None in place of a pair: no bounds. The starting
      values must lie between them. ``[(0.0, None)]`` keeps a coefficient positive.
    - ``prior_std``: for each array of ``free`` the standard deviation of a normal prior about its
      starting value, a number or an array of its shape, or None.
    - ``attitude`` (4,): initial attitude ``wxyz``, for recordings without attitudes; None: the
      body axes are those of space at the first time.
    - ``method``, ``rtol``: as in ``ph.simulate``.
    - ``options``: ``FitOptions`` of which ``robust``, ``bias``, ``trust_noise``, ``max_starts``
      (2 at most: all data, then growing parts of them), ``solver`` and ``max_steps`` apply.
    - ``throw``: whether a fit that is not finite or stopped early raises FitError.

    Returns a ``Fit``: ``values`` and ``std`` in the order of ``free``, ``scene`` with the values.
    Numbers without bounds are not constrained: a coefficient may become negative. For an unknown
    inertia use ``fit_inertia``, which needs no starting point and keeps it physical.

        ts = jnp.linspace(0.0, 20.0, 200)
        scene = ph.Scene(ph.Inertia.from_moments([1.0, 2.0, 2.5]), torque=ph.LinearDamping(0.1))
        data = ph.fit.Recording.of(ts, rates, omega_noise=0.01)
        options = ph.fit.FitOptions(trust_noise=True)
        fit = ph.fit_scene(scene, data, free=lambda s: [s.torque.c], options=options)
        print(fit.report())                              # fit.values[0], fit.std[0]: (3,)

    Raises TypeError or ValueError for bad input and for options that do not apply, and FitError.
    """
    _check_single(scene)
    options = checked_options(options)
    for name in ("motion", "unknown", "initial_inertia"):
        require(
            getattr(options, name) is None,
            f"fit_scene has no use for the option {name}: the scene is the model, and free selects"
            " what is unknown.",
        )
    require(
        not options.mounting,
        "fit_scene does not fit a mounting: rotate the rates into the axes of the scene, or use"
        " fit_inertia with motion=SceneMotion(...).",
    )
    recordings = [data] if isinstance(data, Recording) else data
    if not (
        isinstance(recordings, list | tuple)
        and recordings
        and all(isinstance(one, Recording) for one in recordings)
    ):
        raise TypeError(
            "data must be a ph.fit.Recording (ph.fit.Recording.of(times, omega_body, ...)) or a"
            f" list of them, got {type(data).__name__}."
        )
    for one in recordings:
        require(
            one.wheel is None,
            "fit_scene does not read wheel_speed: describe the wheel by rotors of the scene"
            " (ph.Rotor), and leave wheel_speed out of the recording.",
        )
        require(
            one.force is None,
            "fit_scene does not model accelerometer readings: leave force_body out.",
        )
        require(
            attitude is None or one.wxyz is None,
            "attitude is for recordings without attitudes; these have wxyz, whose first one is"
            " fitted.",
        )
    check_usable(options, recordings[0])
    places = places_of(scene, free)
    starts = [jax.tree.leaves(scene)[i] for i in places]
    motion = LeafMotion(
        scene,
        places,
        _start(attitude, scene),
        method,
        rtol,
        None if bounds is None else _bounds(bounds, starts),
        None if prior_std is None else _widths(prior_std, starts),
    )
    options = dataclasses.replace(options, motion=motion, unknown=NoInertia())
    if isinstance(data, Recording):
        return checked_fit(each(data, options, conclude_scene), throw)
    return checked_fit(together(stack(recordings), options, conclude_scene), throw)


def _bounds(bounds: Sequence, starts: Sequence[Array]) -> tuple[tuple[Array, Array] | None, ...]:
    _check_count("bounds", bounds, starts)
    found = []
    for k, (pair, start) in enumerate(zip(bounds, starts, strict=True)):
        if pair is None:
            found.append(None)
            continue
        if not (isinstance(pair, tuple | list) and len(pair) == 2):
            raise TypeError(f"bounds[{k}] must be a pair (lower, upper) or None, got {pair!r}.")
        ends = [
            jnp.full(start.shape, sign * jnp.inf, start.dtype)
            if end is None
            else jnp.broadcast_to(jnp.asarray(end, start.dtype), start.shape)
            for end, sign in zip(pair, (-1, 1), strict=True)
        ]
        inside = (ends[0] < start) & (start < ends[1])
        require(
            np.asarray(inside),
            f"the starting values of array {k} must lie between their bounds, got"
            f" {np.asarray(start)} for {pair}.",
        )
        found.append((ends[0], ends[1]))
    return tuple(found)


def _widths(prior_std: Sequence, starts: Sequence[Array]) -> tuple[Array | None, ...]:
    _check_count("prior_std", prior_std, starts)
    found = []
    for k, (std, start) in enumerate(zip(prior_std, starts, strict=True)):
        if std is None:
            found.append(None)
            continue
        require_positive(f"prior_std[{k}]", std, hint="None stands for no prior")
        found.append(jnp.broadcast_to(jnp.asarray(std, start.dtype), start.shape))
    return tuple(found)


def _check_count(name: str, given: Sequence, starts: Sequence[Array]) -> None:
    require(
        isinstance(given, list | tuple) and len(given) == len(starts),
        f"{name} must be a list with one entry for each of the {len(starts)} arrays of free.",
    )


def _start(attitude: ArrayLike | None, scene: Scene) -> Array | None:
    if attitude is None:
        return None
    return as_float_array("attitude", attitude, (4,)).astype(scene.inertia.dtype)


def _check_single(scene: Any) -> None:
    """TypeError or ValueError for what is not the scene of one body."""
    if not isinstance(scene, Scene):
        raise TypeError(f"scene must be a ph.Scene, got {type(scene).__name__}.")
    shapes = [shape for name in PARTS for shape in batch_shapes(getattr(scene, name))]
    if any(shapes):
        raise ValueError(
            f"the scene of a fit is that of one body, got parts with the batch axes {max(shapes)}:"
            " give one body's numbers as the start; a batch is in the recording."
        )
