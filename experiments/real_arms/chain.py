"""A serial arm in numpy: inverse dynamics as a regressor, and its MJCF. Shares no code with jaxpanda.

Ten numbers a link, about the joint's frame: mass [kg], first moment (3) [kg m], inertia xx yy zz xy xz yz
[kg m²].
"""

import dataclasses

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

UP = np.array([0.0, 0.0, 1.0])
STILL = 0.01
"""Speed below which dry friction of the models here sets in gradually [rad/s]."""


@dataclasses.dataclass(frozen=True)
class Chain:
    """Joints turn about the z axis of their own frame, which stands at `pos`, `turn` in the frame before."""

    name: str
    pos: np.ndarray
    turn: np.ndarray
    """(n, 3, 3)"""
    phi: np.ndarray
    """(n, 10)"""
    armature: np.ndarray
    damping: np.ndarray
    frictionloss: np.ndarray
    gravity: np.ndarray

    @property
    def dof(self):
        return len(self.pos)

    def but(self, **values):
        return dataclasses.replace(self, **values)


def from_mjcf(text, gravity=(0, 0, -9.81)):
    """Of a serial arm whose joints turn about z at their bodies' origins."""
    model = mujoco.MjModel.from_xml_string(text)
    n = model.nv
    assert model.nbody == n + 1
    np.testing.assert_allclose(model.jnt_axis, np.tile(UP, (n, 1)))
    np.testing.assert_allclose(model.jnt_pos, 0)
    turn = np.array([matrix(q) for q in model.body_quat[1:]])
    phi = np.zeros((n, 10))
    for i in range(n):
        R = matrix(model.body_iquat[i + 1])
        about_com = R @ np.diag(model.body_inertia[i + 1]) @ R.T
        phi[i] = from_com(model.body_mass[i + 1], model.body_ipos[i + 1], about_com)
    return Chain(
        "arm",
        model.body_pos[1:].copy(),
        turn,
        phi,
        model.dof_armature.copy(),
        model.dof_damping.copy(),
        model.dof_frictionloss.copy(),
        np.array(gravity, float),
    )


def matrix(quat):
    w, x, y, z = quat
    return Rotation.from_quat([x, y, z, w]).as_matrix()


def symmetric(six):
    xx, yy, zz, xy, xz, yz = six
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def six_of(I):
    return np.array([I[0, 0], I[1, 1], I[2, 2], I[0, 1], I[0, 2], I[1, 2]])


def from_com(mass, com, about_com):
    """The ten numbers of a body by its centre of mass and its inertia about it."""
    com = np.asarray(com, float)
    steiner = mass * (com @ com * np.eye(3) - np.outer(com, com))
    return np.concatenate([[mass], mass * com, six_of(about_com + steiner)])


def to_com(phi):
    """(mass, com, inertia about it) of ten numbers."""
    mass, com = phi[0], phi[1:4] / phi[0]
    return mass, com, symmetric(phi[4:]) - mass * (com @ com * np.eye(3) - np.outer(com, com))


def mjcf(chain, body=None):
    """The arm as a user's MJCF; `body` (mass, com, inertia about it) is fixed to the last link."""
    text = lambda values: " ".join(f"{v:.10g}" for v in np.ravel(values))
    lines = [
        f'<mujoco model="{chain.name}">',
        '  <compiler angle="radian"/>',
        f'  <option gravity="{text(chain.gravity)}"/>',
        "  <worldbody>",
    ]
    for i in range(chain.dof):
        pad = "  " * (i + 2)
        x, y, z, w = Rotation.from_matrix(chain.turn[i]).as_quat()
        mass, com, inertia = to_com(chain.phi[i])
        lines += [
            f'{pad}<body name="link{i + 1}" pos="{text(chain.pos[i])}" quat="{text([w, x, y, z])}">',
            f'{pad}  <inertial mass="{mass:.10g}" pos="{text(com)}" fullinertia="{text(six_of(inertia))}"/>',
            f'{pad}  <joint name="joint{i + 1}" axis="0 0 1" armature="{chain.armature[i]:.8g}"'
            f' damping="{chain.damping[i]:.8g}" frictionloss="{chain.frictionloss[i]:.8g}"/>',
        ]
    if body is not None:
        pad = "  " * (chain.dof + 2)
        lines.append(
            f'{pad}<body name="load"><inertial mass="{body[0]:.10g}" pos="{text(body[1])}"'
            f' fullinertia="{text(six_of(body[2]))}"/></body>'
        )
    lines += ["  " * (i + 2) + "</body>" for i in reversed(range(chain.dof))]
    return "\n".join([*lines, "  </worldbody>", "</mujoco>", ""])


def _skew(v):
    x, y, z = np.moveaxis(v, -1, 0)
    o = np.zeros_like(x)
    return np.stack([np.stack([o, -z, y], -1), np.stack([z, o, -x], -1), np.stack([-y, x, o], -1)], -2)


def _on_six(w):
    x, y, z = np.moveaxis(w, -1, 0)
    o = np.zeros_like(x)
    rows = [[x, o, o, y, z, o], [o, y, o, x, o, z], [o, o, z, o, x, y]]
    return np.stack([np.stack(r, -1) for r in rows], -2)


def regressor(chain, q, qd, qdd, gravity=None):
    r"""(T, n, 10 n) with $\tau = Y \phi$: Newton and Euler, one link's ten numbers after another."""
    T, n = q.shape
    gravity = chain.gravity if gravity is None else np.asarray(gravity, float)
    turns, wrenches = [], []
    w, wd, a = np.zeros((T, 3)), np.zeros((T, 3)), np.tile(-gravity, (T, 1))
    for i in range(n):
        E = chain.turn[i] @ Rotation.from_rotvec(q[:, i, None] * UP).as_matrix()
        p = np.tile(chain.pos[i], (T, 1))
        a = a + np.cross(wd, p) + np.cross(w, np.cross(w, p))
        back = lambda v, E=E: np.einsum("tba,tb->ta", E, v)
        w, wd, a = back(w), back(wd), back(a)
        spin = qd[:, i, None] * UP
        wd = wd + qdd[:, i, None] * UP + np.cross(w, spin)
        w = w + spin
        W = np.zeros((T, 6, 10))
        W[:, :3, 0] = a
        W[:, :3, 1:4] = _skew(wd) + _skew(w) @ _skew(w)
        W[:, 3:, 1:4] = -_skew(a)
        W[:, 3:, 4:] = _on_six(wd) + _skew(w) @ _on_six(w)
        turns.append(E)
        wrenches.append(W)
    Y = np.zeros((T, n, 10 * n))
    for i in range(n):
        W = wrenches[i]
        for j in range(i, -1, -1):
            Y[:, j, 10 * i : 10 * i + 10] = W[:, 5]
            force = turns[j] @ W[:, :3]
            moment = turns[j] @ W[:, 3:] + _skew(chain.pos[j]) @ force
            W = np.concatenate([force, moment], 1)
    return Y


def torque(chain, q, qd, qdd):
    """(T, n) what the model says: links, rotors, viscous and dry friction."""
    rigid = regressor(chain, q, qd, qdd) @ chain.phi.ravel()
    dry = chain.frictionloss * np.tanh(qd / STILL)
    return rigid + chain.armature * qdd + chain.damping * qd + dry


def c_engine(text, q, qd, qdd):
    """(T, n) inverse dynamics of an MJCF by MuJoCo's C engine: bodies, rotors, damping; no dry friction."""
    model = mujoco.MjModel.from_xml_string(text)
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    data = mujoco.MjData(model)
    out = np.zeros_like(q)
    for t in range(len(q)):
        data.qpos[:], data.qvel[:], data.qacc[:] = q[t], qd[t], qdd[t]
        mujoco.mj_inverse(model, data)
        out[t] = data.qfrc_inverse
    return out


def pushed(text, q, force, point, link):
    """(T, n) what the joints must bear, -Jᵀ f, of a force [N, world axes] on a point of a link."""
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    out, J = np.zeros_like(q), np.zeros((3, model.nv))
    for t in range(len(q)):
        if not np.any(force[t]):
            continue
        data.qpos[:] = q[t]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        place = data.xpos[link] + data.xmat[link].reshape(3, 3) @ point
        mujoco.mj_jac(model, data, J, None, place, link)
        out[t] = -J.T @ force[t]
    return out
