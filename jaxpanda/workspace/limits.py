"""What an arm can do: ranges, velocity, acceleration, jerk and torque of its joints, and who says so."""

import dataclasses
import functools
import json
from collections.abc import Mapping, Sequence
from importlib import resources
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Bool, Float

from ..arms.arm import Arm
from ..arms.mjcf import MjcfSource
from ..errors import InputError
from ..files import finite

TURNING = {"velocity": 1.5, "acceleration": 5.0, "jerk": 50.0}
"""Of a joint that turns and of which nothing is known [rad/s, rad/s², rad/s³]: what collaborative arms do."""
SLIDING = {"velocity": 0.5, "acceleration": 2.0, "jerk": 20.0}
"""The same of one that slides [m/s, m/s², m/s³]."""
_REACH = {False: np.pi, True: 0.5}
"""Half range of a joint without a range [rad], of one that slides [m]."""
_ON_JOINT = int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT)
_SAME = 0.02
"""By which ranges [rad] and frames [-, m] may differ from the Panda's for an arm to be one."""


@functools.cache
def published() -> Mapping[str, Any]:
    """Limits and collision capsules of Franka's arms; `source` and `conventions` stand in it."""
    return json.loads(resources.files("jaxpanda").joinpath("published/franka.json").read_text("utf-8"))


@dataclasses.dataclass(frozen=True)
class Limits:
    """Of each joint; infinite where there is none."""

    lower: Float[np.ndarray, " dof"]
    """[rad; m where the joint slides]"""
    upper: Float[np.ndarray, " dof"]
    velocity: Float[np.ndarray, " dof"]
    """[rad/s]"""
    acceleration: Float[np.ndarray, " dof"]
    """[rad/s²]"""
    jerk: Float[np.ndarray, " dof"]
    """[rad/s³]"""
    torque: Float[np.ndarray, " dof"]
    """[N m]"""
    sources: Mapping[str, str]
    """Of each of these, by name: where it is from."""

    def within(self, margin: float, share: float) -> "Limits":
        """What is left `margin` [rad, m] from each end of the range and at a share of the others."""
        if not 0 < share <= 1:
            raise InputError(f"--share: {share:g}, where a share above 0 and up to 1 is expected")
        lower, upper = self.lower + margin, self.upper - margin
        if margin < 0 or np.any(lower >= upper):
            raise InputError(f"--margin: {margin:g} leaves nothing of a joint's range; a smaller one will")
        rates = {name: share * getattr(self, name) for name in ("velocity", "acceleration", "jerk", "torque")}
        return dataclasses.replace(self, lower=lower, upper=upper, **rates)

    def to_json(self) -> dict[str, Any]:
        names = ("lower", "upper", "velocity", "acceleration", "jerk", "torque")
        numbers = {name: [finite(v) for v in getattr(self, name)] for name in names}
        return {**numbers, "sources": dict(self.sources)}


def limits_of(arm: Arm, source: MjcfSource, given: Mapping[str, Sequence[float]]) -> Limits:
    """The limits of an arm.

    Args:
        arm: for its ranges.
        source: the file that it was read from, for the actuators' limits.
        given: by the user, one number for all joints or one a joint, by the names in `Limits`.

    Raises:
        InputError: a number that cannot be a limit, or as many as there are joints neither.
    """
    sources = {"range": f"of {source.path.name}"}
    slides = np.asarray(arm.chain.prismatic)
    half = np.where(slides, _REACH[True], _REACH[False])
    lower, upper = (np.asarray(x) for x in (arm.lower, arm.upper))
    if not np.all(np.isfinite([lower, upper])):
        sources["range"] += ", assumed where it has none"
    lower, upper = np.where(np.isfinite(lower), lower, -half), np.where(np.isfinite(upper), upper, half)
    values: dict[str, np.ndarray] = {}
    known = published()["panda"] if is_franka_panda(arm) else {}
    for name in ("velocity", "acceleration", "jerk"):
        values[name] = np.array(known.get(name, np.where(slides, SLIDING[name], TURNING[name])), float)
        sources[name] = "published by Franka for the Panda" if known else _assumed(name, slides)
    values["torque"] = actuator_limits(source)
    sources["torque"] = f"of the actuators in {source.path.name}"
    if known:
        values["torque"] = np.minimum(values["torque"], known["torque"])
        sources["torque"] = "published by Franka for the Panda"
    elif not np.all(np.isfinite(values["torque"])):
        sources["torque"] = f"none, where {source.path.name} limits no actuator"
    for name, numbers in given.items():
        if not len(numbers):
            continue
        if len(numbers) not in (1, arm.dof) or not all(np.isfinite(v) and v > 0 for v in numbers):
            raise InputError(
                f"--{name}: one positive number for all joints or {arm.dof}, one a joint, are expected"
            )
        values[name] = np.broadcast_to(np.array(numbers, float), arm.dof).copy()
        sources[name] = "given"
    return Limits(lower, upper, **values, sources=sources)


def _assumed(name: str, slides: Bool[np.ndarray, " dof"]) -> str:
    """What is said of a limit that nobody gave, by its name in `Limits`."""
    power = {"velocity": "", "acceleration": "²", "jerk": "³"}[name]
    turning, sliding = f"{TURNING[name]:g} rad/s{power}", f"{SLIDING[name]:g} m/s{power}"
    value = (
        sliding if slides.all() else turning if not slides.any() else f"{turning}, {sliding} where it slides"
    )
    return f"assumed, {value}; --{name} takes your arm's"


def is_franka_panda(arm: Arm) -> bool:
    """Whether an arm has the Panda's geometry beyond its base, and ranges no other Franka has."""
    own = Arm.panda()
    if arm.dof != own.dof:
        return False
    pairs = (
        (arm.chain.R[1:], own.chain.R[1:]),
        (arm.chain.p[1:], own.chain.p[1:]),
        (arm.lower, own.lower),
        (arm.upper, own.upper),
    )
    return all(np.allclose(a, b, atol=_SAME) for a, b in pairs)


def actuator_limits(source: MjcfSource) -> Float[np.ndarray, " dof"]:
    """Torque that actuators and joints of an MJCF allow [N m]; infinite where they do not say."""
    model, out = source.model, np.full(len(source.links), np.inf)
    for k, link in enumerate(source.links):
        if model.jnt_actfrclimited[link.joint_id]:
            out[k] = np.abs(model.jnt_actfrcrange[link.joint_id]).min()
        for a in range(model.nactuator):
            if model.actuator_trntype[a] not in _ON_JOINT or model.actuator_trnid[a, 0] != link.joint_id:
                continue
            gear = abs(model.actuator_gear[a, 0])
            if model.actuator_forcelimited[a]:
                out[k] = min(out[k], gear * np.abs(model.actuator_forcerange[a]).min())
            fixed = model.actuator_gaintype[a] == int(mujoco.mjtGain.mjGAIN_FIXED)
            unbiased = model.actuator_biastype[a] == int(mujoco.mjtBias.mjBIAS_NONE)
            if model.actuator_ctrllimited[a] and fixed and unbiased:
                force = abs(model.actuator_gainprm[a, 0]) * np.abs(model.actuator_ctrlrange[a]).min()
                out[k] = min(out[k], gear * force)
    return np.where(out > 0, out, np.inf)
