"""What MuJoCo has to say while it reads a model."""

# MuJoCo's names come from a compiled module without stubs.
import contextlib
from collections.abc import Iterator

import mujoco


@contextlib.contextmanager
def own_log() -> Iterator[list[str]]:
    """What MuJoCo warns of; it would write that to a file in the folder that it was called from."""
    said: list[str] = []
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(said.append)
    try:
        yield said
    finally:
        mujoco.set_mju_user_warning(before)
