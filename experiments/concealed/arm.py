"""Panda arms that differ a little from each other, as MJCF text, and MuJoCo's dynamics of them.

Written with numpy and MuJoCo only: nothing here is shared with the analysis that is on trial.
"""

from dataclasses import dataclass, replace

import mujoco
import numpy as np

N = 7
LIMITS = np.array(
    [
        [-2.8973, 2.8973],
        [-1.7628, 1.7628],
        [-2.8973, 2.8973],
        [-3.0718, -0.0698],
        [-2.8973, 2.8973],
        [-0.0175, 3.7525],
        [-2.8973, 2.8973],
    ]
)
HOME = np.array([0.0, -0.785, 0.0, -2.2, 0.0, 1.6, 0.785])
FLANGE = 0.107
MAX_TORQUE = np.array([87, 87, 87, 87, 12, 12, 12])

# Mass [kg], centre of mass [m] and inertia about it [kg m^2] (xx yy zz xy xz yz), along the link's frame;
# of the size of Gaz et al., RA-L 2019, table of retrieved parameters.
_MASS = np.array([4.9707, 0.6469, 3.2286, 3.5879, 1.2259, 1.6666, 0.7355])
_COM = np.array(
    [
        [0.0039, 0.0021, -0.1600],
        [-0.0031, -0.0287, 0.0035],
        [0.0275, 0.0393, -0.0665],
        [-0.0532, 0.1044, 0.0275],
        [-0.0120, 0.0411, -0.0384],
        [0.0601, -0.0141, -0.0105],
        [0.0105, -0.0043, 0.0616],
    ]
)
_INERTIA = np.array(
    [
        [0.7034, 0.7066, 0.0350, -0.0001, 0.0068, 0.0190],
        [0.0095, 0.0300, 0.0285, -0.0039, 0.0103, 0.0007],
        [0.0372, 0.0362, 0.0120, -0.0047, -0.0114, -0.0120],
        [0.0270, 0.0205, 0.0300, 0.0078, -0.0013, 0.0086],
        [0.0355, 0.0295, 0.0100, -0.0021, -0.0040, 0.0002],
        [0.0022, 0.0046, 0.0056, 0.0001, -0.0012, 0.0003],
        [0.0125, 0.0101, 0.0052, -0.0004, -0.0012, -0.0007],
    ]
)
# Pose of each link's frame in its parent's: modified Denavit-Hartenberg, as position and turn about x [rad].
_POSITION = (
    (0, 0, 0.333),
    (0, 0, 0),
    (0, -0.316, 0),
    (0.0825, 0, 0),
    (-0.0825, 0.384, 0),
    (0, 0, 0),
    (0.088, 0, 0),
)
_TURN = (0, -1, 1, 1, -1, 1, 1)
_LOOKS = (
    "0 0 -0.25 0 0 -0.05",
    "0 -0.1 0 0 0 0",
    "0 0 -0.12 0.05 0.03 0",
    "-0.06 0.08 0 0 0 0",
    "0 0 -0.2 0 0.05 0",
    "0 0 0 0.07 0 0",
    "0 0 0.02 0 0 0.09",
)


@dataclass(frozen=True)
class Body:
    """Mass [kg], centre of mass [m], inertia about it [kg m^2] (xx yy zz xy xz yz)."""

    mass: float
    com: np.ndarray
    inertia: np.ndarray


@dataclass(frozen=True)
class SoftJoint:
    """A joint whose position sensor and link are joined by a spring or by a dead band.

    `rotor` [kg m^2] is on the sensor's side; the law itself belongs to the effect.
    """

    joint: int
    rotor: float


@dataclass(frozen=True)
class Arm:
    """What MuJoCo is told about an arm."""

    links: tuple[Body, ...]
    damping: np.ndarray
    frictionloss: np.ndarray
    armature: np.ndarray
    gravity: np.ndarray
    gripper: Body | None = None
    load: Body | None = None
    soft: SoftJoint | None = None


def tensor(inertia):
    """The symmetric matrix of (xx yy zz xy xz yz)."""
    xx, yy, zz, xy, xz, yz = inertia
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def is_physical(body, margin=1e-6):
    """Whether mass and principal moments of inertia are those of a body with positive density."""
    moments = np.linalg.eigvalsh(tensor(body.inertia))
    return (
        body.mass > 1e-3 and moments[0] > 1e-7 and moments[0] + moments[1] - moments[2] > margin * moments[2]
    )


def _made_physical(body):
    while not is_physical(body, 1e-3):
        body = replace(
            body, inertia=body.inertia + 0.05 * np.mean(body.inertia[:3]) * np.array([1, 1, 1, 0, 0, 0])
        )
    return body


def draw_arm(rng):
    """An arm of the family: masses 4 %, centres 3 mm, inertias 5 %; known friction, armature, gripper."""
    links = tuple(
        _made_physical(
            Body(
                m * (1 + 0.04 * rng.standard_normal()),
                c + 0.003 * rng.standard_normal(3),
                inertia * (1 + 0.05 * rng.standard_normal()) * (1 + 0.01 * rng.standard_normal(6)),
            )
        )
        for m, c, inertia in zip(_MASS, _COM, _INERTIA, strict=True)
    )
    big = np.array([1, 1, 1, 1, 0.45, 0.45, 0.45])
    damping = rng.uniform(0.1, 0.6, N) * big * (rng.random(N) < 0.3)
    frictionloss = rng.uniform(0.1, 0.5, N) * big * (rng.random(N) < 0.35)
    if rng.random() < 0.3:
        damping, frictionloss = np.zeros(N), np.zeros(N)
    armature = rng.uniform(0.02, 0.12, N) * big * (rng.random() < 0.2)
    gripper = Body(0.73, np.array([0, 0, 0.04]), np.array([0.0012, 0.0025, 0.0017, 0, 0, 0]))
    return Arm(
        links,
        damping,
        frictionloss,
        armature,
        np.array([0, 0, -9.81]),
        gripper=gripper if rng.random() < 0.35 else None,
    )


def rough(arm, rng):
    """The arm as data sheets and drawings tell it: masses to 4 %, centres of mass to 3 mm, inertias to 10 %."""
    links = tuple(
        _made_physical(
            Body(
                b.mass * (1 + 0.04 * rng.standard_normal()),
                b.com + 0.003 * rng.standard_normal(3),
                b.inertia * (1 + 0.1 * rng.standard_normal()),
            )
        )
        for b in arm.links
    )
    return replace(arm, links=links)


def _text(values):
    return " ".join(f"{value + 0.0:.10g}" for value in np.atleast_1d(values))


def _inertial(body):
    return (
        f'<inertial mass="{_text(body.mass)}" pos="{_text(body.com)}" fullinertia="{_text(body.inertia)}"/>'
    )


def mjcf(arm, actuators=True):
    """The arm as MJCF: plain motors for the user's file, none for a plant."""
    lines = [
        '<mujoco model="panda">',
        '  <compiler angle="radian"/>',
        f'  <option timestep="0.001" gravity="{_text(arm.gravity)}"/>',
        '  <default><geom contype="0" conaffinity="0" mass="0" rgba="0.9 0.9 0.9 1"/></default>',
        "  <worldbody>",
        '    <body name="link0">',
        '      <geom type="capsule" fromto="-0.08 0 0.04 0 0 0.1" size="0.06"/>',
    ]
    indent = "      "
    closing = []
    for j, link in enumerate(arm.links):
        half = np.sqrt(0.5)
        quat = (half, half * _TURN[j], 0, 0) if _TURN[j] else (1, 0, 0, 0)
        place = f'pos="{_text(_POSITION[j])}" quat="{_text(quat)}"'
        joint = f'name="joint{j + 1}" axis="0 0 1" range="{LIMITS[j, 0]} {LIMITS[j, 1]}"'
        for word in ("damping", "frictionloss", "armature"):
            value = getattr(arm, word)[j]
            if value:
                joint += f' {word}="{_text(value)}"'
        if arm.soft is not None and arm.soft.joint == j:
            joint = joint.replace(f' armature="{_text(arm.armature[j])}"', "")
            lines += [
                f'{indent}<body name="rotor" {place}>',
                f'{indent}  <inertial mass="1e-6" pos="0 0 0" diaginertia="1e-9 1e-9 1e-9"/>',
                f'{indent}  <joint {joint} armature="{_text(arm.soft.rotor + arm.armature[j])}"/>',
            ]
            closing.append(f"{indent}</body>")
            indent += "  "
            place, joint = "", 'name="twist" axis="0 0 1"'
        lines += [
            f'{indent}<body name="link{j + 1}" {place}>',
            f"{indent}  {_inertial(link)}",
            f"{indent}  <joint {joint}/>",
            f'{indent}  <geom type="capsule" fromto="{_LOOKS[j]}" size="0.05"/>',
        ]
        closing.append(f"{indent}</body>")
        indent += "  "
    lines.append(f'{indent}<body name="flange" pos="0 0 {FLANGE}">')
    if arm.gripper is not None:
        lines.append(f"{indent}  {_inertial(arm.gripper)}")
    lines.append(f'{indent}  <geom type="capsule" fromto="0 0 0 0 0 0.01" size="0.03"/>')
    if arm.load is not None:
        lines.append(f'{indent}  <body name="load">{_inertial(arm.load)}</body>')
    lines += [f"{indent}</body>", *reversed(closing), "    </body>", "  </worldbody>"]
    if actuators:
        lines.append("  <actuator>")
        lines += [f'    <motor joint="joint{j + 1}" ctrlrange="-{m} {m}"/>' for j, m in enumerate(MAX_TORQUE)]
        lines.append("  </actuator>")
    return "\n".join([*lines, "</mujoco>", ""])


def inverse_dynamics(model, q, v, a, before=None, wrench=None, times=None):
    """Joint torque [N m] that the motion takes, without frictionloss, row by row.

    Args:
        model: rigid arm of seven joints; its frictionloss is set to zero here.
        q: positions [rad].
        v: velocities [rad/s].
        a: accelerations [rad/s^2].
        before: called as before(model, t) ahead of every row: what changes in the plant with time.
        wrench: called as wrench(model, data, t); returns the joint torque that forces from outside put in.
        times: time of each row [s], for the two above.
    """
    model.dof_frictionloss[:] = 0
    data = mujoco.MjData(model)
    tau = np.empty_like(q)
    for k in range(len(q)):
        if before is not None:
            before(model, times[k])
        data.qpos[:] = q[k]
        data.qvel[:] = v[k]
        data.qacc[:] = a[k]
        mujoco.mj_inverse(model, data)
        tau[k] = data.qfrc_inverse
        if wrench is not None:
            tau[k] -= wrench(model, data, times[k])
    return tau


def _standard(body):
    """The ten numbers in which inverse dynamics is linear: m, m c, inertia about the frame's origin."""
    c = body.com
    about_origin = tensor(body.inertia) + body.mass * (c @ c * np.eye(3) - np.outer(c, c))
    return np.concatenate([[body.mass], body.mass * c, about_origin[np.triu_indices(3)]])


def _from_standard(phi):
    m, mc = phi[0], phi[1:4]
    about_origin = np.zeros((3, 3))
    about_origin[np.triu_indices(3)] = phi[4:]
    about_origin += np.triu(about_origin, 1).T
    c = mc / m
    I = about_origin - m * (c @ c * np.eye(3) - np.outer(c, c))
    return Body(m, c, np.array([I[0, 0], I[1, 1], I[2, 2], I[0, 1], I[0, 2], I[1, 2]]))


def _put(model, link, body):
    """Overwrite a link's inertia in a compiled model."""
    moments, axes = np.linalg.eigh(tensor(body.inertia))
    if np.linalg.det(axes) < 0:
        axes[:, 0] *= -1
    index = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, f"link{link + 1}")
    model.body_mass[index] = body.mass
    model.body_ipos[index] = body.com
    model.body_inertia[index] = moments
    mujoco.mju_mat2Quat(model.body_iquat[index], axes.flatten())


def regressor(arm, q, v, a):
    """d tau / d phi (rows x joints, 70) by differences, exact because torque is linear in phi."""
    columns = []
    model = mujoco.MjModel.from_xml_string(mjcf(arm))
    base = inverse_dynamics(model, q, v, a)
    for link, body in enumerate(arm.links):
        phi = _standard(body)
        for k in range(10):
            step = np.zeros(10)
            step[k] = 1e-2
            _put(model, link, _from_standard(phi + step))
            columns.append((inverse_dynamics(model, q, v, a) - base).ravel() / 1e-2)
        _put(model, link, body)
    return np.stack(columns, axis=1)


def identified(arm, rng, q, v, a, noise_std):
    """The arm as an identification from the motion (q, v, a) would leave it.

    Draws the links' parameters from the Gaussian posterior of that identification: prior of the family's own
    spread, rows of the motion with the noise of the torque sensors. Directions that the motion does not show
    stay as far from the truth as the prior allows; the others end within a fraction of the noise.
    """
    phi = np.concatenate([_standard(body) for body in arm.links])
    spread = np.concatenate(
        [
            np.concatenate(
                [[0.04 * b.mass], np.full(3, 0.003 * b.mass + 0.002), np.full(6, 0.05 * np.max(b.inertia))]
            )
            for b in arm.links
        ]
    )
    W = regressor(arm, q, v, a) / np.tile(noise_std, len(q))[:, None]
    precision = np.diag(1 / spread**2) + W.T @ W
    scaled = precision * np.outer(spread, spread)
    draw = spread * np.linalg.solve(np.linalg.cholesky(scaled).T, rng.standard_normal(70))
    while True:
        links = tuple(_from_standard((phi + draw)[10 * k : 10 * k + 10]) for k in range(N))
        if all(is_physical(body) for body in links):
            return replace(arm, links=links)
        draw = 0.7 * draw
