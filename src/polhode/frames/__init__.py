"""Rotating frames, the forces in them, and sensors in a body (docs/equations.md, 003)."""

from polhode.frames._frame import (
    RotatingFrame as RotatingFrame,
    SampledAttitude as SampledAttitude,
    accelerometer as accelerometer,
    angular_acceleration as angular_acceleration,
    gyroscope as gyroscope,
)
from polhode.frames._particles import (
    FrameForce as FrameForce,
    ParticlePaths as ParticlePaths,
    SpaceForce as SpaceForce,
    simulate_particles as simulate_particles,
)
