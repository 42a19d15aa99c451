"""Rotating frames, the forces that appear in them, and sensors fixed in a body (document 003)."""

from polhode.frames._frame import RotatingFrame as RotatingFrame
from polhode.frames._interpolation import SampledAttitude as SampledAttitude
from polhode.frames._particles import (
    FrameForce as FrameForce,
    ParticlePaths as ParticlePaths,
    SpaceForce as SpaceForce,
    simulate_particles as simulate_particles,
)
from polhode.frames._sensors import (
    accelerometer as accelerometer,
    angular_acceleration as angular_acceleration,
    gyroscope as gyroscope,
)
