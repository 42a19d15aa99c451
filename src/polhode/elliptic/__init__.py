"""Elliptic integrals and functions with analytic derivatives; nothing about bodies."""

from polhode.elliptic._complete import (
    associate_b as associate_b,
    associate_d as associate_d,
    ellipe as ellipe,
    ellipk as ellipk,
)
from polhode.elliptic._incomplete import (
    ellipe_inc as ellipe_inc,
    ellipe_inc_sincos as ellipe_inc_sincos,
    ellipf as ellipf,
    ellipf_sincos as ellipf_sincos,
)
from polhode.elliptic._jacobi import ellipj as ellipj, jacobi_epsilon as jacobi_epsilon
