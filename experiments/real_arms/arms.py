"""Nominal models of the recorded arms as MJCF, from public facts: geometry, masses, centres of mass, inertias."""

import dataclasses
from collections.abc import Sequence

import numpy as np

HALF = 0.5 * np.pi


@dataclasses.dataclass(frozen=True)
class Link:
    """A joint about its own z axis, placed in the frame of the one before, and the body that it turns."""

    pos: Sequence[float]
    quat: Sequence[float]
    mass: float
    com: Sequence[float]
    """In the joint's frame [m]."""
    inertia: Sequence[float]
    """Principal moments about the centre of mass [kg m²]."""
    axes: Sequence[float] = (1.0, 0.0, 0.0, 0.0)
    """Of those moments, as a quaternion in the joint's frame."""


def mjcf(name: str, links: Sequence[Link], armature: Sequence[float] | None = None) -> str:
    """A serial arm as MJCF."""
    armature = [0.0] * len(links) if armature is None else armature
    lines = [f'<mujoco model="{name}">', '  <option gravity="0 0 -9.81"/>', "  <worldbody>"]
    for i, (link, rotor) in enumerate(zip(links, armature, strict=True)):
        pad = "  " * (i + 2)
        lines += [
            f'{pad}<body name="link{i + 1}" pos="{_text(link.pos)}" quat="{_text(link.quat)}">',
            f'{pad}  <inertial pos="{_text(link.com)}" mass="{link.mass!r}" quat="{_text(link.axes)}"'
            f' diaginertia="{_text(link.inertia)}"/>',
            f'{pad}  <joint name="joint{i + 1}" axis="0 0 1" range="-6.3 6.3" limited="true"'
            f' armature="{float(rotor)!r}" damping="0" frictionloss="0"/>',
        ]
    lines += ["  " * (i + 2) + "</body>" for i in reversed(range(len(links)))]
    return "\n".join([*lines, "  </worldbody>", '  <compiler angle="radian"/>', "</mujoco>", ""])


def _text(values: Sequence[float]) -> str:
    return " ".join(repr(round(float(v), 12)) for v in values)


def _rod(mass: float, length: float, radius: float, along: int) -> list[float]:
    """Principal moments of a cylinder."""
    across, about = mass * (3 * radius**2 + length**2) / 12, mass * radius**2 / 2
    return [about if k == along else across for k in range(3)]


def ur10e(armature: Sequence[float] | None = None) -> str:
    """Classic DH, masses and centres of mass that Universal Robots publishes; inertias of cylinders.

    Source: universal-robots.com, "DH Parameters for calculations of kinematics and dynamics" (centres of mass in
    the DH frames, at the far end of each link); lengths of the recorded arm from its calibration.
    """
    a = [0.0, -0.6127, -0.57155, 0.0, 0.0, 0.0]
    d = [0.1807, 0.0, 0.0, 0.17415, 0.11985, 0.11655]
    alpha = [HALF, 0.0, 0.0, HALF, -HALF, 0.0]
    mass = [7.369, 13.051, 3.989, 2.1, 1.98, 0.615]
    wrist = [0, 0.007, 0.018]
    com = [[0.021, 0, 0.027], [0.38, 0, 0.158], [0.24, 0, 0.068], wrist, wrist, [0, 0, -0.026]]
    bulb = (0.12, 0.045, 1)
    body = [(0.18, 0.075, 1), (0.75, 0.06, 0), (0.68, 0.05, 0), bulb, bulb, (0.05, 0.045, 2)]
    links, pos, quat = [], np.zeros(3), np.array([1.0, 0, 0, 0])
    for i in range(6):
        c, s = np.cos(alpha[i]), np.sin(alpha[i])
        R = np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
        end = np.array([a[i], 0, d[i]])
        moments = np.array(_rod(mass[i], *body[i]))
        turned = np.abs(R) @ moments if abs(s) > 0.5 else moments
        links.append(Link(pos, quat, mass[i], end + R @ com[i], turned))
        pos, quat = end, np.array([np.cos(alpha[i] / 2), np.sin(alpha[i] / 2), 0, 0])
    return mjcf("ur10e", links, armature)


def iiwa14() -> str:
    """Geometry of the LBR iiwa 14 and its masses and inertias as people simulate it (MuJoCo Menagerie, drake)."""
    up, down, flat = (0, 0, 1, 1), (1, 1, 0, 0), (1, 0, 0, 0)
    rows = [
        ((0, 0, 0.1575), flat, 5.76, (0, -0.03, 0.12), (0.0333, 0.033, 0.0123)),
        ((0, 0, 0.2025), up, 6.35, (0.0003, 0.059, 0.042), (0.0305, 0.0304, 0.011)),
        ((0, 0.2045, 0), up, 3.5, (0, 0.03, 0.13), (0.025, 0.0238, 0.0076)),
        ((0, 0, 0.2155), down, 3.5, (0, 0.067, 0.034), (0.017, 0.0164, 0.006)),
        ((0, 0.1845, 0), up, 3.5, (0.0001, 0.021, 0.076), (0.01, 0.0087, 0.00449)),
        ((0, 0, 0.2155), down, 1.8, (0, 0.0006, 0.0004), (0.0049, 0.0047, 0.0036)),
        ((0, 0.081, 0), up, 1.2, (0, 0, 0.02), (0.001, 0.001, 0.001)),
    ]
    return mjcf("iiwa14", [Link(*row) for row in rows])


def kinova_gen3() -> str:
    """Geometry, masses and inertias of Kinova's own description of the Gen3 with 7 joints (ros_kortex)."""
    flip, over, back = (0, 1, 0, 0), (1, 1, 0, 0), (1, -1, 0, 0)
    rows = [
        ((0, 0, 0.15643), flip, 1.3773, (-2.3e-05, -0.010364, -0.07336), (0.00488868, 0.00457, 0.00135132),
         (0.707051, 0.0451246, -0.0453544, 0.704263)),
        ((0, 0.005375, -0.12838), over, 1.1636, (-4.4e-05, -0.09958, -0.013278),
         (0.0113017, 0.011088, 0.00102532), (0.482348, 0.516286, -0.516862, 0.483366)),
        ((0, -0.21038, -0.006375), back, 1.1636, (-4.4e-05, -0.006641, -0.117892),
         (0.0111633, 0.010932, 0.00100671), (0.706144, 0.0213722, -0.0209128, 0.707437)),
        ((0, 0.006375, -0.21038), over, 0.9302, (-1.8e-05, -0.075478, -0.015006),
         (0.00834839, 0.008147, 0.000598606), (0.483678, 0.515961, -0.515859, 0.483455)),
        ((0, -0.20843, -0.006375), back, 0.6781, (1e-06, -0.009432, -0.063883),
         (0.00165901, 0.001596, 0.000346988), (0.703558, 0.0707492, -0.0707492, 0.703558)),
        ((0, 0.00017505, -0.10593), over, 0.6781, (1e-06, -0.045483, -0.00965),
         (0.00170087, 0.001641, 0.00035013), (0.44426, 0.550121, -0.550121, 0.44426)),
        ((0, -0.10593, -0.00017505), back, 0.5, (0.000281, 0.011402, -0.029798),
         (0.000657336, 0.000587019, 0.000320645), (0.394358, 0.596779, -0.577293, 0.393789)),
    ]  # fmt: skip
    return mjcf("kinova_gen3", [Link(*row) for row in rows])
