"""What a scene file says, checked, in SI units, as plain numpy: nothing here needs JAX."""

import dataclasses
import datetime
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from polhode.io._batches import Statistic
from polhode.io._models import Method, Output


@dataclasses.dataclass(frozen=True)
class Part:
    """One kind of thing with its numbers: an inertia, a potential, a torque, a rotor."""

    kind: str
    values: Mapping[str, object]
    where: str


@dataclasses.dataclass(frozen=True)
class Attitudes:
    """Attitudes as the file gives them: quaternions (..., 4), or Euler angles (..., 3) in rad.

    R = R_a(angle 1) R_b(angle 2) R_c(angle 3) for the letters abc of `sequence` (None: quaternions
    `wxyz`, not yet normalised), body -> space.
    """

    values: np.ndarray
    sequence: str | None = None


@dataclasses.dataclass(frozen=True)
class InitialState:
    """Attitude, and rates or momentum (`rate` says which), at the first time."""

    attitude: Attitudes
    rate: str
    value: np.ndarray


@dataclasses.dataclass(frozen=True)
class Times:
    """Sample times, s, with the unit used in tables and figures."""

    seconds: np.ndarray
    unit: str
    unit_seconds: float


@dataclasses.dataclass(frozen=True)
class Spread:
    """Standard deviation of one quantity in the Monte Carlo batch, SI, and where it comes from."""

    quantity: str
    sigma: np.ndarray
    source: str


@dataclasses.dataclass(frozen=True)
class MonteCarlo:
    clones: int
    seed: int
    spreads: tuple[Spread, ...]


@dataclasses.dataclass(frozen=True)
class Draw:
    """How one quantity of an ensemble is drawn: deviates of `scale` (3,), SI, normal or uniform;
    scale None: every attitude alike.
    """

    quantity: str
    scale: np.ndarray | None
    uniform: bool


@dataclasses.dataclass(frozen=True)
class EnsemblePlan:
    bodies: int
    seed: int
    trajectories: bool
    draws: tuple[Draw, ...]
    statistics: tuple[Statistic, ...]
    rows: Mapping[str, np.ndarray] = dataclasses.field(default_factory=dict)


@dataclasses.dataclass(frozen=True)
class PublishedValue:
    """A published number to print beside ours, SI; `uncertainty` may be absent."""

    name: str
    value: float
    uncertainty: float | None
    source: str


@dataclasses.dataclass(frozen=True)
class Observations:
    """Attitudes and body rates (n, 3) observed at n times (s); NaN where a row has none."""

    seconds: np.ndarray
    attitudes: Attitudes
    omega_body: np.ndarray
    source: str


@dataclasses.dataclass(frozen=True)
class SceneFile:
    """A whole scene file with the `text` it was read from; `read_scene` makes it."""

    path: Path
    text: str
    title: str
    source: str
    epoch: datetime.datetime | None
    frame: str
    axis_names: tuple[str, str, str]
    inertia: Part
    relative_moments: bool
    state: InitialState
    times: Times
    potentials: tuple[Part, ...]
    torques: tuple[Part, ...]
    rotors: tuple[Part, ...]
    method: Method
    monte_carlo: MonteCarlo | None
    published: tuple[PublishedValue, ...]
    observations: Observations | None
    output: Output
    ensemble: EnsemblePlan | None = None
