"""The frame in which a body at the flange is told."""

import dataclasses

import mujoco
import numpy as np
from jaxtyping import Float

from ..arms.mjcf import MjcfSource
from ..errors import InputError

NAMES = ("flange", "attachment_site", "tool0", "link8", "attachment", "ee_link")
"""What bodies and sites at a flange are called in the files of Panda, UR, Kinova and others, the surest first."""


@dataclasses.dataclass(frozen=True)
class Frame:
    """A frame fixed to the last link, as a pose in the MJCF body of that link."""

    name: str
    body: str
    """The last link's body."""
    R: Float[np.ndarray, "3 3"]
    p: Float[np.ndarray, "3"]
    """[m]"""
    R_link: Float[np.ndarray, "3 3"]
    """The same as a pose in the last link's frame (`jaxpanda.arms.mjcf`), in which dynamics are computed."""
    p_link: Float[np.ndarray, "3"]

    @property
    def says(self) -> str:
        if self.name == self.body:
            return f"the frame of the MJCF body {self.body!r}, the arm's last link (its origin and axes)"
        at = ", ".join(f"{v + 0.0:.4g}" for v in np.round(self.p, 9))
        turned = "" if np.allclose(self.R, np.eye(3), atol=1e-6) else ", turned against it"
        return f"the frame of {self.name!r}, at ({at}) m in the last link's MJCF body {self.body!r}{turned}"


def frame_of(source: MjcfSource, name: str = "") -> Frame:
    """The frame called `name`; without a name, of what is called a flange, or the last link's body.

    Raises:
        InputError: nothing of that name, or it is not fixed to the last link.
    """
    model, link = source.model, source.links[-1]
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    fixed = {link.body: (data.xmat[link.body_id].reshape(3, 3), data.xpos[link.body_id])}
    last = _welded(model, link.body_id)
    for b in range(1, model.nbody):
        if model.body(b).name and _welded(model, b) == last:
            fixed.setdefault(model.body(b).name, (data.xmat[b].reshape(3, 3), data.xpos[b]))
    for s in range(model.nsite):
        if model.site(s).name and _welded(model, int(model.site_bodyid[s])) == last:
            fixed.setdefault(model.site(s).name, (data.site_xmat[s].reshape(3, 3), data.site_xpos[s]))
    if name and name not in fixed:
        raise InputError(
            f"--frame: {name!r} is no body or site fixed to the last link of {source.path}; there are "
            f"{', '.join(fixed)}"
        )
    called = [n for want in NAMES for n in fixed if n == want or n.endswith((f"_{want}", f"/{want}"))]
    name = name or (called[0] if called else link.body)
    R_wb, p_wb = fixed[link.body]
    R_w, p_w = fixed[name]
    R, p = R_wb.T @ R_w, R_wb.T @ (p_w - p_wb)
    return Frame(name, link.body, R, p, link.R.T @ R, link.R.T @ (p - link.p))


def _welded(model: mujoco.MjModel, body: int) -> int:
    return int(model.body_weldid[body])
