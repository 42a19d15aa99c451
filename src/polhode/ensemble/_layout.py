"""The arrays of a store, and how many bodies form a chunk."""

import math
from typing import Any, NamedTuple

import numpy as np

_CHUNK_BYTES = 2**26
_STATISTICS_BLOCKS = 64  # blocks of a chunk where only statistics are stored
_PROCESS_BYTES = 600_000_000  # Python, JAX and the compiled program
_DEFAULT_MEMORY = 4_000_000_000
_COPIES = 4  # of a chunk while it is computed, compressed and written


class Field(NamedTuple):
    """One array of a store. ``rows`` rows form a chunk, which is one file."""

    shape: tuple[int, ...]
    rows: int
    dtype: Any
    dimensions: tuple[str, ...]
    attributes: dict[str, Any]

    @property
    def fill_value(self) -> Any:
        """A value that no result has."""
        if self.dtype == np.uint8:
            return 255
        return np.nan if np.issubdtype(self.dtype, np.floating) else -1

    def region(self, k: int) -> slice:
        """The rows of chunk ``k``."""
        return slice(k * self.rows, min((k + 1) * self.rows, self.shape[0]))


class Sizes(NamedTuple):
    """Bodies of a chunk, and the number of chunks that one process computes at a time."""

    chunk: int
    concurrent: int


def sizes(
    bodies: int,
    block: int,
    body_bytes: int,
    trajectories: bool,
    devices: int,
    cores: int,
    memory: int | None,
    chunk: int | None,
) -> Sizes:
    """Sizes that stay within ``memory`` bytes. ``block``: bodies of a block; ``body_bytes``: bytes
    of one trajectory. Raises ValueError for a memory or a chunk that is not possible.
    """
    if chunk is not None and (chunk < 1 or chunk % block):
        raise ValueError(
            f"chunk must be a positive multiple of the block of {block} bodies, got {chunk}: leave"
            f" it out, or give --chunk {max(1, round(chunk / block)) * block} or a multiple of"
            f" {block} (chunk= in Python)."
        )
    block_bytes = block * body_bytes
    available = (_DEFAULT_MEMORY if memory is None else memory) - _PROCESS_BYTES
    unit = devices  # every device computes a block of its own at a time

    def required(blocks: int) -> int:
        """Bytes for one chunk of so many blocks."""
        stored = blocks if trajectories else 0
        return block_bytes * (_COPIES * (stored or 1) + 2 * devices)

    if memory is not None and required(1) > available:
        least = required(1) + _PROCESS_BYTES
        raise ValueError(
            f"a memory of {memory:,} bytes is too small: raise --memory to"
            f" {math.ceil(least / 1e7) / 100}GB or more (memory={least} in Python), the minimum for"
            " these times and devices, or save fewer times."
        )
    if chunk is not None:
        blocks = chunk // block
    else:
        target = _CHUNK_BYTES // block_bytes if trajectories else _STATISTICS_BLOCKS
        while target > 1 and required(target) > available:
            target //= 2
        blocks = unit * -(-target // unit) if target > 0 else 1
        blocks = min(blocks, -(-bodies // block))
    concurrent = max(1, min(cores, available // required(blocks)))
    return Sizes(blocks * block, int(concurrent))


def fields(
    bodies: int, chunk: int, block: int, times: np.ndarray, trajectories: bool, statistics: tuple
) -> dict[str, Field]:
    """Arrays of the store by name."""
    from polhode._method import Status

    t = times.size
    status = {
        "units": "1",
        "long_name": "outcome of each body; 255: not computed",
        "flag_values": [int(code) for code in Status],
        "flag_meanings": " ".join(code.name.lower() for code in Status),
    }
    arrays = {"status": Field((bodies,), chunk, np.dtype("uint8"), ("body",), status)}
    if trajectories:
        wxyz = {"units": "1", "long_name": "attitude quaternion, scalar first, body to space"}
        omega = {"units": "rad s-1", "long_name": "angular velocity in body axes"}
        for name, width, axis, words in (
            ("wxyz", 4, "quaternion", wxyz),
            ("omega_body", 3, "axis", omega),
        ):
            dimensions = ("body", "time", axis)
            arrays[name] = Field((bodies, t, width), chunk, times.dtype, dimensions, words)
    blocks, chunks = -(-bodies // block), -(-bodies // chunk)
    for s in statistics:
        for name in ("count", "mean", "squares", "least", "greatest"):
            dtype = np.dtype("int32") if name == "count" else times.dtype
            words = {"long_name": f"{name} of {s.name} in each block of {block}"}
            dimensions = ("block", "time")
            arrays[f"{s.name}_{name}"] = Field(
                (blocks, t), chunk // block, dtype, dimensions, words
            )
        if s.low is not None:
            words = {"long_name": f"bodies per bin of {s.name}, those below and above included"}
            dimensions = ("chunk", "time", f"{s.name}_bin")
            arrays[f"{s.name}_histogram"] = Field(
                (chunks, t, s.bins + 2), 1, np.dtype("int64"), dimensions, words
            )
    return arrays
