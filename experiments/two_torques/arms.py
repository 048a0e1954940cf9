"""Five serial arms with torque sensors or something like them, from published kinematics.

Distances and axes are those of the makers' URDF files, masses and centres of mass theirs or near them; a link's
inertia is that of a solid cylinder. Rated torques are continuous ones and set the scale of friction and noise.
"""

from dataclasses import dataclass, replace

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation


@dataclass(frozen=True)
class Arm:
    """One row a link: where its frame lies in the one before (m, fixed-axis rpy), its joint and its body."""

    name: str
    pos: np.ndarray  # (n, 3)
    rpy: np.ndarray  # (n, 3)
    axis: np.ndarray  # (n, 3)
    mass: np.ndarray
    com: np.ndarray  # (n, 3)
    radius: np.ndarray
    limits: np.ndarray  # (n, 2) [rad]
    rated: np.ndarray  # [N m]
    armature: np.ndarray  # [kg m2]
    speed: np.ndarray  # [rad/s]
    home: np.ndarray
    flange: np.ndarray  # in the last link
    outward: np.ndarray
    payload: float  # the most it carries [kg]

    @property
    def joints(self) -> int:
        return len(self.mass)


def arm(name, frames, bodies, drives, home, flange, outward, payload) -> Arm:
    """frames: (pos, rpy, axis); bodies: (mass, com, radius); drives: (lower, upper, rated, armature, speed)."""
    columns = [
        np.array(column, float) for rows in (frames, bodies, drives) for column in zip(*rows, strict=True)
    ]
    pos, rpy, axis, mass, com, radius, lower, upper, rated, armature, speed = columns
    limits = np.stack([lower, upper], axis=1)
    ends = [np.array(x, float) for x in (home, flange, outward)]
    return Arm(name, pos, rpy, axis, mass, com, radius, limits, rated, armature, speed, *ends, payload)


H, Z, Y, X = np.pi / 2, (0, 0, 1), (0, 1, 0), (1, 0, 0)
O = (0, 0, 0)

GEN3 = arm(
    "gen3",
    [
        ((0, 0, 0.15643), (np.pi, 0, 0), Z),
        ((0, 0.005375, -0.12838), (H, 0, 0), Z),
        ((0, -0.21038, -0.006375), (-H, 0, 0), Z),
        ((0, 0.006375, -0.21038), (H, 0, 0), Z),
        ((0, -0.20843, -0.006375), (-H, 0, 0), Z),
        ((0, 0.00017505, -0.10593), (H, 0, 0), Z),
        ((0, -0.10593, -0.00017505), (-H, 0, 0), Z),
    ],
    [
        (1.377, (0, -0.0104, -0.0734), 0.046),
        (1.164, (0, -0.0996, -0.0133), 0.046),
        (1.164, (0, -0.0066, -0.1179), 0.046),
        (0.930, (0, -0.0755, -0.0150), 0.046),
        (0.678, (0, -0.0094, -0.0639), 0.036),
        (0.678, (0, -0.0455, -0.0097), 0.036),
        (0.500, (-0.0003, -0.0114, -0.0298), 0.036),
    ],
    [
        (-6.28, 6.28, 39, 0.45, 1.2),
        (-2.24, 2.24, 39, 0.45, 1.2),
        (-6.28, 6.28, 39, 0.45, 1.2),
        (-2.57, 2.57, 39, 0.45, 1.2),
        (-6.28, 6.28, 9, 0.16, 1.2),
        (-2.09, 2.09, 9, 0.16, 1.2),
        (-6.28, 6.28, 9, 0.16, 1.2),
    ],
    (0, 0.6, 0, 1.4, 0, 0.8, 0),
    (0, 0, -0.0615),
    (0, 0, -1),
    4.0,
)

IIWA = arm(
    "iiwa14",
    [
        ((0, 0, 0.1575), O, Z),
        ((0, 0, 0.2025), (H, 0, np.pi), Z),
        ((0, 0.2045, 0), (H, 0, np.pi), Z),
        ((0, 0, 0.2155), (H, 0, 0), Z),
        ((0, 0.1845, 0), (-H, np.pi, 0), Z),
        ((0, 0, 0.2155), (H, 0, 0), Z),
        ((0, 0.081, 0), (-H, np.pi, 0), Z),
    ],
    [
        (4.0, (0, -0.03, 0.12), 0.07),
        (4.0, (0.0003, 0.059, 0.042), 0.07),
        (3.0, (0, 0.03, 0.13), 0.065),
        (2.7, (0, 0.067, 0.034), 0.065),
        (1.7, (0.0001, 0.021, 0.076), 0.06),
        (1.8, (0, 0.0006, 0.004), 0.055),
        (0.5, (0.004, 0, 0.02), 0.04),
    ],
    [
        (-2.97, 2.97, 160, 2.2, 1.4),
        (-2.09, 2.09, 160, 2.2, 1.4),
        (-2.97, 2.97, 90, 1.3, 1.5),
        (-2.09, 2.09, 90, 1.3, 1.4),
        (-2.97, 2.97, 55, 0.7, 1.8),
        (-2.09, 2.09, 20, 0.3, 2.0),
        (-3.05, 3.05, 20, 0.3, 2.0),
    ],
    (0, 0.6, 0, -1.3, 0, 0.8, 0),
    (0, 0, 0.045),
    (0, 0, 1),
    10.0,
)

M0609 = arm(
    "m0609",
    [
        ((0, 0, 0.135), O, Z),
        ((0, 0.0062, 0), (0, -H, -H), Z),
        ((0.411, 0, 0), (0, 0, H), Z),
        ((0, -0.368, 0), (H, 0, 0), Z),
        (O, (-H, 0, 0), Z),
        ((0, -0.121, 0), (H, 0, 0), Z),
    ],
    [
        (4.6, (0, 0.012, -0.022), 0.07),
        (7.1, (0.19, 0, 0.105), 0.065),
        (2.8, (0, -0.03, 0.02), 0.06),
        (2.5, (0, 0.008, -0.13), 0.05),
        (2.1, (0, -0.021, 0.012), 0.045),
        (0.8, (0.002, 0.001, -0.028), 0.04),
    ],
    [
        (-6.28, 6.28, 100, 1.7, 1.6),
        (-1.66, 1.66, 100, 1.7, 1.4),
        (-2.61, 2.61, 60, 0.9, 1.6),
        (-6.28, 6.28, 22, 0.25, 2.0),
        (-2.35, 2.35, 22, 0.25, 2.0),
        (-6.28, 6.28, 22, 0.25, 2.0),
    ],
    (0, 0.3, 1.3, 0, 0.8, 0),
    O,
    (0, 0, 1),
    6.0,
)

WX250 = arm(
    "wx250",
    [
        ((0, 0, 0.0727), O, Z),
        ((0, 0, 0.0387), O, Y),
        ((0.04975, 0, 0.25), O, Y),
        ((0.25, 0, 0), O, Y),
        ((0.0656, 0, 0), O, X),
    ],
    [
        (0.54, (0, 0.001, 0.026), 0.04),
        (0.38, (0.017, 0, 0.196), 0.025),
        (0.42, (0.15, 0, 0), 0.025),
        (0.22, (0.042, 0, 0), 0.02),
        (0.35, (0.055, 0.002, 0.006), 0.03),
    ],
    [
        (-3.14, 3.14, 4.0, 0.025, 1.8),
        (-1.88, 1.99, 8.0, 0.045, 1.5),
        (-2.15, 1.60, 4.0, 0.025, 1.6),
        (-1.75, 2.15, 2.0, 0.010, 2.0),
        (-3.14, 3.14, 1.5, 0.006, 2.5),
    ],
    (0, -0.2, 0.3, 0.4, 0),
    (0.09, 0, 0),
    (1, 0, 0),
    0.4,
)

OMX = arm(
    "omx",
    [
        ((0.012, 0, 0.017), O, Z),
        ((0, 0, 0.0595), O, Y),
        ((0.024, 0, 0.128), O, Y),
        ((0.124, 0, 0), O, Y),
    ],
    [
        (0.079, (0, 0.0002, 0.04), 0.025),
        (0.104, (0.012, 0, 0.101), 0.02),
        (0.130, (0.091, 0, 0), 0.02),
        (0.220, (0.060, 0, 0.004), 0.025),
    ],
    [
        (-3.14, 3.14, 1.5, 0.010, 1.8),
        (-1.50, 1.50, 1.5, 0.010, 1.6),
        (-1.50, 1.40, 1.2, 0.008, 1.6),
        (-1.70, 1.97, 0.8, 0.005, 2.0),
    ],
    (0, -0.2, 0.2, 0.4),
    (0.126, 0, 0),
    (1, 0, 0),
    0.25,
)

ARMS = (GEN3, IIWA, M0609, WX250, OMX)


def built(arm: Arm, rng: np.random.Generator) -> Arm:
    """This arm as another piece of its kind: masses, centres of mass and drives differ."""
    n = arm.joints
    size = np.linalg.norm(arm.com, axis=1, keepdims=True)
    return replace(
        arm,
        mass=np.round(arm.mass * rng.uniform(0.8, 1.25, n), 3),
        com=np.round(arm.com + 0.06 * size * rng.standard_normal((n, 3)), 4),
        radius=arm.radius * rng.uniform(0.85, 1.15, n),
        armature=arm.armature * rng.uniform(0.7, 1.4, n),
    )


def link_inertia(arm: Arm, j: int) -> np.ndarray:
    """A solid cylinder about its centre, along the way from the joint to the centre of mass or the next joint."""
    ends = [*arm.pos[1:], arm.flange]
    along = ends[j] if np.linalg.norm(ends[j]) > np.linalg.norm(arm.com[j]) else 2 * arm.com[j]
    length, r = np.linalg.norm(along), arm.radius[j]
    u = np.outer(along, along) / length**2
    return arm.mass[j] * ((3 * r**2 + length**2) / 12 * (np.eye(3) - u) + r**2 / 2 * u)


def numbers(values, digits: int = 6) -> str:
    return " ".join(f"{value:.{digits}g}" for value in np.atleast_1d(values))


def as_mjcf(arm: Arm, damping, frictionloss, armature) -> str:
    """The user's file; the drives' numbers are those it is to hold."""
    opened, closed = [], []
    for j in range(arm.joints):
        x, y, z, w = Rotation.from_euler("xyz", arm.rpy[j]).as_quat()
        inertia = link_inertia(arm, j)[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
        indent = "  " * (j + 2)
        opened += [
            f'{indent}<body name="link{j + 1}" pos="{numbers(arm.pos[j])}" quat="{numbers([w, x, y, z], 9)}">',
            f'{indent}  <inertial pos="{numbers(arm.com[j])}" mass="{numbers(arm.mass[j])}" '
            f'fullinertia="{numbers(inertia)}"/>',
            f'{indent}  <joint name="joint{j + 1}" type="hinge" axis="{numbers(arm.axis[j])}" '
            f'range="{numbers(arm.limits[j])}" damping="{numbers(damping[j], 4)}" '
            f'frictionloss="{numbers(frictionloss[j], 4)}" armature="{numbers(armature[j], 4)}"/>',
        ]
        closed.insert(0, f"{indent}</body>")
    site = f'{"  " * (arm.joints + 2)}<site name="flange" pos="{numbers(arm.flange)}"/>'
    return "\n".join(
        [
            f'<mujoco model="{arm.name}">',
            '  <compiler angle="radian" autolimits="true"/>',
            '  <option gravity="0 0 -9.81"/>',
            "  <worldbody>",
            *opened,
            site,
            *closed,
            "  </worldbody>",
            "</mujoco>",
            "",
        ]
    )


def rigid(xml: str) -> mujoco.MjModel:
    """The file's rigid body alone: no damping, friction, rotor or limit."""
    model = mujoco.MjModel.from_xml_string(xml)
    model.dof_damping[:] = model.dof_frictionloss[:] = model.dof_armature[:] = 0
    model.jnt_limited[:] = 0
    return model


def with_load_body(arm: Arm, xml: str, com: np.ndarray) -> str:
    """The file with one more body at the flange, of next to no mass until somebody gives it one."""
    place = numbers(arm.flange + com)
    inertial = '<inertial pos="0 0 0" mass="1e-9" diaginertia="1e-12 1e-12 1e-12"/>'
    body = f'<body name="load" pos="{place}">{inertial}</body>'
    return xml.replace('<site name="flange"', f'{body}<site name="flange"')
