"""Inertia of thrown objects from 55 real throws with a flywheel.

Recordings: TU Delft (arXiv:2503.13137), a device with gyroscope, accelerometer and wheel, thrown
alone, on a proof body of known inertia, and on objects in four configurations. Not part of the
project; expected in ``../shared/data/tudelft_throws`` or the folder ``--data``. The procedure uses
no reference value of an object:

1. only free flight, from 80 ms after the wheel's start, without the speeds of the wheel just after
   its motor was switched;
2. one ``fit_balance`` of all throws: six tensors, and the deviations of the instrument from ideal;
3. centres of mass by ``lever_arm``;
4. the spin inertia of the wheel from the proof body: all moments are proportional to it;
5. the object: the measured body minus the device (``MassProperties``, parallel-axis theorem).

The output contains the tensors of every throw and of every configuration, and their errors if the
data contain a reference: |moments - reference| / |reference|, and the smallest rotation between the
principal axes.

    python -m benchmarks.throws [--varied] [--data FOLDER] [--output out/benchmarks/throws.json]

``--varied``: also repeat the joint fit with other choices in the procedure (some minutes more).
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
from benchmarks.throws import Instrument, Tolerance, fit_balance, fit_each, lever_arm
from polhode import fit as room
from polhode.inertia import MassProperties
from polhode.rotation import wxyz_to_matrix

DATA = Path(__file__).resolve().parents[3] / "shared" / "data" / "tudelft_throws"
DEVICE, PROOF = "device_only", "proof_body"
# spin inertia of the wheel [kg m^2], a starting value that the proof body corrects
SPIN = 1.7e-6
# samples that are averaged, and averaged samples per residual
FAST, BLOCK = 4, 4


# Varied choices: window of the flight [s]; additional margin around each switching of the motor
# [s]; samples per residual
VARIED = {
    "flight from 0.10 to 0.52 s": {"flight": (0.10, 0.52)},
    "10 ms more left out at each switch": {"margin": 0.01},
    "5 samples to a residual": {"block": 5},
}


def load(folder, configurations=None, **how):
    """Index, and recordings by configuration; ``how``: options of ``recording``."""
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
    """The free flight of one throw. Columns: time, rates, wheel, force."""
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
    fit = fit_balance(
        everything, Instrument(SPIN), bodies=bodies, tolerance=Tolerance(), block=block
    )
    return everything, bodies, fit


def varied(folder, usual, single):
    """Effect of other choices on the joint fit ``usual`` and on single throws, by configuration.

    Changes of the joint moments are divided by their standard deviation, and by the change expected
    from omitted readings (the square root of the difference of the variances, if it is positive).
    Changes of the means of single throws are divided by the standard deviation of these means, and
    by that which follows from the scatter of the changes of single throws.
    """
    table = {}
    first, spread = np.asarray(usual.moments), np.asarray(usual.moments_std)
    for name, choice in VARIED.items():
        how = dict(choice)
        block = how.pop("block", BLOCK)
        _, found = load(folder, **how)
        _, _, fit = together(found, block)
        moved = np.asarray(fit.moments) - first
        more = np.asarray(fit.moments_std) ** 2 - spread**2
        shift = moved / spread
        wider = more > 0.01 * spread**2
        by_chance = (moved / np.sqrt(np.where(wider, more, 1)))[wider]
        means, pairs = [], []
        for body, kind in enumerate(found):
            if kind not in single:
                continue
            before = np.asarray(single[kind].moments)
            apart = np.asarray(fit_each(fit, found[kind], body).moments) - before
            root = len(before) ** 0.5
            means.append(root * apart.mean(axis=0) / before.std(axis=0, ddof=1))
            pairs.append(root * apart.mean(axis=0) / apart.std(axis=0, ddof=1))
        table[name] = {
            "shift_over_std": dict(zip(found, shift.tolist(), strict=True)),
            "largest": float(np.abs(shift).max()),
            "largest_percent": 100 * float(np.abs(moved / first).max()),
            "beyond_half": int((np.abs(shift) > 0.5).sum()),
            "wider": int(wider.sum()),
            "rms_over_expected": float(np.sqrt(np.mean(by_chance**2))) if wider.any() else None,
            "means_shift_over_std": dict(zip(single, np.array(means).tolist(), strict=True)),
            "means_largest": float(np.abs(means).max()),
            "means_beyond_half": int((np.abs(means) > 0.5).sum()),
            "means_over_own_scatter": dict(zip(single, np.array(pairs).tolist(), strict=True)),
            "means_rms_over_own_scatter": float(np.sqrt(np.mean(np.square(pairs)))),
        }
        plain = {kind: x for kind, x in table[name].items() if not isinstance(x, dict)}
        print(name, plain, flush=True)
    return table


def agreement(joint, single, body):
    """Means of single throws minus the joint fit, in per cent and divided by the expected
    deviation.

    Both for plain means and for means weighted by the stated errors.
    """
    moments, spread = np.asarray(joint.moments)[body], np.asarray(joint.moments_std)[body]
    each, own = np.asarray(single.moments), np.asarray(single.moments_std)
    apart = each.mean(axis=0) - moments
    weight = own**-2.0
    weighed = (weight * (each - moments)).sum(axis=0) / weight.sum(axis=0)
    expected = np.sqrt((own**2 - spread**2).mean(axis=0) / len(each))
    return {
        "apart_percent": (100 * apart / moments).tolist(),
        "apart_over_std": (apart / expected).tolist(),
        "apart_weighed_percent": (100 * weighed / moments).tolist(),
        "apart_weighed_over_std": (weighed * np.sqrt(weight.sum(axis=0))).tolist(),
        "std_of_one_percent": (100 * np.median(own, axis=0) / moments).tolist(),
        "scatter_of_one_percent": (100 * each.std(axis=0, ddof=1) / moments).tolist(),
    }


def measure(found):
    """Joint fit, tensors of every throw, and mean positions of the sensor, by configuration."""
    names = list(found)
    everything, bodies, fit = together(found)
    each = {
        name: fit_each(fit, found[name], k)
        for k, name in enumerate(names)
        if name not in (DEVICE, PROOF)
    }
    slow = room.stack([room.averaged(one, BLOCK) for one in everything])
    arms = np.asarray(lever_arm(slow))
    arms = {name: arms[np.array(bodies) == k].mean(axis=0) for k, name in enumerate(names)}
    return fit, each, arms


def body(mass, arm, tensor):
    """Mass properties about the sensor; ``arm``: its position relative to the centre of mass."""
    return MassProperties.of(mass, -np.asarray(arm), ph.Inertia(full=tensor))


def objects(index, joint, tensors, arms):
    """Tensors of the objects, scaled by the proof body; ``joint``, ``tensors``: by name."""
    light, proof = index["m_dev_kg"], index["proof_body"]

    def device(scale):
        return body(light, arms[DEVICE], scale * joint[DEVICE])

    def less(name, mass, tensor, scale):
        whole = body(mass + light, arms[name], scale * tensor)
        return np.asarray((whole - device(scale)).inertia.tensor)

    # traces do not depend on the axes, and are linear in the scale
    at = [np.trace(less(PROOF, proof["mass_kg"], joint[PROOF], scale)) for scale in (0.9, 1.1)]
    known = np.trace(np.array(proof["I_kgm2"]))
    scale = 0.9 + 0.2 * (known - at[0]) / (at[1] - at[0])
    made = {
        name: [less(name, index["configs"][name]["mass_kg"], one, scale) for one in tensors[name]]
        for name in tensors
        if name in index["configs"]
    }
    return scale, made


def turn_of(tensor, reference):
    """Smallest rotation (3,) [degrees, sensor axes] from the reference to the estimated principal
    axes.
    """
    frames = []
    for given in (reference, tensor):
        _, turn = ph.Inertia(full=given).to_principal()
        frames.append(np.asarray(wxyz_to_matrix(turn)))
    # half turns about principal axes do not change the tensor
    signs = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
    signs = signs[np.argmax(signs @ np.diagonal(frames[0].T @ frames[1]))]
    matrix = frames[1] @ np.diag(signs) @ frames[0].T
    axis = np.array([matrix[k - 1, k - 2] - matrix[k - 2, k - 1] for k in range(3)])
    size = np.arccos(np.clip((np.trace(matrix) - 1) / 2, -1, 1))
    return np.degrees(size) * axis / max(np.linalg.norm(axis), np.finfo(float).tiny)


def errors(tensor, reference):
    """Relative error of the moments [%], and rotation of the axes [degrees]."""
    found, true = (np.linalg.eigvalsh(one) for one in (tensor, reference))
    apart = np.linalg.norm(found - true) / np.linalg.norm(true)
    return 100 * float(apart), float(np.linalg.norm(turn_of(tensor, reference)))


def tables(index, made):
    """Estimates of every configuration, and errors where the reference is known."""
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
            turns = np.array([turn_of(one, np.array(reference)) for one in tensors])
            row["turn_common_deg"] = turns.mean(axis=0).tolist()
            row["axes_scatter_deg"] = float(
                np.linalg.norm(turns - turns.mean(axis=0), axis=1).mean()
            )
        found[name] = row
    return found


def run(folder, configurations=None, vary=False):
    """The complete procedure."""
    index, found = load(folder, configurations)
    fit, each, arms = measure(found)
    joint = dict(zip(found, np.asarray(fit.inertia.tensor), strict=True))
    single = {name: np.asarray(one.inertia.tensor) for name, one in each.items()}
    scale, alone = objects(index, joint, single, arms)
    _, together = objects(index, joint, {name: joint[name][None] for name in single}, arms)
    device = jax.tree.map(lambda x: x[0], fit.instrument)
    numbers = {
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
    if vary:
        numbers["varied"] = varied(folder, fit, each)
    return numbers


def main() -> int:
    """Run, print and write."""
    options = recordings(__doc__, DATA, {"varied": "other choices of the recipe as well"})
    jax.config.update("jax_enable_x64", True)
    numbers = run(options.data, vary=options.varied)
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
