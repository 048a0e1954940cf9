r"""The recordings as least squares sees them: what any links' torque error on them is, without the recordings.

$$\lVert y_j - A_j x\rVert = \lVert R_j\,(x, -1)\rVert\ \text{up to sign, with}\ [A_j\; y_j] = Q_j R_j$$

A joint's $R_j$ is as small as its columns are few, however long the recording. Those of all samples, and of every
block that cross-validation holds out and of what is left then, are what `retrieve` needs to say how well its
links explain torque, and how well such links do where they were not fitted.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import scipy.optimize
from jaxtyping import Float

from .. import inputs
from ..errors import InputError
from ..files import write_npz
from ..friction import Friction, linear
from ..parameters import triangle
from .regression import Masks, Regression, triangles, weighted_fit

FILE = "identification.npz"
"""Stands beside identification.json."""

_UNFELT = 1e-6
"""Rms of a column of friction below which its joint did not move, in rad/s or of a sign."""


@dataclasses.dataclass(frozen=True)
class Condensed:
    """Some samples of the recordings, every joint's columns and torque as one triangle."""

    R: Float[np.ndarray, "dof columns columns"]
    """Of the base parameters' columns, the joint's own friction's, and the torque less what the model holds; each
    sample weighed as in the regression."""
    unweighted: Float[np.ndarray, "dof columns columns"]
    """The same of the samples as they are."""
    samples: int
    torque: float
    """Norm of all joints' measured torque [N m], what relative errors are relative to."""

    @classmethod
    def of(cls, regressions: Sequence[Regression], masks: Masks, rank: int) -> "Condensed":
        """The samples that masks leave."""
        weighed = triangles(regressions, masks)
        doubted = any(np.any(r.weight != 1) for r in regressions)
        plain = triangles(regressions, masks, weighted=False) if doubted else weighed
        dof, columns = len(weighed), weighed.shape[2]
        extra = (columns - 1 - rank) // dof
        own = [
            [*range(rank), *range(rank + j * extra, rank + (j + 1) * extra), columns - 1] for j in range(dof)
        ]
        torque = np.sqrt(
            sum(float(np.sum(r.tau[:, mask] ** 2)) for r, mask in zip(regressions, masks, strict=True))
        )
        R, unweighted = (
            np.stack([triangle(Rj[:, chosen]) for Rj, chosen in zip(each, own, strict=True)])
            for each in (weighed, plain)
        )
        return cls(R, unweighted, sum(int(mask.sum()) for mask in masks), torque)

    @property
    def dof(self) -> int:
        return len(self.R)

    def residual(
        self, beta: Float[np.ndarray, " base"], own: Float[np.ndarray, "dof extra"]
    ) -> Float[np.ndarray, " dof"]:
        """Norm of what base parameters and friction leave of each joint's torque, as weighed [N m]."""
        return _left(self.R, beta, own)

    def error(
        self, beta: Float[np.ndarray, " base"], own: Float[np.ndarray, "dof extra"]
    ) -> Float[np.ndarray, " dof"]:
        """The same of the samples as they are [N m]."""
        return _left(self.unweighted, beta, own)

    def classical(self, rank: int, weighting: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Least squares on these samples: base parameters, friction, and the residuals that weigh the joints."""
        dof, extra = self.dof, self.R.shape[2] - 1 - rank
        wide = np.zeros((dof, self.R.shape[1], rank + dof * extra + 1))
        for j, R in enumerate(self.R):
            wide[j, :, :rank] = R[:, :rank]
            wide[j, :, rank + j * extra : rank + (j + 1) * extra] = R[:, rank:-1]
            wide[j, :, -1] = R[:, -1]
        fit = weighted_fit(wide, self.samples, weighting)
        return fit.x[:rank], fit.x[rank:].reshape(dof, extra), fit.sigma

    def expecting(self, weights: Float[np.ndarray, "dof extra"]) -> "Condensed":
        """The same where friction's parameters are expected to be zero, off by weight times parameter [N m]."""
        extra = weights.shape[1]
        rows = np.zeros((self.dof, extra, self.R.shape[2]))
        rows[:, :, -1 - extra : -1] = weights[:, :, None] * np.eye(extra)
        R = np.stack([triangle(np.concatenate(pair)) for pair in zip(self.R, rows, strict=True)])
        return dataclasses.replace(self, R=R)

    def weigh(self, rank: int, sigma: Float[np.ndarray, " dof"]) -> Float[np.ndarray, "base base"]:
        r"""$T$ with $\lVert T\,\delta\rVert^2$ the weighted squares that moving base parameters by δ costs.

        Each joint's friction follows as it serves best.
        """
        extra = self.R.shape[2] - 1 - rank
        rows = []
        for R, s in zip(self.R, sigma, strict=True):
            friction_first = triangle(np.concatenate([R[:, rank:-1], R[:, :rank]], 1) / s)
            rows.append(friction_first[extra:, extra:])
        return triangle(np.concatenate(rows))

    def following(
        self, beta: Float[np.ndarray, " base"], least: Float[np.ndarray, "dof extra"]
    ) -> Float[np.ndarray, "dof extra"]:
        """The friction that serves given base parameters best, none of its parameters below `least`; none where a
        joint never moved."""
        rank = len(beta)
        own = []
        for R, low in zip(self.R, least, strict=True):
            left, columns = R[:, -1] - R[:, :rank] @ beta, R[:, rank:-1]
            scale, x = np.linalg.norm(columns, axis=0), np.zeros(columns.shape[1])
            told = scale > _UNFELT * np.sqrt(self.samples)
            if told.any():
                scale, bounds = scale[told], (low[told] * scale[told], np.inf)
                x[told] = (
                    scipy.optimize.lsq_linear(columns[:, told] / scale, left, bounds, method="bvls").x / scale
                )
            own.append(x)
        return np.array(own)


def _left(
    R: Float[np.ndarray, "dof columns columns"],
    beta: Float[np.ndarray, " base"],
    own: Float[np.ndarray, "dof extra"],
) -> Float[np.ndarray, " dof"]:
    x = np.concatenate([np.tile(beta, (len(R), 1)), own, -np.ones((len(R), 1))], 1)
    return np.linalg.norm(np.einsum("jrc,jc->jr", R, x), axis=1)


@dataclasses.dataclass(frozen=True)
class Evidence:
    """What recordings hold against any links: as a whole, and block by block."""

    whole: Condensed
    folds: tuple[tuple[Condensed, Condensed], ...] = ()
    """Of each fold of the cross-validation what it was fitted to, and what was held out."""

    def save(self, path: Path) -> None:
        """Write the arrays; whoever calls sees to it that nothing is left half-written."""
        parts = [self.whole, *(part for fold in self.folds for part in fold)]
        arrays = {
            "R": np.stack([part.R for part in parts]),
            "unweighted": np.stack([part.unweighted for part in parts]),
            "samples": np.array([part.samples for part in parts]),
            "torque": np.array([part.torque for part in parts]),
        }
        write_npz(path, arrays)

    @classmethod
    def load(cls, path: Path) -> "Evidence":
        """The inverse of `save`.

        Raises:
            InputError: the file is not as `identify` writes it.
        """
        try:
            arrays = inputs.read_npz(path)
            plain = arrays.get("unweighted", arrays["R"])
            columns = [arrays["R"], plain, arrays["samples"], arrays["torque"]]
            parts = [
                Condensed(np.asarray(R, float), np.asarray(unweighted, float), int(samples), float(torque))
                for R, unweighted, samples, torque in zip(*columns, strict=True)
            ]
            return cls(parts[0], tuple(zip(parts[1::2], parts[2::2], strict=True)))
        except InputError:
            raise
        except (KeyError, TypeError, ValueError, IndexError) as error:
            raise InputError(
                f"{path}: is not as `identify` writes it ({error}); identify again, or take it away"
            ) from None


def own_parameters(friction: Friction | None, dof: int) -> Float[np.ndarray, "dof extra"]:
    """What multiplies each joint's own columns."""
    names = linear_names(friction)
    return (
        np.stack([np.asarray(friction.parameters[n]) for n in names], 1)
        if friction and names
        else np.zeros((dof, 0))
    )


def linear_names(friction: Friction | None) -> tuple[str, ...]:
    """The parameters that friction is linear in."""
    return () if friction is None else linear(friction.model)


def with_own_parameters(friction: Friction, own: Float[np.ndarray, "dof extra"]) -> Friction:
    """The friction with other numbers."""
    new = dict(zip(linear_names(friction), own.T, strict=True))
    return dataclasses.replace(friction, parameters={**friction.parameters, **new})
