"""The table of closed forms: the planner takes the first one that is known to hold."""

from typing import NamedTuple

from polhode._closed_forms._closed_form import AbstractClosedForm
from polhode._closed_forms._elementary import FixedAxis, SymmetricTop
from polhode._closed_forms._free import ClosedForm
from polhode._closed_forms._lagrange_top import LagrangeTop
from polhode._method._base import Record
from polhode._scene import Scene, State
from polhode.inertia import Symmetry


class Solution(NamedTuple):
    """One row: name, what ``explain`` prints where it runs, and the method that evaluates it.

    ``symmetry``: the symmetry that the inertia must be known to have; None: decided by the method.
    ``of_state``: whether it holds for some states of a scene only.
    """

    name: str
    explanation: str
    method: AbstractClosedForm
    symmetry: Symmetry | None = None
    of_state: bool = False

    def why_not(self, scene: Scene, state: State, record: Record) -> str | None:
        """Why it is not known to hold; None where it is."""
        reason = self.method.why_not(scene, state, record)
        if reason is None and self.symmetry not in (None, scene.inertia.symmetry):
            return f"the inertia is not declared {self.symmetry.name.lower()}"
        return reason


CLOSED_FORMS = (
    Solution(
        "free body",
        "free and known to be spherical: exact rotation about a fixed axis",
        ClosedForm(),
        Symmetry.SPHERICAL,
    ),
    Solution(
        "free body",
        "free and known to be axisymmetric: exact regular precession",
        ClosedForm(),
        Symmetry.AXISYMMETRIC,
    ),
    Solution(
        "free body",
        "nothing acts on the body: exact motion in Jacobi elliptic functions",
        ClosedForm(),
    ),
    Solution(
        "Lagrange's top",
        "symmetric body, centre of mass on its axis, uniform gravity (Lagrange's top): exact motion"
        " in theta functions",
        LagrangeTop(),
    ),
    Solution(
        "symmetric top",
        "symmetric body with torque, damping or wheels about its axis: exact motion in elementary"
        " functions",
        SymmetricTop(),
    ),
    Solution(
        "fixed axis",
        "spin about one fixed principal axis: exact motion in elementary functions",
        FixedAxis(),
        of_state=True,
    ),
)


def choose_closed_form(
    scene: Scene, state: State, record: Record
) -> tuple[Solution | None, tuple[str, ...]]:
    """The first closed form known to hold, or None; and why those before it do not."""
    refused = []
    for solution in CLOSED_FORMS:
        reason = solution.why_not(scene, state, record)
        if reason is None:
            return solution, tuple(refused)
        refused.append(f"{solution.name}: {reason}")
    return None, tuple(dict.fromkeys(refused))
