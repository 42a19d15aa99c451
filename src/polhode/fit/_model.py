"""The model of a fit: its unknowns, and the motions that they give."""

import abc
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Float

from polhode._closed_forms._free import free_motion
from polhode._hamiltonian import (
    Attitude,
    Dynamics,
    Hamiltonian,
    components,
    inverse_inertia,
    lie_poisson_field,
    momentum_rate,
)
from polhode._hamiltonian._energy import from_rows
from polhode._integrate import LiePoisson
from polhode._method import AbstractMethod
from polhode._scene import AbstractTorque, LinearDamping, QuadraticDamping, Scene, State, Table
from polhode._simulate import simulate
from polhode.fit._numerics import ClassicalRungeKutta, inverse, to_bounded, to_unbounded
from polhode.frames import gyroscope
from polhode.inertia import Inertia, inertia_of_second_moments, principal
from polhode.inertia._physical import symmetric
from polhode.rotation import conjugate, multiply, normalise, rotate, wxyz_to_matrix

# Unconstrained unknowns of a fit, and the body that they describe.

# Eigenvalues of the second moments below about this fraction of their sum: a nearly flat body.
_SOFT = 5e-3


def entries_of(tensor: Float[Array, "3 3"], count: int = 6) -> Float[Array, " e"]:
    """The first ``count`` (0, 3 or 6) entries of a tensor in the order xx, yy, zz, yz, zx, xy."""
    a, b, c = tensor[0, 0], tensor[1, 1], tensor[2, 2]
    return jnp.stack([a, b, c, tensor[1, 2], tensor[2, 0], tensor[0, 1]])[:count]


def whole_of(entries: Float[Array, " e"], count: int = 6) -> Float[Array, "3 3"]:
    """The tensor with these ``count`` (3 or 6) entries; three entries: zero products.

    With no entries it is the identity, for motions that ignore the tensor.
    """
    if count == 0:
        return jnp.eye(3, dtype=entries.dtype)
    return symmetric(entries[:3], entries[3:6] if count == 6 else jnp.zeros_like(entries[:3]))


def is_nearly_flat(tensor: Float[Array, "3 3"], moments: Float[Array, " 3"]) -> Array:
    """Whether the smallest second moment is nearly zero; ``moments``: ascending."""
    trace = tensor[0, 0] + tensor[1, 1] + tensor[2, 2]
    return trace / 2 - moments[2] < 1e-4 * trace


class Parameters(eqx.Module):
    """Unconstrained unknowns of one body and its recordings (None: not fitted).

    **Fields:** ``shape`` (k,): coordinates of the inertia tensor, zero at the starting body;
    ``omega`` (r, 3), rad/s: rates at the first time of each recording; ``attitude`` (r, 3), rad:
    rotation vector (body axes) from the first recorded attitude to the initial one; ``bias`` (3,),
    rad/s, of the readings, added to the calibrated one; ``mounting`` (3,), rad: rotation vector of
    the sensor axes; ``lever`` (3,), m: accelerometer position from the centre of mass; ``motion``:
    the motion's own unknowns; ``gain`` (9,): errors of the gyroscope's gain matrix relative to the
    calibrated one, row by row; ``delay``, s, of the readings, added to the calibrated one; ``walk``
    (r, k, 3), rad/s: changes of the bias over each of k equal parts of a recording.
    """

    shape: Float[Array, " k"]
    omega: Float[Array, "r 3"]
    attitude: Float[Array, "r 3"] | None = None
    bias: Float[Array, " 3"] | None = None
    mounting: Float[Array, " 3"] | None = None
    lever: Float[Array, " 3"] | None = None
    motion: Any = None
    gain: Float[Array, " 9"] | None = None
    delay: Float[Array, ""] | None = None
    walk: Float[Array, "r k 3"] | None = None


class AbstractInertiaUnknown(eqx.Module):
    """Which directions of the inertia tensor are unknown."""

    @abc.abstractmethod
    def columns(self) -> np.ndarray:
        """Unknown directions (6, k), orthonormal, of six entries (three diagonal ones first)."""


class FullTensor(AbstractInertiaUnknown):
    """Any tensor in sensor axes: six numbers, of which torque-free rates determine five."""

    def columns(self) -> np.ndarray:
        return np.eye(6)


class MomentsOnly(AbstractInertiaUnknown):
    """Sensor axes are principal axes: three numbers, of which torque-free rates determine two."""

    def columns(self) -> np.ndarray:
        return np.eye(6)[:, :3]


class NoInertia(AbstractInertiaUnknown):
    """The inertia is known, or belongs to the unknowns of the motion."""

    def columns(self) -> np.ndarray:
        return np.zeros((6, 0))


# Direction of the trace. It is fixed where the data determine the ratios of the moments only.
SCALE = np.array([1, 1, 1, 0, 0, 0]) / np.sqrt(3)


def free_columns(unknown: AbstractInertiaUnknown, scale_known: bool) -> np.ndarray:
    """Directions that the data can determine: all, or those orthogonal to ``SCALE``."""
    columns = unknown.columns()
    if scale_known:
        return columns
    flat = columns - np.outer(SCALE, SCALE @ columns)
    basis, size, _ = np.linalg.svd(flat, full_matrices=False)
    return basis[:, size > 0.5]


class Base(NamedTuple):
    """Origin of the coordinates ``Parameters.shape``.

    ``entries`` (6,): of a symmetric matrix S (diagonal, then yz, zx, xy), kg m^2; ``soft``, kg m^2:
    eigenvalues of S below about this size are mapped to larger, positive second moments.
    """

    entries: Float[Array, " 6"]
    soft: Float[Array, ""]


def base_of(sigma: Float[Array, "3 3"], scale_known: bool) -> Base:
    """The base whose tensor at ``shape = 0`` has second moments ``sigma``, up to a factor."""
    total = sigma[0, 0] + sigma[1, 1] + sigma[2, 2]
    if not scale_known:
        sigma, total = sigma / total, jnp.ones_like(total)
    soft = _SOFT * total
    matrix = sigma - soft**2 / 4 * inverse(sigma)
    return Base(entries_of(matrix), soft)


def tensor_of(shape: Float[Array, " k"], base: Base, columns: np.ndarray) -> Array:
    """Inertia tensor (3, 3) at ``shape``: physical for any real numbers.

    Second moments ``(S + sqrt(S^2 + soft^2)) / 2`` of a symmetric matrix S that is linear in
    ``shape``. Away from flat bodies they equal S, so a direction that the data do not determine is
    a straight valley of the misfit. In the entries of a Cholesky factor it would be a curved one,
    which forces an optimiser to short steps. As an eigenvalue of S goes to minus infinity the body
    becomes flat.
    """
    scale = base.soft / _SOFT
    y = base.entries + scale * jnp.sum(jnp.asarray(columns, shape.dtype) * shape[None], axis=1)
    values, axes, (yz, zx, xy) = principal(whole_of(y))
    root = jnp.sqrt(values**2 + base.soft**2)
    # the second form avoids cancellation for negative eigenvalues
    positive = jnp.where(values > 0, (values + root) / 2, base.soft**2 / (2 * (root - values)))

    def slope(i, j):
        # Divided difference of ``positive``. The products that it multiplies are zero; their
        # tangents are those of the rotating principal axes.
        return (1 + (values[i] + values[j]) / (root[i] + root[j])) / 2

    body_moments = symmetric(positive, (slope(1, 2) * yz, slope(2, 0) * zx, slope(0, 1) * xy))
    turn = wxyz_to_matrix(axes)
    exact = jax.lax.Precision.HIGHEST
    sigma = jnp.einsum("ij,jk,lk->il", turn, body_moments, turn, precision=exact)
    return inertia_of_second_moments(sigma)


# Motions: predictions of rates and attitudes from the first sample and the unknowns.


class Predicted(NamedTuple):
    """Body rates, their derivatives (None: unknown or not needed), attitudes (None: not needed)."""

    omega: Float[Array, "t 3"]
    omega_dot: Float[Array, "t 3"] | None
    wxyz: Float[Array, "t 4"] | None


class AbstractMotion(eqx.Module):
    """Model of the motion of one body in one recording, from initial rates (and attitude)."""

    @abc.abstractmethod
    def start(self) -> Any:
        """Starting values (a pytree of arrays) of this motion's unknowns; None: it has none."""

    @abc.abstractmethod
    def fixes_scale(self) -> bool:
        """Whether rates alone depend on the absolute size of the inertia (static)."""

    @property
    def has_bounds(self) -> bool:
        """Whether ``bounded`` differs from the identity."""
        return False

    def bounded(self, unknown: Any) -> Any:
        """Values of the motion's unknowns, within their bounds, from unconstrained numbers."""
        return unknown

    def unbounded(self, values: Any) -> Any:
        """The inverse of ``bounded``."""
        return values

    def at_bound(self, values: Any) -> Array:
        """Whether an unknown is at its bound."""
        return jnp.asarray(False)

    def prior_std(self) -> list[Array | None]:
        """Standard deviations of normal priors about the start, one for each unknown leaf."""
        return [None for _ in jax.tree.leaves(self.start())]

    @property
    def entry_counts(self) -> list[int | None]:
        """Number of entries of each unknown symmetric tensor, None for other arrays (static)."""
        return [None for _ in jax.tree.leaves(self.start())]

    def arrays_of(self, unknown: Any) -> list[Array]:
        """The unknown arrays: of symmetric tensors all nine components."""
        pairs = zip(jax.tree.leaves(unknown), self.entry_counts, strict=True)
        return [x if n is None else whole_of(x, n) for x, n in pairs]

    @property
    def scales(self) -> bool:
        """Whether ``over`` is implemented for the unknowns of this motion."""
        return not jax.tree.leaves(self.start())

    def over(self, unknown: Any, size: Array) -> Any:
        """The unknowns that give the same motion with an inertia divided by ``size``; linear in
        ``unknown``."""
        return unknown

    @abc.abstractmethod
    def __call__(
        self,
        tensor: Float[Array, "3 3"],
        omega: Float[Array, " 3"],
        wxyz: Float[Array, " 4"] | None,
        times: Float[Array, " t"],
        wheel: Float[Array, " t"] | None,
        unknown: Any,
        acceleration: bool = True,
    ) -> Predicted:
        """Motion with the inertia ``tensor`` from ``omega`` and ``wxyz`` at ``times[0]``.

        ``acceleration``: whether ``omega_dot`` is needed.
        """


class Drag(eqx.Module):
    """Isotropic drag torque, ``-(linear + quadratic |omega|) omega``.

    **Fields:** ``linear`` [N m s], ``quadratic`` [N m s^2].
    """

    linear: Array | float = 0.0
    quadratic: Array | float = 0.0

    def torque(self, dtype: DTypeLike) -> AbstractTorque:
        """The torque of a scene. ``tree_at`` sets the coefficients, because the constructors reject
        negative ones, which a fit may try."""
        parts = LinearDamping(1.0) + QuadraticDamping(1.0)
        coefficients = [jnp.full(3, c, dtype) for c in (self.linear, self.quadratic)]
        return eqx.tree_at(lambda s: [term.c for term in s.terms], parts, coefficients)


def _three_floats(values: Sequence[float]) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z


class SteppedMotion(AbstractMotion):
    """Motion with drag and a reaction wheel of known speed, by Runge-Kutta steps of order 4.

    **Fields:** ``spin_inertia`` [kg m^2] of the wheel about its ``axis`` (3,), a unit vector in
    sensor axes (None: no wheel): its momentum is ``spin_inertia`` times the speed W(t - ``delay``)
    of the recording, and the inertia is that with the wheel locked; ``drag``: a ``Drag`` or None;
    ``fit_drag``, ``fit_delay``: whether these are unknown; ``steps`` between two samples.
    """

    spin_inertia: Array | float | None = None
    axis: tuple[float, float, float] = eqx.field(
        static=True, converter=_three_floats, default=(0.0, 0.0, 1.0)
    )
    delay: Array | float = 0.0
    drag: Drag | None = None
    fit_drag: bool = eqx.field(static=True, default=False)
    fit_delay: bool = eqx.field(static=True, default=False)
    steps: int = eqx.field(static=True, default=1)

    def start(self) -> dict[str, Any]:
        return {
            "drag": (self.drag or Drag()) if self.fit_drag else None,
            "delay": self.delay if self.fit_delay else None,
        }

    @property
    def scales(self) -> bool:
        return True

    def over(self, unknown: dict[str, Any], size: Array) -> dict[str, Any]:
        return unknown | {"drag": jax.tree.map(lambda x: x / size, unknown["drag"])}

    def fixes_scale(self) -> bool:
        return self.spin_inertia is not None or (self.drag is not None and not self.fit_drag)

    def __call__(
        self,
        tensor: Float[Array, "3 3"],
        omega: Float[Array, " 3"],
        wxyz: Float[Array, " 4"] | None,
        times: Float[Array, " t"],
        wheel: Float[Array, " t"] | None,
        unknown: Any,
        acceleration: bool = True,
    ) -> Predicted:
        inertia = Inertia(full=tensor)
        drag = unknown["drag"] if self.fit_drag else self.drag
        torque = None if drag is None else drag.torque(times.dtype)
        inverse = inverse_inertia(inertia)

        def dynamics(size) -> Dynamics:
            carried = None if size is None else lambda t: self._along(size(t))
            return Dynamics(Hamiltonian(inverse, inertia, None, carried), torque)

        wheel_at = self._wheel(times, wheel, unknown["delay"] if self.fit_delay else self.delay)
        halves = jnp.arange(2 * self.steps + 1, dtype=times.dtype) / (2 * self.steps)
        nodes = times[:-1, None] + jnp.diff(times)[:, None] * halves[None]
        solver, term = ClassicalRungeKutta(), diffrax.ODETerm(_field)

        def interval(y, inputs):
            ts, spins = inputs
            for k in range(0, 2 * self.steps, 2):
                step_dynamics = dynamics(
                    None if spins is None else _parabola(ts[k : k + 3], spins[k : k + 3])
                )
                y, *_ = solver.step(term, ts[k], ts[k + 2], y, step_dynamics, None, made_jump=False)
            return y, y

        momentum = inertia.momentum(omega)
        if wheel_at is not None:
            momentum = momentum + jnp.stack(self._along(wheel_at(times[0])))
        y = components(momentum), None if wxyz is None else tuple(wxyz)
        _, path = jax.lax.scan(interval, y, (nodes, wheel_at and wheel_at(nodes)))
        momentum, attitude = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), y, path)
        push, rates = momentum_rate(times, momentum, _attitude(), dynamics(wheel_at))
        push, rates = jnp.stack(push, axis=-1), jnp.stack(rates, axis=-1)
        if attitude is not None:
            attitude = normalise(jnp.stack(attitude, axis=-1))
        if not acceleration:
            return Predicted(rates, None, attitude)
        if wheel_at is not None:  # momentum that the wheel takes up does not accelerate the body
            carried = jnp.stack(self._along(wheel_at(times)), axis=-1)
            momentum_change, step = (jnp.asarray(jnp.gradient(x, axis=0)) for x in (carried, times))
            push = push - momentum_change / step[:, None]
        return Predicted(rates, inertia.rates(push), attitude)

    def _wheel(self, times, wheel, delay) -> Callable[[Array], Array] | None:
        """The wheel's momentum along its axis as a function of time; None without a wheel."""
        spin = self.spin_inertia
        if spin is None:
            return None
        return lambda t: spin * jnp.interp(t - delay, times, wheel)

    def _along(self, size: Array) -> tuple[Array, ...]:
        return tuple(size * component for component in self.axis)


def _parabola(ts: Array, values: Array) -> Callable[[Array], Array]:
    """The parabola through the values at the ends and the middle of a step. A Runge-Kutta step
    evaluates it only there, so that no interpolation in the table is compiled into the step."""
    first, middle, last = values

    def at(t):
        s = (t - ts[1]) / (ts[2] - ts[1])
        return middle + s * ((last - first) / 2 + s * ((first + last) / 2 - middle))

    return at


def free_acceleration(inertia: Inertia, omega: Float[Array, "t 3"]) -> Float[Array, "t 3"]:
    """d(omega)/dt of the torque-free body."""
    dynamics = Dynamics(Hamiltonian(inverse_inertia(inertia), inertia))
    push, _ = momentum_rate(0.0, components(inertia.momentum(omega)), None, dynamics)
    return inertia.rates(jnp.stack(push, axis=-1))


def _attitude() -> Attitude:
    """A placeholder without rows: drag and a wheel do not depend on the attitude."""
    return from_rows({})


def _field(t, y, dynamics):
    """Rates of the body momentum and, where there is one, of the attitude."""
    if y[1] is not None:
        return lie_poisson_field(t, y, dynamics)
    return momentum_rate(t, y[0], _attitude(), dynamics)[0], None


class FreeMotion(AbstractMotion):
    """Torque-free motion in closed form (Jacobi elliptic functions)."""

    def start(self) -> None:
        return None

    def fixes_scale(self) -> bool:
        return False

    def __call__(
        self,
        tensor: Float[Array, "3 3"],
        omega: Float[Array, " 3"],
        wxyz: Float[Array, " 4"] | None,
        times: Float[Array, " t"],
        wheel: Float[Array, " t"] | None,
        unknown: Any,
        acceleration: bool = True,
    ) -> Predicted:
        moments, axes, (yz, zx, xy) = principal(tensor)
        start = rotate(conjugate(axes), omega)
        attitude = None if wxyz is None else tuple(multiply(wxyz, axes))
        rates, path_wxyz = free_motion(
            tuple(moments),
            attitude,
            tuple(start),
            times - times[0],
            (xy, zx, yz),
            attitude=wxyz is not None,
        )
        path = _combined(wxyz_to_matrix(axes), rates)
        if path_wxyz is not None:
            path_wxyz = _combined(_right_product(conjugate(axes)), path_wxyz)
        omega_dot = free_acceleration(Inertia(full=tensor), path) if acceleration else None
        return Predicted(path, omega_dot, path_wxyz)


def _combined(matrix: Float[Array, "n n"], components: tuple[Array, ...]) -> Float[Array, "t n"]:
    """``matrix`` times a vector of components that are arrays over time.

    It loops over the rows because XLA evaluates the inputs of a loop once. In a single expression
    it would fuse the whole motion into every component of the result.
    """

    def row(weights):
        return sum(weights[k] * part for k, part in enumerate(components))

    return jax.lax.map(row, matrix).T


def _right_product(q: Float[Array, " 4"]) -> Float[Array, "4 4"]:
    """The matrix of ``p -> p q``."""
    w, x, y, z = q
    rows = ((w, -x, -y, -z), (x, w, z, -y), (y, -z, w, x), (z, y, -x, w))
    return jnp.stack([jnp.stack(row) for row in rows])


def simulated(
    scene: Scene,
    omega: Float[Array, " 3"],
    wxyz: Float[Array, " 4"] | None,
    times: Float[Array, " t"],
    method: AbstractMethod | None,
    rtol: float | None,
    attitude: Float[Array, " 4"] | None = None,
) -> Predicted:
    """The motion by ``ph.simulate`` from ``wxyz``, else ``attitude``, else the identity."""
    axes = jnp.asarray([1, 0, 0, 0])
    start = next(x for x in (wxyz, attitude, axes) if x is not None).astype(omega.dtype)
    trajectory = simulate(scene, State(start, omega), times, method, rtol=rtol, throw=False)
    return Predicted(gyroscope(trajectory), None, None if wxyz is None else trajectory.wxyz)


class SceneMotion(AbstractMotion):
    """Motion of the scene ``build(inertia, unknown)``, by ``ph.simulate``.

    **Fields:** ``build`` makes a ``ph.Scene`` of an inertia and the motion's own unknowns;
    ``unknown``: a pytree of their starting values, or None (the magnitudes of nonzero values are
    the optimiser's units); ``shows_scale``: whether rates depend on the absolute size of the
    inertia, true for known torques, rotors with known momentum and potentials; ``method``: one
    with forward-mode derivatives, by default ``LiePoisson()``; ``rtol`` as in ``ph.simulate``.

    A scene whose forces depend on the attitude needs attitudes in the recording, or starts from
    the space axes. Accelerometer readings are not modelled.
    """

    build: Callable[[Inertia, Any], Scene] = eqx.field(static=True)
    unknown: Any = None
    shows_scale: bool = eqx.field(static=True, default=True)
    method: AbstractMethod = LiePoisson()
    rtol: float | None = eqx.field(static=True, default=None)

    def start(self) -> Any:
        return self.unknown

    def fixes_scale(self) -> bool:
        return self.shows_scale

    def __call__(
        self,
        tensor: Float[Array, "3 3"],
        omega: Float[Array, " 3"],
        wxyz: Float[Array, " 4"] | None,
        times: Float[Array, " t"],
        wheel: Float[Array, " t"] | None,
        unknown: Any,
        acceleration: bool = True,
    ) -> Predicted:
        scene = self.build(Inertia(full=tensor), unknown)
        return simulated(scene, omega, wxyz, times, self.method, self.rtol)


class LeafMotion(AbstractMotion):
    """Motion of a scene with some unknown arrays, by ``ph.simulate``.

    The unknowns of an inertia tensor (``Inertia.full``) are its six entries.

    **Fields:** ``scene``, with the starting values; ``places`` (static): which of its leaves are
    unknown; ``bounds``: lower and upper ends of each, infinite where there is none, or None;
    ``widths``: standard deviations of normal priors about the start; ``attitude`` (4,): initial
    attitude for recordings without attitudes; ``method`` and ``rtol`` as in ``ph.simulate``.
    """

    scene: Scene
    places: tuple[int, ...] = eqx.field(static=True)
    attitude: Float[Array, " 4"] | None = None
    method: AbstractMethod | None = None
    rtol: float | None = eqx.field(static=True, default=None)
    bounds: tuple[tuple[Array, Array] | None, ...] | None = None
    widths: tuple[Array | None, ...] | None = None

    @property
    def has_bounds(self) -> bool:
        return self.bounds is not None

    def bounded(self, unknown: list[Array]) -> list[Array]:
        if self.bounds is None:
            return unknown
        pairs = zip(unknown, self.start(), self.bounds, strict=True)
        return [x if ends is None else to_bounded(x, at, *ends) for x, at, ends in pairs]

    def unbounded(self, values: list[Array]) -> list[Array]:
        if self.bounds is None:
            return values
        pairs = zip(values, self.start(), self.bounds, strict=True)
        return [x if ends is None else to_unbounded(x, at, *ends) for x, at, ends in pairs]

    def prior_std(self) -> list[Array | None]:
        return super().prior_std() if self.widths is None else list(self.widths)

    def at_bound(self, values: list[Array]) -> Array:
        """Whether a value has come within a thousandth of the start's distance to a bound."""
        is_near = jnp.asarray(False)
        for x, at, ends in zip(values, self.start(), self.bounds or (), strict=False):
            for end in ends or ():
                is_near = is_near | jnp.any(jnp.abs(x - end) < 1e-3 * jnp.abs(at - end))
        return is_near

    def start(self) -> list[Array]:
        leaves = jax.tree.leaves(self.scene)
        arrays = [leaves[i] for i in self.places]
        return [x if n is None else entries_of(x, n) for x, n in zip(arrays, self.entry_counts)]

    @property
    def entry_counts(self) -> list[int | None]:
        parts = jax.tree.leaves(self.scene, is_leaf=lambda part: isinstance(part, Inertia))
        tensors = [id(part.full) for part in parts if isinstance(part, Inertia)]
        leaves = jax.tree.leaves(self.scene)
        return [6 if id(leaves[i]) in tensors else None for i in self.places]

    def fixes_scale(self) -> bool:
        return True

    def with_values(self, values: Sequence[Array]) -> Scene:
        """The scene with these arrays in place of the unknown ones."""
        leaves, tree = jax.tree.flatten(self.scene)
        for i, value in zip(self.places, values, strict=True):
            leaves[i] = value.astype(leaves[i].dtype)
        scene = jax.tree.unflatten(tree, leaves)
        # derivatives of tables follow from the values, as in their constructor
        return jax.tree.map(
            lambda part: part.updated() if isinstance(part, Table) else part,
            scene,
            is_leaf=lambda part: isinstance(part, Table),
        )

    def __call__(self, tensor, omega, wxyz, times, wheel, unknown, acceleration=True):
        scene = self.with_values(self.arrays_of(unknown))
        return simulated(scene, omega, wxyz, times, self.method, self.rtol, self.attitude)
