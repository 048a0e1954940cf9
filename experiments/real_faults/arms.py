"""The recorded arms as MJCF, from the Denavit-Hartenberg parameters and masses that their makers publish."""

import numpy as np

HALF = 0.5 * np.pi


def classic_dh(name, a, d, alpha, mass, com, gyration, note="") -> str:
    """A serial arm by classic DH parameters. `com` is in the frame at the far end of each link [m].

    A body stands where its joint turns, so that a link's own DH frame is a step further. Links have a radius of
    gyration [m] that nobody published: a guess, which the references correct.
    """
    text = lambda values: " ".join(f"{v:.9g}" for v in values)
    lines = [f"<!-- {note} -->"] if note else []
    lines += [f'<mujoco model="{name}">', '  <compiler angle="radian"/>']
    lines += ['  <option gravity="0 0 -9.81"/>', "  <worldbody>"]
    pos, quat = np.zeros(3), np.array([1.0, 0, 0, 0])
    for i in range(len(a)):
        end, half = np.array([a[i], 0, d[i]]), 0.5 * alpha[i]
        c, s = np.cos(alpha[i]), np.sin(alpha[i])
        at = end + np.array([[1, 0, 0], [0, c, -s], [0, s, c]]) @ np.asarray(com[i], float)
        moment = mass[i] * gyration[i] ** 2
        pad = "  " * (i + 2)
        lines += [
            f'{pad}<body name="link{i + 1}" pos="{text(pos)}" quat="{text(quat)}">',
            f'{pad}  <inertial mass="{mass[i]:.9g}" pos="{text(at)}" diaginertia="{text([moment] * 3)}"/>',
            f'{pad}  <joint name="joint{i + 1}" axis="0 0 1"/>',
        ]
        pos, quat = end, np.array([np.cos(half), np.sin(half), 0, 0])
    pad = "  " * (len(a) + 2)
    lines.append(f'{pad}<site name="flange" pos="{text(pos)}" quat="{text(quat)}"/>')
    lines += ["  " * (i + 2) + "</body>" for i in reversed(range(len(a)))]
    return "\n".join([*lines, "  </worldbody>", "</mujoco>", ""])


# universal-robots.com, "DH Parameters for calculations of kinematics and dynamics"
UR_ALPHA = (HALF, 0, 0, HALF, -HALF, 0)
UR_GYRATION = (0.06, 0.14, 0.13, 0.045, 0.045, 0.03)
UR5_A, UR5_D = (0, -0.425, -0.39225, 0, 0, 0), (0.089159, 0, 0, 0.10915, 0.09465, 0.0823)
UR5E_A, UR5E_D = (0, -0.425, -0.3922, 0, 0, 0), (0.1625, 0, 0, 0.1333, 0.0997, 0.0996)


def ur5() -> str:
    mass = (3.7, 8.393, 2.33, 1.219, 1.219, 0.1879)
    com = ((0, -0.02561, 0.00193), (0.2125, 0, 0.11336), (0.15, 0, 0.0265),
           (0, -0.0018, 0.01634), (0, 0.0018, 0.01634), (0, 0, -0.001159))  # fmt: skip
    return classic_dh("ur5", UR5_A, UR5_D, UR_ALPHA, mass, com, UR_GYRATION)


def ur5e() -> str:
    mass = (3.761, 8.058, 2.846, 1.37, 1.3, 0.365)
    com = ((0, -0.02561, 0.00193), (0.2125, 0, 0.11336), (0.15, 0, 0.0265),
           (0, -0.0018, 0.01634), (0, 0.0018, 0.01634), (0, 0, -0.001159))  # fmt: skip
    return classic_dh("ur5e", UR5E_A, UR5E_D, UR_ALPHA, mass, com, UR_GYRATION)


STAND_IN = (
    "NOT the Yu-Cobot, of whose kinematics nothing published was found. Six axes in the usual order, lengths "
    "and masses made up. What is said of the links with it means nothing; friction of the drives, which is "
    "motor torque minus that of the sensor behind the gear, does not depend on it."
)


def stand_in() -> str:
    """Six axes for a recording whose arm has no published kinematics. See STAND_IN."""
    a, d = (0, 0.4, 0.4, 0, 0, 0), (0.15, 0, 0, 0.1, 0.1, 0.1)
    com = ((0, 0, 0), (-0.2, 0, 0.1), (-0.2, 0, 0), (0, 0, 0), (0, 0, 0), (0, 0, 0))
    mass = (5.0, 8.0, 4.0, 2.0, 2.0, 0.5)
    return classic_dh("stand_in", a, d, UR_ALPHA, mass, com, UR_GYRATION, STAND_IN)
