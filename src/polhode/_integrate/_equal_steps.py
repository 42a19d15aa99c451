"""Steps that lead from one given time to the next: at once, or in equal parts."""

import diffrax
import jax.numpy as jnp
from jaxtyping import Array, Float


class GivenTimes(diffrax.StepTo):
    """``diffrax.StepTo`` for times that are in order and whose ends are those of the solve.

    Its checks raise from inside the program, by callbacks of the host, which keep the program out
    of JAX's persistent cache and from being exported for other platforms. ``ph.simulate`` checks
    times before, or marks them in its status.
    """

    def wrap(self, direction):
        return GivenTimes(self.ts * direction)

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):
        del terms, t0, t1, y0, dt0, args, func, error_order
        return self.ts[1], 2


class EqualSteps(diffrax.AbstractStepSizeController):
    """From each time to the next in equal steps no longer than ``longest`` [s].

    ``ts`` (T,): the times, from first to last. Every one of them is the end of a step.
    """

    ts: Float[Array, "*t"]
    longest: Float[Array, ""]

    def wrap(self, direction):
        return EqualSteps(self.ts * direction, jnp.abs(self.longest))

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):
        del terms, t1, y0, dt0, args, func, error_order
        return self._following(t0, jnp.array(0), jnp.array(0))

    def adapt_step_size(self, t0, t1, y0, y1_candidate, args, y_error, error_order, state):
        del t0, y0, y1_candidate, args, y_error, error_order
        interval, taken = state
        end, state = self._following(t1, interval, taken)
        return jnp.array(True), t1, end, jnp.array(False), state, _GOOD

    def _following(self, t, interval, taken):
        """End of the next step, and where it stands: its interval and number in it."""
        last = self.ts.shape[0] - 2
        start, end = self.ts[interval], self.ts[interval + 1]
        slack = 1 - 8 * jnp.finfo(self.ts.dtype).eps
        count = jnp.maximum(jnp.ceil((end - start) / self.longest * slack), 1).astype(jnp.int32)
        taken = taken + 1
        share = (start + (end - start) * (taken / count).astype(start.dtype)).astype(start.dtype)
        there = taken >= count
        following = jnp.where(there, jnp.minimum(interval + 1, last), interval)
        return jnp.where(there, end, share), (following, jnp.where(there, 0, taken))


_GOOD = diffrax.RESULTS.successful
