"""Slips in an MJCF that MuJoCo compiles without a word."""

# MuJoCo's names come from a compiled module without stubs.
import dataclasses
from collections.abc import Iterator
from typing import Literal

import mujoco
import numpy as np

from .engine_log import own_log
from .mjcf import load_model, load_spec
from .model_file import Model

OUTLIER = 3.0
"""How far a joint's friction may exceed that of every other hinge of its arm.

Drives shrink towards the wrist, so the largest friction sits near the base and its neighbours share its
size: one joint from the third on that has three times the friction of *all* others is a slip of the pen (or
a broken gear). Ratios to a median would fire on ordinary arms, whose wrist and shoulder differ tenfold.
"""
SHARE = 0.5
"""Share of a joint's whole inertia above which the armature hides the link."""
SIZES = 10.0
"""Ratio between the largest and smallest inertia that joints with one and the same armature may have."""
EDGE = 1e-6
"""Distance to the triangle inequality, as a share of the trace, that an export's rounding may cross."""

_HINGE = int(mujoco.mjtJoint.mjJNT_HINGE)


@dataclasses.dataclass(frozen=True)
class Finding:
    """One thing worth a look."""

    severity: Literal["error", "warning", "notice"]
    where: str
    """Joint, body or actuator, by name."""
    message: str


def lint(model: mujoco.MjModel | Model) -> list[Finding]:
    """What a file or a compiled model holds that its author hardly meant; the gravest first.

    Raises:
        InputError: no MJCF, or one that MuJoCo refuses for another reason than an inertia.
    """
    findings: list[Finding] = []
    if not isinstance(model, mujoco.MjModel):
        findings += _impossible_inertias(model)
        model = load_model(model, balanceinertia=bool(findings))
    checks = (_negative, _outliers, _armature, _placeholders, _near_edge)
    findings += [finding for check in checks for finding in check(model)]
    findings += [Finding("warning", "MJX", message) for message in ignored_by_mjx(model)]
    return sorted(findings, key=lambda f: ("error", "warning", "notice").index(f.severity))


def ignored_by_mjx(model: mujoco.MjModel) -> tuple[str, ...]:
    """Features that MuJoCo computes and MJX-JAX passes over without a word, a sentence each."""
    features = {
        "polynomial joint damping": model.dof_dampingpoly,
        "polynomial joint stiffness": model.jnt_stiffnesspoly,
        "polynomial tendon damping": model.tendon_dampingpoly,
        "polynomial tendon stiffness": model.tendon_stiffnesspoly,
        "actuator damping": model.actuator_damping,
        "polynomial actuator damping": model.actuator_dampingpoly,
        "actuator armature": model.actuator_armature,
        "actuator delay": model.actuator_delay,
        "a history buffer (nsample)": np.array(model.nhistory),
    }
    return tuple(f"{name} is ignored by MJX" for name, value in features.items() if np.any(value))


def _impossible_inertias(path: Model) -> list[Finding]:
    """Inertials as written that no body can have; MuJoCo stops at the first of them."""
    spec = load_spec(path)
    findings = []
    if spec.compiler.balanceinertia:
        findings.append(
            Finding("warning", "compiler", "balanceinertia silently replaces an impossible inertia")
        )
    for body in spec.bodies:
        if not body.explicitinertial:
            continue
        full = body.fullinertia
        if np.isfinite(full[0]):
            xx, yy, zz, xy, xz, yz = full
            moments = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        else:
            moments = np.sort(body.inertia)
        if not moments.any():  # a point mass
            continue
        if moments[0] <= 0 or moments[2] - moments[0] - moments[1] > 1e-14 * moments[2]:
            a, b, c = (f"{moment:.4g}" for moment in moments)
            findings.append(
                Finding(
                    "error",
                    f"body {body.name!r}",
                    f"principal moments {a}, {b}, {c} kg m² are no body's: none may be negative,"
                    " or exceed the sum of the other two",
                )
            )
    return findings


def _negative(model: mujoco.MjModel) -> Iterator[Finding]:
    """MuJoCo accepts these without a word."""
    for name, values in (
        ("damping", model.dof_damping),
        ("frictionloss", model.dof_frictionloss),
        ("armature", model.dof_armature),
    ):
        for dof in np.flatnonzero(values < 0):
            effect = "makes the inertia smaller than the links'" if name == "armature" else "feeds energy in"
            yield Finding("error", _of(model, dof), f"{name} is {values[dof]:.6g}; negative, it {effect}")


def _outliers(model: mujoco.MjModel) -> Iterator[Finding]:
    for name, values in (("damping", model.dof_damping), ("frictionloss", model.dof_frictionloss)):
        for dofs in _hinges(model):
            for place, dof in enumerate(dofs):
                others = np.delete(values[dofs], place)
                if place < 2 or np.count_nonzero(others > 0) < 3:
                    continue
                if values[dof] > OUTLIER * others.max():
                    yield Finding(
                        "warning",
                        _of(model, dof),
                        f"{name} is {values[dof]:.6g}, {values[dof] / others.max():.1f} times the largest"
                        f" of the other joints' ({others.max():.6g}); a slip of a digit?",
                    )


def _armature(model: mujoco.MjModel) -> Iterator[Finding]:
    inertia = _joint_inertia(model)
    for dofs in _hinges(model):
        for dof in dofs:
            armature = model.dof_armature[dof]
            if armature > SHARE * inertia[dof]:
                yield Finding(
                    "notice",
                    _of(model, dof),
                    f"armature {armature:.4g} kg m² is {100 * armature / inertia[dof]:.0f} % of the joint's"
                    " inertia at mid-range: the links beyond it hardly matter to its motion",
                )


def _placeholders(model: mujoco.MjModel) -> Iterator[Finding]:
    inertia = _joint_inertia(model) - model.dof_armature
    for dofs in _hinges(model):
        if len(dofs) < 4 or inertia[dofs].max() < SIZES * inertia[dofs].min():
            continue
        for name, values in (
            ("armature", model.dof_armature[dofs]),
            ("damping", model.dof_damping[dofs]),
            ("frictionloss", model.dof_frictionloss[dofs]),
        ):
            if values[0] > 0 and np.all(values == values[0]):
                yield Finding(
                    "notice",
                    f"{_of(model, dofs[0])} to {_of(model, dofs[-1])}",
                    f"one {name} of {values[0]:.6g} for joints of very different size is no measurement",
                )


def _near_edge(model: mujoco.MjModel) -> Iterator[Finding]:
    for body in range(1, model.nbody):
        a, b, c = np.sort(model.body_inertia[body])
        if model.body_mass[body] > 0 and a + b - c < EDGE * (a + b + c):
            name = model.body(body).name or f"number {body}"
            yield Finding(
                "notice",
                f"body {name!r}",
                "its inertia lies on the triangle inequality: rounding a digit can stop compilation",
            )


def _hinges(model: mujoco.MjModel) -> list[np.ndarray]:
    """Degrees of freedom of the hinges of each mechanism, from the base outwards."""
    hinge = model.jnt_type[model.dof_jntid] == _HINGE
    return [np.flatnonzero(hinge & (model.dof_treeid == tree)) for tree in range(model.ntree)]


@own_log()
def _joint_inertia(model: mujoco.MjModel) -> np.ndarray:
    """Diagonal of the mass matrix with the joints at mid-range, armature included [kg m²]."""
    data = mujoco.MjData(model)
    for joint in np.flatnonzero(model.jnt_limited):
        if model.jnt_type[joint] != mujoco.mjtJoint.mjJNT_BALL:
            data.qpos[model.jnt_qposadr[joint]] = model.jnt_range[joint].mean()
    mujoco.mj_fwdPosition(model, data)
    M = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, M)
    return np.diag(M).copy()


def _of(model: mujoco.MjModel, dof: int | np.integer) -> str:
    joint = int(model.dof_jntid[dof])
    return f"joint {model.joint(joint).name!r}" if model.joint(joint).name else f"joint number {joint + 1}"
