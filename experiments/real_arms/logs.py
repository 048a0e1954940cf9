"""The real recordings on uniform ticks, and what is known of each arm before anything is identified."""

import functools
import io
import json
from pathlib import Path

import arms
import numpy as np
import recordings as real
from chain import Chain, from_com, from_mjcf
from reference import Log

HALF = 0.5 * np.pi


def uniform(name, time, q, qd, tau, rate):
    """On ticks of 1/rate, by interpolation between the recorded rows."""
    t = np.arange(time[0], time[-1], 1 / rate)
    at = lambda x: np.stack([np.interp(t, time, c) for c in np.asarray(x).T], 1)
    return Log(name, t - t[0], at(q), at(qd), at(tau))


def craig(name, a, alpha, d, theta, mass, com, radius=0.06):
    """A chain by modified Denavit-Hartenberg parameters; its links have that radius of gyration."""
    turn, pos = [], []
    for ai, al, di, th in zip(a, alpha, d, theta, strict=True):
        c, s = np.cos(al), np.sin(al)
        X = np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
        pos.append([ai, -s * di, c * di])
        c, s = np.cos(th), np.sin(th)
        turn.append(X @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]))
    gyration = np.broadcast_to(radius, len(a))
    phi = np.array(
        [from_com(m, x, m * r**2 * np.eye(3)) for m, x, r in zip(mass, com, gyration, strict=True)]
    )
    zero = np.zeros(len(a))
    return Chain(name, np.array(pos), np.array(turn), phi, zero, zero, zero, np.array([0, 0, -9.81]))


# -------------------------------------------------------------------------------------------------- Panda


@functools.cache
def panda(data: Path, rate=250.0):
    """Row after row to its true tick of 1 ms, as q and dq tell; rows logged twice are dropped."""
    table = {}
    for what, width in (("positions", 7), ("velocity", 7), ("torques", 7)):
        raw = real.content(data, "gaz_panda", f"exciting_traj_{what}.txt").decode()
        table[what] = np.array(raw.split(), float).reshape(-1, width)
    q, qd, tau = table["positions"], table["velocity"], table["torques"]
    new = np.concatenate([[True], np.any(np.diff(q, axis=0) != 0, axis=1)])
    q, qd, tau = q[new], qd[new], tau[new]
    # dq is 5 ms late: the speed over a step is that of about five rows later
    v = qd[np.minimum(np.arange(len(qd)) + 5, len(qd) - 1)]
    v = 0.5 * (v[1:] + v[:-1])
    steps = np.sum(np.diff(q, axis=0) * v, 1) / np.maximum(np.sum(v**2, 1), 1e-6)
    ticks = np.concatenate([[0], np.cumsum(np.maximum(1, np.round(steps * 1000)))])
    return uniform("panda", 1e-3 * ticks, q, qd, tau, rate)


@functools.cache
def panda_nominal(data: Path):
    """The links that Gaz et al. retrieved from this very recording, c6z as their coefficients have it."""
    facts = json.loads((data / "gaz_panda" / "supplement.json").read_text())
    links = facts["tables_VIII_IX"]
    d = [0.333, 0, 0.316, 0, 0.384, 0, 0]
    a = [0, 0, 0, 0.0825, -0.0825, 0, 0.088]
    alpha = [0, -HALF, HALF, HALF, -HALF, HALF, HALF]
    com = np.array(links["com"])
    com[5, 2] = links["c6z_corrected"]
    arm = craig("panda", a, alpha, d, np.zeros(7), links["mass"], com)
    phi = arm.phi.copy()
    for i, (xx, xy, xz, yy, yz, zz) in enumerate(links["inertia6"]):
        I = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        phi[i] = from_com(links["mass"][i], com[i], I)
    return arm.but(phi=phi)


# -------------------------------------------------------------------------------------------------- UR10e

UR10E = {
    "A": "02_10-30sec_12harm",
    "B": "02_12-40sec_12harm",
    "C": "02_12-50sec_12harm",
    "D": "02_19_14harm50sec",
    "P": "01_17-ptp_10_points",
    "load": "02_19_14harm50secLoad",
}


@functools.cache
def ur10e(data: Path, key: str, rate=100.0):
    """Motor current times a gain between the two published ones, in which the mounted load weighs 2.8 kg."""
    read = real.ur10e(data, UR10E[key])
    first, second = (np.array(real.UR10E_GAINS[k]) for k in ("main.m", "UR10E_parameters.txt"))
    tau = read.tau / first * np.sqrt(first * second)
    name = UR10E[key].replace("_", "-")
    return uniform(f"ur10e-{name}", read.time, read.q, read.qd, tau, rate)


@functools.cache
def ur10e_nominal(_):
    return from_mjcf(arms.ur10e()).but(name="ur10e")


# --------------------------------------------------------------------------------------------------- iiwa


@functools.cache
def iiwa(data: Path, name: str, rate=125.0):
    """The runs of a file."""
    return [uniform(f"iiwa-{r.name}", r.time, r.q, r.qd, r.tau, rate) for r in real.iiwa(data, name)]


@functools.cache
def iiwa_nominal(_):
    return from_mjcf(arms.iiwa14()).but(name="iiwa14")


# ------------------------------------------------------------------------------------------------- Kinova


@functools.cache
def kinova(data: Path, number: int, torque: str, rate=500.0):
    read = real.kinova(data, f"opti_traj_testing{number}", torque)
    return uniform(f"kinova-{number}", read.time, read.q, read.qd, read.tau, rate)


@functools.cache
def kinova_nominal(_):
    return from_mjcf(arms.kinova_gen3()).but(name="gen3")


# ------------------------------------------------------------------------------------------------- Doosan


@functools.cache
def doosan(data: Path, torque="measured", rate=100.0):
    """Rows in the order of the controller's clock, which is not that of the file; `torque` measured or model."""
    text = real.content(data, "doosan_m0609", "MonitoringDataLog7.txt").decode()
    table = np.loadtxt(io.StringIO(text))
    table = table[np.argsort(table[:, 2], kind="stable")]
    table = table[np.diff(table[:, 2], prepend=-np.inf) > 0]
    angle = np.unwrap(np.deg2rad(table[:, 3:9]), axis=0)
    tau = table[:, 33:39] if torque == "measured" else table[:, 39:45]
    return uniform("doosan", table[:, 2] - table[0, 2], angle, np.deg2rad(table[:, 15:21]), tau, rate)


@functools.cache
def doosan_nominal(_):
    """Kinematics as inferred in the data's README; masses are what an arm of 27 kg might have."""
    return craig(
        "m0609",
        [0, 0, 0.411, 0, 0, 0],
        [0, -HALF, 0, HALF, -HALF, HALF],
        [0.135, 0.0062, 0, 0.368, 0, 0.121],
        [0, -HALF, HALF, 0, 0, 0],
        [5.0, 8.0, 3.5, 3.5, 2.5, 1.5],
        [[0, 0, -0.03], [0.2, 0, 0.05], [0, 0, 0.03], [0, 0.05, -0.15], [0, 0, 0.03], [0, 0, -0.05]],
        [0.07, 0.18, 0.07, 0.12, 0.06, 0.05],
    )


# ---------------------------------------------------------------------------------------------------- UR5

UR5_GAIN = np.array([11.6, 11.6, 11.6, 8.44, 8.44, 8.44])
"""Controller's own target torque over target current [N m/A], as the log has them."""


@functools.cache
def ur5(data: Path, rate=125.0):
    """Motor current times the controller's own torque a current."""
    raw = real.content(data, "nist_ur5", "nist_half_1p6_1.npz")
    found = np.load(io.BytesIO(raw), allow_pickle=True)
    names = [str(h) for h in found["h"]]
    column = lambda what: found["M"][:, [names.index(f"{what} (J{j})") for j in range(1, 7)]].astype(float)
    time = found["M"][:, names.index("ROBOT_TIME")].astype(float)
    new = np.diff(time, prepend=-np.inf) > 0
    q = np.deg2rad(column("ROBOT_ACTUAL_JOINT_POSITIONS"))
    qd = column("ROBOT_ACTUAL_JOINT_VELOCITIES")
    tau = column("ROBOT_ACTUAL_JOINT_CURRENT") * UR5_GAIN
    return uniform("ur5", time[new] - time[new][0], q[new], qd[new], tau[new], rate)


@functools.cache
def ur5_nominal(_):
    """Universal Robots' published DH parameters, masses and centres of mass; the latter carried to our frames."""
    a = [0, -0.425, -0.39225, 0, 0, 0]
    d = [0.089159, 0, 0, 0.10915, 0.09465, 0.0823]
    alpha = [HALF, 0, 0, HALF, -HALF, 0]
    mass = [3.7, 8.393, 2.33, 1.219, 1.219, 0.1879]
    com = [[0, -0.02561, 0.00193], [0.2125, 0, 0.11336], [0.15, 0, 0.0265],
           [0, -0.0018, 0.01634], [0, 0.0018, 0.01634], [0, 0, -0.001159]]  # fmt: skip
    gyration = [0.06, 0.14, 0.13, 0.045, 0.045, 0.03]
    pos, turn, phi = [], [], []
    before, R_before = np.zeros(3), np.eye(3)
    for i in range(6):
        c, s = np.cos(alpha[i]), np.sin(alpha[i])
        R = np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
        pos.append(before)
        turn.append(R_before)
        before, R_before = np.array([a[i], 0, d[i]]), R
        at = before + R @ com[i]
        phi.append(from_com(mass[i], at, mass[i] * gyration[i] ** 2 * np.eye(3)))
    zero = np.zeros(6)
    return Chain(
        "ur5", np.array(pos), np.array(turn), np.array(phi), zero, zero, zero, np.array([0, 0, -9.81])
    )
