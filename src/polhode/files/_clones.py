"""The Monte Carlo batch of a scene file: the nominal body and clones drawn around it."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import DTypeLike

import polhode
from polhode import rotation
from polhode.files._arrays import possible_moments
from polhode.files._bodies import Attitudes
from polhode.files._build import build_attitudes, build_inertia, build_state
from polhode.files._error import SceneFileError
from polhode.files._models import SceneFile
from polhode.inertia import Inertia

_MOST_ROUNDS = 100


class Clones(NamedTuple):
    """A batch of bodies, the nominal one first; `redrawn` draws had moments that no body has."""

    inertia: Inertia
    state: "polhode.State"
    redrawn: int


def draw_clones(file: SceneFile, dtype: DTypeLike) -> Clones:
    """The nominal body followed by the clones of [monte_carlo], drawn in float64 from its seed.

    Every quantity has its own stream of random numbers, so that adding a spread for one does not
    change the draws of the others. Moments that break the triangle inequality are drawn again.
    Raises SceneFileError when nearly all draws are impossible.
    """
    plan = file.monte_carlo
    nominal = build_inertia(file, dtype)
    if plan is None:
        return Clones(nominal, build_state(file, dtype, nominal), 0)
    noise = {
        name: _Noise(plan.seed, name, np.array(table.sigma)) for name, table in plan.spreads.items()
    }
    count, redrawn, inertia = plan.clones, 0, nominal
    if "moments" in noise:
        moments = np.asarray(file.inertia.moments, np.float64)
        drawn, redrawn = _draw_moments(file, moments, noise["moments"], count)
        inertia = Inertia.from_moments(np.concatenate([moments[None], drawn]).astype(dtype))
    attitude = file.state.attitude
    if "euler" in noise:
        angles = _around(np.array(attitude.values), noise["euler"], count)
        attitude = Attitudes(angles, attitude.sequence)
    wxyz = build_attitudes(attitude, dtype)
    if "attitude" in noise:
        turns = jnp.asarray(_around(np.zeros(3), noise["attitude"], count), dtype)
        wxyz = rotation.multiply(jnp.broadcast_to(wxyz, (count + 1, 4)),
                                 rotation.rotation_vector_to_wxyz(turns))  # fmt: skip
    rates = np.array(file.state.value)
    if file.state.rate in noise:
        rates = _around(rates, noise[file.state.rate], count)
    rates = jnp.broadcast_to(rates.astype(dtype), (count + 1, 3))
    omega = inertia.rates(rates) if file.state.rate == "momentum_body" else rates
    return Clones(inertia, polhode.State(wxyz=wxyz, omega_body=omega), redrawn)


class _Noise:
    """Normal deviates of one quantity."""

    def __init__(self, seed: int, quantity: str, sigma: np.ndarray):
        label = int.from_bytes(quantity.encode(), "big")
        self.stream, self.sigma = np.random.default_rng([seed, label]), sigma

    def __call__(self, count: int) -> np.ndarray:
        return self.sigma * self.stream.standard_normal((count, 3))


def _around(value: np.ndarray, noise: _Noise, count: int) -> np.ndarray:
    """(count + 1, 3): the value itself, then draws around it."""
    return np.concatenate([value[None], value + noise(count)])


def _draw_moments(file: SceneFile, moments: np.ndarray, noise: _Noise, count: int):
    kept, drawn, refused = np.empty((0, 3)), 0, 0
    for _ in range(_MOST_ROUNDS):
        fresh = moments * (1 + noise(count))
        drawn += count
        possible = possible_moments(fresh)
        refused += int((~possible).sum())
        kept = np.concatenate([kept, fresh[possible]])
        if len(kept) >= count:
            break
    else:
        raise SceneFileError(
            file.path, "[monte_carlo.moments] relative_sigma", "impossible moments",
            f"{len(kept)} of {drawn} draws around {moments} are moments of a body",
            "a spread that keeps most draws positive and within the triangle inequality",
            "make relative_sigma smaller",
        )  # fmt: skip
    return kept[:count], refused
