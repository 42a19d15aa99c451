"""Scenes and states, and what they are made of: potentials, torques, damping, rotors.

The names are imported at first use, so that a free body does not wait for control laws and orbits.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
