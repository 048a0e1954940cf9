"""The command `predict`: from files to a file."""

import dataclasses
import re
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from ..convention import PLAIN, Convention
from ..corrected import XML, read
from ..errors import InputError
from ..files import output_file, write_text
from ..reading import Reading
from ..recordings import load
from .predict import predict_sides


@dataclasses.dataclass(frozen=True)
class Prediction:
    """Torque of a motion, and where it was written."""

    path: Path
    rows: int
    joints: tuple[str, ...]
    unit: str
    """Of torque; of force too where joints slide."""
    rms: tuple[float, ...]
    """Of each joint's torque."""
    rmse: tuple[float, ...] | None = None
    """Of each joint against the torque that the motion's file has, noise included; None where it has none."""
    relative_error_percent: float | None = None
    """Norm of that error over the norm of the recorded torque."""
    rmse_motor: tuple[float, ...] | None = None
    """The same of the motors' torque, where the diagnosis was of both and the file has it."""

    def to_json(self) -> dict[str, Any]:
        return {
            "schema": "jaxpanda.prediction/1",
            "path": str(self.path),
            "rows": self.rows,
            "joints": list(self.joints),
            "rms": list(self.rms),
            "rmse": None if self.rmse is None else list(self.rmse),
            "relative_error_percent": self.relative_error_percent,
            "rmse_motor": None if self.rmse_motor is None else list(self.rmse_motor),
        }


_OWN = re.compile(rb"time(,tau_\d+)+(,tau_motor_\d+)*\n")  # no recording has torque and no position


def predict_files(
    diagnosis: Path,
    recording: Path,
    out: Path,
    reading: Reading | None = None,
    convention: Convention = PLAIN,
) -> Prediction:
    """`jaxpanda predict`: torque, and where the motion has torque recorded, how far it is off."""
    if out.suffix.lower() != ".csv":
        raise InputError(f"{out}: a name ending in .csv is needed")
    if convention.mounting is not None:
        raise InputError(f"--gravity: {XML} has its gravity already; give it to the command diagnose")
    (motion,) = convention.applied([load(recording, reading=reading)], diagnosis / XML)
    arm = read(diagnosis)[0].arm
    tau, motors = predict_sides(diagnosis, motion)
    columns = {"tau": tau} | ({} if motors is None else {"tau_motor": motors})
    head = ",".join(["time", *(f"{name}_{j + 1}" for name, x in columns.items() for j in range(x.shape[1]))])
    stamps = motion.time if motion.stamps is None else motion.stamps
    table = np.column_stack([stamps, *columns.values()]).tolist()
    with output_file(out, lambda content: _OWN.match(content) is not None) as file:
        write_text(file, "\n".join([head, *(",".join(map(repr, row)) for row in table)]) + "\n")
    made = Prediction(out, len(tau), arm.joint_names, arm.unit("N·m"), _rms(tau))
    if motors is not None and motion.tau_motor is not None:
        made = dataclasses.replace(made, rmse_motor=_rms(motors - motion.tau_motor))
    if motion.tau is None:
        return made
    error, size = tau - motion.tau, float(np.linalg.norm(motion.tau))
    share = 100 * float(np.linalg.norm(error)) / size if size else None
    return dataclasses.replace(made, rmse=_rms(error), relative_error_percent=share)


def _rms(torque: Float[np.ndarray, "rows dof"]) -> tuple[float, ...]:
    return tuple(np.sqrt(np.mean(torque**2, 0)).tolist())
