r"""The ten parameters of the body, by generalised least squares on all recordings at once.

Prior and noise are Gaussian, so that what the recordings without the body tell of the arm is carried over with
its uncertainty, and what they do not tell stays as open as its prior. The noise of each joint is autoregressive,
fitted to what the model leaves. Because that model is not exact either, the covariance is also taken from the
data, by leaving out one block of time after another (`identification.statistics`); of the two deviations of a
parameter the larger counts.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from threadpoolctl import threadpool_limits

from ..arms.arm import Arm
from ..arms.export import panda_mjcf
from ..arms.markup import parse
from ..arms.mjcf import with_gravity
from ..arms.model_file import Model
from ..arms.source import from_document, from_mjcf
from ..errors import InputError, require_x64
from ..identification import statistics
from ..recordings import Recording, distinct
from .design import CHANGE, SLOW, Design, Sampled, Scales, design, sample
from .frame import frame_of
from .result import PayloadEstimate, result_of

ORDER = 3
"""Of the autoregression."""
_ROUNDS = 3
_QUIET = 1e-6
"""Share of a joint's torque below which noise is rounding."""


@dataclasses.dataclass(frozen=True)
class Noise:
    """Of each joint: an autoregression's coefficients and the deviation of its innovations [N m]."""

    a: Float[np.ndarray, "dof order"]
    sigma: Float[np.ndarray, " dof"]


@dataclasses.dataclass(frozen=True)
class Posterior:
    """Of all unknowns, in units of their priors."""

    x: Float[np.ndarray, " unknowns"]
    covariance: Float[np.ndarray, "unknowns unknowns"]


def estimate_payload(
    model: Model | None,
    without: Sequence[Recording],
    loaded: Sequence[Recording],
    *,
    frame: str = "",
    torque_scale_std: float = 0.0,
    gravity: Sequence[float] | None = None,
) -> PayloadEstimate:
    """Mass, centre of mass and inertia of the body that the arm carries in some recordings and not in others.

    Args:
        model: the arm as MJCF; None for the project's own Panda. What it models (friction, a tool) counts as
            known; what it gets wrong is learned from `without`.
        without: recordings of the arm without the body.
        loaded: of the same arm with it. The motions need not be the same.
        frame: body or site of the MJCF, fixed to the last link, in whose frame results are given; "" takes one
            that is called a flange, else the last link's own body.
        torque_scale_std: relative deviation of a scale that all torques share, as 0.1 where they are motor
            currents times gains known to 10 %. No recording tells it; it widens mass and inertia alike.
        gravity: in place of the model's, in the frame of its world [m/s²].

    Raises:
        InputError: recordings or model that cannot be used, in one sentence.
    """
    require_x64("payload")
    if not without or not loaded:
        raise InputError(
            f"payload: no recording {'with' if without else 'without'} the body; it takes both kinds, of one arm"
        )
    if not 0 <= torque_scale_std < 1:
        raise InputError(f"--torque-scale-std: {torque_scale_std:g}, where a share of 0 to 1 is expected")
    if model is None:
        own = parse(panda_mjcf(), "mujoco", Path("panda.xml"))
        arm, source = from_document(with_gravity(own, gravity))
    else:
        arm, source = from_mjcf(model, gravity)
    place = frame_of(source, frame)
    every = distinct([*without, *loaded])
    samples = [sample(r, arm, k >= len(without)) for k, r in enumerate(every)]
    with threadpool_limits(limits=1, user_api="blas"):
        phi, covariance, prior, fit = _estimated(samples, arm)
    notes = [f"{r.name}: {what}" for r in every for what in r.notes]
    notes += [f"{r.name}: {count} {what}" for r in every for what, count in r.repairs.items()]
    return result_of(phi, covariance, prior, place, source, arm.name, fit, notes, torque_scale_std)


def _estimated(
    samples: Sequence[Sampled], arm: Arm
) -> tuple[Float[np.ndarray, "10"], Float[np.ndarray, "10 10"], Float[np.ndarray, "10"], dict[str, Any]]:
    """Parameters in the last link's frame, their covariance, their prior's deviations, and how well they fit."""
    torque = np.sqrt(np.mean(np.concatenate([r.tau for r in samples]) ** 2, 0))
    torque = np.maximum(torque, 1e-3 * torque.max() + 1e-9)
    known = np.asarray(arm.frictionloss)
    none = np.zeros(arm.dof)
    heavy = float(np.asarray(arm.standard)[:, 0].sum())
    scales = Scales(torque, known + CHANGE * torque, none, none, heavy, heavy)
    load = [r.motion.load for r in samples]

    d = design(samples, load, scales)
    noise = Noise(np.zeros((arm.dof, ORDER)), torque)
    found = _posterior(d, noise, samples)
    for _ in range(_ROUNDS):
        noise = _white(_noise(d, found, samples, noise, torque))
        found = _posterior(d, noise, samples)
    level = _friction(d, found, samples)
    moves = np.max([np.abs(r.motion.qd).max(0) for r in samples], 0) > SLOW
    level = np.where(
        moves | (known > 0), level, CHANGE * torque
    )  # of a joint that always rests nobody knows it
    unloaded = [k for k, r in enumerate(samples) if not r.loaded]
    shape = _rms([d.y[k] - d.A[k] @ found.x for k in unloaded])
    load = [
        r.motion.load
        + r.motion.regressor[:, :, : d.links.size] @ (d.links * found.x[: d.links.size])
        + (r.motion.regressor[:, :, -10:] @ (d.body * found.x[-10:]) if r.loaded else 0)
        for r in samples
    ]
    carried = d.body[0] * (abs(found.x[-10]) + 2 * np.sqrt(found.covariance[-10, -10]))
    scales = Scales(
        torque,
        level + known + 1e-3 * torque,
        CHANGE * level + noise.sigma,
        shape,
        heavy,
        min(heavy, carried),
    )
    d = design(samples, load, scales)
    found = _posterior(d, noise, samples)
    for _ in range(_ROUNDS):
        noise = _noise(d, found, samples, noise, torque)
        found = _posterior(d, noise, samples)
    covariance = _robust(d, found, noise, samples)
    scale = np.outer(d.body, d.body)
    left = [d.y[k] - d.A[k] @ found.x for k in range(len(samples))]
    loaded = [k for k, r in enumerate(samples) if r.loaded]
    fit = {
        "unit": "N·m",
        "rmse_model": _rms(d.y).tolist(),
        "rmse_without": _rms([left[k] for k in unloaded]).tolist(),
        "rmse_with": _rms([left[k] for k in loaded]).tolist(),
        "rms_of_body": _rms([d.A[k][:, :, -10:] @ found.x[-10:] for k in loaded]).tolist(),
    }
    return d.body * found.x[-10:], covariance * scale, d.body, fit


def _whitened(
    rows: Float[np.ndarray, "time ..."], a: Float[np.ndarray, " order"], segments: Sequence[slice]
) -> Float[np.ndarray, "time ..."]:
    r"""$e_t = x_t - \sum_k a_k x_{t-k}$; the first rows of a segment, which have no past, count for nothing."""
    if not a.any():
        return rows
    out = np.zeros_like(rows)
    for s in segments:
        x = rows[s]
        if len(x) > len(a):
            e = x[len(a) :].copy()
            for k, coefficient in enumerate(a, 1):
                e -= coefficient * x[len(a) - k : len(x) - k]
            out[s.start + len(a) : s.stop] = e
    return out


def _whitened_rows(d: Design, noise: Noise, samples: Sequence[Sampled], k: int):
    """Columns and torque of a recording in units of the noise's innovations."""
    dof = len(noise.sigma)
    A = np.stack([_whitened(d.A[k][j], noise.a[j], samples[k].segments) / noise.sigma[j] for j in range(dof)])
    y = np.stack([_whitened(d.y[k][j], noise.a[j], samples[k].segments) / noise.sigma[j] for j in range(dof)])
    return A, y


def _posterior(d: Design, noise: Noise, samples: Sequence[Sampled]) -> Posterior:
    unknowns = d.A[0].shape[2]
    H, g = np.eye(unknowns), np.zeros(unknowns)
    for k in range(len(samples)):
        A, y = _whitened_rows(d, noise, samples, k)
        flat = A.reshape(-1, unknowns)
        H += flat.T @ flat
        g += flat.T @ y.ravel()
    covariance = np.linalg.inv(H)
    return Posterior(covariance @ g, 0.5 * (covariance + covariance.T))


def _noise(
    d: Design, found: Posterior, samples: Sequence[Sampled], before: Noise, torque: np.ndarray
) -> Noise:
    """Autoregressions of what is left, with the degrees of freedom that the unknowns took."""
    dof = len(before.sigma)
    a, sigma = np.zeros((dof, ORDER)), np.zeros(dof)
    taken = np.zeros(dof)
    for k in range(len(samples)):
        A, _ = _whitened_rows(d, before, samples, k)
        taken += np.einsum("jta,ab,jtb->j", A, found.covariance, A, optimize=True)
    for j in range(dof):
        S, count = np.zeros((ORDER + 1, ORDER + 1)), 0
        for k, r in enumerate(samples):
            e = d.y[k][j] - d.A[k][j] @ found.x
            for s in r.segments:
                x = e[s]
                if len(x) > ORDER:
                    now = np.stack([x[ORDER - i : len(x) - i] for i in range(ORDER + 1)])
                    S += now @ now.T
                    count += now.shape[1]
        free = max(count - taken[j], 0.1 * count, 1.0)
        S /= free
        tiny = (_QUIET * torque[j]) ** 2
        a[j] = np.linalg.solve(S[1:, 1:] + (1e-3 * S[0, 0] + tiny) * np.eye(ORDER), S[1:, 0])
        b = np.r_[1.0, -a[j]]
        sigma[j] = np.sqrt(max(b @ S @ b, 0.0) + tiny)
    return Noise(a, sigma)


def _white(noise: Noise) -> Noise:
    """The same deviation a sample, without memory: what a first fit is weighted by."""
    return Noise(np.zeros_like(noise.a), noise.sigma)


def _rms(left: Sequence[Float[np.ndarray, "dof _time"]]) -> Float[np.ndarray, " dof"]:
    return np.sqrt(np.mean(np.concatenate(left, 1) ** 2, 1))


def _friction(d: Design, found: Posterior, samples: Sequence[Sampled]) -> Float[np.ndarray, " dof"]:
    """Rms torque of each joint's friction, known and found, over all recordings [N m]."""
    left = []
    for k, r in enumerate(samples):
        more = np.stack([d.A[k][j] @ (found.x * d.friction[j]) for j in range(len(d.friction))])
        left.append(r.down(r.motion.friction).T + more)
    return _rms(left)


def _robust(
    d: Design, found: Posterior, noise: Noise, samples: Sequence[Sampled]
) -> Float[np.ndarray, "10 10"]:
    """Covariance of the body's parameters: the posterior's correlations, the larger of two deviations."""
    unknowns = len(found.x)
    total = sum(len(r.keep) for r in samples)
    H = np.linalg.inv(found.covariance)
    moves = []
    for k, r in enumerate(samples):
        A, y = _whitened_rows(d, noise, samples, k)
        e = y - A @ found.x
        for block in statistics.cut(len(r.keep), max(2, round(statistics.BLOCKS * len(r.keep) / total))):
            part = A[:, block].reshape(-1, unknowns)
            # by solving, not by `statistics.jackknife`: the priors leave every H - H_b positive definite
            moves.append(-np.linalg.solve(H - part.T @ part, part.T @ e[:, block].ravel())[-10:])
    away = np.array(moves) - np.mean(moves, 0)
    jackknifed = (len(moves) - 1) / len(moves) * np.sum(away**2, 0)
    posterior = found.covariance[-10:, -10:]
    larger = np.sqrt(np.maximum(1.0, jackknifed / np.diag(posterior)))
    return posterior * np.outer(larger, larger)
