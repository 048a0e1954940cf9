"""Which time steps an ensemble's controller bears: one arm for ten seconds in MuJoCo's C engine, float64.

    python experiments/speed/stable.py

The gain on velocity once as a torque held for a step, once as the model's own damping, which the integrator takes
implicitly. The first is stable while the largest eigenvalue of M⁻¹ K dt is below 2.
"""

import mujoco
import numpy as np
from gpu import AMPLITUDE, DAMPING, FREQUENCY, STIFFNESS

from jaxpanda.arms.export import panda_mjcf


def largest_error(time_step: float, as_damping: bool, seconds: float = 10.0) -> tuple[float, float]:
    """Largest error of position [rad], infinite where the engine gave up; largest eigenvalue of M⁻¹ K dt."""
    model = mujoco.MjModel.from_xml_string(panda_mjcf())
    model.opt.timestep, model.opt.integrator = time_step, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    if as_damping:
        model.dof_damping[:] = DAMPING
    data, middle = mujoco.MjData(model), model.jnt_range.mean(1)
    speed = 2 * np.pi * FREQUENCY
    data.qpos[:], data.qvel[:] = middle, AMPLITUDE * speed
    mujoco.mj_forward(model, data)
    M = np.zeros((7, 7))
    for row, unit in zip(M, np.eye(7), strict=True):
        mujoco.mj_mulM(model, data, row, unit)
    eigenvalue = float(np.linalg.eigvals(np.linalg.solve(M, np.diag(DAMPING))).real.max() * time_step)
    worst = 0.0
    for k in range(round(seconds / time_step)):
        phase = speed * k * time_step
        q, qd = middle + AMPLITUDE * np.sin(phase), AMPLITUDE * speed * np.cos(phase)
        worst = max(worst, float(np.abs(q - data.qpos).max()))
        damped = np.array(DAMPING) * (qd if as_damping else qd - data.qvel)
        data.qfrc_applied[:] = np.array(STIFFNESS) * (q - data.qpos) + damped + data.qfrc_bias
        mujoco.mj_step(model, data)
        if data.warning[mujoco.mjtWarning.mjWARN_BADQACC].number:
            return np.inf, eigenvalue
    return worst, eigenvalue


def main() -> None:
    for as_damping in (False, True):
        for time_step in (1e-3, 2e-3):
            worst, eigenvalue = largest_error(time_step, as_damping)
            how = "the model's damping" if as_damping else "a torque"
            print(
                f"{1e3 * time_step:.0f} ms, {how}: largest error {worst:.3g} rad; M⁻¹ K dt {eigenvalue:.2f}"
            )


if __name__ == "__main__":
    main()
