"""Which physics recordings say that an arm's model is missing, and how well the corrected model fits them."""

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from .. import files
from .. import signals as signals_
from ..arms import markup
from ..arms.arm import Arm, joints_named
from ..arms.export import missing_assets
from ..arms.mjcf import MjcfSource
from ..corrected import KIND, Corrected
from ..effects import UNNAMED, AbstractEffect
from ..host import on_host
from ..inference import knowledge as knowledge_
from ..inference.friction_shown import friction_shown
from ..inference.noise import as_sharp_as_shown
from ..inference.problem import FOLDS, Problem
from ..inference.state import State, with_terms
from ..posterior import FILE as POSTERIOR_FILE
from ..prediction.as_recorded import as_recorded
from ..recordings import Recording
from ..search.coverage import HeatMap, Least, heat_map, least_shown
from ..search.premises import settled
from ..search.uncertainty import polished
from ..session import Say
from ..traces import Trace, trajectory
from . import saved
from .calibration import TOLD, calibrated
from .correction import correction, fitted_laws
from .decide import LIKELY, findings, numbers, partly, worded
from .finding import VERDICTS, Finding, Fit
from .localise import Localisation, localise, unbiased
from .next_motion import NextMotion, next_motion
from .posterior import posterior_of
from .unnamed import standing_off
from .written import buildable

NEXT_MOTION = "next_motion.csv"


@dataclasses.dataclass(frozen=True)
class Diagnosis:
    """What the simulation is missing, and the simulation with it."""

    verdict: str
    findings: tuple[Finding, ...]
    fit: Fit
    corrected: Corrected
    written: markup.Document
    """The user's file and what it includes, with what MuJoCo can hold of the corrected model."""
    notes: tuple[str, ...]
    """What was done to the recordings, and what the corrected file cannot hold."""
    log: tuple[str, ...]
    """What the search tried, in its order."""
    problem: Problem = dataclasses.field(repr=False)
    state: State = dataclasses.field(repr=False)
    source: MjcfSource = dataclasses.field(repr=False)
    """The simulation as it was given."""
    knowledge: knowledge_.Knowledge
    spread: Float[np.ndarray, "standard n"] = dataclasses.field(repr=False)
    """Of the inertial parameters, as `knowledge` has it."""
    kept: State = dataclasses.field(repr=False)
    """The terms of the corrected model, by their laws."""
    scale: float = 1.0
    """Multiple of the uncertainty that `knowledge` means."""
    sources: tuple[Mapping[str, str], ...] = ()
    """Files that went in: role, name and sha256."""
    replays: tuple[Mapping[str, Any], ...] = ()
    """How closely both simulations follow recordings, as `jaxpanda.rollout.compare` says it; may be left out."""

    @property
    def bare(self) -> "Diagnosis":
        """The same, without what its search keeps and can be made again."""
        return dataclasses.replace(self, problem=self.problem.bare)

    @functools.cached_property
    def localisation(self) -> tuple[Localisation, Localisation]:
        """What stands out of noise before anything was added to the model, and after."""
        noise = unbiased(self.problem, self.state.terms, self.state.noise)
        after = localise(self.problem, self.problem.design(self.state.terms, noise), noise)
        if not self.state.terms:
            return after, after
        return localise(self.problem, self.problem.design((), noise), noise), after

    @functools.cached_property
    def heat_map(self) -> HeatMap:
        """Held-out gain of every effect at every joint."""
        return heat_map(self.problem, self.state)

    @functools.cached_property
    def least_shown(self) -> tuple[Least, ...]:
        """The smallest size of every effect that these recordings would have shown."""
        return least_shown(self.problem, self.state)

    @functools.cached_property
    def next_motion(self) -> NextMotion | None:
        """The motion that would decide between a finding and its rivals; None where none is needed."""
        return next_motion(self.problem, self.state, self.findings, self.spread, self.knowledge, self.source)

    @functools.cached_property
    def held_out(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """For each recording the errors [N m] of a fit to other blocks, and which samples count."""
        return held_out(self.problem, self.state)

    @on_host
    def to_json(self) -> dict[str, Any]:
        """diagnosis.json."""
        return saved.document(
            self,
            self.knowledge,
            localisation={
                when: found.to_json()
                for when, found in zip(("before", "after"), self.localisation, strict=True)
            },
            heat_map=self.heat_map.to_json(),
            smallest_shown=[one.to_json() for one in self.least_shown],
            next_experiment=None if self.next_motion is None else self.next_motion.to_json(),
            log=list(self.log),
        )

    def residuals(self) -> list[tuple[str, np.ndarray, np.ndarray, np.ndarray]]:
        """For each recording its name, times [s], and what is left of the torque before and after [N m]."""
        before, after = _errors(self.problem, self.state)
        traces = self.problem.traces
        return [(t.name, t.motion.time, b, a) for t, b, a in zip(traces, before, after, strict=True)]

    def lines(self) -> list[str]:
        """Verdict, which joints it does not speak of, and findings in plain sentences."""
        return [VERDICTS[self.verdict], *self.not_judged, *saved.sentences(self.findings)]

    @property
    def not_judged(self) -> list[str]:
        """A sentence about the joints that the verdict does not speak of."""
        joints = [j for j, judged in enumerate(_judged(self.problem)) if not judged]
        return [f"Not judged: {joints_named(joints)}; the notes say why."] if joints else []

    def save(self, folder: str | Path) -> tuple[str, ...]:
        """Write diagnosis.json, corrected.xml with what it includes, corrected.json, and posterior.npz;
        next_motion.csv where one would decide. What corrected.xml will not find there comes back, a sentence
        each.

        Raises:
            InputError: a file of such a name stands there that no earlier diagnosis left; nothing is written.
        """
        with files.output_folder(folder, KIND) as scratch:
            saved.write(self, scratch)
            posterior_of(self).save(scratch / POSTERIOR_FILE)
            if self.next_motion is not None:
                self.next_motion.save(scratch / NEXT_MOTION)
        return missing_assets(self.written, Path(folder))


def sought(
    arm: Arm,
    source: MjcfSource,
    recordings: Sequence[Recording],
    traces: Sequence[Trace],
    active: Sequence[bool],
    knowledge: knowledge_.Knowledge,
    catalogue: tuple[type[AbstractEffect], ...],
    progress: Say,
) -> tuple[Diagnosis, Corrected]:
    """Search the recordings for physics that the arm lacks; what was found, and what of it the user's file is to
    hold. `Diagnosis.written` is that file as it was.

    Args:
        arm: whose torque is compared.
        source: the simulation.
        recordings: those in question.
        traces: of all recordings.
        active: of each trace, whether it is in question.
        knowledge: how well the arm's numbers are known.
        catalogue: effects that are tried.
        progress: called with what is being done.
    """
    progress("looking for effects that make the recordings likelier; that takes most of the time")
    log = _Log(progress)
    shown = friction_shown([t for t, on in zip(traces, active, strict=True) if on])
    traces = as_sharp_as_shown([t.showing(shown) for t in traces])
    premises, searched = settled(tuple(traces), tuple(active), knowledge, log, catalogue=catalogue)
    problem = premises.problem
    progress("refining the numbers, and weighing what else it could be")
    state = polished(problem, searched)
    laws = fitted_laws(problem, state)
    guessed = premises.knowledge not in ("exact", "identified")
    moved = numbers(problem, state, premises.changes) if guessed else []
    motions = [trajectory(recording) for recording in recordings]
    made = correction(arm, premises, laws, motions, moved=bool(moved))
    fitted = fit(problem, made.kept)
    # beside recordings of reference, to which numbers were refitted with the others, they are no news
    wrong = moved if all(active) else []
    found = [*findings(problem, searched, state, laws, fitted.missed), *wrong]
    more = partly(problem, state) or not all(_judged(problem))
    likely = [worded(problem, laws, f) for f in calibrated(found, verdict(found, fitted, more), fitted)]
    unsure = [f for f in likely if f.terms and f.confidence < TOLD]
    told = [f for f in likely if all(f is not u for u in unsure)]
    if unsure and not told:
        # the user's model is as good as any, which need not be good
        made = dataclasses.replace(made, kept=with_terms(problem, ()))
        fitted = fit(problem, made.kept)
        apart = standing_off(problem, made.kept, ())
        told = calibrated(apart, verdict(apart, fitted, more), fitted)
    corrected = made.model
    predicting = as_recorded(motions, buildable(source, corrected, problem), _judged(problem))
    diagnosis = Diagnosis(
        verdict=verdict(told, fitted, more),
        findings=tuple(told),
        fit=fitted,
        corrected=predicting,
        written=source.document,
        notes=(
            *premises.notes,
            *([_too_unsure(unsure)] if unsure else []),
            *([_refitted(arm, moved)] if moved and not wrong else []),
            *made.left_out,
            *(f"{t.name}: {what}: {count}" for t in traces for what, count in t.signals.repairs.items()),
            *(n for t in traces for n in _still(t)),
            *_unheard(problem),
            *_as_recorded(predicting),
            *(n for t in traces for n in t.signals.notes),
        ),
        log=tuple(log),
        problem=problem,
        state=state,
        source=source,
        knowledge=premises.knowledge,
        spread=premises.spread,
        kept=made.kept,
        scale=premises.scale,
    )
    # numbers that moved by less than torque shows stay as the user wrote them
    return diagnosis, corrected if moved else corrected.as_written


def _refitted(arm: Arm, moved: Sequence[Finding]) -> str:
    """A sentence about numbers of the model that healthy recordings had refitted too, and so are no finding."""
    each = []
    for f in moved:
        j = max(f.joints, key=lambda j: f.rms_torque[j])
        size = f"{f.rms_torque[j]:.3g} {arm.unit('N·m', j)} rms"
        each.append(f"{f.effect.replace('_', ' ')}, by up to {size} at joint {j + 1}")
    return f"numbers of the model were refitted to recordings of reference too: {'; '.join(each)}"


def _too_unsure(findings: Sequence[Finding]) -> str:
    """A sentence about findings that are not told."""
    each = []
    for f in findings:
        each.append(f"{f.effect.replace('_', ' ')} at {joints_named(f.joints)} ({f.confidence:.2f})")
    return f"fits, but is hardly likely to be what is missing, and so no finding: {'; '.join(each)}"


class _Log(list[str]):
    """Lines that are also told as they are written."""

    def __init__(self, progress: Say) -> None:
        super().__init__()
        self.progress = progress

    def append(self, line: str) -> None:
        super().append(line)
        self.progress(line)


def _still(trace: Trace) -> list[str]:
    """A sentence about the joints that stand still in a recording."""
    joints = np.flatnonzero(~trace.trust.any(0)).tolist()
    if not joints:
        return []
    return [
        f"{trace.name}: {joints_named(joints)} never moved; friction at rest may carry any part of the load"
        " there, so that torque was not judged"
    ]


def _as_recorded(corrected: Corrected) -> list[str]:
    """Sentences where predictions differ from MuJoCo's, or take less of the motion than q shows."""
    out = []
    turned = [(j, turn) for j, turn in enumerate(corrected.turns) if turn is not None]
    if turned:
        said = ", ".join(
            f"{turn.size:g} {corrected.arm.unit(turn.unit, j)} at joint {j + 1}" for j, turn in turned
        )
        out.append(
            f"`predict` turns the model's Coulomb friction over {said}, which is nearer to the recordings than"
            " MuJoCo's constraint, by which corrected.xml and simulations turn it"
        )
    low = {j + 1: cutoff for j, cutoff in enumerate(corrected.cutoffs) if cutoff is not None}
    if low:
        said = ", ".join(f"{cutoff:g} Hz at joint {joint}" for joint, cutoff in low.items())
        out.append(f"`predict` leaves out faster motion than the recorded torque shows: above {said}")
    return out


def _judged(problem: Problem) -> list[bool]:
    """Whether each joint moved, and enough of its samples tell, in the recordings in question."""
    suspect = [t for t, on in zip(problem.traces, problem.active, strict=True) if on]
    moved = np.any([t.trust.any(0) for t in suspect], 0)
    return [bool(moved[j]) and problem.saturation.tells(j) for j in range(problem.dof)]


def _unheard(problem: Problem) -> list[str]:
    """A sentence about the joints that move, but of which too few samples count."""
    moving = np.any([t.weights.any(0) for t in problem.traces], 0)
    joints = [j for j in range(problem.dof) if moving[j] and not problem.saturation.tells(j)]
    if not joints:
        return []
    return [
        f"too few samples of {joints_named(joints)} can be used to tell physics from"
        " noise, so that torque was not judged there"
    ]


def _errors(problem: Problem, state: State) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Errors of torque before and after in each recording [N m]; zero where a recording has gaps."""
    before = [r * t.weight[:, None] for r, t in zip(problem.residual, problem.traces, strict=True)]
    explained = []
    for i, (n, t) in enumerate(zip(problem.nuisance, problem.traces, strict=True)):
        columns = np.concatenate([n, *(term.columns[i] for term in state.terms)], 2)
        explained.append((columns @ problem.explained(state.design.x, state.terms)) * t.weight[:, None])
    return before, [b - e for b, e in zip(before, explained, strict=True)]


def fit(problem: Problem, state: State) -> Fit:
    """Errors before and after; held out: coefficients refitted without the block that is tested."""
    before, after = _errors(problem, state)
    held = held_out(problem, state)
    return Fit(_rms(before), _rms(after), _rms([b[m] for b, (_, m) in zip(before, held, strict=True)]),
               _rms([e[m] for e, m in held]), state.noise.std)  # fmt: skip


def held_out(problem: Problem, state: State) -> list[tuple[np.ndarray, np.ndarray]]:
    """For each recording: errors [N m] with the samples' own block left out of the fit, and where they count.

    What happened once in a recording has no second instance to be tested on: those samples are left out.
    """
    bound = [t for t in state.terms if t.effect.is_event]
    folds = signals_.blocks_many([t.signals for t in problem.traces], FOLDS)
    out = []
    for r, trace in enumerate(problem.traces):
        counts = trace.weight > 0
        for term in bound:
            counts = counts & ~np.any(term.columns[r] != 0, axis=(1, 2))
        out.append((problem.residual[r].copy(), counts))
    everything = [
        np.concatenate([n, *(t.columns[i] for t in state.terms)], 2) for i, n in enumerate(problem.nuisance)
    ]
    for splits in folds:
        traces = tuple(
            dataclasses.replace(t, weight=t.weight * train)
            for t, (train, _) in zip(problem.traces, splits, strict=True)
        )
        part = dataclasses.replace(problem, traces=traces, silent=problem.silent_joints)
        fitted = part.design(state.terms, state.noise)
        x = problem.explained(fitted.x, state.terms)
        for r, (_, test) in enumerate(splits):
            out[r][0][test] -= everything[r][test] @ x
    return out


def _rms(parts: Sequence[np.ndarray]) -> np.ndarray:
    stacked = np.concatenate(list(parts))
    return np.sqrt(np.mean(stacked**2, 0)) if len(stacked) else np.zeros(stacked.shape[1])


def verdict(found: Sequence[Finding], fit: Fit, partly: bool) -> str:
    """The answer in a word; `partly`: whether structure is left that the findings do not explain, or that could
    not be judged. Nothing is explained where held-out error does not fall."""
    names = [f.effect for f in found]
    if not names:
        return "consistent"
    if UNNAMED not in names:
        doubtful = all(f.confidence < LIKELY for f in found)
        held_out = fit.held_out_rmse_before, fit.held_out_rmse_after
        before, after = (np.sum(np.square(error / fit.noise_floor)) for error in held_out)
        events_alone = all(f.intervals is not None for f in found)  # no second instance to be tested on
        helps = events_alone or after < before
        return "partly_explained" if partly or doubtful or not helps else "explained"
    return "unexplained" if set(names) == {UNNAMED} else "partly_explained"
