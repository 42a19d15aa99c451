"""The table of closed forms: the planner takes the first that the types make valid."""

from typing import NamedTuple

from polhode._closed_forms._closed_form import VARIABLE, AbstractClosedForm
from polhode._closed_forms._elementary import FixedAxis, SymmetricTop
from polhode._closed_forms._free import ClosedForm
from polhode._closed_forms._lagrange_top import LagrangeTop
from polhode._scene import Scene
from polhode.inertia import Symmetry, VariableInertia


class Solution(NamedTuple):
    """One row: name, what ``explain`` prints where it runs, and the method that evaluates it.

    ``symmetry``: that of the type of the inertia; None: decided by the method.
    """

    name: str
    explanation: str
    method: AbstractClosedForm
    symmetry: Symmetry | None = None

    def why_not(self, scene: Scene) -> str | None:
        """Why the types of the parts do not make it valid; None: they do."""
        if isinstance(scene.inertia, VariableInertia):
            return VARIABLE
        reason = self.method.why_not(scene)
        if reason is None and self.symmetry not in (None, scene.inertia.symmetry):
            return f"the inertia is not one of ph.Inertia.{self.symmetry.name.lower()}"
        return reason


CLOSED_FORMS = (
    Solution(
        "free body",
        "free and spherical: exact rotation about a fixed axis",
        ClosedForm(),
        Symmetry.SPHERICAL,
    ),
    Solution(
        "free body",
        "free and axisymmetric: exact regular precession",
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
    ),
)


def choose_closed_form(scene: Scene) -> tuple[Solution | None, tuple[str, ...]]:
    """The first closed form that the types make valid, or None; and why those before it are not."""
    refused = []
    for solution in CLOSED_FORMS:
        reason = solution.why_not(scene)
        if reason is None:
            return solution, tuple(refused)
        refused.append(f"{solution.name}: {reason}")
    return None, tuple(dict.fromkeys(refused))
