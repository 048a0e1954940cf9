"""What the reference model of a real arm leaves although it is there: by its gain on held-out recordings."""

import chain as c
import numpy as np
from added import FRICTION, bristle
from reference import BAND, inner, lowpass, motion

HELPS = 0.05
"""Share of the residual's square that a family must explain on the held-out recording, fitted on the others."""
ORDERS, TURNED = (20.0, 420.0, 0.25), 0.2
"""Of ripples that are looked for [periods a turn], and by how much a joint must turn [rad]."""
PEAKS, APART, NONE = 3, 3.0, 100
"""Orders that are tried held out, how far they are apart, and how many show what chance explains."""


def families(chain, log):
    """Name of the family -> (names that it allows, (T, n, k) columns at each joint by itself)."""
    q, v, a = motion(log)
    rigid = c.regressor(chain, q, v, a) @ chain.phi.ravel()
    sign = np.tanh(v / 0.003)
    pick = lambda *x: np.stack(x, -1)
    one = np.ones_like(q)
    return {
        "friction": (
            list(FRICTION),
            pick(
                v,
                sign,
                np.tanh(v / 0.05),
                v * np.abs(v),
                np.sqrt(np.abs(v)) * np.sign(v),
                np.abs(v),
                np.abs(rigid) * sign,
                bristle(q, 2e-3),
                bristle(q, 1e-2),
                bristle(q, 4e-2),
            ),
        ),
        "offset": (["torque_offset"], pick(one)),
        "spring": (["joint_spring", "encoder_offset"], pick(one, q, np.sin(q), np.cos(q))),
        "rotor": (["armature"], pick(a)),
        "gain": (["torque_gain"], pick(rigid)),
        "elastic": (["joint_elasticity", "backlash"], pick(np.gradient(rigid, axis=0) * log.rate, a * v)),
        "drift": (["torque_drift"], pick(one, log.time[:, None] * one)),
    }


def whole(chain, log):
    """The same of what all joints share: (T, n, k)."""
    q, v, a = motion(log)
    Y = c.regressor(chain, q, v, a)
    phi = chain.phi.ravel()
    size = (0.2 * np.abs(chain.phi).max(1, keepdims=True) * np.ones(10)).ravel()
    base = Y @ phi
    lean = [c.regressor(chain, q, v, a, chain.gravity + d) @ phi - base for d in np.eye(3)[:2]]
    tau = c.torque(chain, q, v, a)
    return {
        "links": (["inertial_parameters", "payload"], Y * size),
        "tilt": (["gravity_direction"], np.stack(lean, -1)),
        "delay": (["time_delay"], np.gradient(tau, axis=0)[..., None] * log.rate),
    }


def _gain(A, b, A_test, b_test, ridge=1e-3):
    """(share of b_test's square explained, of b's)."""
    scale = np.sqrt(np.mean(A**2, 0)) + 1e-12
    k = A.shape[1]
    x = np.linalg.solve((A / scale).T @ (A / scale) + ridge * len(A) * np.eye(k), (A / scale).T @ b) / scale
    share = lambda A, b: 1 - np.sum((b - A @ x) ** 2) / np.sum(b**2)
    return share(A_test, b_test), share(A, b)


def _rippled(train, held, left):
    """Joints whose error goes with the same order of the joint's angle, in the same phase, on all recordings.

    Orders that explain most of the training recordings are tried on the held-out one, their amplitudes and phases
    kept. There they must explain more than each of a hundred orders drawn at random, fitted alike, do by chance.
    A ripple is often faster than BAND: nothing is low-passed, neighbours are differenced instead.
    """
    orders, others = np.arange(*ORDERS), np.random.default_rng(0).uniform(ORDERS[0], ORDERS[1], NONE)
    changes = lambda x: np.diff(x, axis=0)
    rows = [left(x) for x in train], left(held)
    joints = []
    for j in range(held.q.shape[1]):
        at = [x.q[inner(x), j] for x in (*train, held)]
        if min(np.ptp(x) for x in at) < TURNED:
            continue
        b, b_test = np.concatenate([changes(x[:, j]) for x in rows[0]]), changes(rows[1][:, j])

        def explains(order, at=at, b=b, b_test=b_test):
            """Shares of the squared change that it explains: (held out, of the others)."""
            A = [changes(np.stack([np.sin(order * q), np.cos(order * q)], 1)) for q in at]
            return _gain(np.concatenate(A[:-1]), b, A[-1], b_test, ridge=1e-6)

        seen = np.array([explains(k)[1] for k in orders])
        peaks = []
        for k in np.argsort(-seen):
            if all(abs(orders[k] - orders[p]) > APART for p in peaks):
                peaks.append(k)
            if len(peaks) == PEAKS:
                break
        chance = max(explains(k)[0] for k in others)
        if max(explains(orders[k])[0] for k in peaks) > max(chance, 0.0):
            joints.append(j + 1)
    return joints


def known_structure(train, held, said, chain, noise):
    """Claims that are neither right nor wrong: {effect, joints, why} of families that help where not fitted.

    `said`: log -> torque by the true model. Also `unknown` at every joint where one of them helps.
    """
    band = lambda x, log: lowpass(x, log.rate, BAND)[inner(log)]
    rest = lambda log: band(log.tau - said(log), log)
    b, b_test = np.concatenate([rest(x) for x in train]), rest(held)
    tables = [families(chain, x) for x in [*train, held]]
    allowed, somewhere = [], set()
    for name in tables[0]:
        parts = [band(t[name][1], x) for t, x in zip(tables, [*train, held], strict=True)]
        A, A_test = np.concatenate(parts[:-1]), parts[-1]
        joints, why = [], []
        for j in range(b.shape[1]):
            test, seen = _gain(A[:, j], b[:, j], A_test[:, j], b_test[:, j])
            if test > HELPS and seen > HELPS:
                joints.append(j + 1)
                why.append(f"{100 * test:.0f} %")
        if joints:
            allowed += [
                {"effect": e, "joints": joints, "why": f"{name} explains {', '.join(why)} held out"}
                for e in tables[0][name][0]
            ]
            somewhere |= set(joints)
    full = lambda log: (log.tau - said(log))[inner(log)]
    if joints := _rippled(train, held, full):
        why = "an order of the joint's angle comes again held out"
        allowed.append({"effect": "torque_ripple", "joints": joints, "why": why})
    tables = [whole(chain, x) for x in [*train, held]]
    for name in tables[0]:
        parts = [band(t[name][1], x) for t, x in zip(tables, [*train, held], strict=True)]
        flat = lambda A: (A / noise[:, None]).reshape(-1, A.shape[2])
        A, A_test = np.concatenate([flat(p) for p in parts[:-1]]), flat(parts[-1])
        test, seen = _gain(A, (b / noise).ravel(), A_test, (b_test / noise).ravel())
        if test > HELPS and seen > HELPS:
            why = f"{name} explains {100 * test:.0f} % held out"
            allowed += [{"effect": e, "joints": None, "why": why} for e in tables[0][name][0]]
            somewhere |= set(range(1, b.shape[1] + 1))
    if somewhere:
        why = "some structure is left there"
        allowed.append({"effect": "unknown", "joints": sorted(somewhere), "why": why})
    return allowed
