"""Torque that sensors would measure in a motion, by what a diagnosis found."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..corrected import Corrected, read, read_sides
from ..effects import AbstractEffect
from ..errors import require_x64
from ..recordings import Recording, load
from ..traces import Trace, Trajectory, trajectory


def predict(
    folder: str | Path, motion: str | Path | Recording, *, effects: Sequence[type[AbstractEffect]] = ()
) -> Float[np.ndarray, "rows dof"]:
    """Torque [N m] that the sensors would measure, for each row of a motion, from what `diagnose` saved.

    Args:
        folder: that `diagnose` wrote.
        motion: of the arm.
        effects: classes of your own that `diagnose` was given.

    Raises:
        InputError: no saved diagnosis in the folder, a motion of another arm, or an effect of an unknown class.
    """
    return predict_sides(folder, motion, effects=effects)[0]


def predict_sides(
    folder: str | Path, motion: str | Path | Recording, *, effects: Sequence[type[AbstractEffect]] = ()
) -> tuple[Float[np.ndarray, "rows dof"], Float[np.ndarray, "rows dof"] | None]:
    """`predict`, and the torque of the motors [N m] where the diagnosis was of both; else None."""
    require_x64("a prediction")
    recording = motion if isinstance(motion, Recording) else load(motion)
    sides = read_sides(folder, effects)
    corrected, _ = sides[0] if sides else read(folder, effects)
    recording.require_dof(corrected.arm.dof)
    drives = sides[1][0].for_motion(recording)[0] if sides else None
    corrected, recording = corrected.for_motion(recording)
    trace, torque = predicted(trajectory(recording.of_link_side()), corrected)
    tau = at_rows(recording, trace.motion.time, torque)
    if drives is None:
        return tau, None
    passed = passed_on(corrected, recording, tau)
    view = dataclasses.replace(recording, tau=None, tau_motor=None, transmitted=passed)
    trace, torque = predicted(trajectory(view), drives)
    return tau, at_rows(recording, trace.motion.time, torque)


def passed_on(
    links: Corrected, recording: Recording, tau: Float[np.ndarray, "rows dof"]
) -> Float[np.ndarray, "rows dof"]:
    """Torque behind the drives in a recording, what the sensors there add to it taken off [N m]."""
    return np.asarray(links.plant(recording.name).true(jnp.asarray(recording.time), jnp.asarray(tau)))


def predicted(
    moved: Trajectory, corrected: Corrected, recordings: Sequence[str] | None = None
) -> tuple[Trace, Float[np.ndarray, "time dof"]]:
    """A motion on the grid of a prediction, and the torque there [N m]; `recordings` as in
    `Corrected.measured_torque`."""
    out: dict[float | None, tuple[Trace, np.ndarray]] = {}
    cutoffs = corrected.cutoffs or (None,) * corrected.arm.dof
    for cutoff in dict.fromkeys(cutoffs):
        trace = moved.trace(corrected.arm, corrected.turns, np.inf if cutoff is None else cutoff)
        trace = trace.showing(corrected.friction_shown)
        out[cutoff] = trace, corrected.measured_torque(trace.motion, trace.channels, trace.sign, recordings)
    torque = np.stack([out[cutoff][1][:, joint] for joint, cutoff in enumerate(cutoffs)], 1)
    return out[cutoffs[0]][0], torque


def at_rows(
    recording: Recording, time: Float[np.ndarray, " time"], torque: Float[np.ndarray, "time dof"]
) -> Float[np.ndarray, "rows dof"]:
    """Torque on a grid, for each row of a recording."""
    return np.stack([np.interp(recording.time, time, column) for column in torque.T], 1)
