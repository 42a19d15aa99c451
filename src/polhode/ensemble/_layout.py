"""The arrays of a store, and how many bodies go into a chunk and into a file."""

import math
from typing import Any, NamedTuple

import numpy as np

_PIECE_BYTES = 2**25
_PIECES, _BLOCKS = 16, 64  # of a chunk: files per array; blocks where only statistics are kept
_OWN_MEMORY = 600_000_000  # Python, JAX and the compiled program
_COPIES, _PER_DEVICE = 5, 5  # pieces on their way to the disk; blocks being computed or copied
_AHEAD_BYTES = 2**29


class Rows(NamedTuple):
    """Bodies of a chunk, which is finished or not, and of the files that make it up."""

    chunk: int
    piece: int


class Field(NamedTuple):
    """One array of a store: ``rows`` of it belong to a chunk and ``piece`` to a file."""

    shape: tuple[int, ...]
    rows: int
    piece: int
    dtype: Any
    dimensions: tuple[str, ...]
    attributes: dict[str, str]


def rows(
    bodies: int,
    block: int,
    body_bytes: int,
    whole: bool,
    devices: int,
    memory: int | None,
    chunk: int | None,
) -> Rows:
    """Sizes in whole blocks. ``whole``: trajectories are kept. ValueError for what cannot be."""
    if chunk is not None and (chunk < 1 or chunk % block):
        raise ValueError(
            f"chunk must be a positive multiple of the block of {block} bodies, got {chunk}: leave"
            f" it out, or give --chunk {max(1, round(chunk / block)) * block} or a multiple of"
            f" {block} (chunk= in Python)."
        )
    block_bytes = block * body_bytes
    budget = _PIECE_BYTES
    if memory is not None:
        least = _OWN_MEMORY + block_bytes * (_COPIES + _PER_DEVICE * devices)
        if memory < least:
            raise ValueError(
                f"a memory of {memory:,} bytes is too small: raise --memory to"
                f" {math.ceil(least / 1e7) / 100}GB or more (memory={least} in Python), the least"
                " for these times and devices, or save fewer times."
            )
        left = memory - _OWN_MEMORY - block_bytes * _PER_DEVICE * devices
        budget = min(budget, left // _COPIES)
    most = max(1, budget // block_bytes)
    if chunk is not None:
        blocks = chunk // block
        piece = next(k for k in range(min(most, blocks), 0, -1) if blocks % k == 0)
        return Rows(chunk, (piece if whole else blocks) * block)
    total = -(-bodies // block)
    # files are filled up: no larger than there are bodies
    piece = min(1 << (most.bit_length() - 1), total) if whole else 1
    # every device has a block of its own in each group, and a chunk holds whole groups
    unit = math.lcm(piece, devices)
    blocks = unit * -(-(_PIECES * piece if whole else _BLOCKS) // unit)
    blocks = min(blocks, piece * -(-total // piece))
    return Rows(blocks * block, (piece if whole else blocks) * block)


def ahead(block_bytes: int, cores: int, devices: int, memory: int | None) -> int:
    """Groups of blocks in flight at once. A block on a processor keeps about one core busy (its
    chunks come one after the other): one for each core, and one that waits, as memory allows.
    """
    budget = _AHEAD_BYTES
    if memory is not None:
        budget = max(0, memory - _OWN_MEMORY - block_bytes * (_COPIES + _PER_DEVICE * devices))
    extra = budget // (2 * block_bytes * devices)
    return 2 + max(0, min(extra, -(-cores // devices) - 1))


def fields(
    bodies: int, size: Rows, block: int, times, trajectories, statistics
) -> dict[str, Field]:
    """Arrays of the store by name."""
    t, chunk = times.size, size.chunk
    status = {"units": "1", "long_name": "outcome per body (0: finished, -1: not computed)"}
    found = {"status": Field((bodies,), chunk, chunk, "int8", ("body",), status)}
    if trajectories:
        wxyz = {"units": "1", "long_name": "attitude quaternion, scalar first, body to space"}
        omega = {"units": "rad s-1", "long_name": "angular velocity in body axes"}
        for name, width, axis, words in (
            ("wxyz", 4, "quaternion", wxyz),
            ("omega_body", 3, "axis", omega),
        ):
            found[name] = Field(
                (bodies, t, width), chunk, size.piece, times.dtype, ("body", "time", axis), words
            )
    blocks, chunks = -(-bodies // block), -(-bodies // chunk)
    for s in statistics:
        for name in ("count", "mean", "squares", "least", "greatest"):
            dtype = np.dtype("int32") if name == "count" else times.dtype
            words = {"long_name": f"{name} of {s.name} in each block of {block}"}
            each = chunk // block
            found[f"{s.name}_{name}"] = Field(
                (blocks, t), each, each, dtype, ("block", "time"), words
            )
        if s.low is not None:
            words = {"long_name": f"bodies per bin of {s.name}, those below and above included"}
            found[f"{s.name}_histogram"] = Field(
                (chunks, t, s.bins + 2), 1, 1, "int64", ("chunk", "time", f"{s.name}_bin"), words
            )
    return found


def title(attributes: dict[str, str]) -> dict[str, str]:
    """The attributes of the store."""
    from polhode import __version__

    return {
        "title": "Ensemble of rotating rigid bodies",
        "source": f"polhode {__version__}",
        "convention": "wxyz scalar first, body -> space; R = Rz(phi) Ry(theta) Rz(psi)",
    } | attributes
