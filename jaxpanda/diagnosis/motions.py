"""Motions that could be recorded next: near the recorded ones, clear of what the arm could run into."""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np
import scipy.interpolate
import scipy.ndimage
from jaxtyping import Float

from ..arms.mjcf import MjcfSource
from ..errors import InputError
from ..inference.problem import Problem
from ..traces import Trace
from ..workspace.scene import CLEARANCE, scene_of

_DWELL = 0.5
"""Rests between moves [s]."""
_SMALLER = (1.0, 0.8, 0.6, 0.45, 0.3, 0.2, 0.1)
"""Sizes of a motion about a recorded pose, the largest that is clear is taken."""
_DRAWS = 30
"""Poses that are drawn until one is clear, at most."""


@dataclasses.dataclass(frozen=True)
class Surroundings:
    """What an arm must not run into, as far as its file says."""

    are_clear: Callable[[Float[np.ndarray, "time dof"]], bool]
    """Whether a motion comes nearer than the clearance to anything, and nearer than the recorded ones did."""
    said: str
    """What is looked after, in a sentence."""

    @classmethod
    def around(cls, problem: Problem, source: MjcfSource) -> "Surroundings":
        arm = problem.arm
        try:
            scene = scene_of(arm, source, CLEARANCE, 0.0)
        except InputError as error:
            return cls(lambda q: True, f"Collisions were not checked: {error}.")
        if not scene.pairs:
            why = "; ".join(scene.notes) or "nothing in the file could touch"
            return cls(lambda q: True, f"Collisions were not checked: {why}.")
        every = [np.asarray(t.channels.q) for t in problem.traces]
        kept = np.min([scene.distance_kept(arm, q) for q in every], 0)
        said = (
            f"It keeps {CLEARANCE:g} m from the arm itself, a floor and what the file holds, or as much as the"
            " recordings kept; what else stands around the arm is not known."
        )
        return cls(lambda q: scene.is_clear(arm, q, kept), said)


def motions(
    problem: Problem, trace: Trace, joints: Sequence[int], surroundings: Surroundings
) -> list[tuple[str, Float[np.ndarray, "time dof"]]]:
    """Candidate motions as long as a recording, on its fine grid, from rest to rest; first the recorded one.

    They stay within nine tenths of the joints' limits and near the box that was recorded, are little faster, and
    are made smaller about a recorded pose until they are clear. `joints` are those that the pairs are about.
    """
    box = _Box.around(problem, surroundings)
    n, dt = len(trace.channels.t), trace.dt
    out = [("the recorded motion again", np.asarray(trace.channels.q))]
    for seed in range(2):
        out.append(("a sum of harmonics", box.fourier(n, dt, seed, 1.0)))
    out.append(("a slow sum of harmonics", box.fourier(n, dt, 2, 0.35)))
    for seed in range(2):
        out.append(("moves from pose to pose with rests between", box.points(n, dt, 10 + seed, 1.0)))
    out.append(("slow moves from pose to pose with rests between", box.points(n, dt, 12, 0.3)))
    for j in joints[:2]:
        name = f"joint {j + 1}"
        out.append((f"{name} back and forth over its range at several speeds", box.sweeps(n, dt, [j], 20)))
        out.append((f"small reversals of {name} in several poses", box.reversals(n, dt, [j], 21)))
    out.append(("all joints back and forth at several speeds", box.sweeps(n, dt, range(problem.dof), 22)))
    return [out[0], *((kind, box.cleared(q)) for kind, q in out[1:])]


@dataclasses.dataclass(frozen=True)
class _Box:
    """Where, how fast and with what acceleration motions may go."""

    lower: np.ndarray
    upper: np.ndarray
    speed: np.ndarray
    acceleration: np.ndarray
    home: np.ndarray
    """A pose that was recorded, in the middle of them."""
    surroundings: Surroundings

    @classmethod
    def around(cls, problem: Problem, surroundings: Surroundings) -> "_Box":
        arm = problem.arm
        every = [t.motion for t in problem.traces]
        q = np.concatenate([m.q for m in every])
        least, most = q.min(0), q.max(0)
        more = 0.25 * np.maximum(most - least, 0.6)
        lower, upper = np.asarray(arm.lower), np.asarray(arm.upper)
        room = 0.05 * np.where(np.isfinite(upper - lower), upper - lower, 0.0)
        return cls(
            np.minimum(np.maximum(least - more, lower + room), least),
            np.maximum(np.minimum(most + more, upper - room), most),
            np.maximum(1.1 * np.abs(np.concatenate([m.qd for m in every])).max(0), 0.3),
            np.maximum(1.1 * np.abs(np.concatenate([m.qdd for m in every])).max(0), 1.0),
            q[np.argmin(np.sum(((q - 0.5 * (least + most)) / np.maximum(most - least, 1e-3)) ** 2, 1))],
            surroundings,
        )

    def cleared(self, q: Float[np.ndarray, "time dof"]) -> Float[np.ndarray, "time dof"]:
        """The motion within the box, about `home` and as large as is clear."""
        q = np.clip(q, self.lower, self.upper)
        sizes = (self.home + size * (q - self.home) for size in _SMALLER)
        return next(
            (one for one in sizes if self.surroundings.are_clear(one)), np.tile(self.home, (len(q), 1))
        )

    def pose(self, rng: np.random.Generator) -> np.ndarray:
        q = self.home
        for _ in range(_DRAWS):
            q = self.lower + rng.uniform(0.05, 0.95, len(self.lower)) * (self.upper - self.lower)
            if self.surroundings.are_clear(q[None]):
                return q
        return q

    def fourier(self, n: int, dt: float, seed: int, share: float) -> np.ndarray:
        """Five harmonics within the box, from rest to rest."""
        rng, t = np.random.default_rng(seed), np.arange(n) * dt
        ramp = np.clip(np.minimum(t, t[-1] - t) / 1.0, 0, 1)
        clock = np.cumsum(ramp**2 * (3 - 2 * ramp)) * dt
        w = 2 * np.pi * np.arange(1, 6) / max(0.6 * t[-1], 5.0)
        a = rng.normal(size=(5, len(self.lower))) / np.arange(1, 6)[:, None]
        phase = rng.uniform(0, 2 * np.pi, (5, len(self.lower)))
        q = np.sum(a * np.sin(w[:, None] * clock[:, None, None] + phase), 1)
        middle = 0.5 * (q.max(0) + q.min(0))
        qd = np.gradient(q, dt, axis=0)
        fastest, hardest = np.abs(qd).max(0), np.abs(np.gradient(qd, dt, axis=0)).max(0)
        room = 0.5 * (self.upper - self.lower) / (0.5 * np.ptp(q, axis=0))
        scale = np.min([room, share * self.speed / fastest, share * self.acceleration / hardest], 0)
        free = 0.5 * (self.upper - self.lower) - 0.5 * scale * np.ptp(q, axis=0)
        centre = 0.5 * (self.upper + self.lower) + rng.uniform(-0.5, 0.5, len(self.lower)) * free
        return centre + scale * (q - middle)

    def points(self, n: int, dt: float, seed: int, share: float) -> np.ndarray:
        """Quintic moves between random poses, and rests."""
        rng = np.random.default_rng(seed)
        at = self.pose(rng)
        parts, rows = [np.repeat(at[None], round(_DWELL / dt), 0)], 0
        while rows < n:
            to = self.pose(rng)
            parts += [self._move(at, to, dt, share), np.repeat(to[None], round(_DWELL / dt), 0)]
            at, rows = to, sum(map(len, parts))
        return _cut(np.concatenate(parts), n, dt)

    def sweeps(self, n: int, dt: float, joints: Sequence[int], seed: int) -> np.ndarray:
        """Some joints to and fro at constant speeds, the others in one pose after another."""
        rng = np.random.default_rng(seed)
        at, parts, rows, turn = self.pose(rng), [], 0, 0
        while rows < n:
            to = self.pose(rng) if turn % 4 == 0 else at.copy()
            parts.append(self._move(at, to, dt, 0.8))
            at, share = to, (1.0, 0.15, 0.5, 0.05)[turn % 4]
            for goal in (self.lower, self.upper):
                to = at.copy()
                to[list(joints)] = (0.9 * goal + 0.1 * at)[list(joints)]
                parts.append(self._steady(at, to, dt, share, longest=4.0))
                parts.append(np.repeat(parts[-1][-1:], round(0.3 / dt), 0))
                at = parts[-1][-1]
            turn, rows = turn + 1, sum(map(len, parts))
        return _cut(np.concatenate(parts), n, dt)

    def reversals(self, n: int, dt: float, joints: Sequence[int], seed: int) -> np.ndarray:
        """In several poses, swings of decreasing size."""
        rng = np.random.default_rng(seed)
        at, parts, rows = self.pose(rng), [], 0
        chosen = np.zeros(len(self.lower))
        chosen[list(joints)] = 1.0
        while rows < n:
            to = self.pose(rng)
            parts.append(self._move(at, to, dt, 0.8))
            for size in (0.15, 0.04, 0.012):
                period = float(np.clip(2 * np.pi * size / (0.15 * self.speed[list(joints)].min()), 0.6, 1.6))
                t = np.arange(round(2 * period / dt)) * dt
                swing = size * np.sin(2 * np.pi * t / period) * np.sin(np.pi * t / t[-1])
                parts.append(to + chosen * swing[:, None])
            at, rows = to, sum(map(len, parts))
        return _cut(np.concatenate(parts), n, dt)

    def _move(self, at: np.ndarray, to: np.ndarray, dt: float, share: float) -> np.ndarray:
        """Quintic, as fast as allowed."""
        way = np.abs(to - at)
        slow = 15 / 8 * way / (share * self.speed)
        hard = np.sqrt(5.7735 * way / (share * self.acceleration))
        s = np.linspace(0, 1, max(round(max(slow.max(), hard.max(), 0.2) / dt), 2))[:, None]
        return at + (to - at) * s**3 * (10 - 15 * s + 6 * s**2)

    def _steady(self, at: np.ndarray, to: np.ndarray, dt: float, share: float, longest: float) -> np.ndarray:
        """At constant speed, cut short where it would take too long."""
        way = np.abs(to - at)
        needed = float((way / (share * self.speed)).max())
        reach = min(1.0, longest / max(needed, 1e-9))
        rows = max(round(reach * needed / dt), 4)
        return at + (to - at) * reach * np.linspace(0, 1, rows)[:, None]


def _cut(q: Float[np.ndarray, "_rows dof"], n: int, dt: float) -> Float[np.ndarray, "_n dof"]:
    """The first n rows, corners rounded, coming to rest at the end."""
    smooth: Callable = scipy.ndimage.gaussian_filter1d
    q = smooth(q[:n], 0.04 / dt, axis=0, mode="nearest")
    tail = min(round(0.6 / dt), n // 4)
    s = np.linspace(0, 1, tail)
    clock = np.concatenate([np.arange(n - tail), n - tail + tail * (s - 0.5 * s**2)])
    return scipy.interpolate.CubicSpline(np.arange(n), q)(np.minimum(clock, n - 1))
