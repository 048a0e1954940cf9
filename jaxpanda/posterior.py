r"""What is known of an arm's links and friction: told combinations with their covariance, and bounds on the rest.

$$G\,(\phi, f) \sim N(\mu, C), \qquad (\phi, f)\ \text{feasible}$$

$\phi$ are the standard parameters of the links, f what else is linear in the torque: friction, sizes of effects.
Of what G does not tell nothing is known but that the links can be built and lie within their bounds. `retrieve`
and `diagnose` write it beside their results, as `posterior.npz`; `jaxpanda.ensemble` draws from it.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from . import inputs
from .errors import InputError
from .feasible.bounds import Bounds
from .files import write_npz

FILE = "posterior.npz"
"""Stands beside retrieval.json, or beside diagnosis.json."""


@dataclasses.dataclass(frozen=True)
class Posterior:
    """A Gaussian in what torque tells, and bounds on everything."""

    told: Float[np.ndarray, "told unknowns"]
    """G; ten columns a link, in the order of `jaxpanda_kernels.inertia`, then one for each of `names`."""
    mean: Float[np.ndarray, " told"]
    covariance: Float[np.ndarray, "told told"]
    names: tuple[str, ...]
    """Of the unknowns beside the links, as `coulomb_1` or `effect_2_1`; joints and coefficients from 1."""
    least: Float[np.ndarray, " extra"]
    """Of the unknowns beside the links; minus infinity where they may have either sign."""
    bounds: Bounds
    carried: Float[np.ndarray, "dof 10"]
    """Of each link, what belongs to bodies that are fixed to it: without them it must be a body too."""
    noise: Float[np.ndarray, " dof"]
    """Rms of what a recording's torque has beyond the model, below the cutoff of the fit [N m]."""

    @property
    def dof(self) -> int:
        return self.bounds.dof

    def save(self, path: Path) -> None:
        """Write the arrays; whoever calls sees to it that nothing is left half-written."""
        box = self.bounds
        write_npz(
            path,
            {
                "told": self.told,
                "mean": self.mean,
                "covariance": self.covariance,
                "names": np.array(self.names, str),
                "least": self.least,
                "bounds_mass": box.mass,
                "bounds_com": box.com,
                "bounds_inertia": box.inertia,
                "bounds_total_mass": np.array(
                    [-np.inf, np.inf] if box.total_mass is None else box.total_mass
                ),
                "carried": self.carried,
                "noise": self.noise,
            },
        )

    @classmethod
    def load(cls, folder: str | Path) -> "Posterior":
        """The inverse of `save`, from the folder of a result.

        Raises:
            InputError: there is none, or not as it was written.
        """
        path = Path(folder) / FILE
        if not path.is_file():
            raise InputError(
                f"{path}: is not there; it holds what an ensemble is drawn from: run retrieve (on what identify"
                " wrote, with standard deviations) or diagnose again"
            )
        arrays = inputs.read_npz(path)
        try:
            total = np.asarray(arrays["bounds_total_mass"], float)
            found = cls(
                told=np.asarray(arrays["told"], float),
                mean=np.asarray(arrays["mean"], float),
                covariance=np.asarray(arrays["covariance"], float),
                names=tuple(str(name) for name in arrays["names"]),
                least=np.asarray(arrays["least"], float),
                bounds=Bounds(
                    *(np.asarray(arrays[f"bounds_{name}"], float) for name in ("mass", "com", "inertia")),
                    total_mass=total if np.isfinite(total).all() else None,
                ),
                carried=np.asarray(arrays["carried"], float),
                noise=np.asarray(arrays["noise"], float),
            )
            found._check()
        except InputError:
            raise
        except (KeyError, TypeError, ValueError, IndexError) as error:
            raise InputError(
                f"{path}: is not as it was written ({error}); retrieve or diagnose again"
            ) from None
        return found

    def _check(self) -> None:
        rows, columns = self.told.shape
        wanted = {
            "told": (rows, 10 * self.dof + len(self.names)),
            "mean": (rows,),
            "covariance": (rows, rows),
            "least": (columns - 10 * self.dof,),
            "carried": (self.dof, 10),
            "noise": (self.dof,),
        }
        for name, shape in wanted.items():
            values = getattr(self, name)
            if values.shape != shape or (name != "least" and not np.isfinite(values).all()):
                raise ValueError(f"{name} must hold {' x '.join(map(str, shape))} finite numbers")


def named(kinds: Sequence[str], dof: int) -> tuple[str, ...]:
    """Names of unknowns that every joint has, all of joint 1 first."""
    return tuple(f"{kind}_{joint + 1}" for joint in range(dof) for kind in kinds)
