"""The parts of a scene file that are chosen by kind: inertia, potentials, torques, rotors."""

from typing import Any

from polhode.io import _unit
from polhode.io._specification import Attitudes, Part
from polhode.io._table import REQUIRED, Table

INERTIA_KINDS = ("moments", "tensor", "axisymmetric", "spherical", "parts")
# shape of a uniform solid -> its lengths: (number of components, whether it may be left out)
SOLIDS = {
    "box": {"sides": ((3,), False), "inner_sides": ((3,), True)},
    "ellipsoid": {"semi_axes": ((3,), False)},
    "sphere": {"radius": ((), False), "inner_radius": ((), True)},
    "cylinder": {"radius": ((), False), "length": ((), False), "inner_radius": ((), True)},
    "cone": {"radius": ((), False), "height": ((), False)},
    "torus": {"ring_radius": ((), False), "tube_radius": ((), False)},
}
# key of the file -> kind -> fields: name -> (shape, whether it may be left out)
KINDS = {
    "potential": {
        "uniform-gravity": {
            "mass": ((), False),
            "centre_body": ((3,), False),
            "gravity_space": ((3,), True),
        },
        "gravity-gradient": {"mu": ((), False), "position_space": ((3,), False)},
    },
    "torque": {
        "body": {"n": ((3,), False)},
        "space": {"n": ((3,), False)},
        "linear-damping": {"c": ((3,), False)},
    },
    "rotors": {
        "rotor": {
            "axis_body": ((3,), False),
            "inertia": ((), True),
            "momentum": ((), True),
            "speed": ((), True),
            "torque": ((), True),
        }
    },
}


SEQUENCES = tuple(a + b + c for a in "xyz" for b in "xyz" for c in "xyz" if a != b and b != c)


def read_sequence(table: Table, default: Any = REQUIRED) -> str:
    """Three letters, lower case."""
    given = table.text("sequence", default)
    if given.lower() not in SEQUENCES:
        raise table.wrong(
            "sequence", "unknown Euler sequence", given,
            "three letters of x, y, z, neighbours different",
        )  # fmt: skip
    return given.lower()


def read_euler(parent: Table) -> Attitudes:
    """`euler = { sequence = "zyz", angles = [..], unit = "deg" }`."""
    table = parent.table("euler", ("sequence", "angles", "unit"))
    factor = _unit.ANGLES[table.choice("unit", tuple(_unit.ANGLES), "rad")]
    return Attitudes(table.array("angles", (3,)) * factor, read_sequence(table, "zyz"))


def read_inertia(top: Table) -> tuple[Part, bool]:
    """The inertia and whether its unit is "relative" (ratios of moments only)."""
    table = top.table("inertia", (*INERTIA_KINDS, "unit"))
    kind = table.one_of(*INERTIA_KINDS)
    unit = table.choice("unit", tuple(_unit.MOMENTS), "kg m^2")
    factor = _unit.MOMENTS[unit]
    if kind == "parts":
        if "unit" in table:
            raise table.wrong(
                "unit", "not used with parts", unit, "no unit: parts are in kg and m",
                "remove the unit",
            )  # fmt: skip
        return Part("parts", {"parts": tuple(_solids(table))}, "[inertia] parts"), False
    if kind == "axisymmetric":
        inner = table.table(kind, ("transverse", "axial"))
        values = {
            name: inner.number(name, positive=True) * factor for name in ("transverse", "axial")
        }
    else:
        shape = {"moments": (3,), "tensor": (3, 3), "spherical": ()}[kind]
        values = {kind: table.array(kind, shape) * factor}
    return Part(kind, values, f"[inertia] {kind}"), unit == "relative"


def _solids(inertia: Table):
    rows = inertia.rows("parts")
    if not rows:
        raise inertia.wrong("parts", "no part", rows, "one or more [[inertia.parts]]")
    lengths = sorted({name for sizes in SOLIDS.values() for name in sizes})
    for index, data in enumerate(rows):
        where = f"inertia.parts {index + 1}"
        common = ("shape", "mass", "centre", "euler")
        shape = Table(inertia.file, where, data, (*common, *lengths)).choice("shape", tuple(SOLIDS))
        sizes = SOLIDS[shape]
        # again with the keys of this shape only, so that the radius of a box is an error
        table = Table(inertia.file, where, data, (*common, *sizes))
        values = {
            name: table.array(name, size)
            for name, (size, optional) in sizes.items()
            if name in table or not optional
        }
        for name, value in values.items():
            if value.min() <= 0:
                raise table.wrong(name, "not positive", data[name], "positive lengths in m")
        values["mass"] = table.number("mass", positive=True)
        place = {
            "centre": table.array("centre", (3,)) if "centre" in table else (0.0, 0.0, 0.0),
            "euler": read_euler(table) if "euler" in table else None,
        }
        yield Part(shape, values, f"[{where}]"), place


def read_parts(top: Table, key: str) -> tuple[Part, ...]:
    """`[key]`, or several `[[key]]`, each with its `kind` and the fields of that kind, SI units."""
    if key not in top:
        return ()
    kinds = KINDS[key]
    single = isinstance(top.data[key], dict)
    rows = [top.data[key]] if single else top.rows(key)
    fields = {name for spec in kinds.values() for name in spec}
    parts = []
    for index, data in enumerate(rows):
        where = key if single else f"{key} {index + 1}"
        kind = next(iter(kinds))
        extra = ()
        if len(kinds) > 1:
            extra = ("kind",)
            kind = Table(top.file, where, data, ("kind", *sorted(fields))).choice(
                "kind", tuple(kinds)
            )
        spec = kinds[kind]
        table = Table(top.file, where, data, (*extra, *spec))
        if key == "rotors":
            table.one_of("momentum", "speed")
        values = {
            name: table.array(name, shape)
            for name, (shape, optional) in spec.items()
            if name in table or not optional
        }
        parts.append(Part(kind, values, f"[{where}]"))
    return tuple(parts)
