"""What Universal Robots' real-time data (RTDE) and drivers call a joint's channels, and what they mean.

No field of RTDE is a measured joint torque. `effort` of the ROS driver was the motor's current [A] until July
2026 (its pull request 1551) and is a torque without gravity since, where the controller offers one (PolyScope
5.23, 10.11).
"""

from .table import Source

RTDE = Source(
    "UR's real-time data (RTDE)",
    {"time": "timestamp", "q": "actual_q_{j}", "dq": "actual_qd_{j}"},
    "unstated",
    "no column is the measured joint torque: actual_current is the motors' [A], target_moment is commanded, "
    "actual_current_as_torque has no gravity; to take one all the same, say --columns tau=actual_current_{j}",
    {
        "actual_current_{j}": "current",
        "target_moment_{j}": "commanded",
        "actual_current_as_torque_{j}": "gravity_removed",
    },
)
JOINTS = (
    "shoulder_pan_joint",
    "shoulder_lift_joint",
    "elbow_joint",
    "wrist_1_joint",
    "wrist_2_joint",
    "wrist_3_joint",
)
"""From the base on; the driver publishes them in the order of the alphabet."""
EFFORT = (
    "UR's driver writes the motors' current [A] into effort, or since July 2026 a torque without gravity: "
    "neither is the measured joint torque with gravity"
)
