"""What a diagnosis knows of links, friction and effects, for others to draw from."""

import dataclasses
from typing import TYPE_CHECKING

import numpy as np
import scipy.linalg

from ..feasible import Bounds
from ..feasible.nearest import are_buildable
from ..inference import knowledge as knowledge_
from ..inference.state import places
from ..posterior import Posterior
from ..search.uncertainty import joint, leaned

if TYPE_CHECKING:
    from .diagnosis import Diagnosis

_EXACT = 1e-6
"""Standard deviation of links that are known exactly, as a share of the largest within their bounds."""


def posterior_of(found: "Diagnosis") -> Posterior:
    """The Gaussian of the refitted numbers of the model and of the coefficients of its effects, these in the
    order of the corrected model; the shapes of effects stay as they were found."""
    arm, kept = found.corrected.arm, found.kept
    dof, inertial = arm.dof, found.spread.shape[1]
    bounds, nominal = Bounds.of(arm), np.asarray(arm.standard)
    C, x = joint(kept.design), kept.design.x
    at, scale, names, least = [*range(inertial)], [1.0] * inertial, [], []
    place = inertial
    known = zip(
        ("viscous", "coulomb", "armature"),
        knowledge_.friction_spread(arm, found.knowledge, found.scale),
        (arm.damping, arm.frictionloss, arm.armature),
        strict=True,
    )
    for kind, deviation, value in known:
        for j in np.flatnonzero(deviation > 0):
            at.append(place)
            scale.append(float(deviation[j]))
            names.append(f"{kind}_{j + 1}")
            least.append(-float(value[j]))
            place += 1
    first = len(found.corrected.effects) - len(kept.terms)
    for i, own in enumerate(places(kept)):
        for k, column in enumerate(range(own.start, own.stop)):
            at.append(column)
            scale.append(1.0)
            names.append(_effect(first + i, k))
            least.append(-np.inf)
    scale = np.array(scale)
    covariance = C[np.ix_(at, at)] * np.outer(scale, scale)
    off = np.concatenate([np.zeros(0), *leaned(kept, found.fit.missed)])
    covariance += np.diag(np.pad(off, (len(at) - len(off), 0)) ** 2)
    mean = x[at] * scale
    if inertial:
        K = np.linalg.pinv(found.spread)
        told = np.zeros((len(at), 10 * dof + len(names)))
        told[:inertial, : 10 * dof] = K
        mean[:inertial] += K @ nominal.ravel()
    else:  # the links are known exactly
        size = np.abs(bounds.mass).max(1)[:, None] * np.array([1.0] + [0.1] * 3 + [0.01] * 6)
        told = np.zeros((10 * dof + len(at), 10 * dof + len(names)))
        told[: 10 * dof, : 10 * dof] = np.eye(10 * dof)
        mean = np.concatenate([nominal.ravel(), mean])
        wide = np.diag(np.concatenate([(_EXACT * size.ravel()) ** 2, np.zeros(len(at))]))
        wide[10 * dof :, 10 * dof :] = covariance
        covariance, inertial = wide, 10 * dof
    told[inertial:, 10 * dof :] = np.eye(len(names))
    carried = np.stack([link.lumped_standard for link in found.source.links])
    return Posterior(
        told=told,
        mean=mean,
        covariance=covariance,
        names=tuple(names),
        least=np.array(least),
        bounds=bounds,
        carried=carried if are_buildable(nominal - carried) else np.zeros_like(carried),
        noise=np.asarray(found.fit.rmse_after, float),
    )


def posterior_of_sides(link: "Diagnosis", drive: "Diagnosis") -> Posterior:
    """Of the whole arm as its motors move it (`two_sided.both`): links by the torque behind the drives, friction
    of the model by that of the motors, effects by that of their side. Neither tells of the other's unknowns."""
    links, drives = posterior_of(link), posterior_of(drive)
    inertial = 10 * links.dof
    shown = [e.acts_on != "torque" for e in link.corrected.effects]
    behind = {_effect(i, k): _effect(sum(shown[:i]), k) for i, k in _coefficients(link) if shown[i]}
    within = {_effect(i, k): _effect(sum(shown) + i, k) for i, k in _coefficients(drive)}
    of_links = [i for i, name in enumerate(links.names) if name in behind]
    # of the links rows that tell of what is left out are left out, of the drives those that tell of links
    out = np.setdiff1d(np.arange(links.told.shape[1]), [*range(inertial), *(inertial + i for i in of_links)])
    rows = [~links.told[:, out].any(1), drives.told[:, inertial:].any(1)]
    columns = [[*range(inertial), *(inertial + i for i in of_links)], slice(inertial, None)]
    each = [*zip((links, drives), rows, columns, strict=True)]
    return dataclasses.replace(
        links,
        told=scipy.linalg.block_diag(*(one.told[on][:, at] for one, on, at in each)),
        mean=np.concatenate([one.mean[on] for one, on, _ in each]),
        covariance=scipy.linalg.block_diag(*(one.covariance[np.ix_(on, on)] for one, on, _ in each)),
        names=(
            *(behind[links.names[i]] for i in of_links),
            *(within.get(name, name) for name in drives.names),
        ),
        least=np.concatenate([links.least[of_links], drives.least]),
        noise=drives.noise,
    )


def _coefficients(found: "Diagnosis") -> list[tuple[int, int]]:
    """Effect and coefficient of each that is fitted."""
    return [(i, k) for i, c in enumerate(found.corrected.coefficients) for k in range(len(c))]


def _effect(i: int, k: int) -> str:
    """Name of a coefficient of an effect, both from 0."""
    return f"effect_{i + 1}_{k + 1}"
