"""Inertia of thrown objects from 55 real throws with a flywheel, and the recipe that finds it.

Recordings: TU Delft (arXiv:2503.13137), a device with gyroscope, accelerometer and wheel, thrown
alone, on a proof body of known inertia, and on objects in four configurations. Not shipped with the
project; expected in ``../shared/data/tudelft_throws`` or given by ``--data``. The recipe uses no
reference value of an object:

1. free flight only, from 80 ms after the wheel's start; speeds of the wheel read just after its
   motor was switched are left out;
2. one ``fit_balance`` of all throws: six tensors, and how the instrument departs from ideal;
3. centres of mass by ``lever_arm``;
4. the spin inertia of the wheel from the proof body: all moments are proportional to it;
5. the object: what was measured less the device (``MassProperties`` know the parallel axes).

Writes tensors of every throw and of every configuration, and their errors where a reference is in
the data: |moments - reference| / |reference|, and the smallest turn between principal axes.

    python -m benchmarks.throws [--varied] [--data FOLDER] [--output out/benchmarks/throws.json]

``--varied``: the joint fit again under other choices of the recipe as well (some minutes more).
"""

import json
import sys
from pathlib import Path

from benchmarks._report import one_thread, recordings, write

if __name__ == "__main__":
    one_thread()

import jax
import numpy as np

import polhode as ph
from polhode import fit as room
from polhode.inertia import MassProperties
from polhode.rotation import to_matrix

DATA = Path(__file__).resolve().parents[2] / "shared" / "data" / "tudelft_throws"
DEVICE, PROOF = "device_only", "proof_body"
# kg m^2, of the wheel: where the balance begins; the proof body corrects it
SPIN = 1.7e-6
# samples averaged first, and samples of those to a residual
FAST, BLOCK = 4, 4


# What a choice of the recipe might change: window of the flight, s; how much more is left out where
# the motor was switched, s; samples to a residual
VARIED = {
    "as it is": {},
    "flight from 0.10 to 0.52 s": {"flight": (0.10, 0.52)},
    "10 ms more left out at each switch": {"margin": 0.01},
    "5 samples to a residual": {"block": 5},
}


def load(folder, configurations=None, **how):
    """Index and recordings by configuration; ``how``: for ``recording``."""
    index = json.loads((folder / "index.json").read_text())
    arrays = np.load(folder / "throws.npz")
    found = {}
    for row in index["throws"]:
        if configurations is None or row["config"] in configurations:
            found.setdefault(row["config"], []).append(
                recording(arrays[row["key"]].astype(float), **how)
            )
    return index, found


def recording(table, flight=(0.08, 0.56), margin=0.0):
    """Free flight of one throw. Columns: time, rates, wheel, force."""
    times, wheel = table[:, 0], table[:, 4].copy()
    up = times[np.argmax((times > 0.1) & (wheel < -400))]
    down = times[np.argmax((times > 0.3) & (wheel > -900))]
    switched = (times > up - 0.022 - margin) & (times < up + 0.037 + margin)
    switched |= (times > down - 0.02 - margin) & (times < down + 0.014 + margin)
    wheel[switched] = np.nan
    flight = (times > flight[0]) & (times < flight[1])
    given = room.Recording.of(
        times[flight], table[flight, 1:4], wheel_speed=wheel[flight], force_body=table[flight, 5:8]
    )
    return room.averaged(given, FAST)


def together(found, block=BLOCK):
    """Recordings, numbers of their bodies, and the joint fit."""
    everything = [one for ones in found.values() for one in ones]
    bodies = [k for k, ones in enumerate(found.values()) for _ in ones]
    fit = room.fit_balance(
        everything, room.Instrument(SPIN), bodies=bodies, tolerance=room.Tolerance(), block=block
    )
    return everything, bodies, fit


def varied(folder):
    """Shifts of the joint fit's moments under other choices, over their standard deviation."""
    table, usual = {}, None
    for name, choice in VARIED.items():
        how = dict(choice)
        block = how.pop("block", BLOCK)
        _, found = load(folder, **how)
        _, _, fit = together(found, block)
        moments, spread = np.asarray(fit.moments), np.asarray(fit.moments_std)
        if usual is None:
            usual = moments, spread
            continue
        shift = (moments - usual[0]) / usual[1]
        table[name] = {
            "shift_over_std": dict(zip(found, shift.tolist(), strict=True)),
            "largest": float(np.abs(shift).max()),
            "largest_percent": 100 * float(np.abs(moments / usual[0] - 1).max()),
            "beyond_half": int((np.abs(shift) > 0.5).sum()),
        }
        print(
            name,
            {kind: table[name][kind] for kind in ("largest", "largest_percent", "beyond_half")},
        )
    return table


def agreement(joint, single, body):
    """Means of single throws less the joint fit, %, and over what the errors stated make of it."""
    moments, spread = np.asarray(joint.moments)[body], np.asarray(joint.moments_std)[body]
    each, own = np.asarray(single.moments), np.asarray(single.moments_std)
    apart = each.mean(axis=0) - moments
    expected = np.sqrt((own**2 - spread**2).mean(axis=0) / len(each))
    return {
        "apart_percent": (100 * apart / moments).tolist(),
        "apart_over_std": (apart / expected).tolist(),
        "std_of_one_percent": (100 * np.median(own, axis=0) / moments).tolist(),
        "scatter_of_one_percent": (100 * each.std(axis=0, ddof=1) / moments).tolist(),
    }


def measure(found):
    """Joint fit, tensors of every throw, and mean positions of the sensor, by configuration."""
    names = list(found)
    everything, bodies, fit = together(found)
    each = {
        name: fit.each(found[name], k)
        for k, name in enumerate(names)
        if name not in (DEVICE, PROOF)
    }
    slow = room.stack([room.averaged(one, BLOCK) for one in everything])
    arms = np.asarray(room.lever_arm(slow))
    arms = {name: arms[np.array(bodies) == k].mean(axis=0) for k, name in enumerate(names)}
    return fit, each, arms


def body(mass, arm, tensor):
    """Mass properties about the sensor: ``arm`` leads from the centre of mass to it."""
    return MassProperties.of(mass, -np.asarray(arm), ph.Inertia(full=tensor))


def objects(index, joint, tensors, arms):
    """Tensors of the objects, the scale set by the proof body; ``joint``, ``tensors`` by name."""
    light, proof = index["m_dev_kg"], index["proof_body"]

    def device(scale):
        return body(light, arms[DEVICE], scale * joint[DEVICE])

    def less(name, mass, tensor, scale):
        whole = body(mass + light, arms[name], scale * tensor)
        return np.asarray((whole - device(scale)).inertia.tensor)

    # traces know nothing of axes, and are linear in the scale
    at = [np.trace(less(PROOF, proof["mass_kg"], joint[PROOF], scale)) for scale in (0.9, 1.1)]
    known = np.trace(np.array(proof["I_kgm2"]))
    scale = 0.9 + 0.2 * (known - at[0]) / (at[1] - at[0])
    made = {
        name: [less(name, index["configs"][name]["mass_kg"], one, scale) for one in tensors[name]]
        for name in tensors
        if name in index["configs"]
    }
    return scale, made


def errors(tensor, reference):
    """Relative error of the moments, %, and turn of the axes, degrees."""
    found, true = ph.Inertia(full=tensor), ph.Inertia(full=reference)
    (found, turn), (true, frame) = found.to_principal(), true.to_principal()
    apart = np.linalg.norm(found.moments - true.moments) / np.linalg.norm(true.moments)
    matrix = np.asarray(to_matrix(turn)).T @ np.asarray(to_matrix(frame))
    # half turns about principal axes change nothing
    signs = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
    trace = np.max(signs @ np.diagonal(matrix))
    return 100 * float(apart), float(np.degrees(np.arccos(np.clip((trace - 1) / 2, -1, 1))))


def tables(index, made):
    """Estimates of every configuration and their errors where the reference is known."""
    found = {}
    for name, tensors in made.items():
        row = {
            "moments": [np.linalg.eigvalsh(one).tolist() for one in tensors],
            "tensors": [one.tolist() for one in tensors],
        }
        reference = index["configs"][name].get("I_kgm2")
        if reference is not None:
            off = np.array([errors(one, np.array(reference)) for one in tensors])
            row["moments_error_percent"], row["axes_error_deg"] = off.mean(axis=0).tolist()
        found[name] = row
    return found


def run(folder, configurations=None):
    """The whole recipe."""
    index, found = load(folder, configurations)
    fit, each, arms = measure(found)
    joint = dict(zip(found, np.asarray(fit.inertia.tensor), strict=True))
    single = {name: np.asarray(one.inertia.tensor) for name, one in each.items()}
    scale, alone = objects(index, joint, single, arms)
    _, together = objects(index, joint, {name: joint[name][None] for name in single}, arms)
    device = fit.instrument
    return {
        "throws": sum(map(len, found.values())),
        "spin_inertia_kgm2": SPIN * scale,
        "wheel_axis": np.asarray(device.axis).tolist(),
        "wheel_delay_s": float(device.delay),
        "gyroscope_skew": np.asarray(device.skew).tolist(),
        "gyroscope_bias_rad_s": np.asarray(device.bias).tolist(),
        "single_throws_and_joint_fit": {
            name: agreement(fit, one, list(found).index(name)) for name, one in each.items()
        },
        "sensor_from_centre_m": {name: arm.tolist() for name, arm in arms.items()},
        "every_throw_alone": tables(index, alone),
        "throws_of_a_configuration_together": tables(index, together),
    }


def main() -> int:
    """Run, print and write."""
    options = recordings(__doc__, DATA, {"varied": "other choices of the recipe as well"})
    jax.config.update("jax_enable_x64", True)
    numbers = run(options.data)
    if options.varied:
        numbers["varied"] = varied(options.data)
    for name, row in numbers["single_throws_and_joint_fit"].items():
        print(name, {kind: np.round(value, 2).tolist() for kind, value in row.items()})
    for kind in ("every_throw_alone", "throws_of_a_configuration_together"):
        for name, row in numbers[kind].items():
            mean = np.mean(row["moments"], axis=0)
            print(f"{kind:36s} {name:14s} {mean}", end=" ")
            if "axes_error_deg" in row:
                print(
                    f"{row['moments_error_percent']:.2f} % {row['axes_error_deg']:.2f} deg", end=""
                )
            print()
    print(f"written: {write('throws', numbers, path=options.output, packages=('optimistix',))}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
