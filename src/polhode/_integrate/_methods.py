"""Public integration methods: Lie-Poisson coordinates, Euler angles, and coarse steps for
training."""

import diffrax
from jaxtyping import Array

from polhode import _policy
from polhode._integrate._charts import EulerChart, LiePoissonChart
from polhode._integrate._extrapolation import Automatic
from polhode._integrate._stepped import AbstractIntegration


class LiePoisson(AbstractIntegration):
    """Unit quaternion and body momentum, free of singularities, with any diffrax solver.

    **Arguments:**

    - ``solver``: a ``diffrax.AbstractSolver`` for ODEs, polhode's or diffrax's; None:
      ``diffrax.Dopri8``.
    - ``controller``: a diffrax step-size controller; None: the estimated error at every saved time
      is kept below the ``rtol`` of ``simulate`` (attitude in radians, momentum relative to the
      scale of each body).
    - ``dt0``: first (or constant) step [s], in the direction of the times; None: chosen.
    - ``max_steps``: of each body, or of bodies that share their steps.
    - ``adjoint``: None: ``ph.FlowAdjoint()``, the derivatives of the exact flow, in forward
      and reverse mode; or an adjoint of diffrax, for the derivative of the steps (for bodies that
      drag stops within the time simulated).
    - ``progress_meter``: as in diffrax.
    - ``chart``: set by the planner (None: no preferred direction in space).
    - ``chunk``: number of bodies that are integrated together; chunks are processed one after the
      other, which limits the memory. None: 200 if the bodies of a chunk have common steps. For
      ``Extrapolation``, in which each body has steps of its own: 1024, of which 64 are in progress
      at a time, as many as fit into the cache of a core; 64 if the field is more than elementwise
      arithmetic (matrix products, for example); 2^18 on an accelerator.
    """

    def __init__(
        self,
        solver: diffrax.AbstractSolver | None = None,
        controller: diffrax.AbstractStepSizeController | None = None,
        dt0: float | Array | None = None,
        max_steps: int = 2**16,
        adjoint: diffrax.AbstractAdjoint | None = None,
        progress_meter: diffrax.AbstractProgressMeter | None = None,
        chunk: int | None = None,
        *,
        chart: LiePoissonChart | None = None,
    ):
        chart = LiePoissonChart() if chart is None else chart
        super().__init__(
            chart,
            _policy.SHARED_STEP_BODIES,
            solver,
            controller,
            dt0,
            max_steps,
            adjoint,
            progress_meter,
            chunk,
        )


class CoarseSteps(AbstractIntegration):
    """Explicit steps of order 5 that do not end where the field kinks or jumps: coarse and fast.

    For training, where a gradient with an error of a few per cent is enough and the controller has
    many kinks (relu, clip): 2 to 20 times faster there than the default. The error of the state is
    controlled by ``rtol``. Its derivative has an error of about sqrt(rtol) at kinks, and of the
    whole contribution of the switching time at jumps. Second derivatives through kinks or jumps
    raise NotImplementedError. Unit quaternion and body momentum; derivatives are those of the
    steps, which are recorded.

    **Arguments:** ``max_steps``: of each body; ``chunk``: number of bodies that are integrated
    together (None: chosen).

        trajectory = ph.simulate(scene, states, ts, ph.CoarseSteps(), rtol=1e-4)
    """

    def __init__(self, max_steps: int = 2**16, chunk: int | None = None):
        solver = Automatic(located=False)
        super().__init__(LiePoissonChart(), 1, solver, None, None, max_steps, None, None, chunk)

    @property
    def name(self) -> str:
        """The name of the class."""
        return "CoarseSteps"


class EulerAngles(AbstractIntegration):
    """Canonical ZYZ Euler angles by Hamilton's equations (docs/equations.md), any diffrax solver.

    For comparison: the coordinates are singular where theta is 0 or pi, which is reported as
    ``Status.CHART_SINGULAR``; motions that pass close to it need many steps. Arguments as of
    ``ph.LiePoisson``. With solvers whose steps are common to a chunk, bodies are integrated one at
    a time, so that no body has to take the steps of another one.
    """

    def __init__(
        self,
        solver: diffrax.AbstractSolver | None = None,
        controller: diffrax.AbstractStepSizeController | None = None,
        dt0: float | Array | None = None,
        max_steps: int = 2**16,
        adjoint: diffrax.AbstractAdjoint | None = None,
        progress_meter: diffrax.AbstractProgressMeter | None = None,
        chunk: int | None = None,
    ):
        super().__init__(
            EulerChart(), 1, solver, controller, dt0, max_steps, adjoint, progress_meter, chunk
        )
