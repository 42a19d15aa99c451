"""Random and adversarial arguments of the elliptic functions, region by region."""

import numpy as np

PARAMETER_REGIONS = ("m in (0, 1)", "m -> 0", "m -> 1", "m -> 1 (tiny m1)")


def parameters(region, count, dtype, rng):
    """A pair (m, m1) of arrays: the smaller one is exact, the other its rounded complement."""
    low = 36 if dtype == np.float32 else 300
    fine = 7 if dtype == np.float32 else 16
    if region == "m in (0, 1)":
        small = rng.uniform(0, 1, count)
        # both sides of the threshold m = 1/2
        small[::10] = 0.5 + rng.integers(-3, 4, small[::10].shape) * np.finfo(dtype).eps
        m = small.astype(dtype)
        return m, (1 - m).astype(dtype)
    if region == "m -> 0":
        m = (10.0 ** -rng.uniform(0.5, low, count)).astype(dtype)
        m[:: max(count // 4, 1)] = 0
        return m, (1 - m).astype(dtype)
    decades = (0.5, fine) if region == "m -> 1" else (fine, low)
    m1 = (10.0 ** -rng.uniform(*decades, count)).astype(dtype)
    return (1 - m1).astype(dtype), m1


def characteristics(m, count, dtype, rng):
    """n from -1e6 to almost 1, with 0, m, -sqrt(m), -1 and its neighbours, 1/2 among them."""
    n = -(10.0 ** rng.uniform(-9, 6, count))
    n[::3] = rng.uniform(0, 1, n[::3].shape)
    n[1::9] = 1 - 10.0 ** -rng.uniform(0, 4, n[1::9].shape)
    n = n.astype(dtype)
    one = dtype(1)
    special = (0, -one, -np.nextafter(one, dtype(2)), dtype(0.5), np.nextafter(dtype(0.5), one))
    for i, value in enumerate(special):
        n[5 + i :: 40] = value
    n[10::40] = m[10::40]
    n[11::40] = -np.sqrt(m[11::40])
    n[12::40] = np.sqrt(m[12::40])
    return np.where(n < 0.9999, n, dtype(0.75)).astype(dtype)


def sines_cosines(count, dtype, rng):
    """A quarter turn: uniform, close to 0, close to a right angle, exactly both, unnormalised."""
    angle = rng.uniform(0, np.pi / 2, count)
    s, c = np.sin(angle), np.cos(angle)
    low = 15 if dtype == np.float32 else 60
    c[::5], s[::5] = 10.0 ** -rng.uniform(0, low, c[::5].shape), 1
    s[1::7], c[1::7] = 10.0 ** -rng.uniform(0, low, s[1::7].shape), 1
    s[2::50], c[2::50] = 1, 0
    s[3::50], c[3::50] = 0, 1
    s[4::9] *= 1000
    c[4::9] *= 1000
    return s.astype(dtype), c.astype(dtype)


def quarter_period(m, m1):
    """K, roughly (only to place points)."""
    return np.where(m1 < 1e-3, np.log(4 / np.sqrt(np.maximum(m1, 1e-310))), np.pi / 2 + m)


def carlson_arguments(kind, count, dtype, rng):
    """Arguments of RF, RC, RD, RJ spread over many decades, equal ones and zeros among them."""
    wide = 4 if dtype == np.float32 else 12
    columns = {"rf": 3, "rc": 2, "rd": 3, "rj": 4}[kind]
    values = 10.0 ** rng.uniform(-wide, wide, (columns, count))
    values[:, ::3] = rng.uniform(0, 2, values[:, ::3].shape)
    values[1, 1::8] = values[0, 1::8]
    if kind == "rc":
        near = 1 + rng.uniform(-0.04, 0.04, values[0, 3::4].shape)
        values[1, 3::4] = values[0, 3::4] * near
    values[0, 2::9] = 0
    return tuple(np.ascontiguousarray(row).astype(dtype) for row in values)


def points(name, region, count, dtype, rng):
    """The argument arrays of function `name` in `region`."""
    if name.startswith("carlson"):
        return carlson_arguments(name[-2:], count, dtype, rng)
    m, m1 = parameters(region, count, dtype, rng)
    if name in ("ellipk", "ellipe", "associate_b", "associate_d"):
        return m, m1
    if name in ("ellippi", "associate_j"):
        return characteristics(m, count, dtype, rng), m, m1
    if name in ("ellipj", "jacobi_epsilon"):
        u = rng.uniform(-2, 2, count) * quarter_period(m.astype(float), m1.astype(float))
        u[::6] *= 10.0 ** -rng.uniform(0, 10, u[::6].shape)
        u[1::6] *= 10.0 ** rng.uniform(0, 3 if dtype == np.float32 else 7, u[1::6].shape)
        return u.astype(dtype), m, m1
    if name in ("ellipf", "ellipe_inc", "ellippi_inc"):
        phi = rng.uniform(-10, 10, count).astype(dtype)
        if name == "ellippi_inc":
            return characteristics(m, count, dtype, rng), phi, m, m1
        return phi, m, m1
    s, c = sines_cosines(count, dtype, rng)
    if name == "ellippi_inc_sincos":
        return characteristics(m, count, dtype, rng), s, c, m, m1
    return s, c, m, m1


FUNCTIONS = (
    "ellipk",
    "ellipe",
    "associate_b",
    "associate_d",
    "ellipj",
    "jacobi_epsilon",
    "ellipf",
    "ellipf_sincos",
    "ellipe_inc",
    "ellipe_inc_sincos",
    "ellippi",
    "associate_j",
    "ellippi_inc",
    "ellippi_inc_sincos",
    "carlson_rf",
    "carlson_rc",
    "carlson_rd",
    "carlson_rj",
)


def regions(name):
    return ("all",) if name.startswith("carlson") else PARAMETER_REGIONS
