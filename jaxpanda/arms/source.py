"""Arms, and the files that they come from."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from . import markup
from .arm import Arm
from .mjcf import MjcfSource, load_model, parts_of, read, with_gravity
from .model_file import Model, ModelFile, Part


def from_mjcf(path: Model, gravity: Sequence[float] | None = None) -> tuple[Arm, MjcfSource]:
    """The serial arm in an MJCF or URDF file, and where its parts stand in it.

    Meshes may be missing where a body has its `inertial`. `gravcomp` is no part of the arm: it is a force of
    the simulation, while a measured torque carries the weight.

    Args:
        path: of the file, or which arm of it is meant.
        gravity: in place of the file's, in the frame of its world [m/s²].

    Raises:
        InputError: no MJCF, one that MuJoCo refuses, or something that a serial arm cannot represent.
    """
    return from_document(with_gravity(read(path), gravity))


def from_document(document: markup.Document, dropped: frozenset[int] | None = None) -> tuple[Arm, MjcfSource]:
    """`from_mjcf` of a text that need not be on disk; names in it are relative to `document.path`.

    Args:
        document: the text.
        dropped: geoms whose mesh to leave out, as `MjcfSource` has them; else those without a say.
    """
    fields, source = parts_of(document, dropped)
    return Arm(**fields), source


def file_with(arm: Arm, path: str | Path) -> ModelFile:
    """A file that holds this arm, with what chooses the arm by the names of its joints."""
    model = load_model(ModelFile(path, Part(outside=True)))
    names = [model.joint(joint).name for joint in range(model.njnt)]
    if not set(arm.joint_names) <= set(names):
        return ModelFile(path)
    first, last = (int(model.jnt_bodyid[names.index(arm.joint_names[i])]) for i in (0, -1))
    base = int(model.body_parentid[first])
    root, tip = (model.body(body).name for body in (base, last))
    return ModelFile(path, Part(root if base else "", tip if root or not base else "", outside=True))


def is_panda(arm: Arm) -> bool:
    """Whether an arm is the project's own Panda, and not another model of that name."""
    own = Arm.panda()
    pairs = ((arm.chain.R, own.chain.R), (arm.chain.p, own.chain.p), (arm.standard, own.standard))
    return all(np.array_equal(a, b) for a, b in pairs)
