r"""The serial arm in a user's MJCF.

MuJoCo's own compiler reads the file, so defaults, includes, units and inertia from geoms are as MuJoCo has
them. What the arm is: the hinges and slides met one after another on the way out from the world, or those
between two bodies that the user names (`model_file.Part`). Bodies without a joint, and the fingers of a gripper
(where the chain branches), are lumped into the link that carries them, at the reference pose of the file; what
the arm stands on is held there. Of several joints on one body all but the last have links without mass. A URDF
is read by MuJoCo too, and is MJCF from there on (`urdf_in`).

Link frame: the body's own where the joint turns about (or slides along) the body's +z through its origin,
as in files made from a modified Denavit-Hartenberg table; else the body's turned by the smallest angle that
brings z onto the axis, with its origin at the joint's position.
"""

# MuJoCo's names come from a compiled module without stubs.
import dataclasses
import difflib
import warnings
from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np
from jaxpanda_kernels import Chain
from jaxtyping import Float

from .. import inputs
from ..errors import InputError
from . import markup
from .engine_log import own_log
from .model_file import Model, Part, part_of
from .urdf_in import as_mjcf, moves

KNOWN = ("armature", "damping", "frictionloss", "stiffness", "springref")
"""Fields of an `Arm` that hold its physics beyond rigid links."""
FINGER_JOINTS = 4
"""Most joints one after another in a finger; longer branches are arms of their own."""
LEAST_JOINTS = 3
"""What is offered as an arm has so many, where there is such."""
_OFFERED = 4

_HINGE, _SLIDE = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)
_FREE = int(mujoco.mjtJoint.mjJNT_FREE)
_TIES = (int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD))
_ROW, _COLUMN = np.array([0, 0, 1, 0, 1, 2]), np.array([0, 1, 1, 2, 2, 2])  # of jaxpanda_kernels.inertia


@dataclasses.dataclass(frozen=True)
class MjcfLink:
    """Where a link of the arm stands in the file."""

    body: str
    joint: str
    body_id: int
    joint_id: int
    dof: int
    """Address of the joint in MuJoCo's qvel and, as all joints here have one coordinate, of its friction."""
    qpos: int
    R: Float[np.ndarray, "3 3"]
    """Axes of the link's frame in the body's."""
    p: Float[np.ndarray, "3"]
    """Origin of the link's frame in the body's [m]."""
    lumped: tuple[str, ...]
    """Bodies carried by this one and counted with it."""
    lumped_standard: Float[np.ndarray, "10"]
    """Their parameters together, in the link's frame."""


@dataclasses.dataclass(frozen=True)
class MjcfSource:
    """A user's file: its text, what MuJoCo made of it, and where the arm's links stand in it."""

    document: markup.Document
    model: mujoco.MjModel
    """Compiled without the meshes that only give looks or contacts."""
    dropped: frozenset[int]
    """Geoms, by their place in the text, whose mesh was left out."""
    links: tuple[MjcfLink, ...]
    standard: Float[np.ndarray, "dof 10"]
    """Parameters of the links, what is lumped into them included, in float64 whatever JAX is set to."""
    degrees: bool
    """Angles in the file are in degrees."""
    notes: tuple[str, ...]
    """What was lumped, locked or left aside, a sentence each."""

    @property
    def path(self) -> Path:
        return self.document.path

    @property
    def text(self) -> str:
        return self.document.text

    def qpos(self, q: Float[np.ndarray, "*time dof"]) -> Float[np.ndarray, "*time nq"]:
        """MuJoCo's positions for the arm's, everything else at its reference."""
        full = np.broadcast_to(self.model.qpos0, (*q.shape[:-1], self.model.nq)).copy()
        full[..., [link.qpos for link in self.links]] = q
        return full

    def qvel(self, qd: Float[np.ndarray, "*time dof"]) -> Float[np.ndarray, "*time nv"]:
        """MuJoCo's velocities (or accelerations) for the arm's, everything else at rest."""
        full = np.zeros((*qd.shape[:-1], self.model.nv))
        full[..., [link.dof for link in self.links]] = qd
        return full


def read(model: Model) -> markup.Document:
    """The text of a model, as MJCF, with what is meant of it.

    Raises:
        InputError: neither MJCF nor URDF, or a URDF that MuJoCo refuses.
    """
    document = markup.read(Path(model), "mujoco", "robot", part=part_of(model))
    return as_mjcf(document) if document.root.tag == "robot" else document


def with_gravity(document: markup.Document, gravity: Sequence[float] | None) -> markup.Document:
    """The file with this gravity, in the frame of its world [m/s²], or as it is where that is None."""
    if gravity is None:
        return document
    value = markup.numbers(gravity)
    options = [element for element in document.root.children if element.tag == "option"]
    said = [option for option in options if "gravity" in option.attributes] or options[:1]
    edits = [markup.Edit(option, {"gravity": value}) for option in said]
    if not said:
        edits = [markup.Edit(document.root, first_child=f'<option gravity="{value}"/>')]
    flags = [flag for option in options for flag in option.children if "gravity" in flag.attributes]
    return markup.edit(document, [*edits, *(markup.Edit(flag, {"gravity": None}) for flag in flags)])


def parts_of(
    document: markup.Document, dropped: frozenset[int] | None = None
) -> tuple[dict[str, Any], MjcfSource]:
    """The fields of the `Arm` in a text, which need not be on disk, and where its parts stand there.

    Args:
        document: the text.
        dropped: geoms whose mesh to leave out, as `MjcfSource` has them; else those without a say.
    """
    with warnings.catch_warnings(record=True) as said, own_log() as logged:
        warnings.simplefilter("always")
        spec = _parse(document)
        dropped = _drop_looks(spec, document, dropped)
        model = _compile(spec, document.path)
    notes = [*document.notes]
    notes += [f"MuJoCo warns: {what}" for what in dict.fromkeys([*(str(w.message) for w in said), *logged])]
    if dropped:
        notes.append(f"{len(dropped)} mesh geoms that give looks or contacts only were not read")
    joints, locked = _serial_joints(model, document.path, document.part)
    _check_joints(model, joints, document.path)
    notes += _notes(model, joints, locked)
    with np.errstate(invalid="ignore", over="ignore"):  # of numbers that `_check_finite` refuses
        links, chain, standard = _links(model, joints)
    fields = _fields(model, links, chain, standard, spec.modelname or document.path.stem)
    _check_finite(fields, document.path)
    source = MjcfSource(document, model, dropped, links, standard, bool(spec.compiler.degree), tuple(notes))
    return fields, source


@own_log()
def load_model(path: Model, *, balanceinertia: bool = False) -> mujoco.MjModel:
    """The compiled model of a file, without the meshes that only give looks or contacts.

    Args:
        path: of the MJCF.
        balanceinertia: let MuJoCo replace an impossible inertia by its mean, to see the rest of the model.

    Raises:
        InputError: no MJCF, or one that MuJoCo refuses.
    """
    document = read(path)
    spec = _parse(document)
    _drop_looks(spec, document)
    spec.compiler.balanceinertia |= balanceinertia
    return _compile(spec, document.path)


@own_log()
def load_spec(path: Model) -> mujoco.MjSpec:
    """A file as MuJoCo's parser has it, before compilation.

    Raises:
        InputError: no MJCF.
    """
    return _parse(read(path))


def with_shapes(document: markup.Document) -> mujoco.MjSpec:
    """A text as MuJoCo's parser has it, before compilation, with its meshes and height fields but no pictures.

    Raises:
        InputError: no MJCF, or a mesh that is no regular file.
    """
    spec = _parse(document)
    for skin in list(spec.skins):
        spec.delete(skin)
    _drop_pictures(spec)
    for asset in [*spec.meshes, *spec.hfields]:
        file = document.path.parent / spec.meshdir / asset.file
        if asset.file and file.exists():
            markup.require_inside(document.path, file, document.part, f"{document.path}: shows {asset.file}")
            inputs.require_regular(file)
    return spec


def _parse(document: markup.Document) -> mujoco.MjSpec:
    files = document.includes | _attached(document)
    try:
        spec = mujoco.MjSpec.from_string(document.text, include=files)
    except ValueError as error:
        raise InputError(f"{document.path}: {_sentence(error)}") from None
    spec.modelfiledir = str(document.path.parent)
    spec.compiler.fusestatic = False  # the bodies stay those of the text; the mechanics are the same
    _find_assets(spec, document)
    return spec


def _find_assets(spec: mujoco.MjSpec, document: markup.Document) -> None:
    """Name the files of shapes as MuJoCo does that reads the model from its folder.

    Beside the model, in the compiler's folder, or else beside the file that is included and names them; parsed
    from a string, MuJoCo looks from where it was called.
    """
    for tag, assets in (("mesh", spec.meshes), ("hfield", spec.hfields)):
        elements = [e for e in document.root.walk() if e.tag == tag and e.has_ancestor("asset")]
        if len(elements) != len(assets):  # some come with attached models
            continue
        for element, asset in zip(elements, assets, strict=True):
            name = element.attributes.get("file", "")
            places = document.path.parent / spec.meshdir / name, element.file.parent / name
            found = [place for place in places if name and place.is_file()]
            if found and element.source:
                asset.file = str(found[0].absolute())


def _attached(document: markup.Document) -> dict[str, bytes]:
    """Other models that the file attaches parts of."""
    names = [e.attributes.get("file", "") for e in document.root.walk() if e.tag == "model"]
    files = {name: document.path.parent / name for name in names if name}
    found = {}
    for name, file in files.items():
        if file.exists():
            what = f"{document.path}: attaches {name!r}"
            markup.require_inside(document.path, file, document.part, what)
            found[name] = inputs.read_bytes(file, markup.BYTES, f"{what}, which")
    return found


def _compile(spec: mujoco.MjSpec, path: Path) -> mujoco.MjModel:
    try:
        return spec.compile()
    except ValueError as error:
        raise InputError(f"{path}: {_sentence(error)}") from None


def _sentence(error: ValueError) -> str:
    """MuJoCo's message on one line."""
    head, *rest = [line.strip() for line in str(error).splitlines() if line.strip()]
    head = head.removeprefix("XML Error: ").removeprefix("Error: ")
    return f"MuJoCo refuses it: {head}" + (f" ({', '.join(rest)})" if rest else "")


def _drop_looks(
    spec: mujoco.MjSpec, document: markup.Document, dropped: frozenset[int] | None = None
) -> frozenset[int]:
    """Let no mesh, height field, skin or picture be read that has no say in the dynamics.

    A geom of such a mesh becomes a small sphere, so that whatever refers to it still can.
    Returns the places of those geoms; `dropped` fixes them beforehand.
    """
    sphere = mujoco.mjtGeom.mjGEOM_SPHERE
    if dropped is None:
        shaped = [(i, geom) for i, geom in enumerate(spec.geoms) if geom.meshname or geom.hfieldname]
        dropped = frozenset(i for i, geom in shaped if not _gives_inertia(spec, geom))
        for i, geom in shaped:
            if i not in dropped:
                _check_mesh(spec, geom, document)
    for geom in [geom for i, geom in enumerate(spec.geoms) if i in dropped]:
        geom.type, geom.meshname, geom.hfieldname = sphere, "", ""
        geom.size, geom.fromto = [0.01, 0, 0], np.full(6, np.nan)
    for site in spec.sites:
        if site.meshname:
            site.type, site.meshname, site.size = sphere, "", [0.01, 0, 0]
    kept = {geom.meshname for geom in spec.geoms}
    meshes = [mesh for mesh in spec.meshes if (mesh.name or Path(mesh.file).stem) not in kept]
    for unused in [*meshes, *spec.hfields, *spec.skins]:
        spec.delete(unused)
    _drop_pictures(spec)
    return dropped


def _drop_pictures(spec: mujoco.MjSpec) -> None:
    for texture in spec.textures:
        if texture.builtin == mujoco.mjtBuiltin.mjBUILTIN_NONE:
            texture.file, texture.builtin = "", mujoco.mjtBuiltin.mjBUILTIN_FLAT
            texture.width = texture.height = 2
            for i in range(len(texture.cubefiles)):
                texture.cubefiles[i] = ""


def _gives_inertia(spec: mujoco.MjSpec, geom) -> bool:
    """MuJoCo's rule: which geoms have a say in the inertia of their body."""
    always = spec.compiler.inertiafromgeom == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
    never = spec.compiler.inertiafromgeom == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_FALSE
    low, high = spec.compiler.inertiagrouprange
    weightless = geom.mass == 0 or (np.isnan(geom.mass) and geom.density == 0)
    explicit = geom.parent.explicitinertial and not always
    return moves(geom.parent) and not (explicit or never or weightless or not low <= geom.group <= high)


def _check_mesh(spec: mujoco.MjSpec, geom, document: markup.Document) -> None:
    named = [mesh.file for mesh in spec.meshes if (mesh.name or Path(mesh.file).stem) == geom.meshname]
    file = document.path.parent / spec.meshdir / (named[0] if named else "")
    if not file.exists():
        raise InputError(
            f"{document.path}: body {geom.parent.name!r} takes its inertia from mesh {geom.meshname!r},"
            f" and {file} is missing; put the mesh there or give the body an <inertial>"
        )
    what = (
        f"{document.path}: body {geom.parent.name!r} takes its inertia from mesh {geom.meshname!r} in {file}"
    )
    markup.require_inside(document.path, file, document.part, what)
    inputs.require_regular(file)


def _serial_joints(model: mujoco.MjModel, path: Path, part: Part) -> tuple[list[int], list[int]]:
    """Joints of the arm from the base outwards, and joints of a gripper behind it."""
    base = _body_called(model, part.root, "--root", path) if part.root else 0
    if part.tip:
        bodies = _way_to(model, base, _body_called(model, part.tip, "--tip", path), path, part)
    else:
        bodies = _way_out(model, base, path)
    joints = [joint for body in bodies for joint in _joints_of(model, body)]
    owner = _owners(model, joints)
    locked = [j for j in range(model.njnt) if j not in joints and owner[model.jnt_bodyid[j]] > 0]
    return joints, locked


def _body_called(model: mujoco.MjModel, name: str, option: str, path: Path) -> int:
    names = [model.body(body).name for body in range(model.nbody)]
    if name in names:
        return names.index(name)
    close = difflib.get_close_matches(name, names, 1)
    meant = f" (did you mean {close[0]!r}?)" if close else ""
    raise InputError(f"{path}: {option} {name}: has no body of that name{meant}{_offer(model)}")


def _way_to(model: mujoco.MjModel, base: int, tip: int, path: Path, part: Part) -> list[int]:
    """Moving bodies from the base to the tip."""
    way = [tip]
    while way[-1] not in (0, base):
        way.append(int(model.body_parentid[way[-1]]))
    if way[-1] != base or tip == base:
        raise InputError(f"{path}: --tip {part.tip} does not lie beyond --root {part.root}{_offer(model)}")
    bodies = [body for body in way[-2::-1] if model.body_jntnum[body]]
    if not bodies:
        raise InputError(f"{path}: no joint leads to --tip {part.tip}{_offer(model)}")
    _require_turns_or_slides(model, bodies, path)
    return bodies


def _way_out(model: mujoco.MjModel, base: int, path: Path) -> list[int]:
    """Moving bodies one after another from the base, as far as there is one way to go."""
    trees = _first_moving(model, base)
    if not trees:
        if base:
            raise InputError(f"{path}: nothing moves beyond --root {model.body(base).name}{_offer(model)}")
        raise InputError(f"{path}: has no joint, so there is no arm in it")
    arms = [root for root in trees if not _is_object(model, root)]
    if not arms:
        _require_turns_or_slides(model, trees, path)
    if len(arms) > 1:
        a, b = (_body_name(model, body) for body in arms[:2])
        raise InputError(
            f"{path}: {a} and {b} both start a mechanism on {'that body' if base else 'the world'}; one serial"
            f" arm is expected{_offer(model)}"
        )
    bodies = [arms[0]]
    while len(branches := _first_moving(model, bodies[-1])) == 1:
        bodies.append(branches[0])
    joints = sum(int(model.body_jntnum[body]) for body in bodies)
    if any(_depth(model, branch) > min(FINGER_JOINTS, joints - 1) for branch in branches):
        others = " and ".join(_body_name(model, b) for b in branches[:2])
        raise InputError(
            f"{path}: the arm branches at {_body_name(model, bodies[-1])} into {others}; one serial arm is"
            f" expected{_offer(model)}"
        )
    _require_turns_or_slides(model, bodies, path)
    return bodies


def _offer(model: mujoco.MjModel) -> str:
    """The options that choose an arm of this model, those of most joints first."""
    found = sorted(_arms(model), key=lambda one: -one[1])
    found = [one for one in found if one[1] >= LEAST_JOINTS] or found
    if not found:
        return ""
    said = ", ".join(
        f"{options} ({joints} joint{'s' * (joints > 1)})" for options, joints in found[:_OFFERED]
    )
    rest = f" or {len(found) - _OFFERED} more" if len(found) > _OFFERED else ""
    return f"; choose one by {said}{rest}"


def _arms(model: mujoco.MjModel) -> Iterator[tuple[str, int]]:
    """The options for each chain of hinges and slides that ends in fingers or in nothing, and its joints."""
    for tip in range(1, model.nbody):
        if not _turns_or_slides(model, tip):
            continue
        bodies, beyond = [tip], _first_moving(model, tip)
        if len(beyond) == 1:
            continue
        while True:
            parent = _moving_parent(model, bodies[-1])
            beside = [b for b in _first_moving(model, parent) if b != bodies[-1]] if parent else []
            ends = not parent or not _turns_or_slides(model, parent)
            if ends or beside:
                yield from _options(model, bodies, beyond)
            if ends or any(_depth(model, b) > FINGER_JOINTS for b in beside):
                break
            bodies.append(parent)


def _options(model: mujoco.MjModel, bodies: list[int], beyond: list[int]) -> Iterator[tuple[str, int]]:
    """The options that choose these bodies, the last of the arm first, where they can be an arm."""
    joints = sum(int(model.body_jntnum[body]) for body in bodies)
    if any(_depth(model, branch) > min(FINGER_JOINTS, joints - 1) for branch in beyond):
        return
    base = int(model.body_parentid[bodies[-1]])
    root, tip = model.body(base).name, model.body(bodies[0]).name
    alone = all(_first_moving(model, body) == [other] for body, other in pairwise([base, *bodies[::-1]]))
    if base and root and alone:
        yield f"--root {root}", joints
    elif root and tip:
        yield (f"--root {root} " if base else "") + f"--tip {tip}", joints


def _require_turns_or_slides(model: mujoco.MjModel, bodies: list[int], path: Path) -> None:
    for body in bodies:
        if not _turns_or_slides(model, body):
            name = _joint_name(model, int(model.body_jntadr[body]))
            raise InputError(
                f"{path}: {name} is a free or ball joint; an arm needs a fixed base, hinges and"
                f" slides{_offer(model)}"
            )


def _turns_or_slides(model: mujoco.MjModel, body: int) -> bool:
    """Whether the body has joints, all hinges or slides."""
    joints = _joints_of(model, body)
    return bool(joints) and all(model.jnt_type[joint] in (_HINGE, _SLIDE) for joint in joints)


def _is_object(model: mujoco.MjModel, root: int) -> bool:
    """A thing that floats freely in the scene, and is not the base of an arm."""
    free = model.jnt_type[model.body_jntadr[root]] == _FREE
    return bool(free) and not _first_moving(model, root)


def _moving_parent(model: mujoco.MjModel, body: int) -> int:
    body = int(model.body_parentid[body])
    while body and not model.body_jntnum[body]:
        body = int(model.body_parentid[body])
    return body


def _first_moving(model: mujoco.MjModel, base: int) -> list[int]:
    """The bodies with joints that come first on the ways out from a body."""
    found, still = [], {base}
    for body in range(base + 1, model.nbody):  # MuJoCo numbers parents before children
        if model.body_parentid[body] in still:
            if model.body_jntnum[body]:
                found.append(body)
            else:
                still.add(body)
    return found


def _depth(model: mujoco.MjModel, body: int) -> int:
    deeper = [_depth(model, child) for child in _first_moving(model, body)]
    return int(model.body_jntnum[body]) + max(deeper, default=0)


def _joints_of(model: mujoco.MjModel, body: int) -> list[int]:
    return list(range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body]))


def _check_joints(model: mujoco.MjModel, joints: list[int], path: Path) -> None:
    """Refuse what a chain of linear joints cannot represent."""
    dofs = model.jnt_dofadr[joints]
    for joint, dof in zip(joints, dofs, strict=True):
        name = _joint_name(model, joint)
        if np.any(model.dof_dampingpoly[dof]) or np.any(model.jnt_stiffnesspoly[joint]):
            raise InputError(
                f"{path}: {name} has polynomial damping or stiffness; only the linear term is understood"
            )
        if model.jnt_plasticadr[joint] >= 0:
            raise InputError(
                f"{path}: {name} has a spring that yields (springyield); only linear springs are understood"
            )
    _check_actuators(model, joints, path)
    _check_tendons(model, joints, path)
    _check_loops(model, joints, path)


def _check_finite(fields: dict[str, Any], path: Path) -> None:
    """MuJoCo takes `nan` for a number."""
    chain, links = fields["chain"], fields["link_names"]
    place = jnp.concatenate([chain.R.reshape(-1, 9), chain.p], 1)
    parts = {"place": place, "inertia": fields["standard"]} | {name: fields[name] for name in KNOWN}
    for what, values in parts.items():
        bad = np.flatnonzero(~np.isfinite(np.asarray(values)).reshape(len(links), -1).all(1))
        if len(bad):
            body, joint = links[bad[0]], fields["joint_names"][bad[0]]
            raise InputError(f"{path}: body {body!r} with joint {joint!r}: the {what} is no finite number")
    if not np.isfinite(np.asarray(chain.gravity)).all():
        raise InputError(f"{path}: gravity is no finite number")


def _check_actuators(model: mujoco.MjModel, joints: list[int], path: Path) -> None:
    """An actuator may push; what it adds to inertia and damping must stand at the joint."""
    for actuator in range(model.nactuator):
        loads = (
            model.actuator_armature[actuator],
            model.actuator_damping[actuator],
            *np.ravel(model.actuator_dampingpoly[actuator]),
        )
        target, kind = int(model.actuator_trnid[actuator, 0]), model.actuator_trntype[actuator]
        if kind == mujoco.mjtTrn.mjTRN_TENDON:
            elsewhere = not _spans(model, target, joints)
        else:
            elsewhere = kind == mujoco.mjtTrn.mjTRN_JOINT and target not in joints
        if np.any(loads) and not elsewhere:
            name = model.actuator(actuator).name or f"number {actuator + 1}"
            raise InputError(
                f"{path}: actuator {name!r} has armature or damping of its own, which MJX ignores;"
                " give it to the joint"
            )


def _check_tendons(model: mujoco.MjModel, joints: list[int], path: Path) -> None:
    """A tendon over the arm's joints may drive them, not load them."""
    for tendon in range(model.ntendon):
        loads = (
            model.tendon_stiffness[tendon],
            model.tendon_damping[tendon],
            model.tendon_frictionloss[tendon],
            model.tendon_armature[tendon],
            *np.ravel(model.tendon_stiffnesspoly[tendon]),
            *np.ravel(model.tendon_dampingpoly[tendon]),
        )
        if np.any(loads) and _spans(model, tendon, joints):
            name = model.tendon(tendon).name or f"number {tendon + 1}"
            raise InputError(
                f"{path}: tendon {name!r} puts stiffness, damping, friction or armature across joints"
                " of the arm; give them to the joints"
            )


def _spans(model: mujoco.MjModel, tendon: int, joints: list[int]) -> bool:
    """Whether the tendon's length depends on one of the joints."""
    start, count = model.ten_J_rowadr[tendon], model.ten_J_rownnz[tendon]
    return bool(set(model.ten_J_colind[start : start + count]) & set(model.jnt_dofadr[joints]))


def _check_loops(model: mujoco.MjModel, joints: list[int], path: Path) -> None:
    """An equality constraint may tie fingers to each other or things to the world, not links of the arm."""
    bodies = set(model.jnt_bodyid[joints].tolist())
    owner = _owners(model, joints)
    for eq in range(model.neq):
        kind, a, b = int(model.eq_type[eq]), int(model.eq_obj1id[eq]), int(model.eq_obj2id[eq])
        name = model.equality(eq).name or f"number {eq + 1}"
        if kind == mujoco.mjtEq.mjEQ_JOINT:
            closes = a in joints or b in joints
        elif kind in _TIES:
            if model.eq_objtype[eq] == mujoco.mjtObj.mjOBJ_SITE:
                a, b = int(model.site_bodyid[a]), int(model.site_bodyid[b])
            # Fingers belong to the last link, so a loop within the gripper has one owner on both sides.
            closes = owner[a] != owner[b] and bool({owner[a], owner[b]} & bodies)
        else:
            closes = False
        held = kind in _TIES and max(model.body_mocapid[a], model.body_mocapid[b]) >= 0  # by the user's hand
        if closes and model.eq_active0[eq] and not held:
            raise InputError(f"{path}: equality {name!r} closes a loop over the arm; a serial arm has none")


def _owners(model: mujoco.MjModel, joints: list[int]) -> np.ndarray:
    """For every body the body of the arm that carries it; 0 for the world, -1 for things that are loose."""
    bodies = set(model.jnt_bodyid[joints].tolist())
    owner = np.zeros(model.nbody, int)
    for body in range(1, model.nbody):
        carried = owner[model.body_parentid[body]]
        if body in bodies:
            owner[body] = body
        elif carried == 0 and model.body_jntnum[body]:
            owner[body] = -1
        else:
            owner[body] = carried
    return owner


def _notes(model: mujoco.MjModel, joints: list[int], locked: list[int]) -> list[str]:
    notes = []
    if locked:
        names = ", ".join(model.joint(j).name or f"number {j + 1}" for j in locked)
        notes.append(
            f"joints {names} are locked at their reference and lumped into the link that carries them"
        )
    owner = _owners(model, joints)
    base = _bodies_below(model, int(model.jnt_bodyid[joints[0]]))
    held = [j for body in base for j in _joints_of(model, body)]
    if held:
        names = ", ".join(model.joint(j).name or f"number {j + 1}" for j in held)
        notes.append(f"joints {names}, on which the arm stands, are held at their reference")
    if loose := int(np.sum(owner < 0)) - sum(owner[body] < 0 for body in base):
        notes.append(f"{loose} loose bodies of the scene are no part of the arm")
    if np.any(model.body_mocapid >= 0) and np.any(np.isin(model.eq_type, _TIES)):
        notes.append("what ties the arm to a mocap body is ignored: it is a hand of the simulation")
    if np.any(model.body_gravcomp[owner > 0]):
        notes.append(
            "gravcomp is ignored: it is a force of the simulation; a measured torque carries the weight"
        )
    if model.opt.density or model.opt.viscosity:
        notes.append("the drag of the medium (density, viscosity) is ignored")
    return notes


def _bodies_below(model: mujoco.MjModel, body: int) -> list[int]:
    """What carries a body, from its parent to the world."""
    found = []
    while body := int(model.body_parentid[body]):
        found.append(body)
    return found


def _links(
    model: mujoco.MjModel, joints: list[int]
) -> tuple[tuple[MjcfLink, ...], Chain, Float[np.ndarray, "dof 10"]]:
    """The links, their chain and their parameters."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)  # at the reference pose of the file
    pose = [(data.xmat[b].reshape(3, 3), data.xpos[b]) for b in range(model.nbody)]
    owner = _owners(model, joints)
    gravity = np.zeros(3) if _disabled(model, "GRAVITY") else model.opt.gravity.copy()

    links, standard, rotations, origins = [], [], [], []
    R_wp, p_wp = np.eye(3), np.zeros(3)
    for joint in joints:
        body, joint_name = int(model.jnt_bodyid[joint]), model.joint(joint).name or f"joint{joint + 1}"
        R_bl, p_bl = _link_frame(model, joint)
        R_wb, p_wb = pose[body]
        R_wl, p_wl = R_wb @ R_bl, p_wb + R_wb @ p_bl
        R, p = R_wp.T @ R_wl, R_wp.T @ (p_wl - p_wp)
        q0 = float(model.qpos0[model.jnt_qposadr[joint]])
        slides = model.jnt_type[joint] == _SLIDE
        rotations.append(R if slides else R @ _turn_z(-q0))
        origins.append(p - q0 * R[:, 2] if slides else p)

        last = joint == _joints_of(model, body)[-1]  # the links of a body's other joints have no mass
        phi = {
            b: _body_standard(model, b, pose[b], (R_wl, p_wl))
            for b in np.flatnonzero((owner == body) & last).tolist()
        }
        own = phi.pop(body, np.zeros(10))
        lumped = np.sum(list(phi.values()), 0) if phi else np.zeros(10)
        standard.append(own + lumped)
        links.append(
            MjcfLink(
                body=(model.body(body).name or f"body{body}") + ("" if last else f"/{joint_name}"),
                joint=joint_name,
                body_id=body,
                joint_id=joint,
                dof=int(model.jnt_dofadr[joint]),
                qpos=int(model.jnt_qposadr[joint]),
                R=R_bl,
                p=p_bl,
                lumped=tuple(model.body(b).name or f"body{b}" for b in phi),
                lumped_standard=lumped,
            )
        )
        R_wp, p_wp = R_wl, p_wl
    chain = Chain(
        jnp.asarray(np.stack(rotations)),
        jnp.asarray(np.stack(origins)),
        jnp.asarray(model.jnt_type[joints] == _SLIDE),
        jnp.asarray(gravity),
    )
    return tuple(links), chain, np.stack(standard)


def _link_frame(model: mujoco.MjModel, joint: int) -> tuple[np.ndarray, np.ndarray]:
    """Pose of the link's frame in the body's."""
    axis, position = model.jnt_axis[joint], model.jnt_pos[joint]
    slides = model.jnt_type[joint] == _SLIDE
    upright = np.array_equal(axis, [0, 0, 1])
    through_origin = upright and not np.any(np.cross(axis, position))
    R = np.eye(3) if upright else smallest_turn(axis)
    return R, np.zeros(3) if slides or through_origin else position.copy()


def smallest_turn(axis: np.ndarray) -> np.ndarray:
    """Rotation by the smallest angle that takes z to `axis`; about x where they are opposite."""
    x, y, c = axis / np.linalg.norm(axis)
    s = np.hypot(x, y)
    if s == 0:
        return np.diag([1.0, c, c])
    n = np.array([-y, x, 0]) / s
    n_cross = np.array([[0, 0, n[1]], [0, 0, -n[0]], [-n[1], n[0], 0]])
    return c * np.eye(3) + s * n_cross + (1 - c) * np.outer(n, n)


def _turn_z(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def _body_standard(model, body, pose, frame) -> np.ndarray:
    """Parameters of one body in a frame, both posed in the world."""
    (R_wb, p_wb), (R_wl, p_wl) = pose, frame
    R_bi = np.zeros(9)
    mujoco.mju_quat2Mat(R_bi, model.body_iquat[body])
    R_li = R_wl.T @ R_wb @ R_bi.reshape(3, 3)
    com = R_wl.T @ (p_wb + R_wb @ model.body_ipos[body] - p_wl)
    return standard_from_com(model.body_mass[body], com, R_li @ np.diag(model.body_inertia[body]) @ R_li.T)


def standard_from_com(mass: float, com: np.ndarray, I_com: np.ndarray) -> Float[np.ndarray, "10"]:
    """`jaxpanda_kernels.inertia.from_com` in float64, whatever JAX is set to."""
    I = I_com + mass * (com @ com * np.eye(3) - np.outer(com, com))
    return np.concatenate([[mass], mass * com, I[_ROW, _COLUMN]])


def com_from_standard(phi: Float[np.ndarray, "10"]) -> tuple[float, np.ndarray, np.ndarray]:
    """`jaxpanda_kernels.inertia.to_com` in float64, whatever JAX is set to."""
    mass, com = float(phi[0]), phi[1:4] / phi[0]
    I = np.zeros((3, 3))
    I[_ROW, _COLUMN] = I[_COLUMN, _ROW] = phi[4:]
    return mass, com, I - mass * (com @ com * np.eye(3) - np.outer(com, com))


def move_standard(
    phi: Float[np.ndarray, "10"], R_ab: np.ndarray, p_ab: np.ndarray
) -> Float[np.ndarray, "10"]:
    """`jaxpanda_kernels.inertia.move` in float64, whatever JAX is set to."""
    I, h = np.zeros((3, 3)), phi[1:4]
    I[_ROW, _COLUMN] = I[_COLUMN, _ROW] = phi[4:]
    J = np.block([[np.trace(I) / 2 * np.eye(3) - I, h[:, None]], [h[None, :], phi[:1, None]]])
    X = np.block([[R_ab, p_ab[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]])
    J = X @ J @ X.T
    I = np.trace(J[:3, :3]) * np.eye(3) - J[:3, :3]
    return np.concatenate([J[3:, 3], J[:3, 3], I[_ROW, _COLUMN]])


def _fields(model, links, chain: Chain, standard: np.ndarray, name: str) -> dict[str, Any]:
    joints = [link.joint_id for link in links]
    dofs = [link.dof for link in links]
    limited = model.jnt_limited[joints].astype(bool)
    lumped = np.stack([link.lumped_standard for link in links])

    rate, slack = friction_law(model, dofs)

    def unless(flag: str, values: np.ndarray):
        return jnp.asarray(np.zeros(len(links)) if _disabled(model, flag) else values)

    return dict(
        chain=chain,
        standard=jnp.asarray(standard),
        armature=jnp.asarray(model.dof_armature[dofs]),
        damping=unless("DAMPER", model.dof_damping[dofs]),
        frictionloss=unless("FRICTIONLOSS", model.dof_frictionloss[dofs]),
        stiffness=unless("SPRING", model.jnt_stiffness[joints]),
        springref=jnp.asarray(model.qpos_spring[[link.qpos for link in links]]),
        lower=jnp.asarray(np.where(limited, model.jnt_range[joints, 0], -np.inf)),
        upper=jnp.asarray(np.where(limited, model.jnt_range[joints, 1], np.inf)),
        joint_names=tuple(link.joint for link in links),
        link_names=tuple(link.body for link in links),
        name=name,
        lumped=jnp.asarray(lumped) if np.any(lumped) else None,
        friction_rate=jnp.asarray(rate),
        friction_slack=jnp.asarray(slack),
    )


SOLREF, SOLIMP = (0.02, 1.0), (0.9, 0.95, 0.001, 0.5, 2.0)
"""MuJoCo's defaults for the constraint that frictionloss is: time constant [s] and damping ratio; impedances,
width [rad], midpoint and power of what is between them."""
_IMPEDANCES = 1e-4, 0.9999
"""What MuJoCo takes for an impedance, at least and at most."""


def friction_law(
    model: mujoco.MjModel, dofs: Sequence[int]
) -> tuple[Float[np.ndarray, " dof"], Float[np.ndarray, " dof"]]:
    r"""b [1/s] and R [1/(kg m²)] of the soft constraint that MuJoCo makes of `frictionloss`.

    $f = \mathrm{clip}((\ddot q + b\,\dot q)/R, \pm F_c)$ with $R = \frac{1 - d_0}{d_0}\,(M^{-1})_{jj}$ at the
    reference pose, and of `solreffriction` either a time constant, $b = 2/(d_{max} T)$ with T of two time
    steps at least where `refsafe` is on, or, where both of its numbers are negative, a damping: $b =
    -c/d_{max}$. What pulls back to a position has no say, as this constraint has none; so $d_0$ counts and
    never the way to $d_{max}$, except where there is no such way: then their mean (MuJoCo, Computation,
    "Solver parameters").
    """
    solref, solimp = model.dof_solref[dofs].copy(), model.dof_solimp[dofs]
    mixed = (solref[:, 0] > 0) != (solref[:, 1] > 0)
    solref[mixed] = SOLREF  # MuJoCo warns and does so
    least = 0.0 if _disabled(model, "REFSAFE") else 2 * model.opt.timestep
    first, most = np.clip(solimp[:, :2], *_IMPEDANCES).T
    impedance = np.where(solimp[:, 2] <= mujoco.mjMINVAL, (first + most) / 2, first)
    time = np.maximum(solref[:, 0], least)
    b = np.where(solref[:, 1] > 0, 2 / np.maximum(most * time, mujoco.mjMINVAL), -solref[:, 1] / most)
    R = (1 - impedance) / impedance * model.dof_invweight0[dofs]
    return b, np.maximum(R, mujoco.mjMINVAL)


def has_own_friction_law(model: mujoco.MjModel, dof: int) -> bool:
    """Whether the file says how the friction of a joint turns: it has some, and not with MuJoCo's defaults."""
    same = np.array_equal(model.dof_solref[dof], SOLREF) and np.array_equal(model.dof_solimp[dof], SOLIMP)
    return bool(model.dof_frictionloss[dof] > 0) and not same


def _disabled(model: mujoco.MjModel, flag: str) -> bool:
    return bool(model.opt.disableflags & getattr(mujoco.mjtDisableBit, f"mjDSBL_{flag}"))


def _body_name(model: mujoco.MjModel, body: int) -> str:
    return f"body {model.body(body).name!r}" if model.body(body).name else f"body number {body}"


def _joint_name(model: mujoco.MjModel, joint: int) -> str:
    return f"joint {model.joint(joint).name!r}" if model.joint(joint).name else f"joint number {joint + 1}"
