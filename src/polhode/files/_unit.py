"""Units a scene file may name, as factors to SI."""

import math

DEGREE = math.pi / 180
SECONDS = {
    "s": 1.0, "ms": 1e-3, "min": 60.0, "h": 3600.0, "day": 86400.0, "year": 365.25 * 86400.0,
}  # fmt: skip
ANGLES = {"rad": 1.0, "deg": DEGREE, "turn": 2 * math.pi}
ANGULAR_RATES = {
    "rad/s": 1.0,
    "deg/s": DEGREE,
    "deg/h": DEGREE / 3600,
    "deg/day": DEGREE / 86400,
    "rpm": 2 * math.pi / 60,
    "rev/s": 2 * math.pi,
    "rev/day": 2 * math.pi / 86400,
}
# 1 slug = 1 lbf s^2/ft exactly, 1 lbf = 4.4482216152605 N, 1 ft = 0.3048 m
MOMENTS = {
    "kg m^2": 1.0,
    "g cm^2": 1e-7,
    "g mm^2": 1e-9,
    "slug ft^2": 4.4482216152605 * 0.3048,
    "relative": 1.0,
}
SI = SECONDS | ANGLES | ANGULAR_RATES | MOMENTS | {"kg m^2/s": 1.0, "N m": 1.0}
