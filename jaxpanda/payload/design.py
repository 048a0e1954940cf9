r"""One linear model of all recordings, without and with the body:

$$\tau_j - \tau_j^{model} = \underbrace{Y_j\,\Delta\phi + \dots}_{\text{what the arm's model gets wrong}}
   + [\text{with}]\; Y_{nj}\,\phi_{body} + e_j$$

What the model gets wrong is common to all recordings: links, rotors, offsets, friction (viscous, Coulomb, in
proportion to the load), and a free function of each joint's velocity and of its position for what those leave.
Friction and offset may also differ a little from one recording to the next (temperature), and of a joint at
rest friction carries an unknown part of the load, one number a rest. Every unknown has a prior: its size is
what a column is worth in units of the prior's standard deviation, so that a unit of each is equally likely.
"""

import dataclasses
import itertools
from collections.abc import Sequence

import numpy as np
import scipy.ndimage
from jaxtyping import Float

from .. import signals as signals_
from ..arms.arm import Arm
from ..effects import Motion
from ..errors import InputError
from ..recordings import Recording

CUTOFF = 5.0
"""Of the zero-phase low-pass that torque and columns share [Hz]: a moved body's gravity and inertia lie below."""
_RATE = 2.5 * CUTOFF
"""Rate at which filtered rows are used, at least [Hz]: closer rows repeat each other."""
_FINE = 200.0
"""Rate on which columns are made, at least [Hz]."""
SLOW = 0.02
"""Speed within which dry friction turns [rad/s or m/s]: below it positions hardly tell the sign."""
_STILL = 0.005
"""Speed below which a joint rests [rad/s or m/s]."""
_SHORTEST_REST = 0.2
"""[s], a period of the low-pass."""
_SPREAD = 0.3
"""Of the model's links, as a share of their mass, of the first moment and inertia that it makes at `_SIZE`."""
_SIZE = 0.2
"""Of a link: its mass times this is a first moment, times its square an inertia [m]."""
_LOAD_SHARE = 0.2
"""Of the transmitted torque that friction takes, as in gears."""
CHANGE = 0.1
"""Share of the friction by which it differs between recordings, as gears do that are a few kelvins warmer."""
REACH = 0.5
"""From the last link's origin, of the parts of a body at the flange [m], as a standard deviation."""
_VELOCITY_KNOTS, _POSITION_KNOTS = 11, 9
"""Of the free functions: velocity in the inverse hyperbolic sine of v / `SLOW`, position evenly."""


@dataclasses.dataclass(frozen=True)
class Sampled:
    """One recording, filtered, and what its columns are made from."""

    name: str
    loaded: bool
    motion: Motion
    """On the fine grid; its `friction` is what the model holds, dry friction turning within `SLOW` [N m]."""
    tau: Float[np.ndarray, "time dof"]
    """Measured torque [N m], filtered, at the rows that are used."""
    keep: np.ndarray
    """Those rows, as indices into the fine grid."""
    segments: tuple[slice, ...]
    """Rows without a gap between them."""

    @property
    def residual(self) -> Float[np.ndarray, "time dof"]:
        """Measured less the model's torque [N m]."""
        return self.tau - self.down(self.motion.torque)

    def down(self, x: Float[np.ndarray, "fine ..."]) -> Float[np.ndarray, "time ..."]:
        """From the fine grid to the rows that are used, filtered like the torque."""
        return signals_.zero_phase(x, CUTOFF, 1 / self.motion.dt)[self.keep]

    def at_rest(self, joint: int) -> list[slice]:
        """Stretches of the fine grid in which a joint rests."""
        dt = self.motion.dt
        still = np.abs(self.motion.qd[:, joint]) < _STILL
        short = max(1, round(_SHORTEST_REST / dt))
        still = scipy.ndimage.binary_closing(still, np.ones(short // 2 + 1))
        edges = np.flatnonzero(np.diff(np.r_[False, still, False]))
        return [slice(a, b) for a, b in edges.reshape(-1, 2) if b - a >= short]


def sample(recording: Recording, arm: Arm, loaded: bool) -> Sampled:
    """Filter a recording.

    Raises:
        InputError: no torque, another number of joints, or too short.
    """
    recording.require_dof(arm.dof)
    recording.require_tau()
    s = signals_.prepare(recording, cutoff=CUTOFF, rate=_RATE)
    assert s.tau is not None
    if len(s.keep) < 10:
        raise InputError(
            f"{recording.name}: {len(s.time) / s.rate:.1f} s leave {len(s.keep)} filtered samples, too few"
        )
    stride = int(np.min(np.diff(s.keep)))
    thin = next(k for k in range(stride, 0, -1) if stride % k == 0 and (k == 1 or s.rate / k >= _FINE))
    fine = np.arange(s.keep[0] % thin, len(s.time), thin)
    keep = (s.keep - fine[0]) // thin
    q, qd, qdd = (x[fine] for x in (s.q, s.qd, s.qdd))
    held = np.asarray(arm.damping) * qd + np.asarray(arm.frictionloss) * np.tanh(qd / SLOW)
    tau = s.tau if thin == 1 else signals_.zero_phase(s.tau, 0.3 * s.rate / thin, s.rate)
    gaps = np.flatnonzero(np.diff(s.keep) > stride) + 1
    bounds = [0, *gaps.tolist(), len(keep)]
    return Sampled(
        recording.name,
        loaded,
        Motion(arm, s.time[fine], q, qd, qdd, held),
        signals_.zero_phase(tau[fine], CUTOFF, s.rate / thin)[keep],
        keep,
        tuple(slice(a, b) for a, b in itertools.pairwise(bounds)),
    )


@dataclasses.dataclass(frozen=True)
class Scales:
    """How large unknowns are expected to be, joint by joint [N m]."""

    torque: Float[np.ndarray, " dof"]
    """Of the friction and the offset, if nothing is known: as large as the torque."""
    rest: Float[np.ndarray, " dof"]
    """What friction may carry at rest."""
    change: Float[np.ndarray, " dof"]
    """By which friction and offset may differ between recordings; 0 leaves that out."""
    shape: Float[np.ndarray, " dof"]
    """Of the free functions; 0 leaves them out."""
    mass: float
    """Of the body [kg]."""
    carried: float
    """The same for its first moment and inertia, which are this mass times lengths [kg]."""

    @property
    def body(self) -> Float[np.ndarray, "10"]:
        """Standard deviations of the ten parameters of the body, about the last link's origin."""
        return np.array([self.mass, *[self.carried * REACH] * 3, *[self.carried * REACH**2] * 6])


@dataclasses.dataclass(frozen=True)
class Design:
    """Columns of every recording, each in units of its prior; the body's ten come last."""

    A: tuple[Float[np.ndarray, "dof _time unknowns"], ...]
    y: tuple[Float[np.ndarray, "dof _time"], ...]
    friction: Float[np.ndarray, "dof unknowns"]
    """1 at the columns that make up a joint's friction in all recordings, else 0."""
    links: Float[np.ndarray, " standard"]
    """Standard deviations of the links' parameters about the model's, the first columns."""
    body: Float[np.ndarray, "10"]
    """Of the body's, the last columns."""


def design(recordings: Sequence[Sampled], load: Sequence[np.ndarray], scales: Scales) -> Design:
    """Everything side by side.

    Args:
        recordings: without and with the body.
        load: torque that each joint transmits in each of them, friction aside, on the fine grid [N m].
        scales: of the unknowns.
    """
    arm = recordings[0].motion.arm
    dof = arm.dof
    together = {
        name: np.concatenate([getattr(r.motion, name) for r in recordings]) for name in ("q", "qd", "qdd")
    }
    rms = {name: np.maximum(np.sqrt(np.mean(x**2, 0)), _STILL) for name, x in together.items()}
    links = _of_links(arm)
    common, rests, changes = [], [], []
    for r, carried in zip(recordings, load, strict=True):
        v = r.motion.qd
        dry = np.tanh(v / SLOW)
        own = np.stack([v / rms["qd"], dry, np.ones_like(v), r.motion.qdd / rms["qdd"]], -1)
        own = own * scales.torque[:, None]
        columns = np.concatenate([own, (_LOAD_SHARE * dry * np.abs(carried))[..., None]], 2)
        if scales.shape.any():
            shapes = [
                scales.shape[j]
                * np.concatenate(
                    [
                        hats(
                            np.arcsinh(v[:, j] / SLOW),
                            np.arcsinh(together["qd"][:, j] / SLOW),
                            _VELOCITY_KNOTS,
                        ),
                        hats(r.motion.q[:, j], together["q"][:, j], _POSITION_KNOTS),
                    ],
                    1,
                )
                for j in range(dof)
            ]
            columns = np.concatenate([columns, np.stack(shapes, 1)], 2)
        common.append(np.moveaxis(r.down(columns), 1, 0))
        changed = np.stack([v / rms["qd"], dry, np.ones_like(v)], -1) * scales.change[:, None]
        changes.append(np.moveaxis(r.down(changed), 1, 0))
        rests.append([_rests(r, j) * scales.rest[j] for j in range(dof)])
    body = scales.body
    A, y = [], []
    for k, r in enumerate(recordings):
        Y = np.moveaxis(r.down(r.motion.regressor), 1, 0)
        parts = [Y * links, _apart(common[k])]
        parts += [
            _apart(c) if i == k else np.zeros((*c.shape[:1], len(r.keep), dof * c.shape[2]))
            for i, c in enumerate(changes)
        ]
        for i in range(len(recordings)):
            for j in range(dof):
                block = np.zeros((dof, len(r.keep), rests[i][j].shape[1]))
                if i == k:
                    block[j] = rests[i][j]
                parts.append(block)
        parts.append(Y[:, :, -10:] * body if r.loaded else np.zeros((dof, len(r.keep), 10)))
        A.append(np.concatenate(parts, 2))
        y.append(r.residual.T)
    of_joint = common[0].shape[2]
    first = 10 * dof
    marks = np.zeros((dof, A[0].shape[2]))
    for j in range(dof):
        marks[j, first + j * of_joint : first + j * of_joint + of_joint] = 1
        marks[j, first + j * of_joint + 2] = 0  # the offset
        marks[j, first + j * of_joint + 3] = 0  # the rotor
        marks[j, first + j * of_joint + 5 + _VELOCITY_KNOTS : first + (j + 1) * of_joint] = 0  # of position
    return Design(tuple(A), tuple(y), marks, links, body)


def hats(
    x: Float[np.ndarray, " time"], every: Float[np.ndarray, " all"], count: int
) -> Float[np.ndarray, "time count"]:
    """Piecewise linear functions of x on even knots over the range of `every`; they add up to one."""
    low, high = float(every.min()), float(every.max())
    at = (x - low) / max(high - low, 1e-9) * (count - 1)
    return np.maximum(0.0, 1 - np.abs(at[:, None] - np.arange(count)))


def _of_links(arm: Arm) -> Float[np.ndarray, " standard"]:
    """Standard deviations of the links' parameters about the model's."""
    mass = np.maximum(np.asarray(arm.standard)[:, 0], 0.1)
    return (_SPREAD * mass[:, None] * np.array([1.0, *[_SIZE] * 3, *[_SIZE**2] * 6])).ravel()


def _rests(r: Sampled, joint: int) -> Float[np.ndarray, "time rests"]:
    """A column for every rest of a joint: one while it lasts."""
    columns = np.zeros((r.motion.samples, 0))
    stretches = r.at_rest(joint)
    if stretches:
        columns = np.zeros((r.motion.samples, len(stretches)))
        for k, stretch in enumerate(stretches):
            columns[stretch, k] = 1.0
    return r.down(columns) if stretches else columns[r.keep]


def _apart(own: Float[np.ndarray, "dof time n"]) -> Float[np.ndarray, "dof time columns"]:
    """Each joint's columns beside the others', which do not feel them."""
    dof, rows, n = own.shape
    out = np.zeros((dof, rows, dof * n))
    for j in range(dof):
        out[j, :, j * n : (j + 1) * n] = own[j]
    return out
