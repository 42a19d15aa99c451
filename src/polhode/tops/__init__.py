"""Exact motion of tops: Lagrange's top and the cases that elementary functions solve."""

from polhode.tops._lagrange import Orbit as Orbit, at as at, orbit as orbit
