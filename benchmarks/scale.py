"""Ensembles: time of a run, of computing and of writing, memory, devices, kills, cost per body.

    python -m benchmarks.scale store        1e6 bodies x 100 times and 1e7 x 10 (free disk: 12 GB)
    python -m benchmarks.scale cost         ns per body and per saved state, on one core
    python -m benchmarks.scale devices      a sharded batch of 1e6 bodies compared with one device
    python -m benchmarks.scale kills        20 kills at random moments
    python -m benchmarks.scale parts        one part, two, and a dask cluster of two, a core each
    python -m benchmarks.scale model        the tables of docs/scale.md, from the committed results

Each command except the last writes ``scale_NAME.json``. Stores of kills, parts and clusters are
compared bit by bit with that of an undisturbed run.
"""

import argparse
import collections
import json
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from benchmarks import _report

ARRAYS = ("wxyz", "omega_body", "status")
CASES = {"1e6 x 100": (1_000_000, 100), "1e7 x 10": (10_000_000, 10)}
PARTS = ("store", "cost", "devices", "kills", "parts")
CHUNK = 16384


def make(bodies: int):
    """Free triaxial bodies with uniform attitudes."""
    import jax.numpy as jnp

    import polhode as ph
    from polhode import ensemble as ens

    scene = ph.Scene(ph.Inertia.from_moments([1.0, 2.0, 2.5]))
    state = ph.State([1.0, 0.0, 0.0, 0.0], [0.1, 1.0, 0.2])
    spreads = (ens.AnyAttitude(), ens.SpreadRates(ens.Deviate(jnp.full(3, 0.1))))
    return ens.Ensemble(scene, state, bodies, spreads, 1)


def store(bodies: int, times: int, folder: Path) -> dict:
    """A complete run, and the same blocks computed alone and the same bytes written alone."""
    import jax
    import numpy as np

    from polhode import ensemble as ens
    from polhode.ensemble._stream import Block

    ensemble, ts = make(bodies), np.linspace(0.0, 100.0, times)
    block = Block(ensemble, ts, None, None, True, (), jax.devices()[:1])
    began = time.perf_counter()
    found = jax.block_until_ready(block(0))
    compiling = time.perf_counter() - began
    starts = range(0, bodies, block.size)

    def compute() -> float:
        began = time.perf_counter()
        flying = collections.deque()
        for first in starts:  # as in a run: as many blocks at a time as there are cores, plus one
            flying.append(block(first))
            if len(flying) > _report.threads():
                jax.block_until_ready(flying.popleft())
        jax.block_until_ready(list(flying))
        return time.perf_counter() - began

    whole = [np.asarray(found[name]) for name in ARRAYS]

    def write() -> float:
        began = time.perf_counter()
        for k in range(len(starts)):
            with open(folder / f"raw{k}", "wb") as file:
                for part in whole:
                    file.write(part.data)
                file.flush()
                os.fsync(file.fileno())
        spent = time.perf_counter() - began
        for k in range(len(starts)):
            (folder / f"raw{k}").unlink()
        return spent

    def run() -> float:
        began = time.perf_counter()
        ens.stream(ensemble, ts, folder / "run.zarr")
        spent = time.perf_counter() - began
        shutil.rmtree(folder / "run.zarr")
        return spent

    # before and after the run, since the disk's speed changes from minute to minute
    writing = [write()]
    computing = [compute()]
    running = run()
    computing.append(compute())
    writing.append(write())
    compute_s, write_s = sum(computing) / 2, sum(writing) / 2
    size = sum(part.nbytes for part in whole) * len(starts)
    return {
        "bodies": bodies,
        "times": times,
        "GB": size / 1e9,
        "compile_s": compiling,
        "compute_s": computing,
        "raw_write_s": writing,
        "run_s": running,
        "efficiency": max(compute_s, write_s) / running,
        "states_per_s": bodies * times / running,
        "raw_write_GB_per_s": size / 1e9 / write_s,
        "peak_memory_MB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3,
    }


def cost(bodies: int = 65_536) -> dict:
    """Nanoseconds per body and per saved state, from blocks of 10 and of 100 times, on one core."""
    import jax
    import numpy as np

    from polhode.ensemble._stream import Block

    each, spread = {}, 0.0
    for times in (10, 100):
        block = Block(
            make(bodies), np.linspace(0.0, 100.0, times), None, None, True, (), jax.devices()[:1]
        )

        def call(block=block):
            jax.block_until_ready([block(first) for first in range(0, bodies, block.size)][-1])

        timing = _report.clock(call, budget=4.0)
        each[times] = 1e9 * timing.median / bodies
        spread = max(spread, timing.spread)
    state = (each[100] - each[10]) / 90
    return {
        "ns_per_body": each[10] - 10 * state,
        "ns_per_state": state,
        "spread": spread,
        "bytes_per_state": 7 * 8,
        "bytes_per_body": 1,
    }


def devices(bodies: int, times: int) -> dict:
    """``simulate`` of a batch on one device, and sharded over 2, 4 and 8 virtual devices."""
    import jax
    import numpy as np
    from jax.sharding import Mesh, NamedSharding, PartitionSpec

    import polhode as ph

    scene, state = make(bodies).draw(np.arange(bodies))
    ts = np.linspace(0.0, 100.0, times)
    calls, results = {}, {}
    for count in (1, 2, 4, 8):
        mesh = Mesh(np.array(jax.devices()[:count]), ("body",))
        placed = jax.device_put(state, NamedSharding(mesh, PartitionSpec("body")))

        def call(placed=placed, count=count):
            results[count] = jax.block_until_ready(ph.simulate(scene, placed, ts).wxyz)

        calls[str(count)] = call
    timings = _report.in_turn(calls, repeats=5, budget=20.0)
    one = timings["1"].median
    return {
        "bodies": bodies,
        "times": times,
        "seconds": {n: t.median for n, t in timings.items()},
        "spread": {n: t.spread for n, t in timings.items()},
        "over_one_device": {n: t.median / one - 1 for n, t in timings.items()},
        "greatest_difference": {
            str(n): float(np.abs(np.asarray(x) - np.asarray(results[1])).max())
            for n, x in results.items()
        },
    }


def child(path: str) -> None:
    """One run of 300,000 bodies, in a process that is killed."""
    import numpy as np

    from polhode import ensemble as ens

    ens.stream(make(300_000), np.linspace(0.0, 10.0, 10), path, chunk=CHUNK)


def _child(path: Path) -> subprocess.Popen:
    return subprocess.Popen([sys.executable, "-m", "benchmarks.scale", "child", str(path)])


def _equal(one: Path, other: Path) -> bool:
    from polhode.ensemble import open_store

    with open_store(one) as ours, open_store(other) as theirs:
        return ours.load().identical(theirs.load())


def kills(count: int, folder: Path) -> dict:
    """Kill and restart runs at random moments."""
    whole = folder / "whole.zarr"
    began = time.perf_counter()
    assert _child(whole).wait() == 0
    usual = time.perf_counter() - began
    seen = []
    while sum(row["kills"] for row in seen) < count:
        path = folder / f"killed{len(seen)}.zarr"
        done = 0
        for _ in range(5):
            running = _child(path)
            try:
                running.wait(random.uniform(0.3, 0.95) * usual)
                break
            except subprocess.TimeoutExpired:
                running.send_signal(signal.SIGKILL)
                running.wait()
                done += 1
        assert _child(path).wait() == 0
        seen.append({"kills": done, "equal": _equal(path, whole)})
        print(seen[-1], flush=True)
        shutil.rmtree(path)
    return {
        "kills": sum(row["kills"] for row in seen),
        "stores": len(seen),
        "stores_equal": sum(row["equal"] for row in seen),
    }


TOPS = """
[inertia]
axisymmetric = { transverse = 1.0, axial = 0.5 }
[state]
euler = { angles = [0.0, 60.0, 0.0], unit = "deg" }
omega_body = [0.1, 0.2, 5.0]
[potential]
kind = "uniform-gravity"
mass = 1.0
centre_body = [0.0, 0.0, 0.1]
[times]
stop = 1000.0
number = 751
[ensemble]
bodies = BODIES
seed = 1
trajectories = false
[ensemble.omega_body]
sigma = 0.3
[[ensemble.statistics]]
quantity = "tilt"
low = 0
high = 3.2
"""


def parts(folder: Path, bodies: int = 262_144) -> dict:
    """Heavy tops over 1,000 s in 32 chunks, statistics only: by one process, by two parts, and by a
    dask cluster of two workers, each process on its own core.
    """
    scene = folder / "tops.toml"
    scene.write_text(TOPS.replace("BODIES", str(bodies)))
    cores = sorted(os.sched_getaffinity(0))[:2]
    python = [sys.executable, "-m"]

    def start(core: int, words: list, quiet: bool = False) -> subprocess.Popen:
        command = ["taskset", "-c", str(core), *python, *map(str, words)]
        return subprocess.Popen(command, stderr=subprocess.DEVNULL if quiet else None)

    def run(name: str, *words: object) -> list:
        store = folder / f"{name}.zarr"
        return ["polhode", "run", scene, "-o", store, "--chunk", 8192, "-q", *words]

    def clock(name: str, commands: list) -> None:
        """Wall time, and the processor time of the slowest process of each group."""
        began, busy = time.perf_counter(), 0.0
        for group in commands:
            running = [start(core, words) for core, words in zip(cores, group)]
            ended = [os.wait4(process.pid, 0)[1:] for process in running]
            assert [code for code, _ in ended] == [0] * len(ended)
            busy += max(used.ru_utime + used.ru_stime for _, used in ended)
        found[f"{name}_s"] = time.perf_counter() - began
        found[f"{name}_cpu_s"] = busy

    found = {"bodies": bodies, "load": os.getloadavg()[0]}
    clock("first", [[run("first", "--part", "1/32")]])  # fills the cache of compiled programs
    clock("one", [[run("one")]])
    clock("parts", [[run("parts", "--part", f"{i}/2") for i in (1, 2)], [run("parts")]])
    address = "127.0.0.1:8799"
    scheduler = ["distributed.cli.dask_scheduler", "--port", "8799", "--dashboard-address", ":0"]
    worker = ["distributed.cli.dask_worker", address, "--nthreads", "1", "--no-dashboard"]
    cluster = [start(cores[0], scheduler, True)] + [start(core, worker, True) for core in cores]
    try:
        time.sleep(8.0)  # the time of the run does not include the start of the cluster
        clock("dask", [[run("dask", "--scheduler", address)]])
    finally:
        for process in reversed(cluster):
            process.terminate()
            process.wait()
    for name in ("parts", "dask"):
        found[f"{name}_over_one"] = found[f"{name}_s"] / found["one_s"]
    found["equal"] = all(
        _equal(folder / f"{name}.zarr", folder / "one.zarr") for name in ("parts", "dask")
    )
    return found


BUS_GB_PER_S = 25.0
"""Assumed: what a GPU hands to its host over 16 lanes of PCIe 4. Not measured."""


def model() -> str:
    """Markdown tables of docs/scale.md: extrapolation to 1e9 bodies, and measured runs."""
    cost, store = (_report.read(f"scale_{name}")["numbers"] for name in ("cost", "store"))
    body, state = cost["ns_per_body"] * 1e-9, cost["ns_per_state"] * 1e-9
    disk = min(case["raw_write_GB_per_s"] for case in store.values())

    def compute(bodies, times, cores):
        return bodies * (body + times * state) / cores

    def size(bodies, times):
        return bodies * (times * cost["bytes_per_state"] + cost["bytes_per_body"]) / 1e9

    lines = [
        "| 1e9 bodies x | 1 core | 64 cores | 1 GPU, at least | 64 GPUs, at least | store |"
        " run on two cores and the measured disk |",
        "|---|---|---|---|---|---|---|",
    ]
    for case in store.values():
        times = case["times"]
        big = size(1e9, times)
        spans = [compute(1e9, times, 1), compute(1e9, times, 64), big / BUS_GB_PER_S]
        spans += [spans[-1] / 64, 1e9 / case["bodies"] * case["run_s"]]
        *before, last = map(_span, spans)
        lines.append(
            f"| {times} times | " + " | ".join([*before, f"{big / 1e3:.2g} TB", last]) + " |"
        )
    lines += [
        "",
        "| measured, two cores | computing: model, measured | writing alone | run | slower of both"
        " / run | peak memory |",
        "|---|---|---|---|---|---|",
    ]
    for name, case in store.items():
        computing, writing = (sum(case[k]) / 2 for k in ("compute_s", "raw_write_s"))
        lines.append(
            f"| {name} | {compute(case['bodies'], case['times'], 2):.1f} s, {computing:.1f} s |"
            f" {writing:.1f} s | {case['run_s']:.1f} s | {case['efficiency']:.2f} |"
            f" {case['peak_memory_MB']:.0f} MB |"
        )
    rate = cost["bytes_per_state"] / cost["ns_per_state"]
    lines += [
        "",
        f"One core needs {cost['ns_per_body']:.0f} ns per body and {cost['ns_per_state']:.0f} ns"
        f" per saved state of {cost['bytes_per_state']} bytes, that is {rate:.2g} GB/s when many"
        f" times are saved. The disk writes {disk:.2g} GB/s: with more than {disk / rate:.1f} cores"
        " it is the bottleneck.",
        "",
        _others(*(_report.read(f"scale_{name}")["numbers"] for name in ("kills", "devices"))),
    ]
    return "\n".join(lines)


def _others(kills: dict, devices: dict) -> str:
    over = ", ".join(f"{100 + 100 * devices['over_one_device'][n]:.0f} %" for n in ("2", "4", "8"))
    away = max(devices["greatest_difference"].values())
    return (
        f"Interruptions: after {kills['kills']} kills at random moments of {kills['stores']} runs,"
        f" {kills['stores_equal']} of the {kills['stores']} stores are equal to an undisturbed one"
        " bit by bit.\n\n"
        f"Devices: `ph.simulate` of {devices['bodies']:,} bodies x {devices['times']} times sharded"
        f" over 2, 4 and 8 virtual devices of two cores takes {over} of the time on one device, and"
        f" its attitudes differ by at most {away:.0e} (two cores allow at most a factor of two)."
    )


def _span(seconds: float) -> str:
    for unit, size in (("days", 86400.0), ("h", 3600.0), ("min", 60.0)):
        if seconds >= size:
            return f"{seconds / size:.2g} {unit}"
    return f"{seconds:.2g} s"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=(*PARTS, "model", "child"))
    parser.add_argument("words", nargs="*", help=argparse.SUPPRESS)
    parser.add_argument("--case", choices=CASES, help="one case of the store alone")
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--bodies", type=int, default=1_000_000, help="of the sharded batch")
    parser.add_argument("--folder", type=Path, help="where the stores are made")
    parser.add_argument("--output", type=Path, help="file to write")
    options = parser.parse_args()
    if options.what == "model":
        print(model())
        return
    if options.what == "cost":
        _report.one_thread()
    import jax

    jax.config.update("jax_enable_x64", True)
    if options.what == "child":
        child(*options.words)
        return
    if options.what == "devices":
        jax.config.update("jax_num_cpu_devices", 8)
    with tempfile.TemporaryDirectory(dir=options.folder) as folder:
        if options.what == "store" and options.case is None:
            found = {}
            for case in CASES:  # peak memory is that of a process: use one for each case
                part = Path(folder) / "part.json"
                command = [sys.executable, "-m", "benchmarks.scale", "store", "--case", case]
                where = ["--folder", folder, "--output", str(part)]
                subprocess.run([*command, *where], check=True, stdout=subprocess.DEVNULL)
                found[case] = json.loads(part.read_text())["numbers"]
        else:
            found = {
                "store": lambda: store(*CASES[options.case], Path(folder)),
                "cost": cost,
                "devices": lambda: devices(options.bodies, 10),
                "kills": lambda: kills(options.kills, Path(folder)),
                "parts": lambda: parts(Path(folder)),
            }[options.what]()
    print(json.dumps(found, indent=1))
    path = options.output or _report.OUT / f"scale_{options.what}.json"
    _report.write("scale", found, path=path, packages=("zarr", "distributed"))


if __name__ == "__main__":
    main()
