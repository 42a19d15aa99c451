"""The rule of steps that suits a scene, chosen while it is traced."""

from polhode._integrate._extrapolation import Extrapolation


class Automatic(Extrapolation):
    """What ``ph.simulate`` integrates with by itself.

    Few bodies on which torques act, and fields with kinks or jumps, are moved by explicit
    Runge-Kutta steps of order 8 that end where the field kinks or jumps (``_loop.py``); others by
    the extrapolated midpoint rule, with the arguments of ``ph.Extrapolation``.
    """
