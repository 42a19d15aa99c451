"""Scenes and states, and their parts: potentials, torques, damping, rotors.

The names are imported on first use, so that scenes of torque-free bodies do not import control laws
and orbits.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
