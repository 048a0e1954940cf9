r"""Writing what was found into a model that MuJoCo reads.

A user's file keeps every byte but the attributes that change. What MuJoCo's joints hold of a friction law:

| law | MJCF |
|---|---|
| $F_v \dot q$ | `damping` |
| $F_c\,\mathrm{sign}(\dot q)$ | `frictionloss`, with stiff `solreffriction`, `solimpfriction` or the file's |
| $F_o$ | nothing: a constant torque has no home on a joint |
| sigmoid (eq. 25 of Gaz et al. 2019) | its level at speed, as `frictionloss` |

What has no home goes into a sidecar, `<name>.jaxpanda.json`, and is said in the warnings.

`frictionloss` is a soft constraint: the joint creeps under a torque that should not move it, and its torque
lags at reversals. With MuJoCo's defaults that is most visible at light joints; a time constant of two steps
and an impedance near one make it the law that is meant.
"""

# MuJoCo's names come from a compiled module without stubs.
import dataclasses
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import mujoco
import numpy as np
from jaxtyping import Array, Float

from ..errors import InputError
from ..files import Kind, output_folder, write_json, write_text
from ..friction import Friction
from ..inputs import read_json
from . import markup
from .arm import Arm
from .lint import ignored_by_mjx
from .markup import numbers
from .mjcf import (
    MjcfLink,
    MjcfSource,
    com_from_standard,
    has_own_friction_law,
    move_standard,
    standard_from_com,
)
from .panda import published
from .source import from_document

SIDECAR = "jaxpanda.sidecar/1"
TORQUE_LIMITS = (87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0)
"""Of the Panda's joints [N m]: Franka Emika, Franka Control Interface documentation."""

_IMPEDANCE = (0.999, 0.999, 0.001)
_EDGE = 1e-12
"""Least share of the trace that a principal second moment is written with: MuJoCo's check is exact, and its
way from `fullinertia` to principal moments rounds at 1e-14."""
_ROUNDING = 1e-9
"""Share of the trace by which a second moment may be negative and still count as zero."""
_SAME = 1e-12
"""Relative agreement demanded of what MuJoCo compiles with what was meant."""
_ORIENTATIONS = ("quat", "axisangle", "xyaxes", "zaxis", "euler", "diaginertia")


@dataclasses.dataclass(frozen=True)
class Change:
    """One attribute that an export set, added (`old` is None) or took away (`new` is None)."""

    file: str
    line: int
    element: str
    attribute: str
    old: str | None
    new: str | None


@dataclasses.dataclass(frozen=True)
class ExportResult:
    """A file with parameters written into it, and what could not be."""

    text: str
    changes: tuple[Change, ...]
    warnings: tuple[str, ...]
    sidecar: Mapping[str, Any]
    """What MJCF cannot hold, as JSON."""
    document: markup.Document
    """The text with what it includes."""

    def save(self, path: str | Path) -> tuple[str, ...]:
        """Write the file, what it includes, and `<name>.jaxpanda.json` beside it; more warnings come back.

        Raises:
            InputError: a file of such a name stands there and is not of an earlier export; nothing is written.
        """
        path, beside = Path(path), sidecar_of(Path(path))
        with output_folder(path.parent, Kind("export", (beside.name, path.name))) as folder:
            write_document(self.document, folder / path.name)
            write_json(folder / beside.name, self.sidecar)
        return missing_assets(self.document, path.parent)


def sidecar_of(model: Path) -> Path:
    """Where an export puts what its MJCF cannot hold."""
    return model.with_name(f"{model.stem}.jaxpanda.json")


def write_document(document: markup.Document, path: Path) -> None:
    """Write a file and what it includes; what it includes from elsewhere comes beside it."""
    for name, text in markup.gathered(document).texts.items():
        write_text(path.parent / name if name else path, text)


def edit_mjcf(
    document: markup.Document, changes: Mapping[tuple[str, str], Mapping[str, str | None]]
) -> markup.Document:
    """The file with attributes changed, every other byte as it was.

    Args:
        document: the file.
        changes: attributes by (tag, name) of their element; None takes an attribute away. An `inertial` goes
            by the name of its body, an element without a name by ''.

    Raises:
        InputError: no such element in the file itself, or more than one.
    """
    edits = [markup.Edit(_find(document, tag, name), values) for (tag, name), values in changes.items()]
    return markup.edit(document, edits)


def _find(document: markup.Document, tag: str, name: str) -> markup.Element:
    found = [
        element
        for element in document.root.walk()
        if element.tag == tag and not element.has_ancestor("default") and _name(element) == name
    ]
    what = f"<{tag}>" + (f" named {name!r}" if name else "")
    if len(found) != 1:
        raise InputError(f"{document.path}: holds {len(found) or 'no'} {what}, where one is expected")
    if found[0].source:
        raise InputError(f"{document.path}: {what} stands in the included {found[0].file}; change that file")
    return found[0]


def _name(element: markup.Element) -> str:
    owner = element.parent if element.tag == "inertial" and element.parent else element
    return owner.attributes.get("name", "")


def write_parameters(
    source: MjcfSource,
    arm: Arm,
    standard: Float[Array, "dof 10"] | Float[np.ndarray, "dof 10"] | None = None,
    friction: Friction | None = None,
) -> ExportResult:
    r"""The user's file as the model $Y\phi$ + `arm.known_torque` + `friction`, and no other byte touched.

    The parameters of a link go into the `inertial` of its own body, less what the bodies lumped into it carry
    already: those keep theirs. Joints get the armature, springs and friction of `arm`, plus `friction`, which
    is what was found beyond them. A value that the file holds already stays as it is written.

    Args:
        source: where the arm's parts stand in the file.
        arm: the arm that `standard` and `friction` were found for; the same geometry as the file's.
        standard: parameters of its links; None leaves the bodies alone.
        friction: found beyond what `arm` holds; None adds nothing.

    Raises:
        InputError: the file cannot hold them, or does not compile to them.
    """
    before, _ = from_document(source.document)
    _check_geometry(source, before, arm)
    warnings: list[str] = []
    bodies = _body_elements(source)
    edits: list[markup.Edit] = []
    meant = source.standard.copy()
    if standard is not None:
        counting = _inertials_that_count(source)
        for i, link in enumerate(source.links):
            target = np.asarray(standard[i], float)
            if not _agree(target, meant[i], np.asarray(standard)):
                if not np.any(meant[i]):
                    raise InputError(
                        f"{source.path}: link {link.body!r} stands between two joints of one body, without mass,"
                        " the parameters give it some; identify with this file as --model"
                    )
                meant[i], edit = _inertial_edit(source, link, bodies[i], target, warnings)
                edits.append(edit)
        edits += counting if edits else []
    joints = _joint_values(arm, friction)
    edits += _joint_edits(source, bodies, before, joints)
    edited = markup.edit(source.document, edits)
    _verify(source, edited, meant, joints)
    return ExportResult(
        text=edited.text,
        changes=tuple(change for edit in edits for change in _changes(edit)),
        warnings=(*warnings, *not_held(arm, friction), *ignored_by_mjx(source.model)),
        sidecar=sidecar(arm, friction),
        document=edited,
    )


def _check_geometry(source: MjcfSource, before: Arm, arm: Arm) -> None:
    """The parameters speak of the frames of `arm`: the file's must be the same."""
    if before.dof != arm.dof:
        raise InputError(f"{source.path}: has {before.dof} arm joints, the parameters are for {arm.dof}")
    same = np.array_equal(before.chain.prismatic, arm.chain.prismatic)
    for a, b in ((before.chain.R, arm.chain.R), (before.chain.p, arm.chain.p)):
        same = same and np.allclose(a[1:], b[1:], atol=1e-5)
    if not same:
        raise InputError(
            f"{source.path}: its joint axes stand elsewhere than those of {arm.name!r}, which the"
            " parameters are for; identify with this file as --model"
        )


def _inertials_that_count(source: MjcfSource) -> list[markup.Edit]:
    """Refuse compiler settings under which MuJoCo does not take an `inertial` as written. The edits are for a
    file without any, which needs no `inertiafromgeom`: bodies without one have the inertia of their geoms."""
    elements = list(source.document.root.walk())
    edits = []
    for element in (e for e in elements if e.tag == "compiler"):
        for name, harmless in (("inertiafromgeom", ("auto", "false")), ("settotalmass", ("-1",))):
            value = element.attributes.get(name)
            if value is None or value in harmless:
                continue
            if name == "settotalmass" or any(e.tag == "inertial" for e in elements):
                raise InputError(
                    f"{element.file}: line {element.line}: compiler {name}={value!r} overrides"
                    " every <inertial>; take it out first"
                )
            edits.append(markup.Edit(element, {name: "auto"}))
    return edits


def _body_elements(source: MjcfSource) -> list[markup.Element]:
    """The `body` element of each link of the arm.

    MuJoCo numbers bodies in the order of the text, so unnamed ones can be found where no body is generated.
    """
    elements = [e for e in source.document.root.walk() if e.tag == "body" and e.has_ancestor("worldbody")]
    names = [source.model.body(b).name for b in range(1, source.model.nbody)]
    in_order = [e.attributes.get("name", "") for e in elements] == names
    by_name = {e.attributes.get("name"): e for e in elements}
    found = []
    for link in source.links:
        element = (
            elements[link.body_id - 1] if in_order else by_name.get(source.model.body(link.body_id).name)
        )
        if element is None:
            raise InputError(
                f"{source.path}: body {link.body!r} is not written in this file (attached or replicated);"
                " export the file that holds it"
            )
        found.append(element)
    return found


def _agree(a: np.ndarray, b: np.ndarray, like: np.ndarray) -> bool:
    """Whether two sets of parameters of a body are the same to rounding in the dtype of `like`."""
    if b[0] == 0:  # the link of a body's first joint, where that has several
        return not np.any(a)
    precision = _precision(like)
    length = np.sqrt(np.abs(b[4:]).max() / b[0])
    scale = b[0] * np.concatenate([[1.0], np.full(3, length), np.full(6, length**2)])
    return bool(np.all(np.abs(a - b) <= precision * scale))


def _precision(like: np.ndarray) -> float:
    return max(_SAME, 8 * float(np.finfo(like.dtype).eps))


def _inertial_edit(
    source: MjcfSource, link: MjcfLink, body: markup.Element, target: np.ndarray, warnings: list[str]
) -> tuple[np.ndarray, markup.Edit]:
    """What the link comes to, and the edit of its own body's `inertial` that brings it there."""
    own = move_standard(target - link.lumped_standard, link.R, link.p)
    lumped = f", once {', '.join(link.lumped)} on it are taken off" if np.any(link.lumped_standard) else ""
    mass, com, I_com = _buildable(f"{source.path}: body {link.body!r}", own, lumped, warnings)
    back = standard_from_com(mass, link.R.T @ (com - link.p), link.R.T @ I_com @ link.R)
    values = {"pos": numbers(com), "mass": numbers(mass), "fullinertia": numbers(_full(I_com))}
    inertial = [child for child in body.children if child.tag == "inertial"]
    if not inertial:
        text = " ".join(f'{name}="{value}"' for name, value in values.items())
        return back + link.lumped_standard, markup.Edit(body, first_child=f"<inertial {text}/>")
    gone = dict.fromkeys(set(_ORIENTATIONS) & set(inertial[0].attributes))
    return back + link.lumped_standard, markup.Edit(inertial[0], {**values, **gone})


def _buildable(
    where: str, phi: np.ndarray, lumped: str, warnings: list[str]
) -> tuple[float, np.ndarray, np.ndarray]:
    """Mass, centre of mass and inertia that pass MuJoCo's exact check, or a refusal."""
    remedy = "; identify with this file as --model" if lumped else "; retrieve feasible parameters first"
    if not np.all(np.isfinite(phi)) or phi[0] <= 0:
        raise InputError(f"{where} would weigh {phi[0]:.4g} kg{lumped}{remedy}")
    mass, com, I_com = com_from_standard(phi)
    moments, axes = np.linalg.eigh(np.trace(I_com) / 2 * np.eye(3) - I_com)
    total = moments.sum()
    if total <= 0 or moments[0] < -_ROUNDING * total:
        raise InputError(
            f"{where} would have a principal moment of inertia that exceeds the sum of the other two by"
            f" {-2 * moments[0]:.3g} kg m²{lumped}{remedy}"
        )
    if moments[0] >= _EDGE * total:
        return mass, com, I_com
    warnings.append(
        f"{where}: its inertia lies on the triangle inequality and was moved inside by"
        f" {(_EDGE * total - moments[0]) / total:.1e} of its size, as MuJoCo's check allows no rounding"
    )
    moments = np.maximum(moments, _EDGE * total)
    return mass, com, moments.sum() * np.eye(3) - (axes * moments) @ axes.T


def not_held(arm: Arm, friction: Friction | None) -> tuple[str, ...]:
    """What MuJoCo's joints cannot hold of the arm's friction, a sentence each."""
    if friction is None or friction.model == "none":
        return ()
    sentences = []
    for name, values in _laws(arm, friction).items():
        for joint in np.flatnonzero(values < 0):
            sentences.append(
                f"{name} of {arm.joint_names[joint]} came out as {values[joint]:.4g}, which would feed energy"
                " into the joint; 0 was written, the number is in the sidecar"
            )
    if friction.model == "sigmoid":
        sentences.append("MuJoCo has no sigmoid friction: its level at speed was written as frictionloss")
    if np.any(friction.offset):
        sentences.append("MuJoCo's joints hold no constant torque: friction offsets are in the sidecar only")
    return tuple(sentences)


def _joint_values(arm: Arm, friction: Friction | None) -> dict[str, np.ndarray]:
    """MJCF's joint attributes, in SI units, for the arm's own physics and the friction beyond it."""
    laws = _laws(arm, friction)
    if friction is not None:
        laws = {name: np.maximum(values, 0) for name, values in laws.items()}
    own = {name: np.asarray(getattr(arm, name)) for name in ("armature", "stiffness", "springref")}
    return own | laws


def _laws(arm: Arm, friction: Friction | None) -> dict[str, np.ndarray]:
    """Viscous and Coulomb friction of the arm and beyond it together, as it came out."""
    viscous, coulomb = _beyond(arm.dof, friction)
    return {
        "damping": np.asarray(arm.damping) + viscous,
        "frictionloss": np.asarray(arm.frictionloss) + coulomb,
    }


def _beyond(dof: int, friction: Friction | None) -> tuple[np.ndarray, np.ndarray]:
    """Viscous and Coulomb part of a friction law, as far as MuJoCo has them."""
    if friction is None or friction.model == "none":
        return np.zeros(dof), np.zeros(dof)
    if friction.model == "sigmoid":  # from -phi1/2 to phi1/2 about its offset
        return np.zeros(dof), np.asarray(friction.parameters["phi1"]) / 2
    return friction.viscous, friction.coulomb


def _joint_edits(
    source: MjcfSource, bodies: Sequence[markup.Element], before: Arm, joints: Mapping[str, np.ndarray]
) -> list[markup.Edit]:
    edits = []
    for i, body in enumerate(bodies):
        values = {}
        for name, value in joints.items():
            unused = name == "springref" and joints["stiffness"][i] == 0
            if value[i] == np.asarray(getattr(before, name))[i] or unused:
                continue
            degrees = name == "springref" and source.degrees and not before.chain.prismatic[i]
            values[name] = numbers(np.rad2deg(float(value[i])) if degrees else value[i])
        link = source.links[i]
        place = link.joint_id - int(source.model.body_jntadr[link.body_id])
        own = has_own_friction_law(source.model, link.dof)
        if joints["frictionloss"][i] > 0 and "frictionloss" in values and not own:
            values |= dry_friction(source.model.opt.timestep)
        if values:
            edits.append(markup.Edit(_joint_element(body, place), values))
    return edits


def _joint_element(body: markup.Element, place: int = 0) -> markup.Element:
    """One of the joints of a body, which may stand in a `frame` of it."""
    written = list(_joint_elements(body))
    if place < len(written):
        return written[place]
    raise InputError(f"{body.file}: line {body.line}: the joint of this body is not written in the file")


def _joint_elements(body: markup.Element) -> Iterator[markup.Element]:
    for child in body.children:
        if child.tag == "joint":
            yield child
        elif child.tag == "frame":
            yield from _joint_elements(child)


def dry_friction(timestep: float) -> dict[str, str]:
    """Joint attributes that make MuJoCo's soft `frictionloss` Coulomb's law, as far as a step can show."""
    return {"solreffriction": numbers([2 * timestep, 1]), "solimpfriction": numbers(_IMPEDANCE)}


def _verify(
    source: MjcfSource, edited: markup.Document, meant: np.ndarray, joints: Mapping[str, np.ndarray]
) -> None:
    """Compile what was written, and find what was meant and nothing else changed."""
    arm, after = from_document(edited, source.dropped)
    for i, link in enumerate(source.links):
        if not _agree(after.standard[i], meant[i], meant):
            raise InputError(
                f"{source.path}: MuJoCo does not compile body {link.body!r} to the inertia written for it;"
                " does a <compiler> setting (boundmass, boundinertia, balanceinertia) change it?"
            )
        for name, value in joints.items():
            got = np.asarray(getattr(arm, name))
            unused = name == "springref" and joints["stiffness"][i] == 0
            if not unused and abs(got[i] - value[i]) > _precision(got) * abs(value[i]):
                raise InputError(
                    f"{source.path}: joint {link.joint!r} compiles to {name} {got[i]:.6g}, not"
                    f" {value[i]:.6g}; does springdamper, or a flag of <option>, decide it?"
                )
    changed = _others_changed(source, after.model)
    if changed:
        raise InputError(f"{source.path}: the export would also change {', '.join(changed)} of the model")


_WRITTEN = {
    "body": ("body_mass", "body_ipos", "body_iquat", "body_inertia"),
    "dof": ("dof_armature", "dof_damping", "dof_frictionloss", "dof_solref", "dof_solimp"),
    "joint": ("jnt_stiffness",),
    "qpos": ("qpos_spring",),
}
"""Arrays of MjModel that an export writes, in the rows of the arm."""
_FOLLOWS = (
    *("body_subtreemass", "body_invweight0", "body_sameframe", "body_simple", "geom_sameframe"),
    *("site_sameframe", "dof_invweight0", "dof_M0", "dof_length", "dof_simplenum", "tendon_invweight0"),
    *("flexedge_invweight0", "cam_poscom0", "light_poscom0"),
    *("actuator_acc0", "actuator_biasprm", "actuator_lengthrange"),
)
"""Arrays that MuJoCo computes from those."""
_LAYOUT = ("bvh_", "body_bvh", "M_", "B_", "D_", "mapM", "mapD", "efm", "names", "dof_Madr")
"""How MuJoCo arranges its work."""


def _others_changed(source: MjcfSource, after: mujoco.MjModel) -> list[str]:
    """Arrays of the model that differ and should not."""
    before = source.model
    rows = {
        "body": [link.body_id for link in source.links],
        "dof": [link.dof for link in source.links],
        "joint": [link.joint_id for link in source.links],
        "qpos": [link.qpos for link in source.links],
    }
    written = {array: rows[kind] for kind, arrays in _WRITTEN.items() for array in arrays}
    changed = []
    for name in dir(before):
        value = getattr(before, name)
        if not isinstance(value, np.ndarray) or name in _FOLLOWS or name.startswith(_LAYOUT):
            continue
        a, b = value, getattr(after, name)
        if name in written and a.shape == b.shape:
            a, b = (np.delete(x, written[name], axis=0) for x in (a, b))
        if a.shape != b.shape or not np.array_equal(a, b, equal_nan=a.dtype.kind == "f"):
            changed.append(name)
    return changed


def _changes(edit: markup.Edit) -> Iterable[Change]:
    element = edit.element
    owner = _name(element) or f"line {element.line}"
    for name, new in edit.attributes.items():
        old = element.attributes.get(name)
        if new != old:
            yield Change(str(element.file), element.line, f"{element.tag} of {owner}", name, old, new)
    if edit.first_child:
        yield Change(str(element.file), element.line, f"body {owner}", "inertial", None, edit.first_child)


def sidecar(arm: Arm, friction: Friction | None) -> dict[str, Any]:
    """What MJCF cannot hold of the friction found, for whoever adds it to the simulation by hand."""
    law = friction if friction is not None and friction.model != "none" else None
    offset = law.offset if law else np.zeros(arm.dof)
    if law and law.model == "sigmoid":
        phi1, phi2, phi3 = (np.asarray(law.parameters[name]) for name in ("phi1", "phi2", "phi3"))
        offset = phi1 * (0.5 - 1 / (1 + np.exp(-phi2 * phi3)))
    return {
        "schema": SIDECAR,
        "arm": arm.name,
        "joints": list(arm.joint_names),
        "torque_offset": [float(value) for value in offset],
        "friction": law.to_json() if law else [],
    }


def read_sidecar(path: str | Path) -> dict[str, Any]:
    """What `sidecar` said, from a file.

    Raises:
        InputError: the file is no sidecar.
    """
    document = read_json(path)
    if not isinstance(document, dict) or document.get("schema") != SIDECAR:
        raise InputError(f"{path}: is no sidecar of an export (schema {SIDECAR!r}); move it away")
    offset, joints = document.get("torque_offset"), document.get("joints")
    if (
        not isinstance(offset, list)
        or not isinstance(joints, list)
        or len(joints) != len(offset)
        or not all(isinstance(value, int | float) for value in offset)
    ):
        raise InputError(f"{path}: torque_offset must hold one number a joint")
    return document


def missing_assets(document: markup.Document, folder: Path) -> tuple[str, ...]:
    """A warning for the files that the model names and that are not where it will look from `folder`."""
    compiler = {k: v for e in document.root.walk() if e.tag == "compiler" for k, v in e.attributes.items()}
    shared = compiler.get("assetdir", "")
    place = {
        "mesh": compiler.get("meshdir", shared),
        "hfield": compiler.get("meshdir", shared),
        "texture": compiler.get("texturedir", shared),
        "model": "",
    }
    files = [
        Path(place[e.tag], e.attributes["file"])
        for e in document.root.walk()
        if e.tag in place and "file" in e.attributes
    ]
    missing = [f for f in files if not (folder / f).exists() and (document.path.parent / f).exists()]
    named = zip(document.inclusions, markup.gathered(document).inclusions, strict=True)
    moved = [f"{old!r}, which it includes, is put beside it as {new!r}" for old, new in named if old != new]
    if not missing:
        return tuple(moved)
    return (
        *moved,
        f"{len(missing)} meshes, textures or attached models ({missing[0]}, ...) lie beside {document.path}"
        " and not beside the file written: write it there, or copy them",
    )


def _full(I: np.ndarray) -> list[float]:
    """MJCF's order of a symmetric tensor: xx yy zz xy xz yz."""
    return [I[0, 0], I[1, 1], I[2, 2], I[0, 1], I[0, 2], I[1, 2]]


def panda_mjcf(
    standard: Float[Array, "dof 10"] | Float[np.ndarray, "dof 10"] | None = None,
    friction: Friction | None = None,
    name: str = "panda",
) -> str:
    """The project's own Panda as MJCF: no meshes, no contacts, every number with all its digits.

    Body frames are the modified Denavit-Hartenberg frames; capsules between them are for looks. Motors carry
    the real torque limits.

    Args:
        standard: parameters of the links; None for the published ones.
        friction: as far as MuJoCo holds it; `not_held` says what it does not, `sidecar` has it.
        name: of the model.

    Raises:
        InputError: parameters that are not a real body's.
    """
    with jax.enable_x64(True):
        arm = jax.tree.map(np.asarray, Arm.panda())
    phi = np.asarray(arm.standard if standard is None else standard, float)
    joints = _joint_values(arm, friction)
    timestep = 0.001
    alpha = np.deg2rad(published()["modified_dh"]["alpha_degrees"])
    origins = np.round(arm.chain.p, 15) + 0.0
    ends = [*origins[1:], np.array([0, 0, published()["modified_dh"]["flange"]])]
    opening, closing = "", ""
    for i in range(arm.dof):
        pad = "  " * (i + 3)
        mass, com, I_com = _buildable(f"{name}: body {arm.link_names[i]!r}", phi[i], "", [])
        laws = {key: numbers(joints[key][i]) for key in ("damping", "frictionloss") if joints[key][i]}
        laws |= dry_friction(timestep) if "frictionloss" in laws else {}
        extra = "".join(f' {key}="{value}"' for key, value in laws.items())
        turn = numbers([1, np.round(np.tan(alpha[i] / 2), 15), 0, 0])
        body = f'pos="{numbers(com)}" mass="{numbers(mass)}" fullinertia="{numbers(_full(I_com))}"'
        opening += (
            f'{pad}<body name="{arm.link_names[i]}" pos="{numbers(origins[i])}" quat="{turn}">\n'
            f"{pad}  <inertial {body}/>\n"
            f'{pad}  <joint name="joint{i + 1}" range="{numbers([arm.lower[i], arm.upper[i]])}"{extra}/>\n'
            f"{pad}  {_capsule(ends[i])}\n"
        )
        closing = f"{pad}</body>\n" + closing
    opening += f'{"  " * (arm.dof + 3)}<site name="flange" pos="{numbers(ends[-1])}"/>\n'
    motors = "".join(
        f'    <motor name="motor{i + 1}" joint="joint{i + 1}" ctrlrange="{-limit} {limit}"/>\n'
        for i, limit in enumerate(TORQUE_LIMITS)
    )
    home = numbers([0, -np.pi / 4, 0, -3 * np.pi / 4, 0, np.pi / 2, np.pi / 4])
    whose = "Gaz et al., RA-L 2019, Table VIII" if standard is None else "written by jaxpanda"
    text = f"""<mujoco model="{markup.quote(name)}">
  <!-- Franka Emika Panda without hand. Kinematics: Franka Control Interface documentation. Inertial
       parameters: {whose}. Body frames are modified Denavit-Hartenberg frames; capsules are for looks. -->
  <compiler angle="radian"/>
  <option timestep="{timestep}" integrator="implicitfast" gravity="{numbers(arm.chain.gravity)}">
    <flag contact="disable"/>
  </option>
  <default>
    <geom type="capsule" contype="0" conaffinity="0" rgba="0.9 0.9 0.92 1"/>
    <joint axis="0 0 1" limited="true"/>
    <motor ctrllimited="true"/>
  </default>
  <worldbody>
    <light pos="1 -1 3" dir="-0.3 0.3 -1"/>
    <body name="link0">
      <geom fromto="0 0 0.06 0 0 0.2" size="0.06"/>
{opening}{closing}    </body>
  </worldbody>
  <actuator>
{motors}  </actuator>
  <keyframe>
    <key name="home" qpos="{home}"/>
  </keyframe>
</mujoco>
"""
    from_document(markup.parse(text, "mujoco", Path(f"{name}.xml")))
    return text


def _capsule(end: np.ndarray) -> str:
    """From the frame's origin to the next one's; about its own axis where the two are the same."""
    start, end = (np.zeros(3), end) if np.any(end) else (np.array([0, 0, -0.1]), np.zeros(3))
    return f'<geom fromto="{numbers(start)} {numbers(end)}" size="0.05"/>'
