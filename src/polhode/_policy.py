"""Sizes, thresholds and switches that were chosen by measurement or depend on the platform.

This module imports nothing from polhode, and no other module inspects the platform. Each row is a
name and a value; its docstring gives the unit in brackets and the reason. ``python -m
benchmarks.policy NAME`` compares the value with others on the scenes that it affects. An
optimisation that makes none of them 1.2 times faster is removed.

``POLHODE_PLAIN=1`` in the environment, set before Python starts, switches all optimisations for
CPUs off (the switches below): programs are compiled as they are written, they are slower, and
results differ by rounding. ``POLHODE_PLAIN=0`` requests fused kernels for any version of jaxlib.
"""

import os
from typing import Any

import jax
import jaxlib.version

# Versions of jaxlib. ``python tests/versions.py next`` tests the newest release. If it passes, add
# it here, and raise the upper bound of jax in pyproject.toml to its minor version.

FUSED_JAXLIB = ("0.10.0", "0.10.1", "0.10.2", "0.11.2", "0.12.0.1")
"""[versions] On which fused kernels have been tested: they use undocumented attributes of XLA. On
any other version all optimisations are off."""


# Switches of the optimisations for CPUs: see ``_kernels/README.md`` for how each works.

FUSION = True
"""[switch] XLA compiles a function of many small arrays as one machine function (``kernel``).
Otherwise it starts a task for every array, and repeats the arithmetic of one task in the next."""

FOLDING = True
"""[switch] Terms that depend on parameters alone are computed before the integration loop, and sums
with zero and products with one, which automatic differentiation of H produces, are removed
(``specialise``), and so are equal operations before switches are found (``without_repeats``)."""

STAGING = True
"""[switch] Values that many results share are computed once (``staged``). Otherwise XLA computes
them again in the loop over each result."""

REFILLING = True
"""[switch] The SIMD lane of a finished body is given to the next body of the batch
(``in_lanes``)."""

TIME_LOOP = True
"""[switch] Closed forms of many free bodies at many times are evaluated in a loop over the times,
each time for all bodies."""


# Fused kernels.

KERNEL_BODIES = 8
"""[bodies] Up to this number, the preparation and the output are in one fused kernel with the
integration. For more bodies, a kernel within a kernel makes the integration up to 1.05 times
slower."""

SINGLE_BODIES = 512
"""[bodies] Up to this number, the loop of explicit steps takes one body after another if a kernel
can contain it. A kernel for KERNEL_BODIES takes twice as long to compile; with it, gradients take
as long, values of larger batches 0.7 to 0.8 of the time."""

KERNEL_BATCH = 16
"""[bodies] In a kernel under ``jax.vmap``. A larger batch is a loop over kernels of this size."""

KERNEL_SUM = 2048
"""[floats] A function that sums this many or more is not made a kernel: XLA computes sums of 4,096
floats by a library call, which a kernel cannot contain."""

KERNEL_TABLE = 1024
"""[numbers] Constant arrays up to this size are part of a kernel; larger ones are its operands."""

KERNEL_PRODUCT = 4096
"""[multiplications] A product of matrices in the field with at most this number, for all bodies of
the program together, is evaluated as a sum, which a kernel can contain. Larger ones are one library
call for all bodies."""

KERNEL_INDEX = 1024
"""[entries times results] Up to this number, an update of entries in the field, and the derivative
of an index, are written as selections, which a kernel can contain."""

STAGE_WORK = 8
"""[operations] An intermediate value of the field that several rates share is staged if it takes
this many operations or more."""

SUM_ROWS = 4
"""[rows] Up to this number, the sum of the cotangents of a broadcast is unrolled; for more rows it
is a loop."""


# Integration.

LANES = 64
"""[bodies] Integrated at the same time, as the entries (SIMD lanes) of arrays. Arrays of this size
fit into the innermost cache of a core; in larger batches more bodies wait for the slowest one."""

REFILL_LANES = 8
"""[lanes] Number of idle lanes that are refilled together: a refill writes the arrays of all lanes
and takes a considerable part of the time of a step."""

QUEUE = 1024
"""[bodies] In one work queue, from which lanes are refilled; limits the memory."""

EXPLICIT_BODIES = 4
"""[bodies] Up to this number, bodies under torques are integrated by explicit Runge-Kutta steps,
which compile in half the time and whose reverse mode is stable under damping. More bodies are
integrated by the extrapolated midpoint rule, which is faster on lanes; bodies in a potential alone
always are."""

LOW_ORDER_RTOL = 1e-7
"""[rad] Tolerance at and above which explicit steps through many switches are of order 5."""

LOW_ORDER_SWITCHES = 48
"""[switches] A field with this many or more takes these steps of order 5: so many steps end at a
switch that the additional stages of order 8 do not pay. The gradient of four bodies with a network
of 64 relu takes 1.8 times as long at order 8; with 32 relu both orders take equally long; a
satellite with plates and tables (20 switches) takes four times the steps at order 5 and 1e-6."""

SORTED_BODIES = 64
"""[bodies] Larger batches are sorted by angular rate, so that neighbouring lanes take similar
steps."""

SHARED_STEP_BODIES = 200
"""[bodies] In one chunk of a diffrax solver, whose steps are common to all bodies of the chunk."""

ACCELERATOR_BODIES = 2**18
"""[bodies] In one chunk on a GPU or TPU; limits the memory."""

SAVE_SAMPLES = 2**18
"""[bodies times samples] In one chunk on a CPU if a function of the motion is saved instead of the
motion (``Record(save=)``): 15 MB of states in float64."""

ACCELERATOR_SAVE_SAMPLES = 2**24
"""[bodies times samples] The same on an accelerator: 0.9 GB."""

STEP_OVERHEAD = 30
"""[evaluations of the field] Fixed cost of a step of the midpoint rule, beyond its own evaluations;
enters the choice of the order."""

RECORD_SEGMENTS = 256
"""[segments] Of the recorded steps (checkpointing): reverse mode replays one segment at a time, and
stores one state for each segment and one for each step of the current segment."""

RECORDED_ITERATIONS = 512
"""[iterations] Of the loop of explicit steps: maximum number that is recorded while values for a
derivative are computed. A motion with more of them is integrated again for reverse mode."""

RECORDED_ITERATIONS_OF_FEW = 128
"""[iterations] The same for a few bodies, since ``jax.vmap`` may multiply their number later: the
records of 100,000 take 2 GB."""

RECORDED_MEMORY = 2**26
"""[bytes] Limit on these records, for all bodies together."""

MIN_RECORDED_ITERATIONS = 64
"""[iterations] If RECORDED_MEMORY allows fewer, none are recorded: most motions take more."""

COMPENSATED_STEPS = 20_000
"""[eps] Tolerance below which steps use compensated summation. Without it rounding errors grow to
about eps * angle**1.5, which exceeds rtol beyond (rtol/eps)**(2/3) = 740 rad."""


# Closed forms.

COMPENSATED_PHASES = 1e5
"""[eps] Tolerance below which the frequencies of a free body are sums of two floats. With one float
the error of the phase is eps times the angle, which exceeds rtol beyond 1e5 rad."""

FREE_CHUNK = 2**12
"""[bodies times samples] Of free bodies in one chunk: its arrays stay in the cache of a core."""

FREE_LANES = 512
"""[bodies] In one chunk of the loop over times (TIME_LOOP): their constants stay in the cache."""

TIME_LOOP_BODIES = 64
"""[bodies] Smallest batch to which TIME_LOOP applies."""

TOP_CHUNK = 2**11
"""[bodies times samples] Of Lagrange's tops in one chunk."""

ELEMENTARY_CHUNK = 2**14
"""[bodies times samples] In a chunk of motions in elementary functions."""

ACCELERATOR_SAMPLES = 2**18
"""[bodies times samples] Of any closed form in one chunk on a GPU or TPU; limits the memory. With
the chunk sizes of a CPU a million free bodies take 4 times as long on an H200, and a million of
Lagrange's tops 300 times as long; in a single chunk, tops take twice as long in float64."""

EVENT_SAMPLES = 128
"""[bodies times samples] Evaluated together in the search for the first event of a closed form, two
samples of each body at least. With two samples at a time a single body takes three to six times as
long, because each evaluation computes the constants of the motion. With a whole window at a time
1,000 bodies with events at different times take three times as long, because root iterations
evaluate the same number of samples."""


# Fits.

BRIEF_FIT = 2**13
"""[samples] Fits of recordings up to this size, called outside of ``jax.jit``, are compiled without
the optimisations of LLVM: the fit runs for at most a second, and the optimisations take longer."""

FIT_SAMPLES = 1024
"""[samples] Of all recordings that are fitted in one batch on a CPU."""


def platform() -> str:
    """The platform that a program traced now is compiled for: "cpu", "gpu" or "tpu".

    It is that of ``jax.default_device`` if set, otherwise of the default backend, because traced
    values have no platform.
    """
    device: Any = jax.config.jax_default_device  # type: ignore[attr-defined]
    if device is None:
        return jax.default_backend()
    return device if isinstance(device, str) else platform_of(device)


def platform_of(device: Any) -> str:
    """The platform of one device."""
    return device.platform


def kind_of(device: Any) -> str:
    """The platform and model of one device, for benchmark records."""
    return f"{device.platform} ({device.device_kind})"


def is_cpu() -> bool:
    """Whether a program traced now is compiled for a CPU."""
    return platform() == "cpu"


def is_plain() -> bool:
    """Whether the optimisations for CPUs are off, by ``POLHODE_PLAIN`` or the version of jaxlib."""
    variable = os.environ.get("POLHODE_PLAIN", "")
    return variable != "0" if variable else jaxlib.version.__version__ not in FUSED_JAXLIB


def plain_reason() -> str | None:
    """Why the optimisations for CPUs are off; None where they are on."""
    if not is_plain():
        return None
    if os.environ.get("POLHODE_PLAIN"):
        return "POLHODE_PLAIN is set"
    tested = ", ".join(FUSED_JAXLIB)
    return f"jaxlib {jaxlib.version.__version__} is not among the tested versions {tested}"


def is_fused() -> bool:
    """Whether functions become fused kernels."""
    return FUSION and is_cpu() and not is_plain()


def is_folded() -> bool:
    """Whether fields are folded before the loop."""
    return FOLDING and not is_plain()


def is_staged() -> bool:
    """Whether shared values are staged."""
    return STAGING and not is_plain()


def is_refilled(bodies: int) -> bool:
    """Whether the lanes of a batch are refilled: on a CPU, for more bodies than lanes. An
    accelerator integrates all bodies at the same time."""
    return REFILLING and is_cpu() and not is_plain() and bodies > LANES


def linearises_units() -> bool:
    """Whether a kernel that contains kernels may be linearised.

    In jax 0.10.0 the function that ``jax.linearize`` returns for such a program may contain tracers
    as constants; fits of scenes did not compile."""
    return jax.__version_info__ >= (0, 10, 2)


def is_time_loop(bodies: int, samples: int) -> bool:
    """Whether closed forms of free bodies are evaluated in a loop over the times (TIME_LOOP)."""
    usable = TIME_LOOP and is_cpu() and not is_plain()
    return usable and samples > 1 and bodies >= TIME_LOOP_BODIES


def bodies_to_save(samples: int) -> int:
    """Bodies in a chunk if a function of the motion is saved instead of the motion; at least
    LANES."""
    sample_limit = SAVE_SAMPLES if is_cpu() else ACCELERATOR_SAVE_SAMPLES
    return max(LANES, sample_limit // samples)


def recorded_iterations(bodies: int, memory: int) -> int:
    """Iterations of the loop that are recorded; each takes ``memory`` bytes for each body."""
    limit = RECORDED_ITERATIONS if bodies > KERNEL_BODIES else RECORDED_ITERATIONS_OF_FEW
    iterations = min(limit, RECORDED_MEMORY // (bodies * memory))
    return iterations if iterations >= MIN_RECORDED_ITERATIONS else 0


def samples_at_once(chunk: int) -> int:
    """Bodies times samples of a closed form in one chunk: ``chunk`` on a CPU, where its arrays stay
    in the cache of a core; as many as the memory allows on an accelerator."""
    return chunk if is_cpu() else ACCELERATOR_SAMPLES


def bodies_at_once(lanes: int) -> int:
    """Bodies that are integrated at the same time: ``lanes`` on a CPU, more on an accelerator."""
    return lanes if is_cpu() else ACCELERATOR_BODIES
