"""Errors in ulps of the result's scale, beyond the conditioning of u and phi."""

import elliptic_truth as truth
import mpmath as mp
import numpy as np

from polhode._closed_forms import elliptic


def labels(name):
    """The names of the results."""
    return ("sn", "cn", "dn", "am") if name == "ellipj" else (name,)


def library_values(name, arguments):
    """The library's result as a tuple of arrays."""
    function = getattr(elliptic, name)
    if name.startswith("carlson"):
        return (np.asarray(function(*arguments)),)
    *rest, m1 = arguments
    value = function(*rest, m1=m1)
    return tuple(map(np.asarray, value)) if name == "ellipj" else (np.asarray(value),)


def true_values(name, arguments):
    """The result at one point, as a tuple of mpmath numbers."""
    if name == "ellipj":
        return truth.jacobi(*arguments)
    return (getattr(truth, name)(*arguments),)


def allowances(name, arguments, values):
    """What a change of u or phi by eps times itself is worth, per result, over eps."""
    if name == "ellipj":
        u, m, _ = arguments
        sn, cn, dn, _ = (abs(float(value)) for value in values)
        return tuple(abs(u) * slope for slope in (cn * dn, sn * dn, m * sn * cn, dn))
    if name == "jacobi_epsilon":
        return (abs(arguments[0]) * float(truth.jacobi(*arguments)[2]) ** 2,)
    if name in ("ellipf", "ellipe_inc", "ellippi_inc"):
        *n, phi, m, m1 = arguments
        root = float(mp.sqrt(mp.cos(phi) ** 2 + m1 * mp.sin(phi) ** 2))
        slope = root if name == "ellipe_inc" else 1 / root
        if n:
            slope /= abs(1 - n[0] * np.sin(phi) ** 2)
        return (abs(phi) * slope,)
    return tuple(0.0 for _ in values)


def scales(name, values):
    """sn and cn: 1. Everything else: itself."""
    if name == "ellipj":
        return (1, 1, values[2], values[3])
    return values


def ulps(found, value, scale, allowance, eps):
    """(|found - value| - allowance eps) / (eps scale), at least 0; inf where not finite."""
    if not np.isfinite(found):
        return np.inf
    error = abs(mp.mpf(float(found)) - value)
    if error == 0:
        return 0.0
    if scale == 0:
        return np.inf
    return max(0.0, float((error / eps - allowance) / abs(scale)))
