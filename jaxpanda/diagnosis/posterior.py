"""What a diagnosis knows of links, friction and effects, for others to draw from."""

from typing import TYPE_CHECKING

import numpy as np

from ..feasible import Bounds
from ..feasible.nearest import are_buildable
from ..posterior import Posterior
from . import knowledge as knowledge_
from .state import places
from .uncertainty import joint

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
            names.append(f"effect_{first + i + 1}_{k + 1}")
            least.append(-np.inf)
    scale = np.array(scale)
    covariance = C[np.ix_(at, at)] * np.outer(scale, scale)
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
