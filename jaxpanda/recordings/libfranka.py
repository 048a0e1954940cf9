"""What libfranka and panda-py call the columns of a Franka arm's state, and what they mean.

`tau_J` is measured at the links, gravity included (libfranka's `RobotState`); `tau_J_d` is commanded, without
gravity; `tau_ext_hat_filtered` is what the arm's own model leaves of `tau_J`.
"""

from .table import MEASURED, Source

LIBFRANKA = Source(
    "libfranka's log (franka::logToCSV)",
    {"time": "time:ms", "q": "state.q[{j}]", "dq": "state.dq[{j}]", "tau": "state.tau_J[{j}]"},
    "measured",
    f"state.tau_J is the {MEASURED}; cmd.tau_J_d is commanded, without gravity",
    {"cmd.tau_J_d[{j}]": "commanded"},
)
PANDA_PY = Source(
    "panda-py's log (Panda.get_log)",
    {"time": "time:ms", "q": "q_{j}", "dq": "dq_{j}", "tau": "tau_J_{j}"},
    "measured",
    f"tau_J is the {MEASURED}; tau_ext_hat_filtered is what the arm's own model leaves of it",
    marks=("tau_J_{j}",),
)
PANDA_PY_ARRAYS = Source(
    PANDA_PY.name,
    {"time": "time:ms", "q": "q", "dq": "dq", "tau": "tau_J"},
    PANDA_PY.torque,
    PANDA_PY.says,
    marks=("tau_J",),
)
"""The same as arrays, as `numpy.savez(file, **panda.get_log())` leaves them."""
