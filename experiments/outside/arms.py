"""Five arms written by hand from published kinematics, and their MJCF.

Kinematics: Franka's modified Denavit-Hartenberg table; Universal Robots' and KUKA's published standard
tables; the fifth is a small industrial arm of our own. Masses and centres of mass are the published or plausible
ones; inertia is that of a thick rod along the link. Every case varies them a little.
"""

from dataclasses import dataclass, field, replace

import mujoco
import numpy as np


@dataclass(frozen=True)
class Link:
    """One link: where its joint frame is in the parent's joint frame, and its ten inertial parameters."""

    offset: np.ndarray  # [m], of the joint in the parent's frame
    turn: np.ndarray  # quaternion of the joint's frame in the parent's
    mass: float  # [kg]
    com: np.ndarray  # [m], in the link's joint frame
    inertia: np.ndarray  # [kg m^2], 3 x 3 about the centre of mass
    damping: float = 0.0
    frictionloss: float = 0.0
    armature: float = 0.0


@dataclass(frozen=True)
class Body:
    """A body fixed to the flange."""

    mass: float
    com: np.ndarray
    radius: float

    def inertia(self) -> np.ndarray:
        return 0.4 * self.mass * self.radius**2 * np.eye(3)


@dataclass(frozen=True)
class Arm:
    """An arm with its habits: pose, reach of its motions, speed, sensor noise and friction of its kind."""

    name: str
    links: tuple[Link, ...]
    flange: np.ndarray  # [m], in the last link's frame
    home: np.ndarray  # [rad]
    reach: np.ndarray  # [rad], half range of a motion about home
    speed: np.ndarray  # [rad/s]
    noise: np.ndarray  # [N m], torque noise
    friction: np.ndarray  # [N m], typical Coulomb level
    gravity: np.ndarray = field(default_factory=lambda: np.array([0.0, 0.0, -9.81]))
    tool: Body | None = None

    @property
    def n(self) -> int:
        return len(self.links)

    def with_joint(self, **values) -> "Arm":
        """The same arm with `damping`, `frictionloss` or `armature` of every joint replaced."""
        rows = [{key: float(value[j]) for key, value in values.items()} for j in range(self.n)]
        return replace(self, links=tuple(replace(a, **b) for a, b in zip(self.links, rows, strict=True)))

    def of(self, name: str) -> np.ndarray:
        return np.array([getattr(link, name) for link in self.links])


def turn_x(angle: float) -> np.ndarray:
    return np.array([np.cos(angle / 2), np.sin(angle / 2), 0.0, 0.0])


def rotate_x(angle: float, v: np.ndarray) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([v[0], c * v[1] - s * v[2], s * v[1] + c * v[2]])


def rod(mass: float, along: np.ndarray, thickness: float) -> np.ndarray:
    """Inertia of a thick rod about its middle."""
    length = np.linalg.norm(along)
    axis = along / length if length > 1e-6 else np.array([0.0, 0.0, 1.0])
    side = mass * (length**2 / 12 + thickness**2 / 4)
    return side * np.eye(3) + (mass * thickness**2 / 2 - side) * np.outer(axis, axis)


def modified(table, masses, coms, thickness) -> tuple[Link, ...]:
    """Links of a modified table: rows (a, alpha, d) before each joint; centres of mass in the link's frame."""
    links = []
    for (a, alpha, d), mass, com, r in zip(table, masses, coms, thickness, strict=True):
        offset = np.array([a, 0.0, 0.0]) + rotate_x(alpha, np.array([0.0, 0.0, d]))
        com = np.array(com)
        links.append(Link(offset, turn_x(alpha), mass, com, rod(mass, 2 * com, r)))
    return tuple(links)


def standard(table, masses, coms, thickness, home_of_com="end") -> tuple[tuple[Link, ...], np.ndarray]:
    """Links and flange of a standard table: rows (a, alpha, d) after each joint.

    Centres of mass are given in the frame at the link's end, as the vendors do, or ("start") in the joint's.
    """
    links, offset, turn = [], np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])
    for (a, alpha, d), mass, com, r in zip(table, masses, coms, thickness, strict=True):
        end = np.array([a, 0.0, d])
        com = np.array(com, float)
        if home_of_com == "end":
            com = end + rotate_x(alpha, com)
        links.append(Link(offset, turn, mass, com, rod(mass, end, r)))
        offset, turn = end, turn_x(alpha)
    return tuple(links), offset


H = np.pi / 2


def panda() -> Arm:
    table = [
        (0, 0, 0.333),
        (0, -H, 0),
        (0, H, 0.316),
        (0.0825, H, 0),
        (-0.0825, -H, 0.384),
        (0, H, 0),
        (0.088, H, 0),
    ]
    coms = [
        (0.004, 0.002, -0.175),
        (-0.003, -0.029, 0.0035),
        (0.0275, 0.039, -0.0665),
        (-0.053, 0.104, 0.027),
        (-0.012, 0.041, -0.038),
        (0.060, -0.014, -0.0105),
        (0.0105, -0.004, 0.0616),
    ]
    masses = [4.97, 0.65, 3.23, 3.59, 1.23, 1.67, 0.74]
    links = modified(table, masses, coms, [0.07, 0.06, 0.06, 0.06, 0.06, 0.05, 0.05])
    return Arm(
        "panda_like",
        links,
        np.array([0, 0, 0.107]),
        home=np.array([0, -0.6, 0, -2.1, 0, 1.7, 0.8]),
        reach=np.array([1.5, 0.8, 1.4, 0.7, 1.5, 0.9, 1.5]),
        speed=np.array([1.5, 1.3, 1.5, 1.5, 2.0, 2.0, 2.0]),
        noise=np.array([0.10, 0.11, 0.08, 0.08, 0.04, 0.035, 0.03]),
        friction=np.array([0.7, 0.8, 0.6, 0.7, 0.4, 0.3, 0.3]),
    )


def ur5e() -> Arm:
    table = [
        (0, H, 0.1625),
        (-0.425, 0, 0),
        (-0.3922, 0, 0),
        (0, H, 0.1333),
        (0, -H, 0.0997),
        (0, 0, 0.0996),
    ]
    coms = [
        (0, -0.0256, 0.0019),
        (0.2125, 0, 0.1134),
        (0.15, 0, 0.0265),
        (0, -0.0018, 0.0163),
        (0, 0.0018, 0.0163),
        (0, 0, -0.0012),
    ]
    links, flange = standard(
        table, [3.761, 8.058, 2.846, 1.37, 1.3, 0.365], coms, [0.06, 0.06, 0.05, 0.045, 0.045, 0.04]
    )
    arm = Arm(
        "ur5e",
        links,
        flange,
        home=np.array([0, -1.4, 1.5, -1.6, -1.5, 0]),
        reach=np.array([1.6, 0.7, 0.9, 1.2, 1.2, 1.8]),
        speed=np.array([1.5, 1.4, 1.6, 2.0, 2.0, 2.2]),
        noise=np.array([0.45, 0.5, 0.35, 0.10, 0.10, 0.09]),
        friction=np.array([5.0, 6.0, 4.0, 1.1, 1.0, 0.9]),
    )
    return arm.with_joint(armature=[0.65, 0.65, 0.4, 0.1, 0.1, 0.1])


def ur10e() -> Arm:
    table = [
        (0, H, 0.1807),
        (-0.6127, 0, 0),
        (-0.57155, 0, 0),
        (0, H, 0.17415),
        (0, -H, 0.11985),
        (0, 0, 0.11655),
    ]
    coms = [(0.021, 0, 0.027), (0.38, 0, 0.158), (0.24, 0, 0.068), (0, 0.007, 0.018), (0, 0.007, 0.018)]
    coms.append((0, 0, -0.026))
    links, flange = standard(
        table, [7.369, 13.051, 3.989, 2.1, 1.98, 0.615], coms, [0.08, 0.075, 0.06, 0.05, 0.05, 0.045]
    )
    arm = Arm(
        "ur10e",
        links,
        flange,
        home=np.array([0, -1.3, 1.4, -1.6, -1.5, 0]),
        reach=np.array([1.4, 0.6, 0.8, 1.2, 1.2, 1.8]),
        speed=np.array([1.1, 1.0, 1.3, 1.8, 1.8, 2.0]),
        noise=np.array([1.0, 1.1, 0.7, 0.18, 0.17, 0.15]),
        friction=np.array([9.0, 11.0, 7.0, 2.0, 1.8, 1.6]),
    )
    return arm.with_joint(armature=[1.7, 1.7, 0.9, 0.22, 0.22, 0.2])


def iiwa14() -> Arm:
    table = [(0, -H, 0.36), (0, H, 0), (0, H, 0.42), (0, -H, 0), (0, -H, 0.4), (0, H, 0), (0, 0, 0.126)]
    coms = [
        (0, -0.03, 0.28),
        (0, 0.04, 0.06),
        (0, 0.03, 0.29),
        (0, -0.034, 0.07),
        (0, -0.02, 0.28),
        (0, 0.002, 0.0),
        (0, 0, 0.10),
    ]
    links, flange = standard(
        table,
        [5.76, 6.35, 3.5, 3.5, 3.5, 1.8, 1.2],
        coms,
        [0.09, 0.12, 0.085, 0.10, 0.08, 0.08, 0.045],
        home_of_com="start",
    )
    return Arm(
        "iiwa14",
        links,
        flange,
        home=np.array([0, 0.5, 0, -1.3, 0, 0.9, 0]),
        reach=np.array([1.6, 0.8, 1.5, 0.8, 1.6, 0.9, 1.8]),
        speed=np.array([1.3, 1.3, 1.5, 1.5, 1.8, 1.9, 2.0]),
        noise=np.array([0.2, 0.2, 0.14, 0.14, 0.09, 0.06, 0.05]),
        friction=np.array([1.6, 1.7, 1.2, 1.2, 0.8, 0.5, 0.45]),
    )


def industrial() -> Arm:
    table = [(0.1, -H, 0.4), (0.45, 0, 0), (0.03, -H, 0), (0, H, 0.42), (0, -H, 0), (0, 0, 0.08)]
    coms = [
        (0.04, 0.02, 0.30),
        (0.21, 0.01, 0.08),
        (0.02, 0.01, 0.02),
        (0, 0.01, 0.22),
        (0, -0.01, 0.02),
        (0, 0, 0.05),
    ]
    links, flange = standard(
        table,
        [18.0, 12.0, 8.0, 3.0, 1.5, 0.4],
        coms,
        [0.1, 0.07, 0.08, 0.06, 0.05, 0.04],
        home_of_com="start",
    )
    arm = Arm(
        "industrial6",
        links,
        flange,
        home=np.array([0, -1.1, 0.5, 0, 0.6, 0]),
        reach=np.array([1.4, 0.6, 0.7, 1.6, 1.0, 2.0]),
        speed=np.array([1.4, 1.2, 1.5, 2.2, 2.0, 2.5]),
        noise=np.array([0.9, 1.0, 0.6, 0.12, 0.10, 0.08]),
        friction=np.array([8.0, 10.0, 6.0, 1.5, 1.2, 0.8]),
    )
    return arm.with_joint(armature=[2.2, 2.5, 1.1, 0.2, 0.15, 0.1])


ARMS = (panda, ur5e, ur10e, iiwa14, industrial)


def draw_arm(rng: np.random.Generator, name: str | None = None) -> Arm:
    """One of the arms with its masses, centres of mass and noise varied, some with a tool that the user knows."""
    made = [make() for make in ARMS]
    arm = made[rng.integers(len(made))]
    if name is not None:
        arm = next(a for a in made if a.name == name)
    arm = perturb_links(arm, rng, mass=0.08, com=0.006, inertia=0.1)
    arm = replace(arm, noise=arm.noise * np.exp(0.25 * rng.standard_normal(arm.n)))
    if rng.random() < 0.4:
        arm = replace(arm, tool=draw_body(rng, arm, 0.3, 1.0))
    if not np.any(arm.of("armature")) and rng.random() < 0.5:
        arm = arm.with_joint(armature=0.15 * arm.friction * np.exp(0.2 * rng.standard_normal(arm.n)))
    return arm


def draw_body(rng: np.random.Generator, arm: Arm, low: float, high: float) -> Body:
    """A tool or load in front of the flange; larger arms carry more."""
    size = sum(link.mass for link in arm.links) / 16.0
    mass = size * rng.uniform(low, high)
    com = np.array([*rng.normal(0, 0.02, 2), rng.uniform(0.02, 0.12)])
    return Body(float(mass), com, float(0.06 * np.cbrt(mass)))


def perturb_links(
    arm: Arm, rng: np.random.Generator, mass: float, com: float, inertia: float, which=None
) -> Arm:
    """Links with relative errors of mass and inertia (uniform) and centres of mass off by `com` [m]."""
    links = list(arm.links)
    for j in range(arm.n) if which is None else which:
        link = links[j]
        grow = 1 + rng.uniform(-mass, mass)
        spread = np.diag(np.sqrt(1 + rng.uniform(-inertia, inertia, 3)))
        tensor = grow * spread @ link.inertia @ spread
        links[j] = replace(
            link, mass=link.mass * grow, com=link.com + rng.uniform(-com, com, 3), inertia=realizable(tensor)
        )
    return replace(arm, links=tuple(links))


def realizable(tensor: np.ndarray) -> np.ndarray:
    """The tensor, a little rounder where its principal moments break the triangle inequality."""
    moments, axes = np.linalg.eigh(0.5 * (tensor + tensor.T))
    moments = np.maximum(moments, 1e-6)
    moments[:2] += max(0.0, 1.02 * moments[2] - moments[0] - moments[1])
    return axes @ np.diag(moments) @ axes.T


def numbers(values) -> str:
    return " ".join(f"{v:.10g}" for v in np.ravel(values))


def inertial(mass: float, com: np.ndarray, tensor: np.ndarray) -> str:
    i = tensor
    six = [i[0, 0], i[1, 1], i[2, 2], i[0, 1], i[0, 2], i[1, 2]]
    return f'<inertial mass="{mass:.10g}" pos="{numbers(com)}" fullinertia="{numbers(six)}"/>'


def mjcf(arm: Arm) -> str:
    """The arm as its user would write it down."""
    lines = [
        f'<mujoco model="{arm.name}">',
        '  <compiler angle="radian"/>',
        f'  <option timestep="0.001" gravity="{numbers(arm.gravity)}"/>',
        "  <worldbody>",
        '    <body name="base">',
    ]
    for j, link in enumerate(arm.links):
        pad = "  " * (j + 3)
        extra = "".join(
            f' {key}="{getattr(link, key):.10g}"'
            for key in ("damping", "frictionloss", "armature")
            if getattr(link, key)
        )
        limit = numbers([arm.home[j] - arm.reach[j] - 1.0, arm.home[j] + arm.reach[j] + 1.0])
        place = f'pos="{numbers(link.offset)}" quat="{numbers(link.turn)}"'
        lines += [
            f'{pad}<body name="link{j + 1}" {place}>',
            f"{pad}  {inertial(link.mass, link.com, link.inertia)}",
            f'{pad}  <joint name="joint{j + 1}" axis="0 0 1" range="{limit}"{extra}/>',
        ]
    pad = "  " * (arm.n + 3)
    lines.append(f'{pad}<body name="flange" pos="{numbers(arm.flange)}">')
    if arm.tool is None:
        lines.append(f'{pad}  <site name="flange"/>')
    else:
        lines.append(f"{pad}  {inertial(arm.tool.mass, arm.tool.com, arm.tool.inertia())}")
    lines.append(f"{pad}</body>")
    lines += ["  " * (j + 3) + "</body>" for j in reversed(range(arm.n))]
    lines += ["    </body>", "  </worldbody>", "</mujoco>", ""]
    return "\n".join(lines)


def rigid(arm: Arm) -> mujoco.MjModel:
    """The compiled arm without constraints; its joint damping stays, its frictionloss is left to the caller."""
    model = mujoco.MjModel.from_xml_string(mjcf(arm))
    flags = mujoco.mjtDisableBit
    model.opt.disableflags |= flags.mjDSBL_CONSTRAINT | flags.mjDSBL_CONTACT
    return model


def dry(arm: Arm, qd) -> np.ndarray:
    """Dry friction of the arm's file: the sign of the velocity, smoothed over 0.01 rad/s."""
    return arm.of("frictionloss") * np.tanh(qd / 0.01)


def inverse(arm: Arm, q, qd, qdd) -> np.ndarray:
    """Torque of the arm's file for every row: MuJoCo's inverse dynamics, its damping and its frictionloss."""
    model = rigid(arm)
    data = mujoco.MjData(model)
    tau = np.empty_like(q)
    for k in range(len(q)):
        data.qpos, data.qvel, data.qacc = q[k], qd[k], qdd[k]
        mujoco.mj_inverse(model, data)
        tau[k] = data.qfrc_inverse
    return tau + dry(arm, qd)
