"""A URDF as MJCF: MuJoCo's parser reads it, and what it found is written down with the same names.

Links become bodies, fixed joints bodies without a joint, `<dynamics>` damping and frictionloss, limits of
position ranges, limits of effort motors. Meshes are left out: they give looks and contacts, and a link's inertia
stands in the file. Every number keeps all its digits, which MuJoCo's own writer does not.
"""

# MuJoCo's names come from a compiled module without stubs.
from collections.abc import Iterator
from pathlib import Path

import mujoco
import numpy as np

from ..errors import InputError
from . import markup
from .engine_log import own_log
from .markup import numbers, quote

_KINDS = {
    int(mujoco.mjtJoint.mjJNT_HINGE): "hinge",
    int(mujoco.mjtJoint.mjJNT_SLIDE): "slide",
    int(mujoco.mjtJoint.mjJNT_BALL): "ball",
    int(mujoco.mjtJoint.mjJNT_FREE): "free",
}
_SHAPES = {
    int(mujoco.mjtGeom.mjGEOM_SPHERE): ("sphere", 1),
    int(mujoco.mjtGeom.mjGEOM_CAPSULE): ("capsule", 2),
    int(mujoco.mjtGeom.mjGEOM_CYLINDER): ("cylinder", 2),
    int(mujoco.mjtGeom.mjGEOM_BOX): ("box", 3),
}
"""MJCF's name and how many sizes it has."""
_NAMED = 3  # links in a sentence
_TENSOR = np.array([[0, 3, 4], [3, 1, 5], [4, 5, 2]])  # of MuJoCo's xx yy zz xy xz yz
_EDGE = 1e-9
"""Least share of the whole that a second moment keeps: MuJoCo's check of the triangle inequality is exact."""
_ROUNDING = 1e-4
"""Share by which one may be negative for the digits of the file alone."""


def as_mjcf(document: markup.Document) -> markup.Document:
    """The same robot as MJCF, under the same path.

    Raises:
        InputError: xacro, links that move and have no mass, or what MuJoCo refuses.
    """
    path = document.path
    if macros := [e for e in document.root.walk() if e.tag.startswith("xacro:")]:
        raise InputError(
            f"{path}: line {macros[0].line}: <{macros[0].tag}> is a macro of xacro; run xacro on the file first"
        )
    notes = ["a URDF: it was read by MuJoCo, and models that are written of it are MJCF with its names"]
    with own_log() as said:
        try:
            spec = mujoco.MjSpec.from_string(document.text)
        except ValueError as error:
            raise _refused(path, error) from None
        dropped = _drop_meshes(spec)
        notes += _fix_weightless(spec)
        _require_masses(spec, document)
        notes += _mend_inertias(spec, path)
        spec.compiler.fusestatic = False
        spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_FALSE
        try:
            model = spec.compile()
        except ValueError as error:
            raise _refused(path, error) from None
    text = "\n".join([*_lines(model, document.root.attributes.get("name", path.stem)), ""])
    if dropped:
        notes.append(f"{dropped} meshes of the URDF are left out: it has no contacts there")
    if fast := [e for e in document.root.walk() if e.tag == "limit" and "velocity" in e.attributes]:
        notes.append(f"limits of velocity of {len(fast)} joints have no place in MJCF and are left out")
    notes += [f"MuJoCo warns: {what.strip()}" for what in dict.fromkeys(said)]
    return markup.parse(text, "mujoco", path, part=document.part, notes=tuple(notes))


def _refused(path: Path, error: ValueError) -> InputError:
    said = ", ".join(line.strip() for line in str(error).splitlines() if line.strip())
    return InputError(
        f"{path}: MuJoCo refuses it: {said.removeprefix('XML Error: ').removeprefix('Error: ')}"
    )


def _fix_weightless(spec: mujoco.MjSpec) -> list[str]:
    """Take fingers that weigh nothing for fixed: what does not weigh is no mechanics, and MuJoCo refuses it."""
    fixed = []
    for body in spec.bodies:
        fingers = [b for b in _first_moving(body) if not _weighs(b)]
        if list(body.joints) and len(_first_moving(body)) > 1:
            for joint in [joint for finger in fingers for b in _all_below(finger) for joint in b.joints]:
                fixed.append(joint.name)
                spec.delete(joint)
    for tie in [tie for tie in spec.equalities if {tie.name1, tie.name2} & set(fixed)]:
        spec.delete(tie)
    return [f"joints {', '.join(fixed)} move nothing that weighs, and are taken for fixed"] if fixed else []


def _first_moving(body) -> list:
    """The links with joints that come first on the ways out from a link."""
    return [b for child in body.bodies for b in ([child] if list(child.joints) else _first_moving(child))]


def _all_below(body) -> Iterator:
    yield body
    for child in body.bodies:
        yield from _all_below(child)


def _weighs(body) -> bool:
    return any(b.mass > 0 for b in _all_below(body))


def _mend_inertias(spec: mujoco.MjSpec, path: Path) -> list[str]:
    """Let MuJoCo read inertias that are no body's; what is told of each that counts.

    A point mass has none, and that of what stands still is no matter. Else the nearest body's is taken: second
    moments below zero become zero.
    """
    told = []
    for body in spec.bodies:
        if not body.explicitinertial:
            continue
        if not moves(body) or body.mass <= 0:
            body.mass, body.explicitinertial, body.fullinertia = 0.0, False, np.full(6, np.nan)
            body.inertia = np.zeros(3)
            continue
        full = np.asarray(body.fullinertia)
        I = full[_TENSOR] if np.isfinite(full[0]) else np.diag(body.inertia)
        if not np.isfinite(I).all():
            raise InputError(f"{path}: link {body.name!r}: its inertia is no finite number")
        moments, axes = np.linalg.eigh(np.trace(I) / 2 * np.eye(3) - I)
        total = np.abs(moments).sum()
        if total < mujoco.mjMINVAL:
            body.fullinertia, body.inertia = np.full(6, np.nan), np.zeros(3)
        elif moments[0] < _EDGE * total:
            if moments[0] < -_ROUNDING * total:
                told.append(body.name)
            moments = np.maximum(moments, _EDGE * total)
            I = moments.sum() * np.eye(3) - (axes * moments) @ axes.T
            body.fullinertia = I[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    if not told:
        return []
    named = ", ".join(told[:_NAMED]) + (f" and {len(told) - _NAMED} more" if len(told) > _NAMED else "")
    return [f"the inertia of {named} is no body's: the nearest that is was taken in its place"]


def moves(body) -> bool:
    """Whether a joint stands between the body and the world; else its inertia is no matter."""
    while body is not None:
        if list(body.joints):
            return True
        body = body.parent
    return False


def _drop_meshes(spec: mujoco.MjSpec) -> int:
    """Take the meshes out; how many geoms had one."""
    shaped = [geom for geom in spec.geoms if geom.meshname or int(geom.type) not in _SHAPES]
    for asset in [*shaped, *spec.meshes]:
        spec.delete(asset)
    return len(shaped)


def _require_masses(spec: mujoco.MjSpec, document: markup.Document) -> None:
    """Every link that moves weighs something, itself or by what is fixed to it."""
    weightless = [body.name for body in spec.bodies if list(body.joints) and not _carries_mass(body)]
    if not weightless:
        return
    if not any(e.tag == "inertial" for e in document.root.walk()):
        raise InputError(
            f"{document.path}: none of its links has an <inertial>, so it says nothing of masses; a URDF with"
            " them is needed"
        )
    named = ", ".join(repr(name) for name in weightless[:_NAMED])
    more = f" and {len(weightless) - _NAMED} more" if len(weightless) > _NAMED else ""
    raise InputError(
        f"{document.path}: links {named}{more} move and have no mass in an <inertial>, nor has what is fixed to"
        " them; give them one"
    )


def _carries_mass(body) -> bool:
    fixed = [child for child in body.bodies if not list(child.joints)]
    return body.mass > 0 or any(_carries_mass(child) for child in fixed)


def _lines(model: mujoco.MjModel, name: str) -> Iterator[str]:
    yield f'<mujoco model="{quote(name)}">'
    yield '  <compiler angle="radian" inertiafromgeom="false"/>'
    yield "  <worldbody>"
    for child in _children(model, 0):
        yield from _body(model, child, "    ")
    yield "  </worldbody>"
    motors = [j for j in range(model.njnt) if model.jnt_actfrclimited[j]]
    if motors:
        yield "  <actuator>"
        for joint in motors:
            called = quote(model.joint(joint).name)
            limits = numbers(model.jnt_actfrcrange[joint])
            yield f'    <motor name="{called}" joint="{called}" ctrllimited="true" ctrlrange="{limits}"/>'
        yield "  </actuator>"
    if model.neq:
        yield "  <equality>"
        for eq in range(model.neq):  # <mimic> is the only constraint that URDF has
            a, b = (quote(model.joint(int(j[eq])).name) for j in (model.eq_obj1id, model.eq_obj2id))
            shape = numbers(model.eq_data[eq, :5])
            yield f'    <joint joint1="{a}" joint2="{b}" polycoef="{shape}"/>'
        yield "  </equality>"
    yield "</mujoco>"


def _children(model: mujoco.MjModel, body: int) -> list[int]:
    return [b for b in range(1, model.nbody) if model.body_parentid[b] == body]


def _place(pos: np.ndarray, quat: np.ndarray) -> str:
    turned = "" if np.array_equal(quat, [1, 0, 0, 0]) else f' quat="{numbers(quat)}"'
    return f'pos="{numbers(pos)}"{turned}'


def _body(model: mujoco.MjModel, body: int, pad: str) -> Iterator[str]:
    place = _place(model.body_pos[body], model.body_quat[body])
    yield f'{pad}<body name="{quote(model.body(body).name)}" {place}>'
    if model.body_mass[body] > 0:
        place = _place(model.body_ipos[body], model.body_iquat[body])
        moments = numbers(model.body_inertia[body])
        yield f'{pad}  <inertial {place} mass="{numbers(model.body_mass[body])}" diaginertia="{moments}"/>'
    for joint in range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body]):
        yield f"{pad}  <joint {_joint(model, joint)}/>"
    for geom in range(model.body_geomadr[body], model.body_geomadr[body] + model.body_geomnum[body]):
        shape, count = _SHAPES[int(model.geom_type[geom])]
        place = _place(model.geom_pos[geom], model.geom_quat[geom])
        yield f'{pad}  <geom type="{shape}" size="{numbers(model.geom_size[geom, :count])}" {place}/>'
    for child in _children(model, body):
        yield from _body(model, child, pad + "  ")
    yield f"{pad}</body>"


def _joint(model: mujoco.MjModel, joint: int) -> str:
    """Attributes of a joint."""
    kind, dof = _KINDS[int(model.jnt_type[joint])], int(model.jnt_dofadr[joint])
    values = {"name": quote(model.joint(joint).name), "type": kind}
    if kind in ("hinge", "slide"):
        values |= {"pos": numbers(model.jnt_pos[joint]), "axis": numbers(model.jnt_axis[joint])}
        if model.jnt_limited[joint]:
            values |= {"limited": "true", "range": numbers(model.jnt_range[joint])}
        if model.jnt_actfrclimited[joint]:
            values |= {
                "actuatorfrclimited": "true",
                "actuatorfrcrange": numbers(model.jnt_actfrcrange[joint]),
            }
        for name, numbers_of in (("damping", model.dof_damping), ("frictionloss", model.dof_frictionloss)):
            if numbers_of[dof]:
                values[name] = numbers(numbers_of[dof])
    return " ".join(f'{name}="{value}"' for name, value in values.items())
