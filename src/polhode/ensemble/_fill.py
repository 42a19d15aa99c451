"""The work of one process: compute what is missing, write it meanwhile, check what was there."""

import collections
import concurrent.futures
import itertools
import time
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from polhode.ensemble._program import Block
from polhode.ensemble._store import Store

_WAITING = 2  # files handed to the writer and not yet on the disk


class Progress(NamedTuple):
    """Bodies finished out of the share of this process; ``rate`` bodies/s of this run,
    ``remaining`` seconds (None before the first chunk); ``reused`` bodies were there already.
    """

    done: int
    total: int
    reused: int
    rate: float | None
    remaining: float | None


def fill(
    store: Store,
    block: Block,
    share: range,
    verify: bool,
    ahead: int,
    progress: Callable[[Progress], None],
) -> None:
    """Compute the chunks of the share that are missing, then those that turn out damaged.

    Finished chunks are read and checked in a thread of their own meanwhile. A chunk is begun when
    the one before it is marked: whatever ends the process costs one chunk at most. ``ahead``
    blocks are computed at a time.
    """
    tally = _Tally(store, block.ensemble.bodies, share, progress)
    marked = store.finished()
    todo = collections.deque(n for n in share if not marked[n])
    old = iter([n for n in share if marked[n]])
    tally.begin(n for n in share if marked[n])
    with (
        concurrent.futures.ThreadPoolExecutor(1) as writer,
        concurrent.futures.ThreadPoolExecutor(1) as reader,
    ):
        checks = _checks(store, reader, old) if verify else iter(())
        pending = next(checks, None)
        while todo or pending is not None:
            while pending is not None and (pending[1].done() or not todo):
                number, good = pending[0], pending[1].result()
                if not good:
                    tally.lost(number)
                    todo.append(number)
                pending = next(checks, None)
            if todo:
                number = todo.popleft()
                _chunk(store, block, number, writer, ahead)
                tally.done(number)


def _checks(store: Store, reader, numbers: Iterator[int]):
    for number in numbers:
        yield number, reader.submit(store.valid, number)


class _Tally:
    """Counts bodies and reports them."""

    def __init__(self, store: Store, bodies: int, share: range, progress):
        self.chunk, self.bodies, self.progress = store.chunk, bodies, progress
        self.total = sum(map(self.count, share))
        self.reused = self.computed = 0
        self.began = time.perf_counter()

    def count(self, number: int) -> int:
        return min(self.chunk, self.bodies - number * self.chunk)

    def begin(self, marked: Iterator[int]) -> None:
        self.reused = sum(map(self.count, marked))
        self.report()

    def lost(self, number: int) -> None:
        self.reused -= self.count(number)
        self.report()

    def done(self, number: int) -> None:
        self.computed += self.count(number)
        self.report()

    def report(self) -> None:
        done, rate, remaining = self.reused + self.computed, None, None
        if self.computed:
            rate = self.computed / (time.perf_counter() - self.began)
            remaining = (self.total - done) / rate
        self.progress(Progress(done, self.total, self.reused, rate, remaining))


def _chunk(store: Store, block: Block, number: int, writer, ahead: int) -> None:
    """Compute a chunk and have it written and marked; one file is written while the next ones are
    computed.
    """
    # the trajectories go file by file as they come; what has one file in a chunk is gathered
    rows = {name: store.rows(name, number) for name in store.arrays}
    gathered = {
        name: np.zeros((r.stop - r.start, *store.arrays[name].shape[1:]), store.arrays[name].dtype)
        for name, r in rows.items()
        if name not in store.split
    }
    first = number * store.chunk
    last = min(first + store.chunk, block.ensemble.bodies)
    waiting: collections.deque = collections.deque()
    checksum = 0

    def wait(most: int) -> None:
        while len(waiting) > most:
            waiting.popleft().result()

    def write(name: str, rows: slice, values: np.ndarray) -> None:
        nonlocal checksum  # of the writer's thread alone, until all is written
        checksum = store.write(name, rows, values, checksum)

    def send(name: str, rows: slice, values: np.ndarray) -> None:
        wait(_WAITING - 1)
        waiting.append(writer.submit(write, name, rows, values))

    files = store.pieces(number)
    blocks: list[dict] = []  # of the files at hand, which hold whole blocks
    for offset, found in _blocks(block, first, last, ahead):
        _gather(gathered, offset, found, block.size)
        blocks.append({name: np.asarray(found[name]) for name in store.split})
        done = min(offset + block.size, last - first)
        if done % store.piece and done < last - first:
            continue
        for name, at in itertools.islice(files, len(store.split)):
            parts = [one[name] for one in blocks]
            values = parts[0] if len(parts) == 1 else np.concatenate(parts)
            send(name, at, values[: at.stop - at.start])
        blocks.clear()
    for name, at in files:
        send(name, at, gathered[name][at.start - rows[name].start : at.stop - rows[name].start])
    wait(0)
    store.finish(number, checksum)


def _blocks(block: Block, first: int, last: int, ahead: int):
    """(offset in the chunk, arrays) of each block in order, ``ahead`` in flight."""
    flying: collections.deque = collections.deque()
    for start in range(first, last, block.size):
        flying.append((start - first, block(start)))
        if len(flying) >= ahead:
            yield flying.popleft()
    yield from flying


def _gather(parts: dict, offset: int, found: dict, size: int) -> None:
    for name, part in parts.items():
        values = np.asarray(found[name])
        if name.endswith("_histogram"):
            part[0] += values.sum(axis=0)
            continue
        at = offset if name == "status" else offset // size
        count = min(len(values), len(part) - at)
        part[at : at + count] = values[:count]
