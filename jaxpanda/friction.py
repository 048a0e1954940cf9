r"""Friction of the joints as functions of velocity.

| model | torque of one joint |
|---|---|
| `none` | 0 |
| `viscous` | $F_v \dot q$ |
| `coulomb_viscous` | $F_v \dot q + F_c\,\mathrm{sign}(\dot q)$ |
| `coulomb_viscous_offset` | $F_v \dot q + F_c\,\mathrm{sign}(\dot q) + F_o$ |
| `sigmoid` | $\varphi_1\,(\sigma(\varphi_2(\dot q + \varphi_3)) - \sigma(\varphi_2\varphi_3))$ |

with $\sigma(x) = 1/(1 + e^{-x})$. The sigmoid is eq. 25 of Gaz et al. 2019: its offset is tied, so that the
torque is zero at rest. Friction is part of the joint torque that inverse dynamics must reproduce, hence
positive where the velocity is.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .errors import InputError

LINEAR: Mapping[str, tuple[str, ...]] = {
    "none": (),
    "viscous": ("viscous",),
    "coulomb_viscous": ("viscous", "coulomb"),
    "coulomb_viscous_offset": ("viscous", "coulomb", "offset"),
}
"""Models that are linear in their parameters, and those parameters in the order of `columns`."""

SIGMOID = ("phi1", "phi2", "phi3")
MODELS: Mapping[str, tuple[str, ...]] = {**LINEAR, "sigmoid": SIGMOID}

UNITS = {
    "viscous": "N m s/rad",
    "coulomb": "N m",
    "offset": "N m",
    "phi1": "N m",
    "phi2": "s/rad",
    "phi3": "rad/s",
}
_HELD_AS = {"viscous": "damping", "coulomb": "frictionloss"}
"""Parameters that are not negative in a joint that takes energy out, and what they are in a model."""

_COLUMN = {"viscous": lambda qd: qd, "coulomb": jnp.sign, "offset": jnp.ones_like}


def least_beyond(
    names: Sequence[str], known: Mapping[str, Float[np.ndarray, " dof"]], dof: int
) -> Float[np.ndarray, "dof names"]:
    """Lower bounds of a law's parameters beside a model that holds some friction (`Arm.damping`, `frictionloss`):
    what brakes a joint in all is not negative, so that a model with too much may be told to have less."""
    least = np.full((dof, len(names)), -np.inf)
    for k, name in enumerate(names):
        if name in _HELD_AS:
            least[:, k] = -np.maximum(known.get(_HELD_AS[name], np.zeros(dof)), 0.0)
        elif name == "phi1":
            least[:, k] = 0.0
    return least


def linear(model: str) -> tuple[str, ...]:
    """The parameters that a model is linear in."""
    return ("phi1",) if model == "sigmoid" else LINEAR[model]


def check_model(model: str) -> None:
    """Refuse a name that is none of `MODELS`."""
    if model not in MODELS:
        raise InputError(f"unknown friction model {model!r}; there are {', '.join(MODELS)}")


def columns(model: str, qd: Float[Array, "*shape"]) -> Float[Array, "*shape parameters"]:
    """What each parameter of a linear model multiplies, at joint velocities `qd` [rad/s]."""
    parts = [_COLUMN[parameter](qd) for parameter in LINEAR[model]]
    return jnp.stack(parts, -1) if parts else jnp.zeros((*qd.shape, 0), qd.dtype)


def sigmoid(
    qd: Float[Array, "*shape"], phi2: Float[Array, "*#shape"], phi3: Float[Array, "*#shape"]
) -> Float[Array, "*shape"]:
    """The sigmoid of eq. 25 for a unit `phi1`: zero at rest, rising by one from end to end."""
    return jax.nn.sigmoid(phi2 * (qd + phi3)) - jax.nn.sigmoid(phi2 * phi3)


@dataclasses.dataclass(frozen=True)
class Friction:
    """A friction model with one value of each of its parameters a joint."""

    model: str
    parameters: Mapping[str, Float[np.ndarray, " dof"]]
    """By the names in `MODELS[model]`, units in `UNITS`."""
    std: Mapping[str, Float[np.ndarray, " dof"]] | None = None
    """Standard deviation of each; not a number where the recording does not tell."""

    def __post_init__(self):
        check_model(self.model)
        if set(self.parameters) != set(MODELS[self.model]):
            raise InputError(
                f"friction model {self.model!r} has parameters {', '.join(MODELS[self.model]) or 'none'},"
                f" not {', '.join(self.parameters) or 'none'}"
            )

    @property
    def viscous(self) -> Float[np.ndarray, " dof"]:
        """[N m s/rad]; zeros where the model has none."""
        return self._or_zero("viscous")

    @property
    def coulomb(self) -> Float[np.ndarray, " dof"]:
        """[N m]; zeros where the model has none."""
        return self._or_zero("coulomb")

    @property
    def offset(self) -> Float[np.ndarray, " dof"]:
        """[N m]; zeros where the model has none."""
        return self._or_zero("offset")

    def _or_zero(self, name: str) -> np.ndarray:
        dof = len(next(iter(self.parameters.values()), ()))
        return np.asarray(self.parameters.get(name, np.zeros(dof)))

    def torque(self, qd: Float[Array, "*time dof"]) -> Float[Array, "*time dof"]:
        """Friction torque [N m] at joint velocities [rad/s]."""
        if self.model == "sigmoid":
            phi1, phi2, phi3 = (jnp.asarray(self.parameters[name]) for name in SIGMOID)
            phi2, phi3 = jnp.broadcast_to(phi2, qd.shape), jnp.broadcast_to(phi3, qd.shape)
            return phi1 * sigmoid(qd, phi2, phi3)
        values = [jnp.asarray(self.parameters[name]) for name in LINEAR[self.model]]
        weights = jnp.stack(values, -1) if values else jnp.zeros((qd.shape[-1], 0), qd.dtype)
        return jnp.sum(columns(self.model, qd) * weights, -1)

    def to_json(self) -> list[dict[str, Any]]:
        """One entry a joint, as `identification.json` holds them."""
        entries = []
        for joint in range(len(next(iter(self.parameters.values()), ()))):
            entry: dict[str, Any] = {
                "joint": joint + 1,
                "model": self.model,
                "parameters": {name: float(self.parameters[name][joint]) for name in MODELS[self.model]},
            }
            if self.std is not None:
                deviations = {name: float(values[joint]) for name, values in self.std.items()}
                entry["std"] = {
                    name: value if np.isfinite(value) else None for name, value in deviations.items()
                }
            entries.append(entry)
        return entries

    @classmethod
    def from_json(cls, entries: Sequence[Any], *, where: str = "friction") -> "Friction":
        """The inverse of `to_json`.

        Raises:
            InputError: no list of one entry a joint, of one known model, with finite numbers.
        """
        if not entries:
            return cls("none", {})
        for row, entry in enumerate(entries):
            if not isinstance(entry, Mapping) or not isinstance(entry.get("parameters"), Mapping):
                raise InputError(f"{where}[{row}]: needs 'joint', 'model' and 'parameters'")
            if entry.get("joint") != row + 1:
                raise InputError(f"{where}[{row}].joint: {entry.get('joint')!r}, where {row + 1} is expected")
            if entry.get("model") != entries[0].get("model"):
                raise InputError(
                    f"{where}[{row}].model: {entry.get('model')!r}; one model for all joints is expected"
                )
        model = entries[0]["model"]
        check_model(model)
        return cls(
            model,
            {name: _numbers(entries, "parameters", name, where) for name in MODELS[model]},
            {name: _numbers(entries, "std", name, where) for name in MODELS[model]}
            if "std" in entries[0]
            else None,
        )


def _numbers(entries: Sequence[Mapping[str, Any]], field: str, name: str, where: str) -> np.ndarray:
    values = np.empty(len(entries))
    for row, entry in enumerate(entries):
        table = entry.get(field)
        value = table.get(name, "nothing") if isinstance(table, Mapping) else "nothing"
        if value is None and field == "std":
            value = np.nan
        elif isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
            raise InputError(f"{where}[{row}].{field}.{name}: {value!r} is no finite number")
        values[row] = value
    return values
