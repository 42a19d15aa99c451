"""What one chunk of an ensemble is: a pure function from its number to its arrays."""

import collections
from collections.abc import Mapping

import numpy as np

from polhode.ensemble._layout import Field
from polhode.ensemble._program import Block


def compute(block: Block, layout: Mapping[str, Field], chunk: int, k: int) -> dict[str, np.ndarray]:
    """The arrays of chunk ``k``, the bodies from ``k * chunk`` on, by name.

    Every device computes one block at a time. The result depends on ``k``, the seed and the scene
    alone: not on the size of the chunk, the number of devices or what was computed before.
    """
    first, last = k * chunk, min((k + 1) * chunk, block.ensemble.bodies)
    arrays = {}
    for name, field in layout.items():
        rows = field.region(k)
        arrays[name] = np.zeros((rows.stop - rows.start, *field.shape[1:]), field.dtype)
    pending: collections.deque = collections.deque()

    def collect() -> None:
        start, values = pending.popleft()
        for name, array in arrays.items():
            part = np.asarray(values[name])
            axis = layout[name].dimensions[0]
            if axis == "chunk":
                array[0] += part.sum(axis=0)
                continue
            row = (start - first) // (block.size if axis == "block" else 1)
            array[row : row + len(part)] = part[: len(array) - row]

    for start in range(first, last, block.size):
        if len(pending) == len(block.devices):
            collect()
        pending.append((start, block(start)))
    while pending:
        collect()
    return arrays
