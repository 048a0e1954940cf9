"""What a diagnosis works on, and the model it has arrived at so far."""

import dataclasses
import functools
import itertools
import operator
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import scipy.linalg
from jaxtyping import Bool, Float

from .. import signals as signals_
from ..arms.arm import Arm
from ..effects import CATALOGUE, AbstractEffect, Channels, Stretches, joint_columns
from ..errors import InputError
from ..host import parallel
from ..traces import Trace
from .bodies import Body, Correction, body, corrections_of
from .discrepancy import at_rest, known_at_rest, of_law, resting, unresolved, unresolved_known
from .evidence import Columns, Design, Noise
from .grid import Grid
from .library import Candidates
from .noise import ORDER, QUIETEST, JointNoise, Saturation
from .scan import Block, Family, Score, Whitened, families, projected, scan

_UNHEARD = 1e9
"""Innovations of a joint that no recording tells anything about [N m]."""
_PICKED = 64
"""Rows of a joint at rest that are looked at."""
FOLDS = 5
"""Blocks of the cross-validation, and how often they come in a recording for what changes with time."""


@dataclasses.dataclass(frozen=True)
class Term:
    """An effect taken into the model: its columns in each recording, and the prior of its coefficients."""

    effect: AbstractEffect
    columns: tuple[Float[np.ndarray, "_time dof _n"], ...]
    deviation: Float[np.ndarray, " n"]
    discrepancy: tuple[Float[np.ndarray, "_time dof _m"], ...] = ()
    """What its law may be off, with coefficients of unit variance; none where empty."""
    unresolved: Float[np.ndarray, "rows dof"] | None = None
    """Square of what it may be off from sample to sample, which no column describes [N² m²]."""
    at_rest: Float[np.ndarray, "rows dof"] | None = None
    """Square of what it may be off for as long as a joint rests, likewise [N² m²]."""
    prior: float = 0.0
    """Logarithm of its prior odds, less what the search over its shapes has cost [nats]."""
    corrections: Mapping[int, Correction] = dataclasses.field(default_factory=dict)
    """Which coefficients correct a number of the user's arm."""

    @property
    def law(self) -> "Term":
        """The law alone; samples at which it may be off weigh as little as with its discrepancy."""
        return dataclasses.replace(self, discrepancy=())

    @property
    def exact(self) -> "Term":
        """The law alone, believed to the last digit."""
        return dataclasses.replace(self, discrepancy=(), unresolved=None, at_rest=None)

    @property
    def key(self) -> tuple[str, tuple[int, ...]]:
        """Name and joints: what makes two terms the same finding."""
        return self.effect.name, self.effect.joints

    @functools.cached_property
    def precision(self) -> Float[np.ndarray, " width"]:
        """Prior precision of all its coefficients in a design: the law's, then the discrepancy's."""
        more = self.discrepancy[0].shape[2] if self.discrepancy else 0
        return np.concatenate([self.deviation**-2.0, np.ones(more)])

    @functools.cached_property
    def body(self) -> Body | None:
        """That the law's coefficients must be those of; None for the tangent of a shape."""
        if self.effect.body is None or len(self.deviation) != len(self.effect.coefficients):
            return None
        return body(self.effect.body)

    @property
    def width(self) -> int:
        """How many coefficients it has in a design."""
        return len(self.precision)

    @functools.cached_property
    def acts(self) -> Bool[np.ndarray, " dof"]:
        """In which joints."""
        return np.any([np.any(c, (0, 2)) for c in self.columns], 0)

    def torque_at(self, joint: int, x: Float[np.ndarray, " width"]) -> list[Float[np.ndarray, " _time"]]:
        """Torque of a joint in each recording with these coefficients, the discrepancy's included [N m]."""
        own = len(self.deviation)
        law = [c[:, joint] @ x[:own] for c in self.columns]
        if not self.discrepancy:
            return law
        return [tau + d[:, joint] @ x[own:] for tau, d in zip(law, self.discrepancy, strict=True)]

    def at_joint(self, joint: int) -> list[Float[np.ndarray, "_time width"]]:
        """Columns of a joint in each recording, the discrepancy's last."""
        law = [c[:, joint] for c in self.columns]
        if not self.discrepancy:
            return law
        return [np.concatenate([a, d[:, joint]], 1) for a, d in zip(law, self.discrepancy, strict=True)]


@dataclasses.dataclass(frozen=True)
class Problem:
    """Recordings, what the nominal model leaves of them, and what is no physics to report."""

    traces: tuple[Trace, ...]
    active: tuple[bool, ...]
    """Whether effects may act in a recording; not in those of reference."""
    nuisance: tuple[Float[np.ndarray, "_time dof _n"], ...]
    background: tuple[Term, ...] = ()
    """Effects that are known already: their columns are in the nuisance, and count as signal in the noise."""
    numbers: int | None = None
    """How many columns of the nuisance, the first ones, are numbers of the user's model."""
    corrections: Mapping[int, Correction] = dataclasses.field(default_factory=dict)
    """Which of these change a number that is not negative."""
    saturated: Saturation | None = dataclasses.field(default=None, repr=False, compare=False)
    """That of the same recordings, where a problem posed otherwise has made it already."""
    catalogue: tuple[type[AbstractEffect], ...] = CATALOGUE
    """Effects that are tried."""
    shapes: Grid | None = dataclasses.field(default=None, repr=False, compare=False)
    """Those of the same recordings and effects, likewise."""
    silent: tuple[int, ...] | None = None
    """Joints that no recording tells noise of, where a problem with more samples has told them."""

    def __getstate__(self) -> dict[str, Any]:
        """For pickle."""
        return vars(self.bare)

    @property
    def bare(self) -> "Problem":
        """The same, without what a search keeps and can be made again: most of what it takes in memory."""
        return dataclasses.replace(self, saturated=None, shapes=None)

    @property
    def arm(self) -> Arm:
        """The nominal one."""
        return self.traces[0].motion.arm

    @property
    def dof(self) -> int:
        return self.traces[0].motion.dof

    @functools.cached_property
    def residual(self) -> list[Float[np.ndarray, "_time dof"]]:
        """Measured less nominal torque [N m]."""
        return [trace.residual for trace in self.traces]

    @functools.cached_property
    def left_by_user(self) -> Float[np.ndarray, " dof"]:
        """What the user's model leaves of each joint's torque, `weighed`; at least the steps it has [N m]."""
        return np.maximum(self.weighed(self.residual), np.max([t.torque_step for t in self.traces], 0))

    def weighed(self, torque: Sequence[Float[np.ndarray, "_time dof"]]) -> Float[np.ndarray, " dof"]:
        """Root mean square of each joint's torque in all recordings, by what samples weigh [N m]."""
        parts = [x * t.weights for x, t in zip(torque, self.traces, strict=True)]
        return np.sqrt(np.mean(np.concatenate(parts) ** 2, 0))

    @functools.cached_property
    def grid(self) -> Grid:
        """Shapes of effects on these recordings, and their columns."""
        return self.shapes or Grid(self.traces, self.active, self.catalogue)

    @property
    def library(self) -> list[Candidates]:
        """The catalogue on these recordings; zero in those of reference."""
        return self.grid.library

    @property
    def catchalls(self) -> list[Candidates]:
        """Free forms on these recordings; zero in those of reference."""
        return self.grid.catchalls

    def columns(self, effects: Sequence[AbstractEffect]) -> list[Float[np.ndarray, "_time ..."]]:
        """Columns of shapes of one form at one place in all recordings, as `library.columns_of`."""
        return self.grid.columns(effects)

    @property
    def shaken(self) -> slice:
        """Where the nuisance has what was recorded otherwise than it was."""
        stop = self.nuisance[0].shape[2] - sum(len(t.deviation) for t in self.background)
        return slice(stop - self.traces[0].shaken.shape[2], stop)

    @property
    def known_off(self) -> slice:
        """Where the nuisance has what the known friction may be off."""
        stop = self.shaken.start
        return slice(stop if self.numbers is None else self.numbers, stop)

    def explained(self, x: Float[np.ndarray, " n"], terms: Sequence[Term] = ()) -> Float[np.ndarray, " laws"]:
        """Of a design's coefficients those of the nuisance and of the terms' laws, what belongs to a recording
        and to no model set to zero: the encoders' noise, and what laws are off."""
        count = self.nuisance[0].shape[2]
        nuisance = x[:count].copy()
        nuisance[self.shaken], nuisance[self.known_off] = 0.0, 0.0
        ends = count + np.cumsum([0, *(t.width for t in terms)])
        laws = [x[at : at + len(t.deviation)] for at, t in zip(ends, terms, strict=False)]
        return np.concatenate([nuisance, *laws])

    def term(
        self,
        effect: AbstractEffect,
        deviation: Float[np.ndarray, " n"],
        c: Float[np.ndarray, " n"] | None = None,
        std: Float[np.ndarray, " dof"] | None = None,
        prior: float = 0.0,
    ) -> Term:
        """The effect's columns in all recordings; with its discrepancy, if coefficients and noise are known."""
        columns = tuple(self.full_columns(effect))
        known = corrections_of(effect, self.arm)
        if c is None or std is None:
            return Term(effect, columns, deviation, prior=prior, corrections=known)
        torque = [x @ c for x in columns]
        evaluate = lambda other: [x @ c for x in self.full_columns(other)]
        off = tuple(of_law(self.traces, effect, torque, std, evaluate))
        traces = self.traces
        rests = at_rest(traces, effect, torque)
        return Term(effect, columns, deviation, off, unresolved(traces, torque), rests, prior, known)

    def full_columns(self, effect: AbstractEffect) -> list[Float[np.ndarray, "_time dof _n"]]:
        """Columns of an effect, at all joints."""
        columns = self.columns([effect])
        if not effect.one_joint:
            return [c[:, :, 0] for c in columns]
        out = []
        for c in columns:
            wide = np.zeros((len(c), self.dof, c.shape[2]))
            wide[:, effect.joints[0]] = c[:, 0]
            out.append(wide)
        return out

    def whitened(self, columns: Sequence[np.ndarray], noise: Noise, joint: int) -> np.ndarray:
        """Rows of a joint in all recordings, one below the other, with unit noise."""
        parts = []
        for r, x in enumerate(columns):
            parts.append(noise.whiten(x, joint, self.weights(noise, r, joint), self.rows[r]))
        return np.concatenate(parts)

    def weights(self, noise: Noise, r: int, joint: int) -> Float[np.ndarray, " _time"]:
        """What the samples of a recording weigh in a joint."""
        return self.traces[r].weights[:, joint] * noise.trusted(self.rows[r], joint)

    def counts(self, noise: Noise, joint: int) -> float:
        """How many samples tell of a joint: the square of weighted innovations that are noise, in sum. One counts
        little where the joint may rest, held at any load by friction: it scatters no more there for what it
        weighs."""
        total = 0.0
        for rows, trace in zip(self.rows, self.traces, strict=True):
            each = trace.scatter[:, joint]
            if noise.at_rest is not None:
                each = each * (1 - noise.at_rest[rows, joint] * noise.trusted(rows, joint) ** 2)
            total += float(np.sum(each[noise.a.shape[1] :]))
        return total

    @functools.cached_property
    def rows(self) -> list[slice]:
        """Where each recording's samples are, all one below the other."""
        ends = np.cumsum([0, *(t.motion.samples for t in self.traces)]).tolist()
        return [slice(a, b) for a, b in itertools.pairwise(ends)]

    @functools.cached_property
    def families(self) -> list[Family]:
        """Library and free forms as the scan takes them."""
        return families([*self.library, *self.catchalls], self.arm)

    @functools.cached_property
    def places(self) -> Counter[str]:
        """At how many places each effect is tried."""
        keys = {(g.name, g.effects[0].joints) for g in (*self.library, *self.catchalls)}
        events = {(one.name, one.joints) for forms in self.grid.at_some_time(0) for one in forms}
        joints = range(self.dof)
        swept = {(c.name, (j,)) for c in self.catalogue for j in joints if self.grid.sweep(c, j)}
        return Counter(name for name, _ in {*keys, *events, *swept})

    @functools.cached_property
    def likeliest_shapes(self) -> dict[tuple, AbstractEffect]:
        """Where searches over the shapes of an effect at a place have ended last."""
        return {}

    @functools.cached_property
    def tried(self) -> dict[tuple, Any]:
        """Steps of a search that have been tried, and what was found."""
        return {}

    @functools.cached_property
    def _scanned(self) -> list:
        return []

    def scan(self, design: Design, noise: Noise, groups: Sequence[Candidates]) -> dict[int, Score]:
        """`scan.scan` of these groups' families; those of the last design are kept."""
        if not self._scanned or self._scanned[0] is not design or self._scanned[1] is not noise:
            self._scanned[:] = design, noise, {}
        found, asked = self._scanned[2], {id(g) for g in groups} - set(self._scanned[2])
        found |= scan(self, design, noise, [f for f in self.families if asked & {id(g) for g in f.groups}])
        return found

    @functools.cached_property
    def _joints(self) -> dict[tuple[int, bool], Whitened]:
        """By joint, and whether its noise is more than what a saturated model leaves."""
        return {}

    def whitened_joint(self, noise: Noise, joint: int, terms: Sequence[Term] = ()) -> Whitened:
        """Residual, nuisance and terms in a joint, whitened; kept while the joint's noise stays."""
        trust = None if noise.trust is None else noise.trust[:, joint].tobytes()
        slow = noise.slow[joint].tobytes() if noise.has_slow(joint) else None  # pyright: ignore
        stamp = noise.a[joint].tobytes(), float(noise.sigma[joint]), trust, slow
        key = joint, noise.is_widened(joint)
        here = self._joints.get(key)
        if here is None or here.stamp != stamp:
            residual = self.whitened([r[:, joint] for r in self.residual], noise, joint)
            nuisance = self.whitened([n[:, joint] for n in self.nuisance], noise, joint)
            here = self._joints[key] = Whitened(stamp, residual, nuisance)
        for term in terms:
            if id(term) not in here.terms:
                rows = self.whitened(term.at_joint(joint), noise, joint) if term.acts[joint] else None
                here.terms[id(term)] = term, rows
        return here

    def transposed(self, noise: Noise, joint: int, here: Whitened, key: Any) -> Float[np.ndarray, "rows n"]:
        """`Noise.transposed` of rows in a joint, kept while they are."""
        if key not in here.transposed:
            x = here.rows(key)
            assert x is not None
            parts = [
                noise.transposed(x[rows], joint, self.weights(noise, r, joint), rows)
                for r, rows in enumerate(self.rows)
            ]
            here.transposed[key] = np.concatenate(parts).reshape(len(x), -1)
        return here.transposed[key]

    def forget(self, term: Term) -> None:
        """Give back what was kept of a term that was tried: a search tries thousands."""
        for here in self._joints.values():
            _, rows = here.terms.pop(id(term), (term, None))
            here.transposed.pop(id(term), None)
            if rows is not None:
                here.products = {k: v for k, v in here.products.items() if id(term) not in k}
                for _, kept in here.blocks.values():
                    kept.pop(id(term), None)

    def whitened_joints(self, noise: Noise, terms: Sequence[Term]) -> list[Whitened]:
        """`whitened_joint` of all."""
        return [self.whitened_joint(noise, j, terms) for j in range(self.dof)]

    @functools.cached_property
    def _repeated(self) -> dict[Any, Block]:
        return {}

    def projected(
        self, key: Any, make: Any, noise: Noise, design: Design, joint: int
    ) -> tuple[Float[np.ndarray, "m n"], Float[np.ndarray, "m n n"]]:
        """b and G (its lower triangle) of candidates in one joint that come again.

        Args:
            key: names the columns.
            make: gives them for each recording, `(time, m, n)`.
            noise: to whiten by.
            design: what the model holds.
            joint: where.
        """
        if (key, joint) not in self._repeated:
            x = np.swapaxes(np.concatenate(make()), 1, 2)
            flat = np.ascontiguousarray(x).reshape(len(x), -1)
            self._repeated[key, joint] = Block(key, joint, x.shape[1], flat)
        return projected(self, noise, design, [self._repeated[key, joint]])

    def design(self, terms: Sequence[Term], noise: Noise) -> Design:
        """The model with these terms, whitened."""
        counts = [self.nuisance[0].shape[2], *(t.width for t in terms)]
        ends = np.cumsum([0, *counts])
        place = {
            key: slice(ends[i], ends[i + 1]) for i, key in enumerate(["nuisance", *(id(t) for t in terms)])
        }
        H, g = np.zeros((ends[-1], ends[-1])), np.zeros(ends[-1])
        joints = self.whitened_joints(noise, terms)
        for here in joints:
            acting = ["nuisance", *(id(t) for t in terms if here.rows(id(t)) is not None)]
            for i, left in enumerate(acting):
                g[place[left]] += here.product(left, "residual")
                for right in acting[: i + 1]:
                    H[place[left], place[right]] += here.product(left, right)
        H = np.tril(H) + np.tril(H, -1).T
        for joint, picked, nuisance, residual in self._resting:
            A = np.concatenate([nuisance, *(picked(t.at_joint(joint)) for t in terms)], 1)
            H += A.T @ A
            g += A.T @ residual
        precision = np.concatenate([np.ones(counts[0]), *(t.precision for t in terms)])
        parts = [[(at, x) for key, at in place.items() if (x := h.rows(key)) is not None] for h in joints]
        columns = Columns(parts, len(joints[0].residual), int(ends[-1]))
        residual = [h.residual for h in joints]
        return Design(columns, residual, precision, (H, g), terms, self.corrections)

    @functools.cached_property
    def silent_joints(self) -> tuple[int, ...]:
        """Joints that no recording tells noise of."""
        if self.silent is not None:
            return self.silent
        return tuple(j for j in range(self.dof) if not self.saturation.tells(j))

    @functools.cached_property
    def _resting(self) -> list[tuple[int, Callable, np.ndarray, np.ndarray]]:
        """Joints that no recording tells noise of, as where friction holds them: what picks some rows of their
        columns, and the nuisance and the residual there, over the deviation of the torque.

        It is off by as much as with the user's model, and its rows together tell as much as one sample. Without
        that models differ there in ways that nothing bounds.
        """
        rows = np.unique(np.linspace(0, self.rows[-1].stop - 1, _PICKED).astype(int))
        each = [rows[(rows >= part.start) & (rows < part.stop)] - part.start for part in self.rows]
        some = lambda parts: np.concatenate([x[k] for x, k in zip(parts, each, strict=True)])
        out = []
        for joint in self.silent_joints:
            residual = some([r[:, joint] for r in self.residual])
            size = max(float(np.sqrt(np.mean(residual**2))), QUIETEST) * np.sqrt(len(rows))
            nuisance = some([n[:, joint] for n in self.nuisance]) / size
            out.append((joint, lambda parts, size=size: some(parts) / size, nuisance, residual / size))
        return out

    @functools.cached_property
    def folds(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Rows to train and to test on, blocked so that no test repeats training data."""
        return self._folds()

    @functools.cached_property
    def spread_folds(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """The same in shorter blocks, each fold's all over the recording: of what changes with time, a long block
        left out is the only one that shows how it was then."""
        return self._folds(FOLDS)

    def _folds(self, rounds: int = 1) -> list[tuple[np.ndarray, np.ndarray]]:
        splits = signals_.blocks_many([t.signals for t in self.traces], FOLDS, rounds=rounds)
        return [
            (np.concatenate([s[0] for s in fold]), np.concatenate([s[1] for s in fold])) for fold in splits
        ]

    def held_out_error(
        self, design: Design, counts: Bool[np.ndarray, " rows"] | None = None, *, spread: bool = False
    ) -> float:
        """Squared whitened error on blocks that the coefficients were not fitted to, in the rows that count."""
        error, folds = 0.0, self.spread_folds if spread else self.folds
        for (_, test), x in zip(folds, _left_out(design, folds), strict=True):
            rows = test if counts is None else test & counts
            for A, r in zip(design.columns, design.residual, strict=True):
                error += float(np.sum((r[rows] - A[rows] @ x) ** 2))
        return error

    def predicted_error(
        self, design: Design, noise: Noise, *, spread: bool = False
    ) -> tuple[Float[np.ndarray, " dof"], Float[np.ndarray, " dof"], Float[np.ndarray, " dof"]]:
        """Squared error of each joint's predicted torque, over the noise's deviation, where coefficients were not
        fitted: with the model of the design, with the user's, and of noise alone.

        In other recordings, or in other blocks of the only one.
        """
        of = np.repeat(np.arange(len(self.traces)), [t.motion.samples for t in self.traces])
        folds = [(of != r, of == r) for r, on in enumerate(self.active) if on]
        if len(folds) == 1:
            folds = self.spread_folds if spread else self.folds
        weight = np.concatenate([t.weights for t in self.traces]) / noise.std
        tested = np.any([test for _, test in folds], 0)
        users = weight * np.concatenate(self.residual)
        left = self._mispredicted(design, folds) / noise.std
        alone = weight[tested] * noise.std
        return np.sum(left**2, 0), np.sum(users[tested] ** 2, 0), np.sum(alone**2, 0)

    def mispredicted(
        self, design: Design, noises: Sequence[Noise], *, spread: bool = False
    ) -> Float[np.ndarray, "rows dof"]:
        """Torque that a model gets wrong on blocks that its coefficients were not fitted to [N m], by what a row
        weighs in the noises of the models that are compared: where friction of one may hold any load, neither is
        wrong."""
        left = self._mispredicted(design, self.spread_folds if spread else self.folds)
        trusts = [noise.trust for noise in noises if noise.trust is not None]
        return left * np.min(trusts, 0) if trusts else left

    def _mispredicted(self, design: Design, folds: Sequence) -> Float[np.ndarray, "rows dof"]:
        """Not whitened: as whoever takes the model to predict torque would see it, slow errors count in full,
        what was put down to the encoders' noise does not help, and of what sensors show there is only what is
        predicted."""
        residual, nuisance = np.concatenate(self.residual), np.concatenate(self.nuisance)
        out = np.zeros_like(residual)
        laws = [np.concatenate(term.columns)[:, term.acts] for term in design.terms]
        ends = nuisance.shape[2] + np.cumsum([0, *(len(term.deviation) for term in design.terms)])
        at = [slice(int(a), int(b)) for a, b in itertools.pairwise(ends)]
        found = [self.explained(x, design.terms) for x in _left_out(design, folds)]
        for (_, test), x in zip(folds, found, strict=True):
            left = residual[test] - nuisance[test] @ x[: ends[0]]
            for term, law, own in zip(design.terms, laws, at, strict=True):
                left[:, term.acts] -= law[test] @ x[own]
            out[test] = left
        for term, own in zip(design.terms, at, strict=True):
            if term.effect.takes_shown:
                less = np.concatenate(term.columns) - self._of_predicted(term.effect, out)
                for (_, test), x in zip(folds, found, strict=True):
                    out[test] += less[test] @ x[own]
        return out * np.concatenate([t.weights for t in self.traces])

    def _of_predicted(
        self, effect: AbstractEffect, wrong: Float[np.ndarray, "rows dof"]
    ) -> Float[np.ndarray, "rows dof n"]:
        """Columns of an effect of the torque that sensors show, made from what is predicted of it: all but what
        is `wrong`."""
        columns = np.zeros((*wrong.shape, len(effect.coefficients)))
        for r, (trace, rows) in enumerate(zip(self.traces, self.rows, strict=True)):
            motion = trace.motion
            known = motion.q, motion.qd, motion.qdd, motion.load, trace.tau - trace.residual
            channels = Channels(motion.time, *known, shown=trace.tau - wrong[rows])
            for here in self.grid.placed([effect], r):
                values = joint_columns([here], Stretches(channels), motion.dt)  # pyright: ignore
                columns[rows, here.joints[0]] = values[:, 0]
        return columns

    @functools.cached_property
    def saturation(self) -> Saturation:
        """What the noise is estimated by."""
        if self.saturated is not None and all(map(operator.is_, self.saturated.traces, self.traces)):
            return self.saturated
        return Saturation(self.traces)

    @functools.cached_property
    def telling(self) -> int:
        """How many joints tell of themselves: that move, and of which enough samples count."""
        return sum(self.saturation.tells(joint) for joint in range(self.dof))

    @functools.cached_property
    def beyond_noise(self) -> list[tuple]:
        """What is beyond each joint's noise beside the last model; the next begins so too."""
        return []

    @functools.cached_property
    def _noises(self) -> dict[tuple, tuple[JointNoise, list[Term]]]:
        return {}

    def noise(self, terms: Sequence[Term]) -> Noise:
        """Noise that a saturated model with these terms leaves; of a joint it depends on what acts there."""

        def one(joint: int) -> JointNoise:
            if joint not in heard:
                taus = [t.signals.tau for t in self.traces if t.signals.tau is not None]
                white = float(np.median([signals_.white_noise(tau)[joint] for tau in taus]))
                quietest = max(white, QUIETEST)
                return JointNoise(np.zeros(ORDER), _UNHEARD, quietest, 1.0, 1.0, quietest)
            here = [t for t in (*self.background, *terms) if t.acts[joint]]
            key = joint, *(id(t) for t in here)
            if key not in self._noises:
                extra = [
                    np.concatenate([ripples[joint][r], *(t.columns[r][:, joint] for t in here)], 1)
                    for r in range(len(self.traces))
                ]
                spread = rows_at_rest[:, joint], off[:, joint], rests[:, joint]
                found = self.saturation.noise(joint, extra, *spread)
                self._noises[key] = found, here  # keeps what it names alive
            return self._noises[key][0]

        ripples, rows_at_rest = self.saturation.ripples, self._at_rest  # made once, before there are threads
        heard = {j for j in range(self.dof) if self.saturation.tells(j)}
        if not heard:
            samples = max(self.saturation.samples(j) for j in range(self.dof))
            rows = sum(t.motion.samples for t in self.traces)
            names = ", ".join(t.name for t in self.traces)
            raise InputError(
                f"{names}: {samples:.0f} samples (of {rows}) that tell of a joint, at most, are too few to tell"
                " physics from noise; record longer, or more motion: of seven joints that move all the time"
                " 2 s at 100 Hz or more are enough"
            )
        off = self._known_unresolved + sum(t.unresolved for t in terms if t.unresolved is not None)
        rests = np.zeros_like(off) + sum(t.at_rest for t in terms if t.at_rest is not None)
        a, sigma, std, quiet, share, beside = zip(*parallel(one, range(self.dof)), strict=True)
        off, rests, known = (x / np.square(beside) for x in (off * share, rests, self._known_at_rest))
        trust = 1 / np.sqrt(1 + off + rests)
        return Noise(
            np.stack(a), np.array(sigma), np.array(std), trust, rests, rests + known, quiet=np.array(quiet)
        )

    @functools.cached_property
    def _at_rest(self) -> Float[np.ndarray, "rows dof"]:
        return resting(self.traces)

    @functools.cached_property
    def _known_at_rest(self) -> Float[np.ndarray, "rows dof"]:
        return known_at_rest(self.traces)

    @functools.cached_property
    def _known_unresolved(self) -> Float[np.ndarray, "rows dof"]:
        return unresolved_known(self.traces)


def _left_out(
    design: Design, folds: Sequence[tuple[np.ndarray, np.ndarray]]
) -> list[Float[np.ndarray, " n"]]:
    """Coefficients fitted without each fold: what it holds is subtracted from the whole's normal equations."""
    H, g = design.information, design.g
    less = [(np.zeros_like(H), np.zeros_like(g)) for _ in folds]
    for A, r in zip(design.columns, design.residual, strict=True):
        for (train, _), (dH, dg) in zip(folds, less, strict=True):
            out, missing = A[~train], r[~train]
            dH += out.T @ out
            dg += out.T @ missing
    found = []
    for dH, dg in less:
        if len(g):
            solve = _solver(H - dH)
            found.append(design.admissible(solve(g - dg), solve)[0])
        else:
            found.append(g)
    return found


def _solver(H: Float[np.ndarray, "n n"]) -> Callable[[np.ndarray], np.ndarray]:
    """Multiplies by $H^{-1}$, whose coefficients differ in size by their units."""
    unit = 1 / np.sqrt(np.diag(H))
    factor = scipy.linalg.cho_factor(unit[:, None] * H * unit, lower=True)
    return lambda y: (unit * scipy.linalg.cho_solve(factor, (unit * y.T).T).T).T


def posed(
    traces: tuple[Trace, ...],
    active: tuple[bool, ...],
    nuisance: Sequence[Float[np.ndarray, "_time dof _n"]],
    background: Sequence[Term] = (),
    saturated: Saturation | None = None,
    numbers: int | None = None,
    corrections: Mapping[int, Correction] | None = None,
    catalogue: tuple[type[AbstractEffect], ...] = CATALOGUE,
    shapes: Grid | None = None,
) -> Problem:
    """A problem whose background acts in all recordings: its columns, by their deviations, end the nuisance."""
    everywhere = Problem(traces, (True,) * len(traces), tuple(nuisance))
    terms = tuple(everywhere.term(t.effect, t.deviation) for t in background)
    corrections, place = dict(corrections or {}), nuisance[0].shape[2]
    for t in terms:
        sizes = t.deviation
        corrections |= {
            place + k: dataclasses.replace(one, size=float(sizes[k])) for k, one in t.corrections.items()
        }
        place += len(sizes)
    wide = [
        np.concatenate([n, *(t.columns[r] * t.deviation for t in terms)], 2) for r, n in enumerate(nuisance)
    ]
    return Problem(traces, active, tuple(wide), terms, numbers, corrections, saturated, catalogue, shapes)
