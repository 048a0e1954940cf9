"""MJCF files as users have them, and MuJoCo's own inverse dynamics of their arms."""

import os
from pathlib import Path

import mujoco
import numpy as np

from jaxpanda.arms.mjcf import MjcfSource

MODELS = Path(__file__).parent / "models"
FILES = sorted(MODELS.glob("*.xml"))
REAL = [Path(path) for path in os.environ.get("JAXPANDA_THIRD_PARTY", "").split(os.pathsep) if path]
"""Real files of other projects, tested alike where this machine has them; none is part of this one."""
CASES = [*FILES, *REAL]


def chain_of(joints: str, *, before: str = "", after: str = "") -> str:
    """An MJCF with a two-body arm; `joints` stands in the outer body."""
    return f"""<mujoco>
  {before}
  <worldbody>
    <body name="one">
      <joint name="first" axis="0 0 1"/>
      <inertial pos="0 0 0.1" mass="2" diaginertia="0.02 0.02 0.01"/>
      <body name="two" pos="0 0 0.3">
        {joints}
        <inertial pos="0.1 0 0" mass="1" diaginertia="0.01 0.01 0.01"/>
      </body>
    </body>
  </worldbody>
  {after}
</mujoco>
"""


def random_states(source: MjcfSource, count: int = 20) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    q, qd, qdd = (rng.uniform(-s, s, (count, len(source.links))) for s in (3.0, 2.0, 5.0))
    return q, qd, qdd


def mujoco_torque(
    source: MjcfSource, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray, *, keep: tuple[str, ...] = ()
) -> np.ndarray:
    """Inverse dynamics of the arm's joints by `mj_inverse`.

    Without contacts, limits, constraints and gravcomp, and without frictionloss, which MuJoCo softens; `keep`
    leaves some of them on.
    """
    model, flags = source.model, mujoco.mjtDisableBit
    off = {"CONTACT", "LIMIT", "EQUALITY", "FRICTIONLOSS"} - set(keep)
    model.opt.disableflags |= sum(int(getattr(flags, f"mjDSBL_{name}")) for name in off)
    model.body_gravcomp[:] = 0
    data = mujoco.MjData(model)
    torques = []
    for state in zip(source.qpos(q), source.qvel(qd), source.qvel(qdd), strict=True):
        data.qpos[:], data.qvel[:], data.qacc[:] = state
        mujoco.mj_inverse(model, data)
        torques.append(data.qfrc_inverse[[link.dof for link in source.links]])
    return np.array(torques)
