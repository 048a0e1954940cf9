"""corrected.xml: the user's file with what was found, as far as MuJoCo holds it."""

import functools
from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy.optimize
from jaxtyping import Float

from ..arms import markup
from ..arms.arm import Arm
from ..arms.export import ExportResult, edit_mjcf, write_parameters
from ..arms.mjcf import KNOWN, MjcfSource
from ..arms.source import from_document
from ..corrected import Corrected
from ..effects import AbstractEffect
from ..effects.native import nearest
from ..errors import InputError
from ..feasible.nearest import are_buildable, nearest_buildable
from ..inference.problem import Problem
from ..parameters import triangle
from ..recordings import Recording
from ..validation import torque_rmse

UNSEEN = 0.5
"""Torque over the noise by which links may differ from those found, so that they can be built."""
_NOT_NEGATIVE = tuple(name for name in KNOWN if name != "springref")
"""An arm's numbers that MuJoCo takes from zero on."""
_ROUNDING = 0.01
"""Share of the file's number by which one below zero counts as zero."""
_WORSE = 1.1
"""Ratio of errors from which a joint counts as worse."""


def buildable(source: MjcfSource, corrected: Corrected, problem: Problem) -> Corrected:
    """The nearest torque from links that can be built, so that the arm can be simulated; the links as they are
    where that differs beyond what can be overseen, and leaves more of a joint than the user's model does."""
    standard = np.asarray(corrected.native.standard)
    carried = np.stack([link.lumped_standard for link in source.links])
    if not np.any(np.asarray(corrected.change)) or are_buildable(standard - carried):
        return corrected
    built, off = _nearest(source, standard, problem)
    noise, users = problem.noise(()).std, problem.weighed(problem.residual)
    if np.any((off > UNSEEN * noise) & (np.hypot(noise, off) > users)):
        return corrected
    return eqx.tree_at(lambda c: c.change, corrected, corrected.change + (built - standard))


def file_with(
    source: MjcfSource, corrected: Corrected, problem: Problem, recordings: Sequence[Recording]
) -> tuple[markup.Document, tuple[str, ...]]:
    """The user's file with what MuJoCo holds of the corrected arm; what it does not hold, and where it is further
    from the recordings than it was."""
    document, warnings = corrected_document(source, corrected, problem)
    if document is not source.document:
        after, _ = from_document(document, source.dropped)
        warnings = (*warnings, *worsened(corrected.arm, after, recordings, problem.noise(()).std))
    return document, warnings


def corrected_document(
    source: MjcfSource, corrected: Corrected, problem: Problem
) -> tuple[markup.Document, tuple[str, ...]]:
    """The user's file with what MuJoCo holds natively put in, and what could not be."""
    moved = bool(np.any(np.asarray(corrected.change)))
    if not (corrected.effects or moved):
        return source.document, ()
    corrected, warnings = with_nearest(corrected, problem)
    native = corrected.native
    held = zip(corrected.effects, corrected.coefficients, strict=True)
    moved = moved or any(e.standard_change(c) is not None for e, c in held)
    values = tuple(
        jnp.maximum(getattr(native, n), 0.0) if n in _NOT_NEGATIVE else getattr(native, n) for n in KNOWN
    )
    warnings += _below_zero(native, corrected.arm)
    arm = eqx.tree_at(lambda a: tuple(getattr(a, n) for n in KNOWN), corrected.arm, values)
    result, told = _with_links(source, arm, np.asarray(native.standard) if moved else None, problem)
    warnings += told
    document = result.document
    if not np.allclose(np.asarray(native.chain.gravity), np.asarray(corrected.arm.chain.gravity)):
        value = " ".join(repr(float(v)) for v in np.asarray(native.chain.gravity))
        try:
            document = edit_mjcf(document, {("option", ""): {"gravity": value}})
        except InputError as error:
            warnings.append(f"corrected.xml: gravity should be {value}: {error}")
    return document, (*warnings, *result.warnings)


def _below_zero(native: Arm, before: Arm) -> list[str]:
    """A sentence on numbers that a sensor's gain or delay leaves below zero, by more than rounding."""
    told = []
    for name in _NOT_NEGATIVE:
        new, old = (np.asarray(getattr(arm, name)) for arm in (native, before))
        joints = np.flatnonzero(new < -_ROUNDING * np.abs(old) - 1e-9)
        told += [f"{name} {new[j]:.3g} at joint {j + 1}" for j in joints]
    if not told:
        return []
    return [f"corrected.xml has 0 for what came out below zero, which no MJCF can hold: {', '.join(told)}"]


def worsened(
    before: Arm, after: Arm, recordings: Sequence[Recording], noise: Float[np.ndarray, " dof"]
) -> list[str]:
    """A sentence on the joints where the file's torque is further from the recordings than the user's, by a tenth
    and beyond the noise: parts of what was found may be worse than none where MuJoCo lacks the rest."""
    try:
        old, new = (torque_rmse(arm, recordings) for arm in (before, after))
    except InputError:  # too short for the filter
        return []
    joints = np.flatnonzero(new > np.maximum(_WORSE * old, np.hypot(old, noise)))
    if not len(joints):
        return []
    each = [
        f"{new[j]:.2g} for {old[j]:.2g} {before.unit('N·m', int(j))} rms at joint {j + 1}" for j in joints
    ]
    return [
        "corrected.xml is further from the recorded torque than your file, for want of what it cannot hold:"
        f" {', '.join(each)}; `predict` has all of it"
    ]


def with_nearest(corrected: Corrected, problem: Problem) -> tuple[Corrected, list[str]]:
    """The arm with what MuJoCo's joints hold in place of laws that they do not, nearest to the torque of those
    in the recordings in question; and sentences on what is not held, and what remains of it."""
    native, stands_for = corrected.native, functools.partial(nearest, arm=corrected.arm)
    effects, coefficients, remains = list(corrected.effects), list(corrected.coefficients), []
    beyond = [(law, c) for law, c in corrected.beyond if stands_for(law)]
    for j in sorted({law.joints[0] for law, _ in beyond}):
        laws = [law.lasting(np.asarray(c)) for law, c in beyond if law.joints[0] == j]
        torque = np.sum([_at_joint(problem, law, j) @ c for law, c in laws], 0)
        instead = list({e.name: e for law, _ in laws for e in stands_for(law)}.values())
        columns = [_at_joint(problem, e, j) for e in instead]
        # what the joint has in the end is not negative
        least = [np.full(A.shape[1], -np.inf) for A in columns]
        for effect, at in zip(instead, least, strict=True):
            (attribute, *_) = effect.mjcf(jnp.ones(len(at)), corrected.arm)
            at[0] = -max(float(getattr(native, attribute)[j]), 0.0)
        A, lower = np.concatenate(columns, 1), np.concatenate(least)
        x = scipy.optimize.lsq_linear(A, torque, (lower, np.inf), method="bvls").x
        effects += instead
        coefficients += map(jnp.asarray, np.split(x, np.cumsum([len(at) for at in least])[:-1]))
        whole, left = (float(np.sqrt(np.mean(part**2))) for part in (torque, torque - A @ x))
        remains.append(f"{left:.2g} of {whole:.2g} {corrected.arm.unit('N·m', j)} rms at joint {j + 1}")
    told = [f"corrected.xml cannot hold {e.name}: {e.equation}" for e, _ in corrected.beyond]
    told = list(dict.fromkeys(told))  # once, however many joints a law is at
    if remains:
        told.append(
            "corrected.xml has the damping, frictionloss and springs nearest to those laws in their place; they"
            f" lack {', '.join(remains)}"
        )
    fields = lambda c: (c.effects, c.coefficients)
    return eqx.tree_at(fields, corrected, (tuple(effects), tuple(coefficients))), told


def _at_joint(problem: Problem, effect: AbstractEffect, joint: int) -> Float[np.ndarray, "rows n"]:
    """Columns of an effect at a joint in the recordings in question; zero in rows that do not count."""
    parts = zip(problem.full_columns(effect), problem.traces, problem.active, strict=True)
    return np.concatenate([c[:, joint] * t.weight[:, None] for c, t, on in parts if on])


def _with_links(
    source: MjcfSource, arm: Arm, standard: Float[np.ndarray, "dof 10"] | None, problem: Problem
) -> tuple[ExportResult, list[str]]:
    """The user's file with these links, or the nearest that can be built, or its own; and which it is."""
    try:
        return write_parameters(source, arm, standard), []
    except InputError as error:
        if standard is None:
            raise
        refusal = error
    built, off = _nearest(source, standard, problem)
    try:
        result = write_parameters(source, arm, built)
    except InputError:
        return write_parameters(source, arm), [
            f"corrected.xml: link inertias are left as they were: {refusal}"
        ]
    j = int(np.argmax(off))
    return result, [
        "corrected.xml: links as they were found could not be built; it has the nearest that can, whose torque"
        f" is {off[j]:.3g} {arm.unit('N·m', j)} rms off at joint {j + 1} and less at the others"
    ]


def _nearest(
    source: MjcfSource, standard: Float[np.ndarray, "dof 10"], problem: Problem
) -> tuple[Float[np.ndarray, "dof 10"], Float[np.ndarray, " dof"]]:
    """The nearest links that can be built, and how far their torque is off in the recordings, rms [N m]."""
    weights = np.concatenate([t.weights for t in problem.traces]) / problem.noise(()).std
    felt = np.concatenate([t.motion.regressor for t in problem.traces])
    root = triangle((weights[:, :, None] * felt).reshape(-1, standard.size))
    carried = np.stack([link.lumped_standard for link in source.links])
    changed = np.flatnonzero(np.any(standard != source.standard, axis=1))
    built = nearest_buildable(standard, carried, source.standard, root, changed.tolist())
    return built, np.sqrt(np.mean((felt @ (built - standard).ravel()) ** 2, 0))
