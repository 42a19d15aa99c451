"""Several processes: how they find their numbers, and which of them have ended."""

import contextlib
import json
import os
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import jax

from polhode.ensemble._store import Store, StoreError, locked, running

PATIENCE = 300.0


def join(
    coordinator: str | None = None,
    processes: int | None = None,
    process: int | None = None,
    *,
    patience: float = PATIENCE,
) -> tuple[int, int]:
    """Meet the other processes of a run through ``jax.distributed``; (process, processes).

    ``coordinator``: HOST:PORT of process 0, the same for all; ``processes`` and ``process``: how
    many there are and which this is. What is None comes from the variables
    ``JAX_COORDINATOR_ADDRESS``, ``JAX_NUM_PROCESSES`` and ``JAX_PROCESS_ID``, or else from the
    clusters that JAX knows (SLURM, Open MPI, Kubernetes, Cloud TPU), which also tell each process
    of a machine its own GPU. To be called before anything is computed. They meet in a child
    process, which ends when all have come: the bodies of a run need nothing from each other, and
    JAX ends every process of a group when one of them dies.

    Raises StoreError when there is no coordinator, it does not answer within ``patience``
    seconds, others do not come, or two processes claim the same number.
    """
    coordinator = coordinator or os.environ.get("JAX_COORDINATOR_ADDRESS") or None
    processes = _number("JAX_NUM_PROCESSES") if processes is None else processes
    process = _number("JAX_PROCESS_ID") if process is None else process
    if processes is not None and process is not None:
        _in_range(process, processes)
    if coordinator is not None:
        host, _, port = coordinator.rpartition(":")
        if not host or not port.isdigit():
            raise StoreError(f"the coordinator must be HOST:PORT, got {coordinator!r}.")
        if process not in (None, 0):
            _reach(host.strip("[]"), int(port), process, patience)
    found = _call(coordinator, processes, process, max(1, round(patience)))
    for name in ("jax_cuda_visible_devices", "jax_rocm_visible_devices"):
        if found["devices"] not in (None, "all"):
            jax.config.update(name, found["devices"])
    return found["process"], found["processes"]


_ROLL_CALL = """
import json, sys
import jax
coordinator, processes, process, patience = json.loads(sys.argv[1])
try:
    jax.distributed.initialize(
        coordinator, processes, process, initialization_timeout=patience
    )
except (ValueError, TypeError) as error:
    print(json.dumps({"error": str(error)}))
    sys.exit(1)
found = {"process": jax.process_index(), "processes": jax.process_count()}
found["devices"] = getattr(jax.config, "jax_cuda_visible_devices", None)
jax.distributed.shutdown()
print(json.dumps(found))
"""


def _call(coordinator, processes, process, patience: int) -> dict[str, Any]:
    """Meet in a process of its own: JAX ends a process whose fellows do not come or die."""
    given = json.dumps([coordinator, processes, process, patience])
    done = subprocess.run(
        [sys.executable, "-c", _ROLL_CALL, given],
        capture_output=True, text=True, check=False, env=os.environ | {"JAX_PLATFORMS": "cpu"},
    )  # fmt: skip
    lines = done.stdout.splitlines()
    found = json.loads(lines[-1]) if lines and lines[-1].startswith("{") else {}
    if done.returncode == 0 and "process" in found:
        return found
    if "error" in found:
        raise StoreError(
            "no coordinator was given and JAX finds no cluster: give the coordinator (HOST:PORT),"
            " the number of processes and the number of this one, or start under SLURM or Open"
            f" MPI. Known: coordinator {coordinator}, processes {processes}, process {process}"
            f" ({found['error']})"
        )
    who = f"process {'?' if process is None else process} of {processes or '?'}"
    where = coordinator or "the coordinator"
    if "ALREADY_EXISTS" in done.stderr:
        raise StoreError(
            f"{who}: another process came to {where} with the same number: start each number once."
        )
    if "DEADLINE_EXCEEDED" in done.stderr:
        raise StoreError(
            f"{who}: not all the others came to {where} within {patience} s, or two came with the"
            " same number: start each number once, or wait longer for them."
        )
    last = next((x for x in reversed(done.stderr.splitlines()) if x.strip()), "no message")
    raise StoreError(f"{who}: the processes did not meet at {where}. JAX says: {last}")


def claimed(path: Path, processes: int | None, process: int | None):
    """Hold the store under a number while the processes meet, where the number is known.

    Raises StoreError for a number out of range or one that another process holds.
    """
    if processes is None or process is None:
        return contextlib.nullcontext()
    _in_range(process, processes)
    return locked(Path(path).resolve(), process, processes)


def _in_range(process: int, processes: int) -> None:
    if not 0 <= process < processes:
        raise StoreError(
            f"process {process} of {processes}: processes are numbered from 0 to {processes - 1}."
        )


def _number(name: str) -> int | None:
    text = os.environ.get(name)
    if text is None:
        return None
    if not text.isdigit():
        raise StoreError(f"the variable {name} must be a whole number, got {text!r}.")
    return int(text)


def _reach(host: str, port: int, process: int, patience: float) -> None:
    """Wait until somebody listens there."""
    end = time.monotonic() + patience
    while True:
        try:
            socket.create_connection((host, port), timeout=max(0.1, min(5.0, patience))).close()
            return
        except OSError as error:
            if time.monotonic() > end:
                raise StoreError(
                    f"no coordinator answers at {host}:{port} ({error}) within {patience:g} s:"
                    f" start process 0 there, beside this process {process}, or name the address"
                    " of its machine."
                ) from error
            time.sleep(0.2)


def absent(store: Store, process: int, processes: int) -> list[str]:
    """What to tell about the others that have chunks to do and are not running."""
    marked, told = store.finished(), []
    for other in range(processes):
        share = marked[other::processes]
        missing = int((~share).sum())
        if other == process or not missing or running(store.path, other):
            continue
        told.append(
            f"process {other} of {processes} is not running and {missing} of its {share.size}"
            " chunks are missing: give its command again."
        )
    return told
