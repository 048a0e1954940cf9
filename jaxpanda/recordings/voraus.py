"""What voraus calls the columns of its robots' records (voraus-AD), and what they mean.

Every joint has two torque sensors behind its gear, and torque by the motor's current before it; episodes stand
one below the other, numbered by `sample`.
"""

from .table import Source

VORAUS = Source(
    "voraus' record of a robot",
    {
        "time": "time",
        "q": "joint_position_{j}",
        "dq": "joint_velocity_{j}",
        "tau": "torque_sensor_a_{j}",
        "tau_motor": "motor_torque_{j}",
    },
    "measured",
    "torque_sensor_a and torque_sensor_b measure the joint's torque, gravity included; motor_torque is the "
    "motors', friction of the gears included; target_torque is commanded, computed_torque a model's",
    {"motor_torque_{j}": "motor_side", "target_torque_{j}": "commanded"},
    marks=("torque_sensor_a_1", "sample"),
    episode="sample",
)
