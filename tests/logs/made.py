"""A motion that every format's test writes by that format's own library, and reads back."""

import numpy as np

from jaxpanda.recordings import Recording


def made(dof: int = 7, samples: int = 200, rate: float = 100.0) -> Recording:
    """Joints that all move, with torque that is none of their motion."""
    t, j = np.arange(samples) / rate, np.arange(1, dof + 1)
    phase = t[:, None] * (0.7 + 0.3 * j) + j
    rng = np.random.default_rng(0)
    q, qd = 0.5 * np.sin(phase), 0.5 * (0.7 + 0.3 * j) * np.cos(phase)
    return Recording("made", t, q, qd, 3 * q + 0.1 * rng.normal(size=q.shape))


def assert_same(
    read: Recording, written: Recording, *, tau: bool = True, qd: bool = True, atol: float = 0
) -> None:
    """Every channel to the last digit, unless a conversion was on the way."""
    np.testing.assert_allclose(read.time, written.time, rtol=0, atol=1e-9)
    np.testing.assert_allclose(read.q, written.q, rtol=0, atol=atol)
    for one, other, there in ((read.qd, written.qd, qd), (read.tau, written.tau, tau)):
        assert (one is not None) == there
        if one is not None and other is not None:
            np.testing.assert_allclose(one, other, rtol=0, atol=atol)
    assert not read.repairs
