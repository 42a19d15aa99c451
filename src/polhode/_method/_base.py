"""What every way of moving the bodies of a scene has in common."""

import abc
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
from jaxtyping import Array

from polhode._scene import Scene, State


class Record(eqx.Module):
    """What a simulation saves: attitude, rates, all times or the last one (all static).

    ``work``: also integrate the work [J] of the external torques. ``error``: also estimate the
    error of each body at the last time, by a second, coarser run of about the same cost, and mark
    bodies whose estimate is above ten times the tolerance by ``Status.INACCURATE``: chaotic
    bodies, and those whose rounding error exceeds the tolerance.
    """

    attitude: bool = eqx.field(static=True, default=True)
    rates: bool = eqx.field(static=True, default=True)
    final_only: bool = eqx.field(static=True, default=False)
    work: bool = eqx.field(static=True, default=False)
    error: bool = eqx.field(static=True, default=False)

    def __check_init__(self):
        if not (self.attitude or self.rates):
            raise ValueError("Record keeps nothing: switch on attitude, rates or both.")


class Samples(NamedTuple):
    """What a method returns for N lanes: (N, T, 4), (N, T, 3), (N,), (N,), (N, T), (N,).

    ``error``: sum of the estimated errors of the steps, if the method knows it. ``motor_work``,
    ``spins`` (N, T, m): of every wheel, and momenta of the coupled ones, or None.
    """

    wxyz: Array | None
    omega_body: Array | None
    status: Array
    steps: Array
    work: Array | None = None
    error: Array | None = None
    motor_work: Array | None = None
    spins: Array | None = None


class AbstractMethod(eqx.Module):
    """Base of all methods. ``run`` simulates N bodies; ``simulate`` checks inputs and batches.

    ``exact``: whether the method is a closed form, which does not compute the work.
    """

    exact: ClassVar[bool] = False

    @property
    def keeps_rtol(self) -> bool:
        """Whether ``rtol`` decides how accurate the motion is."""
        return False

    @property
    def name(self) -> str:
        """The name that ``ph.explain`` prints."""
        return type(self).__name__

    @abc.abstractmethod
    def run(self, scene: Scene, state: State, ts: Array, rtol: Array, record: Record) -> Samples:
        """Samples at ``ts`` (T,) or (N, T) of lanes whose state holds at the first time."""

    def search(
        self, scene: Scene, state: State, ts: Array, rtol: Array, search: Any, final_only: bool
    ) -> Any:
        """Events during the motion, if the method can find them by itself; None otherwise."""
        return None
