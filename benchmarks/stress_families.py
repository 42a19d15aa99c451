"""The bodies of the stress suite: families of extreme inertias, states and horizons, as data.

Nothing here is computed by the package. Where possible, inputs are exact in float32, so that the
same reference applies to both precisions (``fits_single``).
"""

import math
from dataclasses import dataclass

import mpmath as mp
import numpy as np

START = (0.5, -0.125, 0.75, 0.5)
RATES = (0.7, -0.9, 1.1)
ANGLE = 5.0  # rotation angle of most bodies [rad], or phase of the nutation if it is faster
# Directions of the derivatives: relative changes of the inertia; changes of attitude, rates, time.
INERTIA_MOVE = (0.5, -0.75, 0.25, 0.125, -0.25, 0.375)
START_MOVE = (0.25, 0.5, -0.125, 0.25)
RATES_MOVE = (-0.5, 0.25, 0.75)
TIME_MOVE = 0.125


@dataclass(frozen=True)
class Body:
    """Inputs of one motion.

    ``kind``: "diagonal" (3 moments), "tensor" (xx, yy, zz, xy, xz, yz), "axisymmetric" (transverse,
    axial), "spherical" (one moment), "euler" (3 moments; ``start`` contains the angles phi, theta,
    psi and ``rates`` their rates). For the other kinds ``start`` is wxyz and ``rates`` are the body
    rates. ``long``: the reference is computed by whole periods.
    """

    family: str
    name: str
    kind: str
    inertia: tuple
    start: tuple
    rates: tuple
    t: float
    long: bool = False

    @property
    def inputs(self) -> list[float]:
        return [*self.inertia, *self.start, *self.rates, self.t]

    @property
    def fits_single(self) -> bool:
        """Whether float32 represents the inputs exactly and their products do not overflow."""
        x = np.array(self.inputs)
        size = np.abs(x)
        least = np.full(len(x), 1e-18)
        if self.kind == "euler":
            least[3:6] = 1e-37
        held = (size > least) & (size < 1e18)
        return bool(np.all((size == 0) | held & (np.where(held, x, 0).astype(np.float32) == x)))

    def moves(self) -> list[list[float]]:
        """Two directions in the space of ``inputs``: of the inertia, and of all other inputs."""
        size = math.hypot(*self.rates) if max(map(abs, self.rates)) > 0 else 1.0
        zero = [0.0] * len(self.inertia)
        if self.kind == "tensor":
            diagonal = self.inertia[:3]
            units = [*diagonal, *(math.sqrt(diagonal[a] * diagonal[b]) for a, b in _PAIRS)]
        else:
            units = self.inertia
        inertia = [c * u for c, u in zip(INERTIA_MOVE, units, strict=False)]
        rest = [*START_MOVE[: len(self.start)], *(c * size for c in RATES_MOVE)]
        return [inertia + [0.0] * (len(rest) + 1), [*zero, *rest, TIME_MOVE * self.t]]


_PAIRS = ((0, 1), (0, 2), (1, 2))


def single(values) -> tuple:
    return tuple(float(np.float32(x)) for x in values)


def nutation(moments, rates) -> tuple[float, float]:
    """Frequency and parameter m of the elliptic functions, in the arithmetic of the arguments."""
    (a, u), (b, v), (c, w) = sorted(zip(moments, rates, strict=True), key=lambda x: x[0])
    # Each square has a difference of moments as factor: only the separatrix causes cancellation.
    above = a * u * u * (b - a) - c * w * w * (c - b)  # 2 E I2 - L^2
    outer = b * v * v * (b - a) + c * w * w * (c - a)  # L^2 - 2 E I1
    inner = a * u * u * (c - a) + b * v * v * (c - b)  # 2 E I3 - L^2
    if above <= 0:
        square, share = (c - b) * outer, (b - a) * inner
    else:
        square, share = (b - a) * inner, (c - b) * outer
    if square == 0:
        return square, share
    return mp.sqrt(square / a / b / c), share / square


def duration(moments, rates, angle: float = ANGLE) -> float:
    size = max(map(abs, rates)) or 1.0
    scaled = [x / size for x in rates]
    if max(moments) > 1e100:  # products would overflow; the time depends on ratios only
        moments = [x / max(moments) for x in moments]
    energy = sum(i * w * w for i, w in zip(moments, scaled, strict=True))
    fast = max(math.hypot(*scaled), math.sqrt(energy / min(moments)))
    return angle / (max(fast, float(nutation(moments, scaled)[0])) or 1.0) / size


def turned_tensor(moments, wxyz) -> tuple:
    """R diag(moments) R^T as xx, yy, zz, xy, xz, yz."""
    w, x, y, z = np.array(wxyz) / np.linalg.norm(wxyz)
    r = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    full = r @ np.diag(moments) @ r.T
    return (*np.diag(full), *(full[a, b] for a, b in _PAIRS))


class _List(list):
    def add(self, family, name, moments, rates, t=None, exact=False, **more) -> None:
        """``exact``: do not round the inputs to float32, which would remove the special case."""
        if not exact:
            moments, rates = single(moments), single(rates)
        t = duration(moments, rates) if t is None else t
        t = float(np.float32(t)) if 1e-30 < abs(t) < 1e30 else float(t)
        kind = more.pop("kind", "diagonal")
        inertia = tuple(map(float, more.pop("inertia", moments)))
        start = more.pop("start", START)
        self.append(Body(family, name, kind, inertia, start, tuple(map(float, rates)), t, **more))


def bodies() -> list[Body]:
    """All families, in the order of the report."""
    made = _List()
    _inertias(made)
    _states(made)
    _scales(made)
    _horizons(made)
    return list(made)


def _inertias(made: _List) -> None:
    for order in ((0, 1, 2), (0, 2, 1), (1, 0, 2), (1, 2, 0), (2, 0, 1), (2, 1, 0)):
        moments = [(1.0, 2.0, 3.0)[k] for k in order]
        made.add("orders", f"{order}", moments, RATES)
        made.add("orders", f"{order}, other mode, back", moments, (-1.1, 0.3, -0.2), -4.0)
    for power in (-8, -6, -4, -2, 2, 4, 6, 8):
        ratio = 10.0**power
        for moments in ((ratio, 1.0, 1.125), (1.0, 1.125, ratio), (ratio, 1.0, 1 / ratio)):
            if moments[2] == 1 / ratio and (power > 0 or power % 4):
                continue
            equal = [x / math.sqrt(i) for x, i in zip(RATES, moments, strict=True)]
            made.add("ratios", f"{moments}, equal energies", moments, equal)
            if power % 4 == 0:
                made.add("ratios", f"{moments}, equal rates", moments, RATES)
                even = [x / i for x, i in zip(RATES, moments, strict=True)]
                made.add("ratios", f"{moments}, equal momenta", moments, even)
    for eps in (2.0**-52, 2.0**-23):
        for ulps in (0, 1, 10, 1000, 10**6):
            if ulps == 0 and eps > 1e-10:
                continue
            near, label = 1 + ulps * eps, f"{ulps} ulps of {eps:.0e}"
            slow = near - ulps * eps / 2
            for moments in ((1.0, near, 1.5), (near, 0.75, 1.0), (1.0, near, near)):
                made.add("ulps", f"{label}, {moments}", moments, single(RATES), exact=True)
            made.add("ulps", f"{label}, three", (1.0, near, slow), single(RATES), exact=True)
            across = single((0.7, -0.9, 0.0))
            made.add("ulps", f"{label}, across", (1.0, near, 1.5), across, exact=True)
    turn = (0.3, -0.5, 0.7, 0.2)
    for moments in ((1, 2, 3), (3, 1, 2), (1, 1.001, 1.5), (1, 1, 2), (1, 1, 1), (0.01, 1, 1.1)):
        inertia = single(turned_tensor(moments, turn))
        t = ANGLE / 2
        made.add("tensors", f"{moments}", moments, RATES, t, kind="tensor", inertia=inertia)
    made.add("tensors", "diagonal", (1, 2, 3), RATES, kind="tensor", inertia=(1, 2, 3, 0, 0, 0))
    for axial in (1e-4, 0.5, 1.0, 1.75, 1e4):
        moments = single((1.0, 1.0, axial))
        made.add(
            "symmetric",
            f"axial {axial:g}",
            moments,
            RATES,
            kind="axisymmetric",
            inertia=moments[1:],
        )
    for rates in (RATES, (0.0, 0.0, 0.0), (0.0, 1.5, 0.0)):
        made.add("symmetric", f"sphere {rates}", (2,) * 3, rates, kind="spherical", inertia=(2,))


def _states(made: _List) -> None:
    # These numbers are exactly on the separatrix: I3 w3^2 (I3 - I2) = I1 w1^2 (I2 - I1).
    moments = (1.0, 2.0, 2.25)
    made.add("separatrix", "exactly", moments, (0.75, 0.5, 1.0))
    made.add("separatrix", "exactly, not passing the middle", moments, (0.75, 0.0, 1.0))
    made.add("separatrix", "exactly, other order", (2.25, 1.0, 2.0), (-1.0, 0.75, 0.5))
    for power in range(1, 17):
        for sign in (1, -1):
            rates = (0.75, 0.5, 1 + sign * max(10.0**-power, 2.0**-53))
            name = f"{sign * 10.0**-power:g}"
            made.add("separatrix", name, moments, rates, exact=power > 6)
    for axis in range(3):
        for off in (0.0, 1e-300, 1e-150, 1e-30, 1e-16, 1e-8, 1e-4, 1e-1):
            rates = [off, -off, off]
            rates[axis] = -1.25
            name = f"axis {axis}, off {off:g}"
            made.add("axes", name, (1.0, 2.0, 3.0), rates, exact=0 < off < 1e-37)
    # Near the unstable axis until deviations grow by nine decades (four in single precision).
    for off in (0.0, 1e-14, 1e-8, 1e-4):
        for lowest, t, exact in ((2.1, 22.0, True), (2.0, 10.0, False)):
            for rates in ((off, 2.0, 0.0), (0.0, -2.0, off)):
                made.add("dwelling", f"{lowest}, {rates}", (lowest, 3, 5), rates, t, exact)
    made.add("dwelling", "from the separatrix", moments, (0.75, 0.5, 1.0), -22.0)
    near = (1e-300, 1e-160, *single((1e-30, 1e-16, 1e-8, 1e-3)))
    thetas = [0.0, *near, -1e-300, math.pi, math.nextafter(math.pi, 4.0)]
    thetas += [math.pi - 1e-15, math.pi - 1e-8, math.pi - 1e-3, float(np.float32(np.pi))]
    for theta in thetas:
        angles = (0.5, theta, -0.75)
        for rates in ((0.75, 0.5, -1.25), (2.0, 0.0, -2.0)):
            made.add(
                "poles",
                f"theta {theta!r}, rates {rates}",
                (1.0, 2.0, 3.0),
                rates,
                2.5,
                kind="euler",
                start=angles,
            )


def _scales(made: _List) -> None:
    for power in (-150, -100, -15, -6, 6, 15, 100, 150):
        size = 10.0**power
        rates = [x * size for x in RATES]
        exact = abs(power) > 30
        made.add("scales", f"rates 1e{power}", (1.0, 2.0, 3.0), rates, exact=exact)
        made.add("scales", f"rates 1e{power}, small", (1e-9, 2e-9, 3e-9), rates, exact=exact)
    for power in (-150, -15, 15, 150):
        moments = [x * 10.0**power for x in (3.0, 1.0, 2.0)]
        made.add("scales", f"moments 1e{power}", moments, single(RATES), exact=abs(power) > 30)
    for size in (0.0, 1e-300, 1e-150, 1e-12, 1e-6):
        rates = [x * size for x in RATES]
        made.add("resting", f"rates {size:g}", (1.0, 2.0, 3.0), rates, 5.0, size < 1e-30)


def _horizons(made: _List) -> None:
    for power in (1, 2, 3, 4, 5, 6):
        turns = 2 * math.pi * 10**power
        for name, moments, rates in (
            ("triaxial", (1.0, 2.0, 3.0), RATES),
            ("needle", (0.01, 1.0, 1.125), (1.1, 0.3, -0.4)),
            ("near the separatrix", (1.0, 2.0, 2.25), (0.75, 0.5, 1.001)),
            ("nearly oblate", (1.0, 1 + 2.0**-20, 1.5), (0.5, 0.25, 1.0)),
        ):
            t = turns / math.hypot(*rates)
            made.add("horizons", f"{name}, 1e{power} turns", moments, rates, t, long=True)
