"""Complex numbers as pairs of real arrays: real and complex mix freely, nothing is promoted."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array


class Complex(NamedTuple):
    """``re + i im``; the other operand of + - * may be a real array or a number."""

    re: Array
    im: Array

    def __add__(self, other):
        if isinstance(other, Complex):
            return Complex(self.re + other.re, self.im + other.im)
        return Complex(self.re + other, self.im)

    def __mul__(self, other):
        if isinstance(other, Complex):
            return Complex(
                self.re * other.re - self.im * other.im, self.re * other.im + self.im * other.re
            )
        return Complex(self.re * other, self.im * other)

    __radd__, __rmul__ = __add__, __mul__

    def __neg__(self):
        return Complex(-self.re, -self.im)

    def __sub__(self, other):
        return self + (-other)

    def __rsub__(self, other):
        return -self + other

    @property
    def conj(self) -> "Complex":
        return Complex(self.re, -self.im)

    @property
    def square(self) -> Array:
        """|z|^2."""
        return self.re * self.re + self.im * self.im

    @property
    def inverse(self) -> "Complex":
        scale = 1 / self.square
        return Complex(self.re * scale, -self.im * scale)

    @property
    def times_i(self) -> "Complex":
        return Complex(-self.im, self.re)

    @property
    def root(self) -> "Complex":
        """Principal square root of a number off the negative real axis, |arg| < 2 pi/3 or so."""
        re = jnp.sqrt((jnp.sqrt(self.square) + self.re) / 2)
        return Complex(re, self.im / (2 * re))

    def at(self, lanes) -> "Complex":
        """The parts indexed alike."""
        return Complex(self.re[lanes], self.im[lanes])


def unit(angle: Array) -> Complex:
    """exp(i angle)."""
    return Complex(jnp.cos(angle), jnp.sin(angle))


def where(condition: Array, a: Complex, b: Complex) -> Complex:
    """Elementwise choice."""
    return Complex(jnp.where(condition, a.re, b.re), jnp.where(condition, a.im, b.im))
