"""A designed motion: what it tells, what was checked, and the files that a robot takes."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from ..arms.arm import Arm
from ..files import Kind, finite, output_folder, write_json, write_text
from ..parameters import Base
from ..simulation import FourierTrajectory
from ..workspace.limits import Limits
from ..workspace.scene import Closest
from .design import Found

SCHEMA = "jaxpanda.excitation/1"
FILE, CSV, ROS, UR = "excitation.json", "excitation.csv", "joint_trajectory.yaml", "excitation.script"
KIND = Kind("excite", (FILE, CSV, ROS))
_ROS_RATE, _UR_RATE = 100.0, 125.0
"""Of the joint trajectory, between whose points controllers interpolate, and of `servoj` [Hz]."""


@dataclasses.dataclass(frozen=True)
class Check:
    """What a motion takes of its limits, at 1 kHz."""

    low: Float[np.ndarray, " dof"]
    """Positions reached [rad, m]."""
    high: Float[np.ndarray, " dof"]
    peaks: Mapping[str, Float[np.ndarray, " dof"]]
    """Largest velocity, acceleration, jerk, torque."""
    between: Float[np.ndarray, " dof"]
    """By how much a position can at most exceed these between two samples [rad, m]."""
    closest: Closest
    failed: str
    """The first thing that is wrong; empty where all is well."""

    def to_json(self) -> dict[str, Any]:
        return {
            "rate": 1000.0,
            "low": self.low.tolist(),
            "high": self.high.tolist(),
            **{name: values.tolist() for name, values in self.peaks.items()},
            "position_between_samples": self.between.tolist(),
            "closest": self.closest.to_json(),
        }


@dataclasses.dataclass(frozen=True)
class Precision:
    """What recordings of a motion would tell."""

    base: Float[np.ndarray, " base"]
    """Standard deviation of each base parameter, in its unit; infinite where nothing tells it."""
    friction: Mapping[str, Float[np.ndarray, " dof"]]
    """Of each friction parameter."""
    conditions: Mapping[str, float]
    """Condition numbers of the regressor: of the base parameters and with friction columns, joints alike and
    weighted by their torque noise."""
    log_det: float
    """Of the information."""


@dataclasses.dataclass(frozen=True)
class Excitation:
    """A motion to record."""

    arm: Arm
    model_file: str
    trajectory: FourierTrajectory
    seconds: float
    rate: float
    """Of the CSV [Hz]."""
    criterion: str
    base: Base
    sigma: Float[np.ndarray, " dof"]
    """Torque noise that was reckoned with [N m]."""
    precision: Precision
    before: Precision | None
    """What was known before."""
    limits: Limits
    share: float
    margin: float
    clearance: float
    check: Check
    found: Found
    chosen: int
    seed: int
    notes: tuple[str, ...]

    def sampled(self, rate: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Time, position, velocity and acceleration, the end included."""
        time = np.linspace(0.0, self.seconds, round(self.seconds * rate) + 1)
        return time, *self.trajectory(time)

    def to_json(self) -> dict[str, Any]:
        """As `excitation.json` holds it."""
        known = self.before
        parameters = [
            {
                "expression": text,
                "terms": terms,
                "nominal": float(nominal),
                "std": finite(self.precision.base[i]),
                **({} if known is None else {"std_before": finite(known.base[i])}),
            }
            for i, (text, terms, nominal) in enumerate(
                zip(self.base.expressions, self.base.terms, self._nominal(), strict=True)
            )
        ]
        friction = [
            {
                "joint": j + 1,
                "std": {name: finite(values[j]) for name, values in self.precision.friction.items()},
            }
            for j in range(self.arm.dof)
        ]
        files = [CSV, ROS, *([UR] if self._for_ur() else [])]
        return {
            "schema": SCHEMA,
            "arm": self.arm.name,
            "model_file": self.model_file or None,
            "seconds": self.seconds,
            "rate": self.rate,
            "criterion": self.criterion,
            "condition_number": dict(self.precision.conditions),
            "log_det": self.precision.log_det,
            "torque_noise": self.sigma.tolist(),
            "parameters": parameters,
            "friction": friction,
            "trajectory": {
                "equation": "q_j(t) = q0_j + sum_l a_jl/(l w) sin(l w t) - b_jl/(l w) cos(l w t)",
                "w": self.trajectory.w,
                "a": self.trajectory.a.tolist(),
                "b": self.trajectory.b.tolist(),
                "q0": self.trajectory.q0.tolist(),
            },
            "joints": list(self.arm.joint_names),
            "limits": {**self.limits.to_json(), "share": self.share, "margin": self.margin},
            "clearance": self.clearance,
            "check": self.check.to_json(),
            "starts": {
                "objective": [finite(v) for v in self.found.f],
                "violation": [finite(v) for v in self.found.violation],
                "chosen": self.chosen,
                "seed": self.seed,
            },
            "files": files,
            "notes": list(self.notes),
        }

    def _nominal(self) -> Float[np.ndarray, " base"]:
        return self.base.projection @ np.asarray(self.arm.standard).ravel()

    def _for_ur(self) -> bool:
        return self.arm.dof == 6 and not np.any(np.asarray(self.arm.chain.prismatic))

    def save(self, folder: str | Path) -> Path:
        """Write `excitation.json` and what robots take; all or nothing."""
        with output_folder(folder, KIND) as scratch:
            write_text(scratch / CSV, self.csv())
            write_text(scratch / ROS, self.joint_trajectory())
            if self._for_ur():
                write_text(scratch / UR, self.ur_script())
            write_json(scratch / FILE, self.to_json())
        return Path(folder) / FILE

    def csv(self) -> str:
        """The motion as a canonical CSV without torque."""
        time, q, qd, _ = self.sampled(self.rate)
        dof = self.arm.dof
        head = ",".join(["time", *(f"q_{j + 1}" for j in range(dof)), *(f"dq_{j + 1}" for j in range(dof))])
        rows = np.column_stack([time, q, qd])
        return "\n".join([head, *(",".join(f"{v:.9g}" for v in row) for row in rows.tolist())]) + "\n"

    def joint_trajectory(self) -> str:
        """A trajectory_msgs/JointTrajectory, as YAML."""
        time, *states = self.sampled(_ROS_RATE)
        lines = [f"joint_names: [{', '.join(self.arm.joint_names)}]", "points:"]
        for k, t in enumerate(time):
            nanoseconds = round(t * 1e9)
            fields = [
                f"{name}: [{', '.join(f'{v:.9f}' for v in values[k])}]"
                for name, values in zip(("positions", "velocities", "accelerations"), states, strict=True)
            ]
            start = f"time_from_start: {{sec: {nanoseconds // 10**9}, nanosec: {nanoseconds % 10**9}}}"
            lines.append(f"- {{{', '.join([*fields, start])}}}")
        return "\n".join(lines) + "\n"

    def ur_script(self) -> str:
        """A URScript program: slowly to the first pose, then the motion by `servoj`."""
        _, q, _, _ = self.sampled(_UR_RATE)

        def pose(row: np.ndarray) -> str:
            return "[" + ", ".join(f"{v:.6f}" for v in row) + "]"

        wait = f"t={1 / _UR_RATE:g}, lookahead_time=0.03, gain=300"
        lines = [
            "def jaxpanda_excitation():",
            f"  movej({pose(q[0])}, a=0.5, v=0.3)",
            "  sleep(1.0)",
            *(f"  servoj({pose(row)}, {wait})" for row in q[1:]),
            "  stopj(2.0)",
            "end",
        ]
        return "\n".join(lines) + "\n"
