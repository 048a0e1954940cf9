"""One case: an arm, what is concealed in it, recordings as its sensors give them, and the answer.

The plant is MuJoCo's C engine at 1 kHz in closed loop: the user's model as feed-forward, a spring and a
damper about the wanted motion. Torque is what the actuators give, read by a sensor with noise. The effects
act while the arm moves.
"""

import copy
import itertools
import json
from dataclasses import dataclass, replace
from pathlib import Path

import effects as catalogue
import mujoco
import numpy as np
from arm import HOME, N, draw_arm, identified, inverse_dynamics, mjcf, rough
from motions import FAMILIES, LEAD, STEP, desired
from scipy.interpolate import CubicSpline
from scipy.signal import butter, filtfilt, lfilter

STRENGTH = {"weak": 1.5, "medium": 5.0, "strong": 15.0}
EDGE = 0.3  # [s] at either end where a zero-phase filter has no past or future: not scored


# -------------------------------------------------------------------------------- the plant


@dataclass(frozen=True)
class Run:
    """What the arm really did: q [rad], v [rad/s], a [rad/s^2], tau [N m] at the steps of the simulation."""

    t: np.ndarray
    q: np.ndarray
    v: np.ndarray
    a: np.ndarray
    tau: np.ndarray


class Unstable(Exception):
    """This draw is of no use: out of reach, off its motion, or chattering faster than filters let through."""


def _friction_law(model, dofs, concealed):
    """Slope, look-ahead and level of MuJoCo's friction constraint: torque = clip((a + b v) / R, +-level).

    Joints with concealed friction get a transition of a few mrad/s of their own, for that of the engine
    depends on the inertia.
    """
    for j, speed, level in concealed:
        dof = dofs[j]
        weight = model.dof_invweight0[dof]
        b = 500.0
        R = b * speed / level
        d = np.clip(weight / (R + weight), 0.01, 0.999)
        model.dof_solref[dof] = (-1.0, -b * d)
        model.dof_solimp[dof] = (d, d, 0.001, 0.5, 2.0)
    d = model.dof_solimp[dofs, 0]
    dmax = model.dof_solimp[dofs, 1]
    reference = model.dof_solref[dofs]
    b = np.where(reference[:, 1] < 0, -reference[:, 1], 2 / np.maximum(reference[:, 0], 2 * STEP)) / dmax
    R = (1 - d) / d * model.dof_invweight0[dofs]
    return b, R


class Plant:
    """The true arm, compiled; and its inverse dynamics by the same physics, for the oracle."""

    def __init__(self, arm, effects, transition):
        self.effects = effects
        for effect in effects:
            arm = effect.plant(arm)
        self.arm = arm
        self.soft = next((e for e in effects if isinstance(e, catalogue.Soft)), None)
        self.model = mujoco.MjModel.from_xml_string(mjcf(arm, actuators=False))
        self.model.opt.disableflags |= (
            mujoco.mjtDisableBit.mjDSBL_EULERDAMP | mujoco.mjtDisableBit.mjDSBL_LIMIT
        )
        self.rigid = mujoco.MjModel.from_xml_string(mjcf(replace(arm, soft=None), actuators=False))
        self.rigid.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_LIMIT
        names = [f"joint{j + 1}" for j in range(N)]
        self.dofs = np.array(
            [mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_JOINT, name) for name in names]
        )
        slow = np.full((1, N), 0.05)
        levels = {}
        for effect in effects:
            for j, F in effect.level(np.full(1, 1.0), HOME[None], slow, np.full((1, N), 5.0)):
                levels[j] = levels.get(j, 0.0) + abs(float(np.max(F)))
        concealed = [(j, transition, max(F, 0.02)) for j, F in levels.items() if arm.frictionloss[j] == 0]
        self.b, self.R = _friction_law(self.model, self.dofs, concealed)
        self.timed = [e for e in effects if type(e).before is not catalogue.Effect.before]
        self.loaded = [e for e in effects if type(e).level is not catalogue.Effect.level]
        self.forced = [e for e in effects if type(e).force is not catalogue.Effect.force]
        self.pushed = [e for e in effects if type(e).wrench is not catalogue.Effect.wrench]

    def before(self, model, t):
        for effect in self.timed:
            effect.before(model, t)

    def wrench(self, model, data, t):
        total = np.zeros(N)
        for effect in self.pushed:
            torque = effect.wrench(model, data, t)
            if torque is not None:
                total += torque
        return total

    def run(self, t, q_wanted, v_wanted, feedforward, stiffness, damping):
        """Track the wanted motion; keeps what the arm did from t = 0 on."""
        model, dofs = self.model, self.dofs
        data = mujoco.MjData(model)
        for effect in self.effects:
            effect.reset()
        twist = None
        if self.soft is not None:
            twist = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, "twist")
            data.qpos[twist] = float(self.soft.settled(feedforward[0, self.soft.joints[0]]))
        data.qpos[dofs] = q_wanted[0]
        data.qvel[dofs] = v_wanted[0]
        mujoco.mj_forward(model, data)
        known = self.arm.frictionloss
        drive = feedforward + stiffness * q_wanted + damping * v_wanted
        Q, V, U = (np.empty((len(t), N)) for _ in range(3))
        u = feedforward[0].copy()
        applied = np.zeros(model.nv)
        simple = not (self.loaded or self.forced or self.pushed or self.soft or self.timed)
        identity = twist is None
        for k in range(len(t)):
            q = data.qpos.copy() if identity else data.qpos[dofs]
            v = data.qvel.copy() if identity else data.qvel[dofs]
            Q[k], V[k] = q, v
            load = u
            u = drive[k] - stiffness * q - damping * v
            U[k] = u
            applied[dofs] = u
            if not simple:
                now = t[k]
                for effect in self.timed:
                    effect.before(model, now)
                if self.loaded:
                    level = known.copy()
                    for effect in self.loaded:
                        for j, F in effect.level(now, q, v, load):
                            level[j] += F
                    model.dof_frictionloss[dofs] = np.maximum(level, 0)
                for effect in self.forced:
                    for j, torque in effect.force(now, q, v, load):
                        applied[dofs[j]] -= torque
                if twist is not None:
                    applied[twist] = self.soft.twist(data.qpos[twist], data.qvel[twist])
                if self.pushed:
                    applied[:] += self._wrench_in_plant(data, now)
            data.qfrc_applied[:] = applied
            mujoco.mj_step(model, data)
        a = np.diff(V, axis=0) / STEP
        start = int(LEAD / STEP)
        keep = slice(start, len(t) - 1)
        if not np.all(np.abs(Q - q_wanted) < 0.4):
            raise Unstable("the arm did not follow its motion")
        tau = U[:-1].copy()
        if self.soft is not None:
            j = self.soft.joints[0]
            tau[:, j] -= self.arm.soft.rotor * a[:, j]
        return Run(t[keep], Q[keep], (0.5 * (V[1:] + V[:-1]))[keep], a[keep], tau[keep])

    def _wrench_in_plant(self, data, now):
        total = np.zeros(self.model.nv)
        for effect in self.pushed:
            torque = effect.wrench(self.model, data, now)
            if torque is not None:
                total += torque
        return total

    def inverse(self, t, q, v, a, still=False):
        """Torque [N m] that the motion (true positions) takes; `still`: a soft joint settles at once."""
        if self.soft is None:
            tau = self._rigid(t, q, v, a)
        else:
            link = [x.copy() for x in (q, v, a)]
            for x, extra in zip(
                link, self._settled(t, q, v, a) if still else self._twist(t, q, v, a), strict=False
            ):
                x[:, self.soft.joints[0]] += extra
            tau = self._rigid(t, *link)
        load = tau
        level = np.tile(self.arm.frictionloss, (len(t), 1))
        for effect in self.loaded:
            for j, F in effect.level(t, q, v, load):
                level[:, j] += F
        level = np.maximum(level, 0)
        tau = tau + np.clip((a + self.b * v) / self.R, -level, level)
        for effect in self.forced:
            if effect.memory:
                effect.reset()
                for k in range(len(t)):
                    for j, torque in effect.force(t[k], q[k], v[k], load[k]):
                        tau[k, j] += torque
            else:
                for j, torque in effect.force(t, q, v, load):
                    tau[:, j] += torque
        return tau

    def _settled(self, t, q, v, a):
        """Twist under the torque of the rigid arm, without its rates: all that survives a noisy motion."""
        smooth = butter(2, 2 * 6.0 * (t[1] - t[0]))
        return (self.soft.settled(filtfilt(*smooth, self._rigid(t, q, v, a)[:, self.soft.joints[0]])),)

    def _twist(self, t, q, v, a):
        """Twist of the link against its sensor, integrated while the sensor's side follows the motion."""
        j, law = self.soft.joints[0], self.soft
        model = self.rigid
        model.dof_frictionloss[:] = 0
        data = mujoco.MjData(model)
        steps = max(1, round((t[1] - t[0]) / STEP))
        h = (t[1] - t[0]) / steps
        unit, column = np.eye(N)[j], np.empty(N)
        out = np.empty((3, len(t)))
        angle = rate = None
        for k in range(len(t)):
            for _ in range(steps):
                if self.timed:
                    self.before(model, t[k])
                data.qpos[:], data.qvel[:], data.qacc[:] = q[k], v[k], a[k]
                if angle is not None:
                    data.qpos[j] += angle
                    data.qvel[j] += rate
                mujoco.mj_inverse(model, data)
                torque = data.qfrc_inverse[j]
                if self.pushed:
                    torque -= self.wrench(model, data, t[k])[j]
                if angle is None:
                    angle, rate = float(law.settled(torque)), 0.0
                mujoco.mj_mulM(model, data, column, unit)
                acceleration = (law.twist(angle, rate) - torque) / column[j]
                rate += h * acceleration
                angle += h * rate
            out[:, k] = angle, rate, acceleration
        return out

    def _rigid(self, t, q, v, a):
        before = self.before if self.timed else None
        wrench = self.wrench if self.pushed else None
        return inverse_dynamics(self.rigid, q, v, a, before, wrench, t)

    def read(self, t, q, v, a, still=False):
        """As `inverse`, from measured positions to what the torque sensors say."""
        for effect in self.effects:
            q = effect.unobserve(q)
        tau = self.inverse(t, q, v, a, still)
        for effect in self.effects:
            _, tau = effect.observe(t, q, tau)
        return tau


# -------------------------------------------------------------------------------- sensors


def draw_sensors(rng):
    """Noise and clocks of a real arm, within what such arms show."""
    return {
        "fs": int(rng.choice([250, 500, 1000], p=[0.5, 0.3, 0.2])),
        "q_std": float(rng.uniform(1e-5, 3e-5)),
        "q_step": float(rng.choice([0.0, 2 * np.pi / 2**20, 2 * np.pi / 2**18])),
        "dq_mode": str(rng.choice(["difference", "filtered"])),
        "dq_std": float(rng.uniform(0.001, 0.005)),
        "colored": float(rng.uniform(0.2, 0.6)),
        "color_tau": float(np.exp(rng.uniform(np.log(0.003), np.log(0.02)))),
        "jitter": bool(rng.random() < 0.25),
        "missing": bool(rng.random() < 0.25),
    }


def draw_noise(rng):
    return np.concatenate([rng.uniform(0.06, 0.15, 4), rng.uniform(0.03, 0.055, 3)])


def sense(rng, run, effects, sensors, noise_std):
    """One table (time, q, dq, tau) as a file would hold it."""
    q_true, tau_true = run.q, run.tau
    for effect in effects:
        q_true, tau_true = effect.observe(run.t, q_true, tau_true)
    h = 1 / sensors["fs"]
    t = np.arange(run.t[0], run.t[-1] - 1e-9, h)
    if sensors["jitter"]:
        wobble = 0.15 * h * rng.standard_normal(len(t))
        t = np.clip(t + np.clip(wobble, -0.4 * h, 0.4 * h), run.t[0], run.t[-1])
        t = np.round(t - t[0], 6) + t[0]
    keep = np.ones(len(t), bool)
    if sensors["missing"]:
        for _ in range(rng.integers(2, 7)):
            start = rng.integers(10, len(t) - 30)
            keep[start : start + rng.integers(1, max(2, int(0.05 / h)))] = False
    if sensors["jitter"]:
        q = CubicSpline(run.t, q_true)(t)
        tau = np.stack([np.interp(t, run.t, column) for column in tau_true.T], axis=1)
    else:
        rows = np.round((t - run.t[0]) / STEP).astype(int)
        q, tau = q_true[rows], tau_true[rows]
    rows = np.clip(np.round((t - run.t[0]) / STEP).astype(int), 0, len(run.t) - 1)
    q = q + sensors["q_std"] * rng.standard_normal(q.shape)
    if sensors["q_step"]:
        q = np.round(q / sensors["q_step"]) * sensors["q_step"]
    share = sensors["colored"]
    memory = np.exp(-h / sensors["color_tau"])
    coloured = lfilter(
        [np.sqrt(1 - memory**2)], [1, -memory], rng.standard_normal((len(t) + 300, N)), axis=0
    )[300:]
    noise = np.sqrt(1 - share) * rng.standard_normal(tau.shape) + np.sqrt(share) * coloured
    tau = tau + noise_std * noise
    t, q, tau, rows = t[keep], q[keep], tau[keep], rows[keep]
    if sensors["dq_mode"] == "difference":
        dq = np.gradient(q, t, axis=0)
    else:
        late = lfilter([0.25], [1, -0.75], run.v, axis=0, zi=0.75 * run.v[:1])[0]
        dq = late[rows] + sensors["dq_std"] * rng.standard_normal(q.shape)
    return np.round(t, 6), q, dq, tau


def write_csv(path, t, q, dq, tau=None):
    groups = ["q", "dq", "tau"][: 2 if tau is None else 3]
    header = "time," + ",".join(f"{g}_{j}" for g in groups for j in range(1, N + 1))
    row = "%.6f," + ",".join(["%.7f"] * N + ["%.5f"] * N * (len(groups) - 1))
    table = np.column_stack([t, q, dq] if tau is None else [t, q, dq, tau])
    path.write_text(header + "\n" + "\n".join(row % tuple(values) for values in table.tolist()) + "\n")


# -------------------------------------------------------------------------------- the oracle


def filtered(t, q, cutoff):
    """Zero-phase positions, velocities and accelerations on a uniform grid, from whatever time stamps."""
    h = np.median(np.diff(t))
    grid = t[0] + h * np.arange(int((t[-1] - t[0]) / h) + 1)
    smooth = CubicSpline(t, q)(grid)
    if 2 * cutoff * h < 0.9:
        smooth = filtfilt(*butter(4, 2 * cutoff * h), smooth, axis=0, padlen=min(len(grid) - 1, int(0.5 / h)))
    v = np.gradient(smooth, h, axis=0)
    return grid, smooth, v, np.gradient(v, h, axis=0)


def scored(t):
    return (t > t[0] + EDGE) & (t < t[-1] - EDGE)


def rmse(x):
    return np.sqrt(np.mean(np.square(x), axis=0))


def prediction_rmse(plant, t, q, tau):
    """Per joint, the least RMSE over the cut-offs that a good filter could have."""
    errors = []
    for cutoff, still in itertools.product((6, 12, 25, 45), (False, True) if plant.soft else (False,)):
        grid, *motion = filtered(t, q, cutoff)
        predicted = plant.read(grid, *motion, still)
        at = np.stack([np.interp(t, grid, column) for column in predicted.T], axis=1)
        errors.append(rmse((tau - at)[scored(t)]))
    return np.min(errors, axis=0)


# -------------------------------------------------------------------------------- a case


@dataclass(frozen=True)
class Plan:
    """What a case should be."""

    stratum: str  # single, pair, outside, null
    kinds: tuple[type, ...]
    strengths: tuple[str, ...]
    nasty: str = ""  # for a null: narrow, jitter, missing, friction, identified
    nominal: str = ""  # exact, identified or rough, instead of drawing one of the first two
    reference: bool = False  # whether recordings of the arm from before come with it


def _strength(extra, noise_std, effect, active, step):
    """RMS torque over noise while the effect acts: at each of its joints, or at the joint that shows most."""
    if isinstance(effect, catalogue.Soft):  # what impacts add above 15 Hz is not what one calls its size
        extra = filtfilt(*butter(2, 2 * 15 * step), extra, axis=0)
    ratio = rmse(extra[active]) / noise_std
    return ratio[list(effect.joints)] if effect.local else np.max(ratio, keepdims=True)


def _compatible(effects):
    soft = sum(isinstance(e, catalogue.Soft) for e in effects)
    loads = sum(isinstance(e, catalogue.Payload) for e in effects)
    body = sum(isinstance(e, (catalogue.Payload, catalogue.Inertial)) for e in effects)
    timed = sum(e.interval is not None for e in effects)
    return soft < 2 and loads < 2 and body < 2 and timed < 2


def _throughout(effect):
    effect = copy.copy(effect)
    effect.interval = (-np.inf, np.inf)
    return effect


class Case:
    """Draws, simulates and writes one case."""

    def __init__(self, seed, plan):
        self.rng = rng = np.random.default_rng(seed)
        self.seed, self.plan = seed, plan
        self.sensors = draw_sensors(rng)
        self.noise_std = draw_noise(rng)
        self.arm = draw_arm(rng)
        self.nominal_kind = str(rng.choice(["exact", "identified"]))
        self.transition = rng.uniform(0.002, 0.01)
        self.family = str(rng.choice(FAMILIES))
        self.records = int(rng.choice([1, 2, 3], p=[0.45, 0.4, 0.15]))
        self._be_nasty(plan.nasty)
        self.nominal_kind = plan.nominal or self.nominal_kind
        timed = any(kind in (catalogue.Contact, catalogue.PayloadChange) for kind in plan.kinds)
        if timed and self.records == 3:
            self.records = 2
        lengths = rng.uniform(12, 20, self.records) * np.where(np.arange(self.records) > 0, 0.7, 1)
        self.seconds = np.round(np.maximum(lengths, 8), 2)
        self.motions = [desired(rng, self.family, s) for s in self.seconds]
        held_family = self.family if rng.random() < 0.6 else str(rng.choice(FAMILIES))
        held_family = "fourier" if held_family == "narrow" else held_family
        self.held_motion = desired(rng, held_family, 0.6 * self.seconds[0])
        drifts = any(kind in (catalogue.Drift, catalogue.FrictionDrift) for kind in plan.kinds)
        gaps = rng.uniform(0.5, 3, self.records + 1)
        self.continued = drifts or rng.random() < 0.3
        ends = np.concatenate([[0], np.cumsum(self.seconds + gaps[1:])])
        self.shifts = np.round(ends, 3) if self.continued else np.zeros(self.records + 1)
        self.user_arm = self._nominal()
        # The effect of an interval is in the last recording: what it leaves behind is in none before.
        self.effects = self._draw_effects()

    def _be_nasty(self, nasty):
        rng = self.rng
        if nasty == "narrow":
            self.family = "narrow"
        elif nasty == "jitter":
            self.sensors.update(jitter=True, missing=True)
        elif nasty == "identified":
            self.nominal_kind = "identified"
        elif nasty == "friction":
            loss = rng.uniform(0.1, 0.5, N) * catalogue.BIG
            self.arm = replace(self.arm, frictionloss=loss, damping=rng.uniform(0.1, 0.6, N) * catalogue.BIG)
        elif nasty == "clean":
            self.nominal_kind = "exact"

    def _nominal(self):
        if self.nominal_kind == "exact":
            return self.arm
        if self.nominal_kind == "rough":
            return rough(self.arm, np.random.default_rng([*self.seed, 2]))
        rng = self.rng
        _, q, v, a = desired(rng, "fourier", 15.0)
        rows = slice(600, None, 50)
        return identified(self.arm, rng, q[rows], v[rows], a[rows], self.noise_std)

    def _clock(self, k):
        """Time of the effects at the start of recording k (the held-out one comes last)."""
        return self.shifts[k] if self.continued else 0.0

    def _draw_effects(self):
        rng = self.rng
        span = self.seconds[-1] if self.records > 1 else self.seconds[0]
        for _ in range(20):
            effects = []
            for kind in self.plan.kinds:
                effect = kind(rng, catalogue.draw_joints(kind, rng, self.arm), self.arm, float(span))
                if isinstance(effect, catalogue.FrictionDrift) and np.any(
                    self.arm.frictionloss[list(effect.joints)] == 0
                ):
                    loss = self.arm.frictionloss.copy()
                    loss[list(effect.joints)] = (
                        rng.uniform(0.15, 0.5, len(effect.joints)) * catalogue.BIG[list(effect.joints)]
                    )
                    self.arm = replace(self.arm, frictionloss=loss)
                    self.user_arm = replace(self.user_arm, frictionloss=loss)
                if effect.interval is not None:
                    clock = self._clock(self.records - 1)
                    effect.interval = (effect.interval[0] + clock, effect.interval[1] + clock)
                effects.append(effect)
            if not _compatible(effects):
                continue
            if all(
                self._scale(effect, STRENGTH[s])
                for effect, s in zip(effects, self.plan.strengths, strict=True)
            ):
                return effects
        raise Unstable(f"no joint at which {self.plan} reaches its strength")

    def _present(self, effect, k):
        """Whether the effect is in recording k."""
        if effect.interval is None:
            return True
        held = k == self.records
        if held:
            return effect.outlives and getattr(effect, "gained", False)
        if k == self.records - 1:
            return True
        return not getattr(effect, "gained", True)

    def _scale(self, effect, wanted):
        """Scale one effect on the wanted motion; False where it cannot get there."""
        record = self.records - 1 if effect.interval is not None else 0
        t, q, v, a = (x[int(LEAD / STEP) :: 4] for x in self.motions[record])
        t = t + self._clock(record)
        bare = Plant(self.arm, [], self.transition).read(t, q, v, a)
        active = effect.active(t)
        if active.sum() < 20:
            return False
        for _ in range(7):
            seen = effect.observe(t, q, bare)[0]
            try:
                with_it = Plant(self.arm, [effect], self.transition).read(t, seen, v, a)
                bare_seen = (
                    Plant(self.arm, [], self.transition).read(t, seen, v, a) if seen is not q else bare
                )
            except ValueError:
                effect.resize(0.5)
                continue
            strength = _strength(with_it - bare_seen, self.noise_std, effect, active, t[1] - t[0])
            if np.all(np.abs(strength / wanted - 1) < 0.03):
                break
            effect.resize(np.clip(wanted / np.maximum(strength, 1e-9), 0.05, 20))
        return bool(np.all((strength > 0.6 * wanted) & (strength < 1.6 * wanted)))

    def _simulate(self, k):
        motion = self.motions[k] if k < self.records else self.held_motion
        effects = [e for e in self.effects if self._present(e, k)]
        effects = [e if e.interval is None or k == self.records - 1 else _throughout(e) for e in effects]
        return self._follow(motion, self._clock(k), effects)

    def _follow(self, motion, clock, effects):
        """The arm with these effects in closed loop on a wanted motion."""
        t, q, v, a = motion
        user = mujoco.MjModel.from_xml_string(mjcf(self.user_arm))
        user.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_LIMIT
        rows = np.unique(np.append(np.arange(0, len(t), 4), len(t) - 1))
        law = Plant(self.user_arm, [], self.transition)
        feed = CubicSpline(t[rows], law.inverse(t[rows], q[rows], v[rows], a[rows]))(t)
        stiffness, damping = self._gains(user)
        plant = Plant(self.arm, effects, self.transition)
        run = plant.run(t + clock, q, v, feed, stiffness, damping)
        return plant, run

    def _from_before(self, rng):
        """A recording of the arm while nothing was wrong yet, on a motion of its own."""
        effects, self.effects = self.effects, []
        run = self._follow(desired(rng, self.family, float(self.seconds[0])), 0.0, [])[1]
        self.effects = effects
        return sense(rng, run, [], self.sensors, self.noise_std)

    def _gains(self, model):
        """Stiffness and damping that hold at 1 kHz in every pose: for the least inertia a joint shows."""
        inertia = np.minimum(1 / model.dof_invweight0, 0.2)
        omega = 60.0 if any(isinstance(e, catalogue.Soft) for e in self.effects) else 100.0
        return inertia * omega**2, 2 * inertia * omega

    def _without(self, effect, k, run, seen_q):
        """Torque that sensors would read on the same motion if this effect alone were absent."""
        others = [e for e in self.effects if e is not effect and self._present(e, k)]
        return Plant(self.arm, others, self.transition).read(run.t, seen_q, run.v, run.a)

    def simulate(self):
        """Run every recording; scale again where the loop made an effect larger or smaller than wanted."""
        for attempt in range(4):
            runs = [self._simulate(k) for k in range(self.records)]
            self.rms, self.strengths, factors = [], [], []
            for effect, wanted in zip(self.effects, self.plan.strengths, strict=True):
                record = self.records - 1 if effect.interval is not None else 0
                plant, run = runs[record]
                q, tau = run.q, run.tau
                for e in plant.effects:
                    q, tau = e.observe(run.t, q, tau)
                rows = slice(0, None, 2)
                part = Run(run.t[rows], run.q[rows], run.v[rows], run.a[rows], run.tau[rows])
                extra = tau[rows] - self._without(effect, record, part, q[rows])
                strength = _strength(extra, self.noise_std, effect, effect.active(part.t), 2 * STEP)
                self.rms.append(rmse(extra[effect.active(part.t)]))
                self.strengths.append(strength)
                factors.append(STRENGTH[wanted] / np.maximum(strength, 1e-9))
            if attempt == 3 or all(np.all(np.abs(np.log(factor)) < 0.12) for factor in factors):
                break
            for effect, factor in zip(self.effects, factors, strict=True):
                effect.resize(np.clip(factor, 0.3, 3))
        self.runs = runs
        self.held = self._simulate(self.records)

    def write(self, folder, slack=0.05):
        """All files of the case; returns the truth. `slack`: how far the oracle may be off, by strength."""
        self.simulate()
        rng = np.random.default_rng([*self.seed, 1])
        plant, run = self.held
        t, q, dq, tau = sense(rng, run, plant.effects, self.sensors, self.noise_std)
        oracle = prediction_rmse(plant, t, q, tau)
        if np.any(oracle > (1.25 + slack * max(map(np.max, self.strengths), default=0)) * self.noise_std):
            raise Unstable("the true model does not explain the motion")
        user = Plant(self.user_arm, [], self.transition)
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        write_csv(folder / "heldout_motion.csv", t, q, dq)
        write_csv(folder / "heldout.csv", t, q, dq, tau)
        (folder / "model.xml").write_text(mjcf(self.user_arm))
        for k, (plant, run) in enumerate(self.runs):
            table = sense(rng, run, plant.effects, self.sensors, self.noise_std)
            write_csv(folder / f"train_{k}.csv", *table)
        for k in range(2 if self.plan.reference else 0):
            write_csv(
                folder / f"reference_{k}.csv", *self._from_before(np.random.default_rng([*self.seed, 3, k]))
            )
        truth = self._truth()
        truth["heldout"] = {
            "rmse_nominal": _digits(prediction_rmse(user, t, q, tau)),
            "rmse_true_model": _digits(oracle),
        }
        (folder / "truth.json").write_text(json.dumps(truth, indent=1, ensure_ascii=False))
        return truth

    def _truth(self):
        entries = []
        for effect, rms, strength in zip(self.effects, self.rms, self.strengths, strict=True):
            entry = {
                "effect": effect.name,
                "joints": [j + 1 for j in effect.joints],
                "intervals": None,
                "parameters": [
                    {"name": name, "joint": j + 1, "value": value, "unit": unit}
                    for name, j, value, unit in effect.parameters()
                ],
                "rms_torque": _digits(rms),
                "strength": _digits(strength),
            }
            if effect.interval is not None:
                k = self.records - 1
                run = self.runs[k][1]
                start, end = max(effect.interval[0], run.t[0]), min(effect.interval[1], run.t[-1])
                entry["intervals"] = [[float(start), float(end)]]
                entry["recordings"] = [f"train_{k}.csv"]
            entries.append(entry)
        return {
            "effects": entries,
            "noise_std": _digits(self.noise_std),
            "nominal": self.nominal_kind,
            # links of a rough model are off, in every recording
            "allowed": ["inertial_parameters"] if self.nominal_kind == "rough" else [],
            "family": self.family,
            "sensors": self.sensors,
            "stratum": self.plan.stratum,
            "strengths": [_band(np.min(strength)) for strength in self.strengths],
            "nasty": self.plan.nasty,
            "seed": list(self.seed),
        }


def _band(strength):
    """Name of the nearest wanted strength, by ratio."""
    return min(STRENGTH, key=lambda name: abs(np.log(STRENGTH[name] / max(strength, 1e-9))))


def _digits(values):
    return [float(f"{x:.5g}") for x in values]
