"""A reference model of a real arm: least squares over links that could be built, rotors, friction, tilt, offsets.

Own code on numpy and scipy, so that what makes the cases and what analyses them have nothing in common.
"""

import dataclasses

import numpy as np
from chain import STILL, Chain, regressor
from scipy.optimize import least_squares
from scipy.signal import butter, sosfiltfilt

BAND = 10.0
"""What models are fitted to and judged in [Hz]."""


@dataclasses.dataclass(frozen=True)
class Log:
    """A recording on uniform ticks."""

    name: str
    time: np.ndarray
    q: np.ndarray
    qd: np.ndarray
    """As recorded."""
    tau: np.ndarray

    @property
    def rate(self):
        return (len(self.time) - 1) / (self.time[-1] - self.time[0])

    def part(self, start, stop):
        """From `start` to `stop` [s] after its beginning."""
        since = self.time - self.time[0]
        rows = (since >= start) & (since < stop)
        return Log(self.name, self.time[rows], self.q[rows], self.qd[rows], self.tau[rows])

    def but(self, **values):
        return dataclasses.replace(self, **values)


def lowpass(x, rate, cutoff=BAND):
    """Zero-phase, along time."""
    if cutoff >= 0.45 * rate:
        return np.asarray(x, float)
    sos = butter(3, cutoff, fs=rate, output="sos")
    pad = min(len(x) - 1, int(3 * rate / cutoff))
    return sosfiltfilt(sos, x, axis=0, padlen=pad, padtype="odd")


def motion(log, cutoff=BAND):
    """(q, qd, qdd), smooth, from the recorded positions alone."""
    q = lowpass(log.q, log.rate, cutoff)
    qd = np.gradient(q, 1 / log.rate, axis=0, edge_order=2)
    return q, qd, np.gradient(qd, 1 / log.rate, axis=0, edge_order=2)


def inner(log, edge=0.3):
    return (log.time > log.time[0] + edge) & (log.time < log.time[-1] - edge)


# ------------------------------------------------------------------------------ links that could be built


def pseudo_inertia(phi):
    """4 × 4, positive definite for links that could be built."""
    m, h, I = phi[0], phi[1:4], phi[4:]
    xx, yy, zz, xy, xz, yz = I
    S = 0.5 * (xx + yy + zz) * np.eye(3) - np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    return np.block([[S, h[:, None]], [h[None], np.array([[m]])]])


def of_pseudo(J):
    S = J[:3, :3]
    I = np.trace(S) * np.eye(3) - S
    return np.concatenate([[J[3, 3]], J[:3, 3], [I[0, 0], I[1, 1], I[2, 2], I[0, 1], I[0, 2], I[1, 2]]])


_LOWER = np.tril_indices(4)
_DIAGONAL = np.flatnonzero(_LOWER[0] == _LOWER[1])
THIN = 1e-3
"""Least diagonal of the factor [kg^½ m]: keeps inertias off the edge of the triangle inequality by 2e-6 kg m²."""


def of_factor(eta):
    """Ten numbers of a lower triangular factor with exp on its diagonal: any eta is a body."""
    L = np.zeros((4, 4))
    L[_LOWER] = eta
    L[np.diag_indices(4)] = np.exp(np.diag(L))
    return of_pseudo(L @ L.T)


def factor_of(phi, least=1e-7):
    """The factor of the nearest body (eigenvalues of the pseudo-inertia are raised to `least`)."""
    values, vectors = np.linalg.eigh(pseudo_inertia(phi))
    L = np.linalg.cholesky((vectors * np.maximum(values, least)) @ vectors.T)
    L[np.diag_indices(4)] = np.log(np.diag(L))
    return L[_LOWER]


def _slope(eta, step=1e-6):
    return np.stack(
        [(of_factor(eta + step * e) - of_factor(eta - step * e)) / (2 * step) for e in np.eye(10)], 1
    )


def buildable(phi):
    return bool(np.linalg.eigvalsh(pseudo_inertia(phi)).min() > 0)


# ------------------------------------------------------------------------------------- the identification


@dataclasses.dataclass(frozen=True)
class Reference:
    chain: Chain
    offset: np.ndarray
    """Of the torque sensors [N m]; MJCF cannot hold it."""
    std: np.ndarray
    """What is left of the recordings it was fitted to, up to BAND [N m]."""


def identify(
    nominal, logs, *, rotors, tilt=False, offsets=True, spread=0.3, friction=True, delay=0.0, rounds=3
):
    """The reference model by `logs`, links near `nominal` where the motion does not tell.

    `spread`: prior deviation of a link's numbers as a share of its size. Joints are weighted by what is left at
    them. `delay`: torque is late by so much [s].
    """
    n = nominal.dof
    gravity = nominal.gravity.copy()
    chain = nominal
    weight = None
    moved = np.zeros(n)
    for _ in range(rounds):
        rows, right = [], []
        for log in logs:
            q, qd, qdd = motion(log)
            keep = inner(log)
            step = max(1, round(log.rate / 50.0))
            Y = regressor(nominal, q, qd, qdd, gravity)
            own = np.stack([qdd, qd, np.tanh(qd / STILL), np.ones_like(qd)], -1)
            wide = np.einsum("tjk,ji->tjki", own, np.eye(n)).reshape(len(q), n, -1)
            parts = [Y, wide]
            if tilt:
                phi = chain.phi.ravel()
                base = Y @ phi
                lean = [regressor(nominal, q, qd, qdd, gravity + d) @ phi - base for d in np.eye(3)[:2]]
                parts.append(np.stack(lean, -1))
            A = lowpass(np.concatenate(parts, 2), log.rate)
            tau = lowpass(shifted(log.tau, delay * log.rate), log.rate)
            rows.append(A[keep][::step])
            right.append(tau[keep][::step])
            moved = np.maximum(moved, np.ptp(q, axis=0))
        A, b = np.concatenate(rows), np.concatenate(right)
        if weight is None:
            weight = 1 / np.maximum(np.std(b, 0), 1e-3) * 10
        W = (A * weight[:, None]).reshape(-1, A.shape[2])
        r = (b * weight).ravel()
        x, chain = _solve(
            chain, nominal, W, r, rotors, tilt, offsets, friction, spread, moved, len(b), np.std(b, 0) + 1e-3
        )
        left = b - A @ x
        weight = 1 / np.maximum(left.std(0), 1e-4)
        if tilt:
            gravity = gravity + np.array([*x[-2:], 0.0])
            gravity *= 9.81 / np.linalg.norm(gravity)
    # neighbouring samples are not independent, which the weight of the prior in _solve accounts for
    return Reference(chain.but(gravity=gravity), x[13 * n : 14 * n], np.sqrt(np.mean(left**2, 0)))


def _solve(start, nominal, W, r, rotors, tilt, offsets, friction, spread, moved, samples, load):
    n = nominal.dof
    Q, R = np.linalg.qr(W)
    y = Q.T @ r
    phi0 = nominal.phi
    reach = np.array([0.1, 0.1, 0.1, 0.03, 0.03, 0.03, 0.02, 0.02, 0.02])
    size = spread * phi0[:, :1] * np.concatenate([[1.0], reach])
    thin = np.sqrt(samples / 500)  # about that many of the samples are independent
    still = moved < 0.02
    lower = np.zeros(4 * n + 2 * tilt)
    upper = np.full(len(lower), np.inf)
    lower[3 * n : 4 * n], lower[4 * n :] = -np.inf, -np.inf
    for k, off in enumerate(
        (
            ~np.full(n, bool(rotors)) | still,
            ~np.full(n, friction) | still,
            ~np.full(n, friction) | still,
            ~np.full(n, bool(offsets)),
        )
    ):
        upper[k * n : (k + 1) * n][off] = 1e-9
        if k == 3:
            lower[k * n : (k + 1) * n][off] = -1e-9

    def unpack(z):
        phi = np.concatenate([of_factor(e) for e in z[: 10 * n].reshape(n, 10)])
        return np.concatenate([phi, z[10 * n :]])

    def residual(z):
        x = unpack(z)
        prior = (x[: 10 * n].reshape(n, 10) - phi0) / size
        return np.concatenate([R @ x - y, thin * prior.ravel(), own * x[10 * n :]])

    def jacobian(z):
        D = np.zeros((10 * n + len(lower), len(z)))
        for i in range(n):
            at = slice(10 * i, 10 * i + 10)
            D[at, at] = _slope(z[at])
        D[10 * n :, 10 * n :] = np.eye(len(lower))
        prior = D[: 10 * n] / size.ravel()[:, None]
        return np.concatenate([R @ D, thin * prior, own[:, None] * D[10 * n :]])

    # without the demand on links first: linear, and near the end already
    # friction and offsets are no larger than the torque that moves the joint, else they cancel one another
    own = np.concatenate([np.full(2 * n, 1e-3), np.tile(thin / load, 2), np.full(2 * tilt, 1e-3)])
    deviation = np.concatenate([thin / size.ravel(), own])
    centre = np.concatenate([phi0.ravel(), np.zeros(len(lower))])
    bar = np.concatenate([np.zeros(10 * n), upper <= 1e-9]).astype(bool)
    S, s = np.concatenate([R, np.diag(deviation)]), np.concatenate([y, deviation * centre])
    free = np.zeros(len(centre))
    free[~bar] = np.linalg.lstsq(S[:, ~bar], s)[0]
    body = np.full(10, -25.0)
    body[_DIAGONAL] = np.log(THIN)
    eta = np.concatenate(
        [factor_of(p, 1e-4 * m[0]) for p, m in zip(free[: 10 * n].reshape(n, 10), phi0, strict=True)]
    )
    eta = np.maximum(eta, np.tile(body, n) + 1e-6)
    z0 = np.concatenate([eta, np.clip(free[10 * n :], lower + 1e-10, upper - 1e-10)])
    low = np.concatenate([np.tile(body, n), lower])
    high = np.concatenate([np.full(10 * n, 25.0), upper])
    found = least_squares(residual, z0, jacobian, bounds=(low, high), x_scale="jac", max_nfev=50)
    x = unpack(found.x)
    values = x[10 * n : 14 * n].reshape(4, n).copy()
    values[np.abs(values) < 1e-6] = 0.0
    x[10 * n : 14 * n] = values.ravel()
    chain = start.but(
        phi=x[: 10 * n].reshape(n, 10), armature=values[0], damping=values[1], frictionloss=values[2]
    )
    return x, chain


def shifted(x, samples):
    """x, so many samples (not whole) earlier: undoes a delay."""
    if not samples:
        return x
    t = np.arange(len(x))
    return np.stack([np.interp(t + samples, t, c) for c in x.T], 1)


def lag(nominal, logs, lags, spread=0.3):
    """The delay of torque [s] among `lags` with which links near `nominal` and friction leave least."""
    n = nominal.dof
    size = (spread * np.abs(nominal.phi).max(1, keepdims=True) * np.ones(10)).ravel()
    rows = []
    for log in logs:
        q, qd, qdd = motion(log)
        own = np.concatenate([np.einsum("tj,ji->tji", x, np.eye(n)) for x in (qd, np.tanh(qd / STILL))], 2)
        rows.append(lowpass(np.concatenate([regressor(nominal, q, qd, qdd) * size, own], 2), log.rate))
    keep = [inner(log) for log in logs]
    A = np.concatenate([r[k] for r, k in zip(rows, keep, strict=True)])
    cost = []
    for late in lags:
        tau = [lowpass(shifted(x.tau, late * x.rate), x.rate) for x in logs]
        b = np.concatenate([x[k] for x, k in zip(tau, keep, strict=True)])
        weight = 1 / b.std(0)
        for _ in range(3):
            W, r = (A * weight[:, None]).reshape(-1, A.shape[2]), (b * weight).ravel()
            x = np.linalg.solve(W.T @ W + 0.01 * len(b) * np.eye(A.shape[2]), W.T @ r)
            weight = 1 / np.maximum((b - A @ x).std(0), 1e-3)
        cost.append(-np.sum(np.log(weight)))
    return float(lags[int(np.argmin(cost))])
