"""The arithmetic that unrolled kernels are written in: numbers known while tracing are folded away.

A `Scalar` is a Python float, so that x + 0, 1 x and 0 x cost nothing in the compiled program, or an array
that holds that one number for every sample. Vectors are tuples of three.
"""

from typing import TypeAlias

from jaxtyping import Array, Float

Scalar: TypeAlias = float | Float[Array, "..."]
Vector: TypeAlias = tuple[Scalar, Scalar, Scalar]
Rows: TypeAlias = tuple[Vector, Vector, Vector]

ZERO: Vector = (0.0, 0.0, 0.0)


def known(x: Scalar, value: float) -> bool:
    """Whether `x` is known to be `value` while tracing."""
    return isinstance(x, float) and x == value


def negative(a: Scalar) -> Scalar:
    return -a


def add(*terms: Scalar) -> Scalar:
    total: Scalar = 0.0
    for a in terms:
        if known(total, 0.0):
            total = a
        elif not known(a, 0.0):
            total = total + a
    return total


def sub(a: Scalar, b: Scalar) -> Scalar:
    if known(b, 0.0):
        return a
    return -b if known(a, 0.0) else a - b


def mul(a: Scalar, b: Scalar) -> Scalar:
    if isinstance(b, float):
        a, b = b, a
    if known(a, 0.0):
        return 0.0
    if known(a, 1.0):
        return b
    return -b if known(a, -1.0) else a * b


def plus(u: Vector, *others: Vector) -> Vector:
    x, y, z = (add(*components) for components in zip(u, *others, strict=True))
    return x, y, z


def times(a: Scalar, u: Vector) -> Vector:
    return mul(a, u[0]), mul(a, u[1]), mul(a, u[2])


def dot(u: Vector, v: Vector) -> Scalar:
    return add(mul(u[0], v[0]), mul(u[1], v[1]), mul(u[2], v[2]))


def cross(u: Vector, v: Vector) -> Vector:
    return (
        sub(mul(u[1], v[2]), mul(u[2], v[1])),
        sub(mul(u[2], v[0]), mul(u[0], v[2])),
        sub(mul(u[0], v[1]), mul(u[1], v[0])),
    )


def apply(A: Rows, u: Vector) -> Vector:
    """A u."""
    return dot(A[0], u), dot(A[1], u), dot(A[2], u)


def transpose(A: Rows) -> Rows:
    (a, b, c), (d, e, f), (g, h, i) = A
    return (a, d, g), (b, e, h), (c, f, i)
