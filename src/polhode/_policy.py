"""Every choice that depends on the machine or on a measured crossover, and one switch for them.

The lowest module: it imports nothing of polhode, and no other one inspects the platform. A row is a
name, a value, its unit in brackets and the reason; ``python -m benchmarks.policy NAME`` compares
the value with others on the scenes that it matters for. An optimisation that makes every one of
these less than 1.2 times faster is to be removed.

``POLHODE_PLAIN=1`` in the environment, set before Python starts, switches all optimisations for
CPUs off (the switches below): programs are compiled as they are written, and slower, and results
differ by rounding. ``POLHODE_PLAIN=0`` requests fused kernels whatever the version of jaxlib.
"""

import os
from typing import Any

import jax
import jaxlib.version

# Versions of jaxlib. ``python tests/versions.py next`` tests the newest one that exists: where it
# passes, add it here, and raise the upper bound of jax in pyproject.toml to its minor version.

FUSED_JAXLIB = ("0.10.0", "0.10.1", "0.10.2", "0.11.2", "0.12.0.1")
"""[versions] Those on which fused kernels, which rest on undocumented attributes of XLA, have been
tested. All optimisations are off on others."""


# Switches of the optimisations for CPUs: see ``_kernels/README.md`` for how each works.

FUSION = True
"""[switch] Functions of many small arrays become one function of the machine (``kernel``). XLA
otherwise starts a task for every array, and repeats the work of one task in the next."""

FOLDING = True
"""[switch] What depends on parameters alone is computed before the loop (``specialise``), and sums
with zero and products with one, which differentiation of H leaves, are removed."""

STAGING = True
"""[switch] Values that many results share are computed once (``staged``); XLA repeats them in the
loop of every result."""

REFILLING = True
"""[switch] A SIMD lane whose body is finished takes the next body of the batch (``in_lanes``)."""

TIME_LOOP = True
"""[switch] Many free bodies at many times are moved to one time after the other, in loops over the
bodies."""


# Fused kernels.

KERNEL_BODIES = 8
"""[bodies] Up to so many, everything around the integration is part of one fused kernel too. For
more the integration is up to 1.05 times slower as a kernel within a kernel."""

KERNEL_BATCH = 16
"""[bodies] In a kernel under ``jax.vmap``; more are moved in such batches, one after the other."""

KERNEL_SUM = 2048
"""[floats] Sums of so many or more are not part of a kernel: XLA hands sums of 4,096 floats to a
library, and a kernel cannot contain that call."""

KERNEL_TABLE = 1024
"""[numbers] Constants up to this size are part of a kernel; larger ones are its operands."""

STAGE_WORK = 8
"""[operations] A value of a field that several rates share is staged from so many on."""

SUM_ROWS = 4
"""[rows] Cotangents of a broadcast are added one by one up to so many, in a loop beyond."""


# Integration.

LANES = 64
"""[bodies] Integrated side by side, as the entries of arrays: these fit into the innermost cache of
a core, and many bodies wait for the slowest of them."""

REFILL_LANES = 8
"""[lanes] Refilled at once: a refill costs as much as a part of a step of all lanes."""

QUEUE = 1024
"""[bodies] In one queue for the lanes; bounds the memory."""

EXPLICIT_BODIES = 4
"""[bodies] On which torques act are integrated by explicit Runge-Kutta steps up to so many, which
compile in half the time and whose derivatives tolerate damping; more by the extrapolated midpoint
rule, which is faster on lanes. Bodies in a potential alone are integrated by that rule always."""

LOW_ORDER_RTOL = 1e-7
"""[rad] Tolerance from which explicit steps through many switches are of order 5."""

LOW_ORDER_SWITCHES = 48
"""[switches] Of a field from which they are: the steps then end at switches so often that the
stages of order 8 do not pay. The gradient of four bodies with a network of 64 relu takes 1.8 times
as long by order 8; with one of 32 both orders take as long; a satellite with plates and tables (20
switches) takes four times the steps by order 5 at 1e-6."""

SORTED_BODIES = 64
"""[bodies] More are sorted by their rates, so that those side by side take similar steps."""

SHARED_STEP_BODIES = 200
"""[bodies] Of one chunk where all bodies of a chunk take the same steps (solvers of diffrax)."""

ACCELERATOR_BODIES = 2**18
"""[bodies] Of one chunk on a GPU or TPU; bounds the memory."""

SAVE_SAMPLES = 2**18
"""[bodies times samples] Of one chunk on a CPU where a function of the motion is saved in its
place (``Record(save=)``): 15 MB of states in float64."""

ACCELERATOR_SAVE_SAMPLES = 2**24
"""[bodies times samples] The same on an accelerator: 0.9 GB."""

STEP_OVERHEAD = 30
"""[evaluations of the field] That a step costs beside its own; decides the order of the midpoint
rule."""

RECORD_SEGMENTS = 256
"""[segments] Of the recorded steps: reverse mode replays one segment at a time, which bounds the
memory to a state for each segment and each step of one."""

RECORDED_TURNS = 512
"""[turns] Of the loop of explicit steps that are recorded where values with derivatives are
computed, at most: reverse mode need not integrate again if there are not more."""

RECORDED_TURNS_OF_FEW = 128
"""[turns] The same of a few bodies, for ``jax.vmap`` may multiply their number afterwards: by
100,000 the records take 2 GB."""

RECORDED_MEMORY = 2**26
"""[bytes] Of such records of all bodies, at most."""

FEWEST_RECORDED_TURNS = 64
"""[turns] If there is room for fewer, none are recorded: most motions take more."""

COMPENSATED_STEPS = 20_000
"""[units of rounding] Tolerance below which steps carry their rounding errors along. Without that
they lose about eps * angle**1.5, more than rtol from (rtol/eps)**(2/3) = 740 rad on."""


# Closed forms.

COMPENSATED_PHASES = 1e5
"""[units of rounding] Tolerance below which a free body has its frequencies in sums of two floats:
its phase loses eps times the angle, more than rtol from 1e5 rad on."""

FREE_CHUNK = 2**12
"""[bodies times samples] Of free bodies in one chunk, whose arrays stay in the cache of a core."""

FREE_LANES = 512
"""[bodies] Whose constants stay in the cache while they are moved to many times (TIME_LOOP)."""

TIME_LOOP_BODIES = 64
"""[bodies] From which TIME_LOOP applies."""

TOP_CHUNK = 2**11
"""[bodies times samples] Of Lagrange's tops in one chunk."""

ELEMENTARY_CHUNK = 2**14
"""[bodies times samples] In a chunk of motions in elementary functions."""

ACCELERATOR_SAMPLES = 2**18
"""[bodies times samples] Of any closed form in one chunk on a GPU or TPU; bounds the memory. With
the chunks of a CPU a million free bodies take 4 times as long on an H200, and a million of
Lagrange's tops 300 times; all at once, tops twice as long in float64."""

EVENT_LOOK = 128
"""[bodies times samples] At which a search for the first event of a closed form evaluates it at
once, for two samples of each body at least. Two samples at a time take a single body three to six
times as long, as each look computes the constants of the motion; a whole window takes 1,000 bodies
with events at times of their own three times as long, as roots are looked at with that width."""


# Fits.

BRIEF_FIT = 2**13
"""[samples] Of recordings whose fit, outside of a compiled function, is compiled without the
optimisations of LLVM: it takes at most a second, and they take more."""

FIT_SAMPLES = 1024
"""[samples] Of recordings that are fitted side by side on a CPU."""


def platform() -> str:
    """The platform that a program traced now is compiled for: "cpu", "gpu" or "tpu".

    That of ``jax.default_device`` if it is set, otherwise of the default backend: values have no
    platform while they are traced.
    """
    device: Any = jax.config.jax_default_device  # type: ignore[attr-defined]
    if device is None:
        return jax.default_backend()
    return device if isinstance(device, str) else platform_of(device)


def platform_of(device: Any) -> str:
    """The platform of one device."""
    return device.platform


def kind_of(device: Any) -> str:
    """The platform and model of one device, for records of runs."""
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
    """Whether functions become fused kernels: on a CPU."""
    return FUSION and is_cpu() and not is_plain()


def is_folded() -> bool:
    """Whether fields are folded before the loop."""
    return FOLDING and not is_plain()


def is_staged() -> bool:
    """Whether shared values are staged."""
    return STAGING and not is_plain()


def is_refilled(bodies: int) -> bool:
    """Whether the lanes of a batch are refilled: on a CPU, for more bodies than lanes. An
    accelerator integrates all bodies side by side."""
    return REFILLING and is_cpu() and not is_plain() and bodies > LANES


def linearises_units() -> bool:
    """Whether the values of a derivative may be one unit that holds others.

    In jax 0.10.0 what ``jax.linearize`` returns for such a program may hold tracers as constants:
    fits of scenes did not compile."""
    return jax.__version_info__ >= (0, 10, 2)


def is_time_loop(bodies: int, samples: int) -> bool:
    """Whether free bodies are moved to one time after the other."""
    usable = TIME_LOOP and is_cpu() and not is_plain()
    return usable and samples > 1 and bodies >= TIME_LOOP_BODIES


def bodies_to_save(samples: int) -> int:
    """Bodies in a chunk where a function of the motion is saved in its place; as many as there are
    lanes at least."""
    sample_limit = SAVE_SAMPLES if is_cpu() else ACCELERATOR_SAVE_SAMPLES
    return max(LANES, sample_limit // samples)


def recorded_turns(bodies: int, memory: int) -> int:
    """Turns of the loop that are recorded, of which each takes so many bytes for each body."""
    most = RECORDED_TURNS if bodies > KERNEL_BODIES else RECORDED_TURNS_OF_FEW
    turns = min(most, RECORDED_MEMORY // (bodies * memory))
    return turns if turns >= FEWEST_RECORDED_TURNS else 0


def samples_at_once(chunk: int) -> int:
    """Bodies times samples of a closed form in one chunk: ``chunk`` on a CPU, where its arrays stay
    in the cache of a core. An accelerator evaluates all side by side."""
    return chunk if is_cpu() else ACCELERATOR_SAMPLES


def bodies_at_once(lanes: int) -> int:
    """Bodies that are integrated side by side: ``lanes`` on a CPU."""
    return lanes if is_cpu() else ACCELERATOR_BODIES
