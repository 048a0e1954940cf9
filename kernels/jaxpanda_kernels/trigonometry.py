r"""Sine and cosine in plain arithmetic, without branches or calls, so that XLA fuses and vectorises them.

The library's functions cost more than the rest of an arm's dynamics: they stand outside the fused loop on a
CPU, and in float64 carry a slow path for huge angles on a GPU.

Reduction after Cody and Waite, $r = x - k\,\pi/2$ with $\pi/2$ in parts whose products with $k$ are exact,
then minimax polynomials on $|r| \le \pi/4$.

References:
    Cody and Waite, Software Manual for the Elementary Functions, 1980.
"""

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


@dataclasses.dataclass(frozen=True)
class _Constants:
    half_pi: tuple[float, ...]
    """Parts of pi/2; all but the last are so short that k times each is exact."""
    sine: tuple[float, ...]
    """Coefficients of (sin r - r) / r³ in r², from the constant up: the largest error over r is smallest."""
    cosine: tuple[float, ...]
    """Coefficients of (cos r - 1 + r²/2) / r⁴ in r²."""


_DOUBLE = _Constants(
    half_pi=(1.5707963267341256, 6.077100506303966e-11, 2.0222662487959506e-21),
    sine=(
        -0.16666666666666632,
        0.008333333333322387,
        -0.00019841269829789417,
        2.7557313686137783e-06,
        -2.5050757273832278e-08,
        1.5896749463024357e-10,
    ),
    cosine=(
        0.0416666666666666,
        -0.0013888888888874155,
        2.4801587289500978e-05,
        -2.755731435756345e-07,
        2.0875723952089186e-09,
        -1.135968094655673e-11,
    ),
)
_SINGLE = _Constants(
    half_pi=(1.5703125, 0.0004837512969970703, 7.549533620476723e-08, 2.5633440682570896e-12),
    sine=(-0.1666665493668954, 0.008332177686228001, -0.0001951723466726797),
    cosine=(0.04166664685459209, -0.0013887366909555215, 2.443837943107455e-05),
)


def _polynomial(coefficients: tuple[float, ...], z: Float[Array, "..."]) -> Float[Array, "..."]:
    value = coefficients[-1] * z
    for c in coefficients[-2:0:-1]:
        value = (value + c) * z
    return value + coefficients[0]


@jax.custom_jvp
def sincos(x: Float[Array, "..."]) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """Sine and cosine of `x` [rad], in its dtype, within 2 units in the last place.

    That holds up to 1e5 rad in float64 and 5e3 rad in float32. Beyond, the error grows to that of rounding
    `x` itself, and past 3e9 rad the answer means nothing: wrap such angles first, or use `jnp.sin`.

    Raises:
        TypeError: `x` is neither float32 nor float64.
    """
    if x.dtype not in (jnp.float32, jnp.float64):
        raise TypeError(f"sincos takes float32 or float64; got {x.dtype}")
    constants = _DOUBLE if x.dtype == jnp.float64 else _SINGLE
    k = jnp.floor(x * 0.6366197723675814 + 0.5)
    r = x
    for part in constants.half_pi:
        r = r - k * part
    z = r * r
    s = r + r * (z * _polynomial(constants.sine, z))
    c = 1 - (0.5 * z - z * z * _polynomial(constants.cosine, z))
    quadrant = k.astype(jnp.int32)
    odd = (quadrant & 1) == 1
    sine, cosine = jnp.where(odd, c, s), jnp.where(odd, s, c)
    sine = jnp.where((quadrant & 2) == 2, -sine, sine)
    cosine = jnp.where(((quadrant + 1) & 2) == 2, -cosine, cosine)
    return sine, cosine


@sincos.defjvp
def _sincos_jvp(primals, tangents):
    s, c = sincos(*primals)
    (dx,) = tangents
    return (s, c), (c * dx, -s * dx)
