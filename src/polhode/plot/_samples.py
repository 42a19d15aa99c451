"""Common parts of the figures: style, samples as NumPy arrays, units of time and rates."""

import dataclasses
import functools
from typing import NamedTuple, Self

import numpy as np
from jaxtyping import Float

from polhode._checks import ArrayLike
from polhode._extras import imported
from polhode._trajectory import Trajectory
from polhode.inertia import Inertia
from polhode.rotation._quaternion import matrix_row

X, Y, Z = "#D55E00", "#009E73", "#0072B2"  # body or space axes; safe for colour-blind readers
AXES = (X, Y, Z)
INK, GREY, PAPER, ACCENT = "#222222", "#8A8A8A", "#FFFFFF", "#C2185B"
STYLE = {
    "font.size": 9.5,
    "axes.titlesize": 10.5,
    "axes.titlelocation": "left",
    "axes.titleweight": "bold",
    "axes.labelsize": 9.5,
    "axes.edgecolor": "#666666",
    "axes.linewidth": 0.8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#E3E3E3",
    "grid.linewidth": 0.7,
    "axes.axisbelow": True,
    "xtick.color": "#444444",
    "ytick.color": "#444444",
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "lines.linewidth": 1.4,
    "lines.solid_capstyle": "round",
    "figure.facecolor": PAPER,
    "savefig.dpi": 160,
}


def styled(function):
    """Decorator: run a plotting function with the common style, without changing user settings."""

    @functools.wraps(function)
    def wrapper(*args, **kwargs):
        with imported("a figure", "matplotlib", extra="plot").rc_context(STYLE):
            return function(*args, **kwargs)

    return wrapper


def plain(text: str, length: int = 120) -> str:
    """A user's text for literal display: `$` and control characters are escaped."""
    from polhode.files._read import escape

    text = escape(text)
    text = text if len(text) <= length else text[: length - 4] + " ..."
    return text.replace("$", r"\$")


def new_figure(width: float, height: float):
    """A pyplot figure, which notebooks show automatically."""
    import matplotlib.pyplot as plt

    return plt.figure(figsize=(width, height), layout="constrained")


_DEGREE = np.pi / 180


class Scale(NamedTuple):
    """Names of the units of time and rate in a figure, and their size in s and rad/s."""

    time: str = "s"
    seconds: float = 1.0
    rate: str = "rad/s"
    radians_per_second: float = 1.0

    @classmethod
    def of(cls, seconds: float) -> Self:
        """Units that suit a motion of this duration."""
        if abs(seconds) > 3 * 86400:
            return cls("day", 86400.0, "deg/day", _DEGREE / 86400)
        if abs(seconds) > 3 * 3600:
            return cls("h", 3600.0, "deg/h", _DEGREE / 3600)
        return cls()


@dataclasses.dataclass(frozen=True)
class Samples:
    """Samples of N bodies: ts (N, T), wxyz (N, T, 4), omega_body (N, T, 3), tensor (N, 3, 3).

    `wxyz`, `tensor` and `energy` (N, T) may be None: plots that need them raise ValueError.
    `momentum` (N, T, 3): body and wheels, in body axes; None: `tensor` times the rates.
    """

    ts: np.ndarray
    omega_body: np.ndarray
    wxyz: np.ndarray | None = None
    tensor: np.ndarray | None = None
    energy: np.ndarray | None = None
    momentum: np.ndarray | None = None

    def need(self, name: str, what: str) -> np.ndarray:
        """The array ``name``; ValueError where it is missing, for a plot of ``what``."""
        value = getattr(self, name)
        if value is None:
            remedy = "inertia" if name in ("tensor", "energy") else name
            raise ValueError(
                f"plotting {what} needs {remedy}, which was not given: pass it to plot.samples, or "
                "plot a Trajectory that recorded attitude and rates, of a body of constant inertia."
            )
        return value

    @property
    def count(self) -> int:
        """Number of bodies."""
        return self.omega_body.shape[0]

    @property
    def momentum_body(self) -> np.ndarray:
        """Angular momentum (N, T, 3) in body axes, wheels included [kg m^2/s]."""
        if self.momentum is not None:
            return self.momentum
        tensor = self.need("tensor", "the angular momentum")
        return np.einsum("nij,ntj->nti", tensor, self.omega_body)

    @property
    def matrices(self) -> np.ndarray:
        """R (N, T, 3, 3), body -> space: column k is body axis k in space."""
        return matrices(self.need("wxyz", "the attitude"))

    @property
    def momentum_space(self) -> np.ndarray:
        """Angular momentum (N, T, 3) in space axes [kg m^2/s]."""
        return np.einsum("ntij,ntj->nti", self.matrices, self.momentum_body)


def samples(
    ts: Float[ArrayLike, "*#b t"],
    omega_body: Float[ArrayLike, "*#b t 3"],
    wxyz: Float[ArrayLike, "*#b t 4"] | None = None,
    inertia: Inertia | None = None,
) -> Samples:
    """Arrays to plot: times (..., T) s, body rates (..., T, 3) rad/s, attitudes (..., T, 4).

    Leading axes are flattened to one axis of bodies; quaternions are normalised. Raises ValueError
    for shapes that do not fit together.
    """
    omega = np.asarray(omega_body, np.float64)
    if omega.ndim < 2 or omega.shape[-1] != 3:
        raise ValueError(f"omega_body must have shape (..., T, 3), got {omega.shape}.")
    if omega.size == 0:
        raise ValueError(
            f"a figure needs one body and one sample or more, got rates of shape {omega.shape}."
        )
    lead, samples = omega.shape[:-2], omega.shape[-2]

    def flat(name, value, core):
        value = np.asarray(value, np.float64)
        if value.shape[value.ndim - len(core) :] != core:
            shape = ", ".join(map(str, core))
            raise ValueError(f"{name} must have shape (..., {shape}), got {value.shape}.")
        return np.broadcast_to(value, lead + core).reshape(-1, *core)

    energy = tensor = None
    if inertia is not None:
        tensor = flat("inertia", inertia.tensor, (3, 3))
        energy = (
            np.einsum(
                "nti,nij,ntj->nt",
                omega.reshape(-1, samples, 3),
                tensor,
                omega.reshape(-1, samples, 3),
            )
            / 2
        )
    attitudes = None
    if wxyz is not None:
        attitudes = flat("wxyz", wxyz, (samples, 4))
        with np.errstate(invalid="ignore"):  # zeros in place of a missing attitude become NaN
            attitudes = attitudes / np.linalg.norm(attitudes, axis=-1, keepdims=True)
    return Samples(
        flat("ts", ts, (samples,)),
        omega.reshape(-1, samples, 3),
        attitudes,
        tensor,
        energy,
    )


def as_samples(what: Trajectory | Samples) -> Samples:
    """The samples of a trajectory; samples unchanged."""
    if isinstance(what, Samples):
        return what
    if not isinstance(what, Trajectory):
        raise TypeError(
            f"expected a ph.Trajectory or a plot.samples(...), got {type(what).__name__}."
        )
    inertia = what.scene.inertia  # a variable inertia has no single ellipsoid to draw
    constant = inertia if isinstance(inertia, Inertia) else None
    result = samples(what.ts, what.omega_body, inertia=constant)
    has_energy = what.scene.potential is None or what._wxyz is not None
    energy = np.asarray(what.energy, np.float64).reshape(result.ts.shape) if has_energy else None
    momentum = None
    if what.scene.rotors is not None or constant is None:
        momentum = np.asarray(what.momentum_body, np.float64).reshape(result.omega_body.shape)
    wxyz = what._wxyz
    if wxyz is not None:  # as they are, without normalisation
        wxyz = np.asarray(wxyz, np.float64).reshape(*result.ts.shape, 4)
    return dataclasses.replace(result, wxyz=wxyz, energy=energy, momentum=momentum)


def pick(what: Trajectory | Samples, body: int | None) -> tuple[Samples, int]:
    """The samples, and the index of the body to plot (over flattened batch axes)."""
    result = as_samples(what)
    body = 0 if body is None else body
    if not (isinstance(body, int | np.integer) and -result.count <= body < result.count):
        raise ValueError(
            f"body must be a whole number below that of the bodies, {result.count}, got {body!r}."
        )
    return result, body % result.count


def box_sides(moments: np.ndarray) -> np.ndarray:
    """Sides (3,) of the homogeneous box with these moments, scaled to a diagonal of 1."""
    second = np.clip(moments.sum() / 2 - moments, 0, None)
    return np.maximum(np.sqrt(second / second.sum()), 0.02)  # a flat body is a thin plate


def matrices(wxyz: np.ndarray) -> np.ndarray:
    """Rotation matrices (..., 3, 3) of unit quaternions (..., 4)."""
    q = tuple(np.moveaxis(wxyz, -1, 0))
    return np.stack([np.stack(matrix_row(q, i), axis=-1) for i in range(3)], axis=-2)
