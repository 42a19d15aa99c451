"""Exact motion of tops: Lagrange's top and the cases that elementary functions solve."""

from polhode._closed_forms.tops._elementary import (
    decay as decay,
    decay_twice as decay_twice,
    precession as precession,
    spin as spin,
    turn as turn,
)
from polhode._closed_forms.tops._lagrange import Orbit as Orbit, at as at, orbit as orbit
from polhode._closed_forms.tops._vertical import (
    lagrange_motion as lagrange_motion,
    upward as upward,
)
