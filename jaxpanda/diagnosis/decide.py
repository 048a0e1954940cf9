"""From accepted terms to findings: merged, weighed against their rivals, and said in words."""

import itertools
from collections import Counter
from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Array, Float

from ..effects import CATALOGUE, AbstractEffect
from ..effects.contact import ExternalContact
from ..effects.drive import Backlash, JointElasticity
from ..effects.friction import CoulombFriction, StribeckFriction, ViscousFriction
from ..effects.load import InertialParameters, PayloadChange
from ..effects.memory import PreslidingHysteresis
from ..effects.sensing import TorqueGain
from .finding import Finding, joined
from .problem import Problem, Term
from .rivals import called, odds
from .search import instead
from .state import State, leftover, places, shares, without
from .uncertainty import covariances
from .unnamed import BEYOND, hum, standing_off, stuck

LEFT, LEFT_CLEAR, LEFT_MAIN = 0.15, 0.1, 0.05
"""When a joint is not fully explained: this share of its squared residual beyond noise is left, more than this
many times the noise's own, in a joint whose residual is at least this share of the largest."""
DOUBT, CROWD = 6.0, 0.6
"""How probability falls with the share that is left in a finding's joints, $e^{-6 s}$, and with every effect
beyond two in its `crowd`: who needs many laws has not met the right one."""
MISLEADS, WANDERS = 0.1, 0.3
"""And for a law that predicts torque no better where it was not fitted; a drift, which goes on as it likes, is
doubted less for that, and so is what happened once, most of it in a joint where another law does so."""
MEANT, AS_CLEAR = 0.05, 0.1
"""Share of a term's torque from which it counts among the laws of a joint; share of a term's evidence from which
another's is about as clear."""
MOST_ALIKE = 2
"""Terms of one effect at one place, beyond which it is not the right one: three ripples make any shape."""
_WIDER = ("stribeck_friction", "asymmetric_friction", "load_dependent_friction", "friction_drift")
_TURNING = 0.02
"""Velocity below which friction is still turning [rad/s]."""
_TOUCHING = 0.15
"""Pause between events that happened at once [s]."""
_LISTED = 0.01
"""Probability from which a rival is listed."""
DOUBTFUL = 0.2
"""Confidence below which what a finding stands for counts as not explained."""
UNLIKELY = 0.1
"""Confidence below which one of several findings loses its name."""
REFITTED = 0.9
"""Confidence that a model's numbers are wrong, where their refit explains what differs and nothing else does."""


def findings(problem: Problem, state: State, lost: Sequence[bool]) -> list[Finding]:
    """The accepted terms as findings, those that explain most first.

    `lost`: which of them predict torque no better where they were not fitted.
    """
    rivals = [_rivals(problem, state, i) for i in range(len(state.terms))]
    groups = together(problem, state.terms)
    before, after = leftover(state)
    left = np.clip(after / np.maximum(before, 1e-9), 0, 1) * (after > LEFT_CLEAR)
    names, where = titles(state.terms, problem.arm.frictionloss), shares(state)
    each = list(names)  # what happened apart in time is not one law
    for k, group in enumerate(groups):
        for i in group:
            if state.terms[i].effect.bound_to_recording:
                each[i] = f"{names[i]} {k}"
    wide = [len(t.effect.joints) > 1 for t in state.terms]
    doubt = CROWD ** np.maximum(0.0, crowd(where, each, [r[0] for r in rivals], wide) - 2)
    doubt = doubt * np.exp(-DOUBT * where @ left)
    drifts = [t.effect.drifts for t in state.terms]
    doubt = doubt * np.where(lost, np.where(drifts, WANDERS, MISLEADS), 1.0)
    misled = sorted({int(where[i].argmax()) for i in np.flatnonzero(lost)})
    for group in groups:
        once = [i for i in group if state.terms[i].effect.bound_to_recording]
        if any(where[i, misled].sum() > 0.5 for i in once):
            doubt[once] *= WANDERS
    spread = covariances(problem, state)
    out = [_finding(problem, state, group, names[group[0]], rivals, doubt, spread) for group in groups]
    out = unnamed_where_doubtful(problem, state, out)
    if all(lost) and all(p <= UNLIKELY for f in out for p in (f.confidence, *dict(f.alternatives).values())):
        out = []  # none is likely, and none predicts torque
    # what is in the band of the search belongs to what was found there
    lowest = {"lowest": problem.traces[0].cutoff} if out else {}
    halted = stuck(problem, state.noise.std)
    unnamed = hum([t.signals for t in problem.traces], problem.active, state.noise.std, **lowest)
    unnamed = unnamed or (None if out else standing_off(problem, state))
    return sorted(out, key=lambda f: -f.evidence) + [f for f in (halted, unnamed) if f is not None]


def numbers(
    problem: Problem, state: State, changes: Callable[[Float[np.ndarray, " n"]], tuple[np.ndarray, ...]]
) -> list[Finding]:
    """The model's own numbers as what is wrong, where their refit explains a joint far beyond its noise.

    `changes`: what coefficients of the nuisance mean for standard parameters, damping and frictionloss.
    """
    n = problem.nuisance[0].shape[2]
    values = changes(state.design.x[:n])
    root = np.linalg.cholesky(np.linalg.inv(state.design.information)[:n, :n])
    deviations = [np.sqrt(np.sum(np.square(part), 0)) for part in zip(*map(changes, root.T), strict=True)]
    suspect = [t for t, on in zip(problem.traces, problem.active, strict=True) if on]
    weights = np.concatenate([t.weights for t in suspect])
    felt = (
        [t.motion.regressor @ values[0].ravel() for t in suspect],
        [t.motion.qd * values[1] for t in suspect],
        [t.down(t.sign) * values[2] for t in suspect],
    )
    told = (
        (InertialParameters.name, "mass_change", "kg", "Y(q, dq, ddq) * (change of inertial parameters)"),
        (ViscousFriction.name, "damping", "N·m·s/rad", "damping * dq, beyond the model's"),
        (CoulombFriction.name, "coulomb", "N·m", "coulomb * sign(dq), beyond the model's"),
    )
    out = []
    for torque, value, std, (name, parameter, unit, law) in zip(felt, values, deviations, told, strict=True):
        power = np.mean((np.concatenate(torque) * weights) ** 2, 0) / np.maximum(np.mean(weights**2, 0), 1e-9)
        joints = tuple(np.flatnonzero(power > BEYOND * state.noise.std**2).tolist())
        if not joints:
            continue
        whole = value.ndim > 1  # links beyond a joint act in it
        strongest = max(joints, key=lambda j: power[j])
        parts = ((j, value[j, 0], std[j, 0]) if whole else (j, value[j], std[j]) for j in range(problem.dof))
        out.append(
            Finding(
                effect=name,
                joints=joints,
                recordings=tuple(t.name for t in suspect),
                intervals=None,
                confidence=REFITTED,
                alternatives=((TorqueGain.name, round(1 - REFITTED, 3)),),
                equation=f"tau = {law}",
                parameters=tuple(
                    {"name": parameter, "joint": j + 1, "value": float(v), "std": float(s), "unit": unit}
                    for j, v, s in parts
                    if whole or j in joints
                ),
                rms_torque=np.sqrt(power),
                evidence=float(0.5 * len(weights) * np.sum(power / state.noise.std**2)),
                summary=f"The simulation's own numbers are not this arm's ({name.replace('_', ' ')}): refitted"
                f" together they explain {np.sqrt(power[strongest]):.3g} N·m rms at joint {strongest + 1}."
                " Torque sensors of a wrong scale could look alike.",
                terms=(),
            )
        )
    return sorted(out, key=lambda f: -f.evidence)


def unnamed_where_doubtful(problem: Problem, state: State, found: Sequence[Finding]) -> list[Finding]:
    """Of several findings those that neither they nor a rival names with `UNLIKELY` made one that is `unknown`.

    Laws that are called on together for what none of them is do not name it, and their parameters mean nothing;
    they stand among the alternatives, and in the model. One finding alone keeps its name: then no other law was
    called on.
    """
    names = {id(f): ((f.effect, f.confidence), *f.alternatives) for f in found if f.effect != "unknown"}
    doubtful = [f for f in found if id(f) in names and all(p < UNLIKELY for _, p in names[id(f)])]
    if not doubtful or len(found) == 1:
        return list(found)
    likely: dict[str, float] = {}
    for name, p in [pair for f in doubtful for pair in names[id(f)]]:
        if p >= _LISTED:
            likely[name] = max(p, likely.get(name, 0.0))
    doubtful += [f for f in found if f.effect == "unknown"]
    alternatives = sorted(likely.items(), key=lambda pair: -pair[1])[:4]
    terms = tuple(i for f in doubtful for i in f.terms)
    felt = [x for x, on in zip(torque(state, *terms), problem.active, strict=True) if on]
    rms = np.sqrt(np.mean(np.concatenate(felt) ** 2, 0))
    stand_ins = sorted({f.effect.replace("_", " ") for f in doubtful if f.effect != "unknown"})
    strongest = int(np.argmax(rms))
    size = f"{rms[strongest]:.3g} {problem.arm.unit('N·m', strongest)} rms"
    one = Finding(
        effect="unknown",
        joints=tuple(sorted({j for f in doubtful for j in f.joints})),
        recordings=tuple(dict.fromkeys(name for f in doubtful for name in f.recordings)),
        intervals=None,
        confidence=1.0 - (sum(p for _, p in alternatives) or 0.005),
        alternatives=tuple(alternatives),
        equation="; ".join(dict.fromkeys(f.equation for f in doubtful)),
        parameters=(),
        rms_torque=rms,
        evidence=sum(f.evidence for f in doubtful),
        summary=f"Joint {strongest + 1} shows {size} that no named effect explains; in its place the model has"
        f" what fits best, none of it likely: {', '.join(stand_ins)}.",
        terms=terms,
    )
    return [*(f for f in found if all(f is not d for d in doubtful)), one]


def crowd(
    where: Float[np.ndarray, "terms dof"],
    names: Sequence[str],
    evidence: Sequence[float],
    wide: Sequence[bool],
) -> Float[np.ndarray, " terms"]:
    """How many effects stand beside each term, itself included: in its joints, or about as clear anywhere.

    `where`: each term's shares of torque in the joints; `wide`: which of them are one cause of what several
    joints show. Those stand beside their like only: what is left of a joint's own laws stays in that joint.
    """
    found = np.zeros(len(names))
    for i, joint in itertools.product(range(len(names)), range(where.shape[1])):
        beside = {
            name
            for name, share, clear, one_cause in zip(names, where[:, joint], evidence, wide, strict=True)
            if (share > MEANT or clear >= AS_CLEAR * evidence[i]) and (one_cause or not wide[i])
        }
        found[i] += where[i, joint] * len(beside)
    return found


def partly(state: State) -> bool:
    """Whether structure is left that the terms do not explain, or one law had to be called on again and again."""
    before, after = leftover(state)
    main = before > LEFT_MAIN * before.max()
    if any(count > MOST_ALIKE for count in Counter(t.key for t in state.terms).values()):
        return True
    return bool(np.any(main & (after > LEFT_CLEAR) & (after > LEFT * before)))


def titles(
    terms: Sequence[Term], frictionloss: Float[Array, " dof"] | Float[np.ndarray, " dof"]
) -> list[str]:
    """What each term is called beside the others: Coulomb's friction is part of the laws that hold it, softness
    of a gear that has a gap, how the friction that the model knows turns where only a rotor feels it of the gap
    or spring beyond, and a body that is held while something pushes is part of the push.

    `frictionloss`: what the model has of it in each joint [N m].
    """
    out = []
    for term in terms:
        name = called(term.effect)
        if any(_meets(term.effect, other.effect) for other in terms):
            name = ExternalContact.name
        beside = [t.effect.name for t in terms if t.effect.joints == term.effect.joints]
        if name == CoulombFriction.name:
            name = next((n for n in _WIDER if n in beside), name)
        soft = next((n for n in (Backlash.name, JointElasticity.name) if n in beside), None)
        if name == JointElasticity.name or (soft and _turns(term.effect, frictionloss)):
            name = soft or name
        out.append(name)
    return out


def _turns(effect: AbstractEffect, frictionloss: Float[Array, " dof"] | Float[np.ndarray, " dof"]) -> bool:
    """Whether an effect is at speeds only at which known friction changes its sign.

    MuJoCo's holds the joint softly, the more so the less inertia it holds, and with a gap beyond that is the
    motor's alone.
    """
    if not isinstance(effect, StribeckFriction) or not float(frictionloss[effect.joints[0]]):
        return False
    return float(effect.stribeck_velocity) < _TURNING


def _meets(body: AbstractEffect, push: AbstractEffect) -> bool:
    """Whether a body is held for a while in which a contact acts too."""
    if not (isinstance(body, PayloadChange) and body.form == "carried" and isinstance(push, ExternalContact)):
        return False
    apart = body.stop < push.start or push.stop < body.start
    return body.recording == push.recording and not apart


def together(problem: Problem, terms: Sequence[Term]) -> list[list[int]]:
    """Which terms make one finding: those of one effect at several joints, or that happened at once."""
    out: list[list[int]] = []
    names = titles(terms, problem.arm.frictionloss)
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
    if getattr(a.effect, "recording", "") != getattr(b.effect, "recording", ""):
        return False
    return a.effect.joints == b.effect.joints or len(_intervals(problem, [a, b])) == 1


def _rivals(problem: Problem, state: State, i: int) -> tuple[float, dict[str, float], float]:
    """Evidence of a term, probability of each effect in its place, its own included."""
    effect = state.terms[i].effect
    evidence = state.design.log_evidence - without(state, i).log_evidence
    likely = odds(instead(problem, state, i), evidence if effect.name == "unknown" else None)
    probability = {name: p for name, (p, _) in likely.items()}
    return evidence, probability, probability.get(called(effect), 0.0)


def coefficients(state: State, i: int) -> Float[np.ndarray, " n"]:
    """Those of a term."""
    return state.design.x[places(state)[i]]


def torque(state: State, *members: int) -> list[Float[np.ndarray, "_time dof"]]:
    """Torque of terms together in each recording [N m]."""
    parts = [[columns @ coefficients(state, i) for columns in state.terms[i].columns] for i in members]
    return [np.sum(of_one, 0) for of_one in zip(*parts, strict=True)]


def _finding(
    problem: Problem,
    state: State,
    members: Sequence[int],
    name: str,
    rivals: Sequence,
    doubt: Float[np.ndarray, " terms"],
    covariance: Sequence[Float[np.ndarray, "_n _n"]],
) -> Finding:
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
        names = [getattr(effect, "recording", names[0])]
        intervals = _intervals(problem, terms)
        acting = [np.any(x != 0, axis=1) for x in together]
    felt = np.concatenate(
        [x[on] for x, on, active in zip(together, acting, problem.active, strict=True) if active]
    )
    rms = np.sqrt(np.mean(felt**2, 0)) if len(felt) else np.zeros(problem.dof)
    parameters, equations = [], []
    for i, term in zip(members, terms, strict=True):
        told = term.effect.parameters(coefficients(state, i), covariance[i])
        parameters += [{**p, "unit": term.effect.unit(p["unit"], problem.arm)} for p in told]
        if term.effect.equation not in equations:
            equations.append(term.effect.equation)
    named = [i for i in members if called(state.terms[i].effect) == name] or list(members)
    clearest = max(named, key=lambda i: rivals[i][0])
    sure = 1.0 if name == "unknown" else float(doubt[clearest])
    own = sure * rivals[clearest][2]
    same = (name, called(state.terms[clearest].effect))
    alternatives = sorted(
        ((n, sure * p) for n, p in rivals[clearest][1].items() if n not in same and sure * p >= _LISTED),
        key=lambda pair: -pair[1],
    )
    summary = _summary(name, joints, rms, intervals, names, alternatives, problem, own, "; ".join(equations))
    if name == CoulombFriction.name and any(isinstance(t.effect, PreslidingHysteresis) for t in terms):
        summary += " Its equation has it stick at rest, as MuJoCo's frictionloss does."
    return Finding(
        effect=name,
        joints=joints,
        recordings=tuple(names),
        intervals=intervals,
        confidence=float(np.clip(own, 0.0, 0.995)),
        alternatives=tuple(alternatives[:4]),
        equation="; ".join(equations),
        parameters=tuple(parameters),
        rms_torque=rms,
        evidence=float(sum(rivals[i][0] for i in members)),
        summary=summary,
        terms=tuple(members),
    )


def _intervals(problem: Problem, terms: Sequence[Term]) -> tuple[tuple[float, float], ...]:
    """When the terms act [s], what touches joined."""
    trace = next(t for t in problem.traces if t.name == getattr(terms[0].effect, "recording", t.name))
    first, last = float(trace.channels.t[0]), float(trace.channels.t[-1])
    spans = sorted((max(first, float(t.effect.start)), min(last, float(t.effect.stop))) for t in terms)  # pyright: ignore
    return joined(spans, _TOUCHING)


def _summary(name, joints, rms, intervals, recordings, alternatives, problem, own, equation) -> str:
    """One or two plain sentences."""
    strongest = int(np.argmax(rms))
    size = f"{rms[strongest]:.3g} {problem.arm.unit('N·m', strongest)} rms"
    if name == "unknown":
        return (
            f"Joint {strongest + 1} shows {size} that no named effect explains; it is"
            f" fitted as a free curve ({equation.split(': ')[-1]})."
        )
    where = "" if len(joints) in (0, problem.dof) else f" at joint{'s' * (len(joints) > 1)} {_listed(joints)}"
    when = ""
    if intervals is not None:
        when = " in " + recordings[0] + " from " + ", ".join(f"{a:.2f} s to {b:.2f} s" for a, b in intervals)
    text = (
        f"The simulation is missing {name.replace('_', ' ')}{where}{when}: up to {size},"
        f" at joint {strongest + 1}."
    )
    if alternatives and own < 0.9:
        rival = alternatives[0][0]
        cls = next(c for c in CATALOGUE if c.name == name)
        text += f" These recordings could also mean {rival.replace('_', ' ')}; {cls.reveals} would tell."
    return text


def _listed(joints: Sequence[int]) -> str:
    return ", ".join(str(j + 1) for j in joints)
