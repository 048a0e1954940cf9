"""An arm as URDF, for the tools that read no MJCF."""

import numpy as np
from jaxtyping import Array, Float

from ..friction import Friction
from .arm import Arm
from .markup import numbers, quote
from .mjcf import com_from_standard

MARK = "written by jaxpanda"
UNLIMITED = 1e6
"""Written for an effort [N m] or velocity [rad/s] that the arm does not tell: URDF demands a number."""


def to_urdf(
    arm: Arm,
    standard: Float[Array, "dof 10"] | Float[np.ndarray, "dof 10"] | None = None,
    friction: Friction | None = None,
    *,
    effort: Float[np.ndarray, " dof"] | None = None,
    velocity: Float[np.ndarray, " dof"] | None = None,
) -> str:
    """URDF of the arm: links, joints, limits and friction.

    Every link's frame is the arm's, with its joint along z. URDF has no gravity, no armature, no springs
    and no constant torque, and its readers refuse friction below zero; a comment in the file says what was
    left out.

    Args:
        arm: geometry, limits, and the friction that its model holds already.
        standard: parameters of the links; None for the arm's own.
        friction: found beyond what `arm` holds; only viscous and Coulomb friction have a home.
        effort: largest torque of each joint [N m].
        velocity: largest velocity of each joint [rad/s].
    """
    phi = np.asarray(arm.standard if standard is None else standard, float)
    damping, coulomb = (np.maximum(values, 0) for values in _laws(arm, friction).values())
    effort = np.full(arm.dof, UNLIMITED) if effort is None else effort
    velocity = np.full(arm.dof, UNLIMITED) if velocity is None else velocity
    lines = [f'<robot name="{quote(arm.name)}">']
    lines.append(f"  <!-- {MARK} -->")
    if parts := left_out(arm, friction):
        lines.append(f"  <!-- not in this file: {'; '.join(parts)} -->")
    lines.append(f'  <link name="{_base(arm)}"/>')
    parents = (_base(arm), *arm.link_names)
    for i in range(arm.dof):
        lines += _link(arm.link_names[i], phi[i])
        kind = "prismatic" if arm.chain.prismatic[i] else "revolute"
        lower, upper = float(arm.lower[i]), float(arm.upper[i])
        limits = f'effort="{numbers(effort[i])}" velocity="{numbers(velocity[i])}"'
        if np.isfinite(lower) and np.isfinite(upper):
            limits = f'lower="{numbers(lower)}" upper="{numbers(upper)}" {limits}'
        elif kind == "revolute":
            kind = "continuous"
        else:
            limits = f'lower="{-UNLIMITED}" upper="{UNLIMITED}" {limits}'
        rpy = roll_pitch_yaw(np.asarray(arm.chain.R[i], float))
        lines += [
            f'  <joint name="{quote(arm.joint_names[i])}" type="{kind}">',
            f'    <parent link="{quote(parents[i])}"/>',
            f'    <child link="{quote(arm.link_names[i])}"/>',
            f'    <origin xyz="{numbers(arm.chain.p[i])}" rpy="{numbers(rpy)}"/>',
            '    <axis xyz="0 0 1"/>',
            f"    <limit {limits}/>",
            f'    <dynamics damping="{numbers(damping[i])}" friction="{numbers(coulomb[i])}"/>',
            "  </joint>",
        ]
    return "\n".join([*lines, "</robot>", ""])


def _link(name: str, phi: np.ndarray) -> list[str]:
    """A link with its inertia about the centre of mass, in URDF's order ixx ixy ixz iyy iyz izz."""
    if phi[0] == 0:
        return [f'  <link name="{quote(name)}"/>']
    mass, com, I = com_from_standard(phi)
    entries = zip(("ixx", "ixy", "ixz", "iyy", "iyz", "izz"), I[np.triu_indices(3)], strict=True)
    inertia = " ".join(f'{key}="{numbers(value)}"' for key, value in entries)
    return [
        f'  <link name="{quote(name)}">',
        "    <inertial>",
        f'      <origin xyz="{numbers(com)}" rpy="0 0 0"/>',
        f'      <mass value="{numbers(mass)}"/>',
        f"      <inertia {inertia}/>",
        "    </inertial>",
        "  </link>",
    ]


def _laws(arm: Arm, friction: Friction | None) -> dict[str, np.ndarray]:
    """URDF's two numbers of each joint's friction, as they came out."""
    found = friction if friction is not None and friction.model not in ("none", "sigmoid") else None
    return {
        "damping": np.asarray(arm.damping, float) + (found.viscous if found else 0),
        "friction": np.asarray(arm.frictionloss, float) + (found.coulomb if found else 0),
    }


def left_out(arm: Arm, friction: Friction | None) -> list[str]:
    """What the URDF does not hold."""
    parts = []
    if np.any(np.asarray(arm.armature)):
        parts.append("armature " + numbers(arm.armature))
    if np.any(np.asarray(arm.stiffness)):
        parts.append("joint springs " + numbers(arm.stiffness) + " about " + numbers(arm.springref))
    if friction is not None and friction.model == "sigmoid":
        parts.append("sigmoid friction")
    elif friction is not None and np.any(friction.offset):
        parts.append("torque offsets " + numbers(friction.offset))
    for name, values in _laws(arm, friction).items():
        parts += [f"{name} {values[j]:.4g} of joint {j + 1}, below zero" for j in np.flatnonzero(values < 0)]
    return parts


def _base(arm: Arm) -> str:
    return "base_link" if "base_link" not in arm.link_names else "world"


def roll_pitch_yaw(R: np.ndarray) -> np.ndarray:
    """Roll, pitch, yaw with R = Rz(yaw) Ry(pitch) Rx(roll), exact to rounding also at pitch = ±90 degrees."""
    yaw = np.arctan2(R[1, 0], R[0, 0]) if R[0, 0] or R[1, 0] else 0.0
    c, s = np.cos(yaw), np.sin(yaw)
    pitch = np.arctan2(-R[2, 0], c * R[0, 0] + s * R[1, 0])
    roll = np.arctan2(s * R[0, 2] - c * R[1, 2], c * R[1, 1] - s * R[0, 1])
    return np.array([roll, pitch, yaw])
