"""Serial arms, written by hand from published kinematics and data sheets, and their MJCF.

Frames and axes are those of the makers' descriptions. Masses and sizes are rounded: every case varies them.
"""

from dataclasses import dataclass

import mujoco
import numpy as np

H = 0.70710678


@dataclass(frozen=True)
class Arm:
    """Kinematics, links as boxes of even density, and what the drives can do.

    links: name, position, quaternion, joint axis, mass [kg], centre of mass [m], box [m], joint range [rad].
    """

    name: str
    joint: str
    links: tuple
    torque: tuple  # largest torque of each joint [N·m]
    speed: tuple  # largest speed [rad/s]
    armature: tuple  # rotor inertia behind the gear [kg·m²]
    gear: tuple
    home: tuple
    payload: float  # rated [kg]
    reach: float  # of the flange from the last frame, along its z or x axis [m]
    flange: int = 2

    @property
    def n(self) -> int:
        return len(self.links)

    @property
    def range(self) -> np.ndarray:
        return np.array([link[7] for link in self.links])

    @property
    def tool(self) -> np.ndarray:
        return self.reach * np.eye(3)[self.flange]


Z, Y, X, NY, NX = (0, 0, 1), (0, 1, 0), (1, 0, 0), (0, -1, 0), (-1, 0, 0)
I4, P, M = (1, 0, 0, 0), (H, H, 0, 0), (H, -H, 0, 0)

# fmt: off
ARMS = (
    Arm("xarm7", "joint", (
        ("link1", (0, 0, .267), I4, Z, 2.4, (0, .029, -.012), (.11, .13, .16), (-3.1, 3.1)),
        ("link2", (0, 0, 0), M, Z, 2.0, (0, -.129, .017), (.11, .3, .12), (-2.05, 2.09)),
        ("link3", (0, -.293, 0), P, Z, 1.7, (.046, -.025, -.008), (.13, .11, .13), (-3.1, 3.1)),
        ("link4", (.0525, 0, 0), P, Z, 1.7, (.07, -.116, .012), (.12, .25, .11), (-.19, 3.9)),
        ("link5", (.0775, -.3425, 0), P, Z, 1.1, (0, .016, -.026), (.09, .1, .18), (-3.1, 3.1)),
        ("link6", (0, 0, 0), P, Z, 1.05, (.065, .033, .021), (.13, .1, .09), (-1.69, 3.1)),
        ("link7", (.076, .097, 0), M, Z, .5, (0, -.007, -.011), (.075, .075, .05), (-3.1, 3.1))),
        (50, 50, 30, 30, 30, 20, 20), (2, 2, 2, 2, 2.4, 2.4, 2.4), (.3, .3, .18, .18, .1, .08, .08),
        (100, 100, 100, 100, 100, 100, 100), (0, -.3, 0, 1.2, 0, 1.4, 0), 3.5, .04),
    Arm("gen3", "joint_", (
        ("shoulder_link", (0, 0, .156), (0, 1, 0, 0), Z, 1.38, (0, -.01, -.073), (.09, .09, .19), (-3, 3)),
        ("half_arm_1_link", (0, .0054, -.1284), P, Z, 1.16, (0, -.1, -.013), (.09, .27, .09), (-2.2, 2.2)),
        ("half_arm_2_link", (0, -.2104, -.0064), M, Z, 1.16, (0, -.007, -.118), (.09, .09, .27), (-3.1, 3.1)),
        ("forearm_link", (0, .0064, -.2104), P, Z, .93, (0, -.075, -.015), (.08, .24, .08), (-2.5, 2.5)),
        ("wrist_1_link", (0, -.2084, -.0064), M, Z, .68, (0, -.009, -.064), (.07, .07, .17), (-3.1, 3.1)),
        ("wrist_2_link", (0, .0002, -.1059), P, Z, .68, (0, -.045, -.01), (.07, .17, .07), (-2.0, 2.0)),
        ("bracelet_link", (0, -.1059, -.0002), M, Z, .5, (0, -.011, -.03), (.07, .07, .08), (-3.1, 3.1))),
        (39, 39, 39, 39, 13, 13, 13), (1.3, 1.3, 1.3, 1.3, 1.2, 1.2, 1.2), (.2, .2, .2, .2, .05, .05, .05),
        (100,) * 7, (0, .4, 0, 1.5, 0, 1.0, 0), 3.0, -.06),
    Arm("sawyer", "right_j", (
        ("right_l0", (0, 0, .08), I4, Z, 5.3, (.024, .011, .144), (.16, .15, .34), (-3, 3)),
        ("right_l1", (.081, .05, .237), (.5, -.5, .5, .5), Z, 4.5, (0, -.03, 0), (.14, .24, .16), (-3, 2)),
        ("right_l2", (0, -.14, .1425), P, Z, 1.75, (0, -.01, .13), (.11, .1, .3), (-3, 3)),
        ("right_l3", (0, -.042, .26), M, Z, 2.5, (0, -.027, -.085), (.11, .15, .2), (-3, 3)),
        ("right_l4", (0, -.125, -.1265), P, Z, 1.1, (0, -.007, .126), (.09, .09, .26), (-3, 3)),
        ("right_l5", (0, .031, .275), M, Z, 1.56, (0, .018, -.06), (.09, .13, .17), (-3, 3)),
        ("right_l6", (0, -.11, .105), (.06, .06, -.7044, .7044), Z, .3, (0, 0, .02), (.1, .1, .1), (-3, 3))),
        (80, 80, 40, 40, 9, 9, 9), (1.7, 1.3, 1.9, 1.9, 3.0, 3.0, 3.0), (.6, .6, .3, .3, .06, .06, .03),
        (121, 121, 121, 121, 101, 101, 101), (0, -.6, 0, 1.3, 0, .7, 0), 4.0, .05),
    Arm("irb120", "joint_", (
        ("link_1", (0, 0, .29), I4, Z, 3.07, (0, 0, -.052), (.14, .16, .2), (-2.88, 2.88)),
        ("link_2", (0, 0, 0), I4, Y, 3.9, (0, -.002, .1), (.12, .15, .36), (-1.9, 1.9)),
        ("link_3", (0, 0, .27), I4, Y, 2.94, (.023, 0, .058), (.17, .14, .17), (-1.9, 1.2)),
        ("link_4", (.134, 0, .07), I4, X, 1.33, (.092, 0, 0), (.22, .1, .1), (-2.79, 2.79)),
        ("link_5", (.168, 0, 0), I4, Y, .55, (0, 0, 0), (.11, .09, .08), (-2.09, 2.09)),
        ("link_6", (.072, 0, 0), I4, X, .14, (-.007, 0, 0), (.02, .05, .05), (-6, 6))),
        (70, 75, 35, 10, 9, 6), (4, 4, 4, 5, 5, 6), (.5, .6, .25, .05, .04, .02),
        (121, 121, 101, 51, 50, 50), (0, .2, -.2, 0, .8, 0), 3.0, .02, 0),
    Arm("crx10", "J", (
        ("J1_link", (0, 0, .245), I4, Z, 10., (0, -.02, -.05), (.19, .2, .25), (-3.3, 3.3)),
        ("J2_link", (0, 0, 0), I4, Y, 13., (0, .08, .33), (.16, .2, .85), (-3.1, 3.1)),
        ("J3_link", (0, 0, .71), I4, NY, 6., (.06, .01, .02), (.22, .17, .18), (-2.3, 2.3)),
        ("J4_link", (.2, 0, 0), I4, NX, 4.2, (.16, 0, .01), (.38, .13, .13), (-3.3, 3.3)),
        ("J5_link", (.34, 0, 0), I4, NY, 2.6, (.02, -.07, 0), (.13, .2, .13), (-3.1, 3.1)),
        ("J6_link", (.16, -.15, 0), I4, NX, .8, (-.04, 0, 0), (.08, .09, .09), (-3.9, 3.9))),
        (230, 260, 150, 45, 40, 30), (1.8, 1.8, 2.2, 3, 3, 3), (2.4, 2.6, 1.1, .25, .22, .12),
        (120, 120, 100, 100, 100, 80), (0, .3, -.2, .2, -1.0, 0), 10., .01, 0),
    Arm("iiwa7", "lbr_joint", (
        ("link1", (0, 0, .15), I4, Z, 3.45, (0, -.03, .12), (.13, .18, .28), (-2.9, 2.9)),
        ("link2", (0, 0, .19), (0, 0, H, H), Z, 3.48, (0, .059, .042), (.13, .28, .17), (-2.0, 2.0)),
        ("link3", (0, .21, 0), (0, 0, H, H), Z, 4.06, (0, .03, .13), (.13, .17, .28), (-2.9, 2.9)),
        ("link4", (0, 0, .19), P, Z, 3.48, (0, .067, .034), (.13, .28, .17), (-2.0, 2.0)),
        ("link5", (0, .21, 0), (0, 0, H, H), Z, 2.16, (0, .021, .076), (.11, .14, .24), (-2.9, 2.9)),
        ("link6", (0, 0, .19), P, Z, 2.35, (0, .001, .0), (.11, .15, .16), (-2.0, 2.0)),
        ("link7", (0, .081, 0), (0, 0, H, H), Z, .9, (0, 0, .02), (.09, .09, .06), (-3.0, 3.0))),
        (176, 176, 110, 110, 110, 40, 40), (1.7, 1.7, 1.7, 2.2, 2.4, 3, 3), (1.4, 1.4, .8, .8, .5, .15, .15),
        (160, 160, 160, 160, 100, 160, 160), (0, .4, 0, -1.3, 0, .9, 0), 7., .045),
    Arm("vx300", "joint", (
        ("shoulder_link", (0, 0, .079), I4, Z, .77, (0, 0, .0), (.08, .09, .1), (-3.1, 3.1)),
        ("upper_arm_link", (0, 0, .048), I4, Y, .8, (.012, .012, .22), (.07, .07, .34), (-1.8, 1.75)),
        ("forearm_link", (.0595, 0, .3), I4, Y, .6, (.16, -.006, 0), (.32, .06, .06), (-1.7, 1.6)),
        ("wrist_link", (.3, 0, 0), I4, Y, .25, (.045, 0, .003), (.09, .05, .05), (-1.8, 2.1)),
        ("gripper_link", (.069, 0, 0), I4, X, .4, (.06, 0, .002), (.14, .1, .06), (-3.1, 3.1))),
        (9., 18., 9., 4.2, 2.2), (1.8, 1.6, 1.8, 2.2, 2.4), (.03, .05, .03, .012, .008),
        (272, 272, 272, 272, 212), (0, -.3, .4, .5, 0), .6, .12, 0),
    Arm("small4", "joint", (
        ("link2", (.012, 0, .017), I4, Z, .08, (0, 0, .045), (.035, .05, .06), (-2.8, 2.8)),
        ("link3", (0, 0, .06), I4, Y, .1, (.009, 0, .10), (.04, .05, .15), (-1.8, 1.6)),
        ("link4", (.024, 0, .128), I4, Y, .14, (.09, 0, 0), (.15, .05, .045), (-1.5, 1.5)),
        ("link5", (.124, 0, 0), I4, Y, .24, (.06, 0, .005), (.11, .1, .05), (-1.7, 2.0))),
        (1.2, 2.0, 1.2, .8), (2.4, 2.2, 2.4, 2.6), (.008, .008, .006, .006),
        (353, 353, 353, 353), (0, -.4, .5, .4), .25, .11, 0),
    Arm("kr210", "joint_a", (
        ("link_1", (0, 0, .33), I4, Z, 230., (.06, 0, .25), (.7, .65, .6), (-3.2, 3.2)),
        ("link_2", (.35, 0, .42), I4, Y, 165., (.02, -.1, .55), (.4, .45, 1.5), (-.78, 1.45)),
        ("link_3", (0, 0, 1.25), I4, Y, 150., (.12, .05, .02), (.75, .5, .45), (-3.6, 1.1)),
        ("link_4", (.56, 0, -.054), I4, X, 95., (.12, 0, 0), (.75, .3, .3), (-6, 6)),
        ("link_5", (.94, 0, 0), I4, Y, 38., (.04, 0, 0), (.35, .25, .25), (-2.1, 2.1)),
        ("link_6", (.193, 0, 0), I4, X, 60., (.16, .02, .03), (.35, .35, .35), (-6, 6))),
        (9000, 9500, 5000, 1300, 1200, 850), (1.3, 1.2, 1.3, 1.8, 1.8, 2.4), (260, 280, 130, 18, 15, 8),
        (259, 267, 252, 221, 240, 154), (0, .1, -.1, 0, .7, 0), 150., .1, 0),
)
# fmt: on


def inertials(arm: Arm, rng: np.random.Generator) -> np.ndarray:
    """A specimen's links, (n, 10): mass, centre of mass, inertia xx yy zz xy xz yz about it."""
    rows = []
    for _, _, _, _, mass, com, box, _ in arm.links:
        box = np.array(box) * rng.uniform(0.85, 1.05, 3)
        moments = mass / 12 * (np.sum(box**2) - box**2)
        turn = rotation(rng.normal(0, 0.12, 3))
        tensor = turn @ np.diag(moments) @ turn.T
        scale = rng.uniform(0.85, 1.15)
        com = np.array(com) + rng.normal(0, 0.03, 3) * box
        rows.append(np.r_[mass * scale, com, scale * six(tensor)])
    return np.array(rows)


def rotation(vector: np.ndarray) -> np.ndarray:
    """Rotation matrix of a rotation vector."""
    quat, matrix = np.zeros(4), np.zeros(9)
    angle = np.linalg.norm(vector)
    mujoco.mju_axisAngle2Quat(quat, vector / max(angle, 1e-12), angle)
    mujoco.mju_quat2Mat(matrix, quat)
    return matrix.reshape(3, 3)


def six(tensor: np.ndarray) -> np.ndarray:
    return tensor[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]


def with_load(phi: np.ndarray, mass: float, com: np.ndarray, size: float) -> np.ndarray:
    """The links with a cube of edge `size` fixed to the last one, its centre at `com` of the last frame."""
    m, c, inertia = phi[-1, 0], phi[-1, 1:4], phi[-1, 4:]
    total = m + mass
    centre = (m * c + mass * com) / total
    tensor = inertia + six(
        _steiner(m, c - centre) + _steiner(mass, com - centre) + np.eye(3) * mass * size**2 / 6
    )
    return np.vstack([phi[:-1], np.r_[total, centre, tensor]])


def _steiner(mass: float, d: np.ndarray) -> np.ndarray:
    return mass * (d @ d * np.eye(3) - np.outer(d, d))


def possible(phi: np.ndarray) -> bool:
    """Whether every link has positive mass and principal moments that fulfil the triangle inequality."""
    for row in phi:
        xx, yy, zz, xy, xz, yz = row[4:]
        e = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        if row[0] <= 0 or e[0] <= 0 or e[0] + e[1] < e[2]:
            return False
    return True


def mjcf(
    arm: Arm, phi: np.ndarray, gravity: np.ndarray, joints: dict[str, np.ndarray], timestep: float
) -> str:
    """The arm as MJCF, as menagerie has it; `joints`: damping, frictionloss, armature, where modelled."""
    first = 0 if arm.name == "sawyer" else 1
    lines = [
        f'<mujoco model="{arm.name}">',
        '  <compiler angle="radian" autolimits="true"/>',
        f'  <option timestep="{timestep:g}" integrator="implicitfast" gravity="{_row(gravity)}"/>',
        f'  <default>\n    <default class="{arm.name}">',
        '      <geom type="capsule" contype="0" conaffinity="0" group="2" mass="0" rgba="0.8 0.8 0.8 1"/>',
        "    </default>\n  </default>",
        "  <worldbody>",
        f'    <body name="base" childclass="{arm.name}">',
        '      <geom fromto="0 0 0 0 0 0.05" size="0.06"/>',
    ]
    for j, (name, pos, quat, axis, _, _, box, limits) in enumerate(arm.links):
        pad = " " * (6 + 2 * j)
        extra = "".join(f' {key}="{value[j]:.6g}"' for key, value in joints.items())
        lines += [
            f'{pad}<body name="{name}" pos="{_row(pos)}" quat="{_row(quat)}">',
            f'{pad}  <inertial mass="{phi[j, 0]:.9g}" pos="{_row(phi[j, 1:4])}" '
            f'fullinertia="{_row(phi[j, 4:])}"/>',
            f'{pad}  <joint name="{arm.joint}{j + first}" axis="{_row(axis)}" '
            f'range="{_row(limits)}"{extra}/>',
            f'{pad}  <geom fromto="0 0 0 {_row(phi[j, 1:4] + 1e-4)}" size="{min(box) / 2.5:.4g}"/>',
        ]
    lines.append(" " * (6 + 2 * arm.n) + f'<site name="flange" pos="{_row(arm.tool)}"/>')
    lines += [" " * (6 + 2 * j) + "</body>" for j in reversed(range(arm.n))]
    lines += ["    </body>", "  </worldbody>", "  <actuator>"]
    lines += [
        f'    <motor name="m{j + 1}" joint="{arm.joint}{j + first}" ctrlrange="{-t} {t}"/>'
        for j, t in enumerate(arm.torque)
    ]
    return "\n".join([*lines, "  </actuator>", "</mujoco>", ""])


def _row(values) -> str:
    return " ".join(f"{value:.10g}" for value in values)
