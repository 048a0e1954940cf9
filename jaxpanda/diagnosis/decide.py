"""From accepted terms to findings: merged, weighed against their rivals, and said in words."""

import dataclasses
import functools
from collections import Counter
from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float

from ..arms.arm import joints_named
from ..effects import UNNAMED, law_of
from ..inference.problem import Problem, Term
from ..inference.state import State, coefficients, foretelling, leftover, torque, without
from ..search.steps import posterior
from ..search.uncertainty import covariances, leaned
from .calibration import SUREST
from .finding import Finding, joined
from .unnamed import held_off, hum, standing_off, stuck

LEFT, LEFT_CLEAR, LEFT_MAIN = 0.15, 0.1, 0.05
"""When a joint is not fully explained: this share of its squared residual beyond noise is left, more than this
many times the noise's own, in a joint whose residual is at least this share of the largest."""
MOST_ALIKE = 2
"""Terms of one effect at one place, beyond which it is not the right one: three ripples make any shape."""
_TOUCHING = 0.15
"""Pause between events that happened at once [s]."""
_LISTED = 0.01
"""Probability from which a rival is listed."""
LIKELY, SURE = 0.5, 0.9
"""Confidence from which a finding is said to be so, and from which its rivals need no mention."""
REFITTED = 0.9
"""Confidence that a model's numbers are wrong, where their refit explains what differs and nothing else does."""


def findings(
    problem: Problem,
    searched: State,
    state: State,
    laws: State,
    missed: Float[np.ndarray, " dof"] | float = 0.0,
) -> list[Finding]:
    """The accepted terms as findings, those first that explain most torque, in the noise of its joint.

    Args:
        problem: the recordings.
        searched: the likeliest model as the search left it, by which its terms are weighed against their rivals.
        state: the same with its shapes polished.
        laws: the same without discrepancy, as the corrected model has them: what is told of torque and numbers.
        missed: torque that the corrected model lacks [N m]; each law may have taken in some of it.
    """
    rivals = [_rivals(problem, searched, state, i) for i in range(len(state.terms))]
    groups = together(problem, state.terms)
    names = titles(state.terms)
    more = leaned(laws, missed + np.zeros(problem.dof))
    spread = [
        covariance + np.diag(np.pad(off, (0, len(covariance) - len(off))) ** 2)
        for covariance, off in zip(covariances(problem, state), more, strict=True)
    ]
    helps = foretold(problem, laws, groups)
    out = [
        _finding(problem, laws, group, names[group[0]], rivals, spread, gained)
        for group, gained in zip(groups, helps, strict=True)
    ]
    # what is in the band of the search belongs to what was found there
    lowest = {"lowest": problem.traces[0].cutoff} if out else {}
    halted = stuck(problem, state.noise.std)
    unnamed = hum([t.signals for t in problem.traces], problem.active, state.noise.std, **lowest)
    explained = lambda f: float(np.sum(np.square(f.rms_torque / state.noise.std)))
    still = held_off(problem, state)
    out = sorted(out, key=explained, reverse=True) + [f for f in (halted, unnamed, still) if f is not None]
    return out + standing_off(problem, state, {j for f in out for j in f.joints})


def numbers(
    problem: Problem, state: State, changes: Callable[[Float[np.ndarray, " n"]], tuple[np.ndarray, ...]]
) -> list[Finding]:
    """The model's own numbers as what is wrong, where their refit explains more of a joint's torque than its
    noise, what the refit is uncertain by taken off.

    `changes`: what coefficients of the nuisance mean for standard parameters, damping, frictionloss
    and armature.
    """
    n = problem.nuisance[0].shape[2]
    values = changes(state.design.x[:n])
    root = np.linalg.cholesky(np.linalg.inv(state.design.information)[:n, :n])
    moved = [changes(x) for x in root.T]
    deviations = [np.sqrt(np.sum(np.square(part), 0)) for part in zip(*moved, strict=True)]
    suspect = [t for t, on in zip(problem.traces, problem.active, strict=True) if on]
    weights = np.concatenate([t.weights for t in suspect])
    regressor = np.concatenate([t.motion.regressor for t in suspect])
    channels = [
        np.concatenate(x)
        for x in zip(*((t.motion.qd, t.down(t.sign), t.motion.qdd) for t in suspect), strict=True)
    ]
    torques = [lambda x: regressor @ x.ravel(), *(lambda x, of=of: of * x for of in channels)]
    power = lambda torque: np.mean((torque * weights) ** 2, 0) / np.maximum(np.mean(weights**2, 0), 1e-9)
    told = (
        ("standard", "mass_change", "kg", "Y(q, dq, ddq) * (change of inertial parameters)"),
        ("damping", "damping", "N·m·s/rad", "damping * dq, beyond the model's"),
        ("frictionloss", "coulomb", "N·m", "coulomb * sign(dq), beyond the model's"),
        ("armature", "armature", "kg·m²", "armature * ddq, beyond the model's"),
    )
    out = []
    for k, (number, parameter, unit, law) in enumerate(told):
        name = law_of(number).name
        value, std, torque = values[k], deviations[k], torques[k]
        felt = power(torque(value))
        unsure = sum((power(torque(part[k])) for part in moved if np.any(part[k])), np.zeros(problem.dof))
        joints = tuple(np.flatnonzero(felt - unsure > state.noise.std**2).tolist())
        if not joints:
            continue
        whole = value.ndim > 1  # links beyond a joint act in it
        strongest = max(joints, key=lambda j: felt[j])
        parts = ((j, value[j, 0], std[j, 0]) if whole else (j, value[j], std[j]) for j in range(problem.dof))
        out.append(
            Finding(
                effect=name,
                joints=joints,
                recordings=tuple(t.name for t in suspect),
                confidence=REFITTED,
                alternatives=((law_of("scale").name, round(1 - REFITTED, 3)),),
                equation=f"tau = {law}",
                parameters=tuple(
                    {"name": parameter, "joint": j + 1, "value": float(v), "std": float(s), "unit": unit}
                    for j, v, s in parts
                    if whole or j in joints
                ),
                rms_torque=np.sqrt(felt),
                evidence=float(0.5 * len(weights) * np.sum(felt / state.noise.std**2)),
                summary=f"The simulation's own numbers are not this arm's ({name.replace('_', ' ')}): refitted"
                f" together they explain {np.sqrt(felt[strongest]):.3g}"
                f" {problem.arm.unit('N·m', strongest)} rms at joint {strongest + 1}."
                " Torque sensors of a wrong scale could look alike.",
            )
        )
    return sorted(out, key=lambda f: -f.evidence)


def partly(problem: Problem, state: State) -> bool:
    """Whether structure is left that the terms do not explain, or one law had to be called on again and again."""
    before, after = leftover(problem, state)
    main = before > LEFT_MAIN * before.max()
    if any(count > MOST_ALIKE for count in Counter(t.key for t in state.terms).values()):
        return True
    return bool(np.any(main & (after > LEFT_CLEAR) & (after > LEFT * before)))


def titles(terms: Sequence[Term]) -> list[str]:
    """What each term is called beside the others: a law that another of its joint may hold goes by that one."""
    out = []
    for term in terms:
        beside = (t.effect for t in terms if t is not term and t.effect.joints == term.effect.joints)
        out.append(next((e.title for e in beside if term.effect.title in e.may_hold), term.effect.title))
    return out


def together(problem: Problem, terms: Sequence[Term]) -> list[list[int]]:
    """Which terms make one finding: those of one effect at several joints, or that happened at once."""
    out: list[list[int]] = []
    names = titles(terms)
    for i, term in enumerate(terms):
        for group in out:
            if any(names[k] == names[i] and _same(problem, terms[k], term) for k in group):
                group.append(i)
                break
        else:
            out.append([i])
    return out


def _same(problem: Problem, a: Term, b: Term) -> bool:
    if not a.effect.bound_to_recording:
        return True
    if a.effect.recordings != b.effect.recordings:
        return False
    return a.effect.joints == b.effect.joints or len(_intervals(problem, [a, b])) == 1


def _rivals(problem: Problem, searched: State, state: State, i: int) -> tuple[float, dict[str, float], float]:
    """Evidence of a term, probability of each effect in its place, and of its own."""
    evidence = state.design.log_evidence - without(state, i).log_evidence
    probability = posterior(problem, searched, i)
    was, title = searched.terms[i].effect.title, state.terms[i].effect.title
    if was != title:  # polished, the same law may go by another name
        probability[title] = probability.get(title, 0.0) + probability.pop(was, 0.0)
    return evidence, probability, probability.get(title, 0.0)


def _finding(
    problem: Problem,
    state: State,
    members: Sequence[int],
    name: str,
    rivals: Sequence,
    covariance: Sequence[Float[np.ndarray, "_n _n"]],
    gained: float,
) -> Finding:
    size = lambda i: float(np.linalg.norm(problem.weighed(torque(state, i))))
    members = sorted(members, key=size, reverse=True)  # of two laws of one joint the larger comes first
    terms = [state.terms[i] for i in members]
    effect = next((t.effect for t in terms if t.effect.name == name), terms[0].effect)
    joints = tuple(sorted({j for t in terms for j in t.effect.joints}))
    if effect.bound_to_recording:  # what happened at once happened at one place
        joints = terms[int(np.argmax([rivals[i][0] for i in members]))].effect.joints
    together = torque(state, *members)
    names = [t.name for t, on in zip(problem.traces, problem.active, strict=True) if on]
    intervals = None
    acting = [np.ones(len(x), bool) for x in together]
    if effect.bound_to_recording:
        names = list(effect.recordings)
        intervals = _intervals(problem, terms) if effect.is_event else None
        acting = [np.any(x != 0, axis=1) for x in together]
    felt = np.concatenate(
        [x[on] for x, on, active in zip(together, acting, problem.active, strict=True) if active]
    )
    rms = np.sqrt(np.mean(felt**2, 0)) if len(felt) else np.zeros(problem.dof)
    variance = np.zeros(problem.dof)
    for i, term in zip(members, terms, strict=True):
        own = slice(0, len(term.deviation))
        some = zip(term.columns, acting, problem.active, strict=True)
        columns = np.concatenate([x[on] for x, on, active in some if active])
        if len(columns):
            variance += np.sum(columns @ covariance[i][own, own] * columns, (0, 2)) / len(columns)
    parameters, equations = [], []
    for i, term in zip(members, terms, strict=True):
        told = term.effect.parameters(coefficients(state, i), covariance[i])
        parameters += [{**p, "unit": term.effect.unit(p["unit"], problem.arm)} for p in told]
        if term.effect.equation not in equations:
            equations.append(term.effect.equation)
    named = [i for i in members if state.terms[i].effect.title == name] or list(members)
    clearest = max(named, key=lambda i: rivals[i][0])
    same = (name, state.terms[clearest].effect.title)
    alternatives = sorted(
        ((n, p) for n, p in rivals[clearest][1].items() if n not in same and p >= _LISTED),
        key=lambda pair: -pair[1],
    )
    return Finding(
        effect=name,
        joints=joints,
        recordings=tuple(names),
        intervals=intervals,
        confidence=float(np.clip(rivals[clearest][2], 0.0, SUREST)),
        alternatives=tuple(alternatives[:4]),
        equation="; ".join(equations),
        parameters=tuple(parameters),
        rms_torque=rms,
        evidence=float(sum(rivals[i][0] for i in members)),
        summary="",
        terms=tuple(members),
        kind=getattr(terms[0].effect, "form", ""),
        own_family=effect.family,
        foretold=gained,
        torque_std=np.sqrt(variance),
    )


def worded(problem: Problem, laws: State, finding: Finding) -> Finding:
    """The same in sentences, which go by how sure it is; what is no law has its own."""
    if not finding.terms:
        return finding
    remarks = dict.fromkeys(laws.terms[i].effect.remark for i in finding.terms)
    numbers = [one for i in finding.terms for one in _corrected(problem, laws, i)]
    said = [_summary(problem, finding, numbers), *(remark for remark in remarks if remark)]
    return dataclasses.replace(finding, summary=" ".join(said))


def foretold(problem: Problem, laws: State, groups: Sequence[Sequence[int]]) -> list[float]:
    r"""By how much likelier the terms of each group make the torque of blocks that nothing was fitted to [nats].

    $\tfrac12 \sum_j n_j \log (s^2_j / S^2_j)$ with S² the mean square error beside all terms, s² without the
    group, and $n_j$ independent samples of either.
    """

    @functools.cache
    def whole(spread: bool) -> Float[np.ndarray, "rows dof"]:
        return problem.mispredicted(laws.design, [laws.noise], spread=spread)

    out = []
    for group in groups:
        effects = [laws.terms[i].effect for i in group]
        spread = any(e.drifts or e.bound_to_recording for e in effects)
        rest = laws.design
        for i in sorted(group, reverse=True):
            rest = rest.without(i)
        out.append(foretelling(problem.mispredicted(rest, [laws.noise], spread=spread), whole(spread)))
    return out


def _intervals(problem: Problem, terms: Sequence[Term]) -> tuple[tuple[float, float], ...]:
    """When the terms act [s], what touches joined."""
    trace = next(t for t in problem.traces if t.name in terms[0].effect.recordings)
    first, last = float(trace.channels.t[0]), float(trace.channels.t[-1])
    spans = sorted((max(first, float(t.effect.start)), min(last, float(t.effect.stop))) for t in terms)  # pyright: ignore
    return joined(spans, _TOUCHING)


Number = tuple[str, int, float, float, str]
"""One of the user's model, its joint, the model's value and the recordings', and the unit."""


def _corrected(problem: Problem, state: State, i: int) -> list[Number]:
    """Numbers of the user's model that a term corrects; none where it is more than that."""
    term = state.terms[i]
    laws, values = term.effect.coefficients, coefficients(state, i)
    if len(term.corrections) < len(laws):
        return []
    unit = lambda k: term.effect.unit(laws[k].unit, problem.arm)
    known = {k: one for k, one in term.corrections.items() if one.value > 0}
    return [(*one.of, one.value, max(one.value + float(values[k]), 0.0), unit(k)) for k, one in known.items()]


def _wrong_number(numbers: Sequence[Number], strongest: int, likely: bool) -> tuple[str, str]:
    """That a number of the user's model is wrong, and what it should be where that shows most."""
    ups = [new > old for _, _, old, new, _ in numbers]
    how = "too small" if all(ups) else "not this arm's" if any(ups) else "too large"
    where = next((one for one in numbers if one[1] == strongest), None)
    closing = "" if where is None else f", where {where[2]:.3g} should be {where[3]:.2g} {where[4]}"
    return f"The simulation's {numbers[0][0]} {'is' if likely else 'may be'} {how}", closing


def _summary(problem: Problem, finding: Finding, numbers: Sequence[Number]) -> str:
    """One or two plain sentences."""
    name, joints, rms = finding.effect, finding.joints, finding.rms_torque
    strongest = int(np.argmax(rms))
    size = f"{rms[strongest]:.3g} {problem.arm.unit('N·m', strongest)} rms"
    if name == UNNAMED and len(joints) > 1:
        return (
            f"{joints_named(joints).capitalize()} show up to {size}, at joint {strongest + 1}, that no named"
            f" effect explains: {finding.equation.split(': ')[-1]}."
        )
    if name == UNNAMED:
        return (
            f"Joint {strongest + 1} shows {size} that no named effect explains; it is"
            f" fitted as a free curve ({finding.equation.split(': ')[-1]})."
        )
    where = "" if len(joints) in (0, problem.dof) else f" at {joints_named(joints)}"
    when = ""
    if finding.intervals is not None:
        times = ", ".join(f"{a:.2f} s to {b:.2f} s" for a, b in finding.intervals)
        when = f" in {finding.recordings[0]} from {times}"
    likely = finding.confidence >= LIKELY
    opening, closing = f"The simulation {'is' if likely else 'may be'} missing {name.replace('_', ' ')}", ""
    if {at for _, at, *_ in numbers} == set(joints):
        opening, closing = _wrong_number(numbers, strongest, likely)
    most = size if joints == (strongest,) else f"up to {size}, at joint {strongest + 1}"
    text = f"{opening}{where}{when}: {most}{closing}."
    if finding.alternatives and finding.confidence < SURE:
        rival = finding.alternatives[0][0]
        cls = next(c for c in problem.catalogue if c.name == name)
        text += f" These recordings could also mean {rival.replace('_', ' ')}; {cls.reveals} would tell."
    return text
