"""Scans over what the grids cannot hold: windows in time, frequencies, and shapes that are too many."""

import dataclasses
import itertools
from collections.abc import Iterable, Iterator, Sequence

import numpy as np
from jaxtyping import Float

from ..effects import AbstractEffect, Sweep
from ..host import parallel
from ..inference.evidence import PHYSICAL_SCALES, SCALES, Design, Noise, levelled, log_bayes, log_mean_exp
from ..inference.problem import Problem

BIN = 0.1
"""Resolution of the scan over time [s]."""
_WIDTHS = (2, 3, 5, 8, 12, 18, 27, 40, 60, 90, 135)
_EDGE = 3
_SOME = 1e-3
"""Share of a window's power that nothing in the model explains, where it is told at all."""
_SLOWEST, _FINER, _LONG = 2.0, 3, 8.0
"""Least frequency of what swings [Hz]; how much closer those lie that are tried than a recording's own, at
least; and how long it must be for one to be told from those beside it [s]."""


@dataclasses.dataclass(frozen=True)
class Proposal:
    """The likeliest shape of an effect at one place, and the evidence for the effect there."""

    effect: AbstractEffect
    evidence: float
    """Averaged over shapes: what the effect has gained, its search paid for [nats]."""
    best: float
    """Of the likeliest shape [nats]."""
    deviation: Float[np.ndarray, " n"]
    steps: tuple[float, ...]
    """First steps of a refinement, one a shape parameter."""
    shared: float = 0.0
    """What of the evidence comes of other joints that have the effect [nats]."""

    @property
    def key(self) -> tuple[str, tuple[int, ...]]:
        return self.effect.name, self.effect.joints


def swept(
    problem: Problem,
    design: Design,
    noise: Noise,
    joints: Iterable[int],
    classes: Sequence[type[AbstractEffect]] | None = None,
) -> list[Proposal]:
    """Of each effect that is swept for (of these `classes`, if given), at each of these joints the likeliest
    shape."""

    def one(cls: type[AbstractEffect], j: int, sweep: Sweep) -> Proposal:
        acting = list(zip(problem.traces, problem.active, strict=True))
        columns = lambda: [sweep.columns(t.motion) * on for t, on in acting]
        b, G = problem.projected(cls.__name__, columns, noise, design, j)
        deviation = np.full(b.shape, noise.std[j] * np.sqrt(2))
        score, scale = log_bayes(b, G, deviation, SCALES)
        top = int(score.argmax())
        return Proposal(
            sweep.shape(top),
            float(log_mean_exp(score)),
            float(score[top]),
            deviation[top] * scale[top],
            sweep.steps(top),
        )

    places = itertools.product(problem.catalogue if classes is None else classes, joints)
    tried = [(cls, j, sweep) for cls, j in places if (sweep := problem.grid.sweep(cls, j)) is not None]
    return parallel(lambda at: one(*at), tried)


def swinging(problem: Problem, design: Design, noise: Noise) -> list[Proposal]:
    """Of each effect that swings, the likeliest frequency in all recordings and in each.

    By one transform a recording: what of such torque the model could take is left out of account. In short ones a
    frequency is as wide as what an arm does by itself, swinging on its gears.
    """
    acting = zip(problem.traces, problem.active, strict=True)
    long = [r for r, (t, on) in enumerate(acting) if on and np.ptp(t.motion.time) > _LONG]
    kinds = [c for c in problem.catalogue if c.swings] if long else []
    return [p for c in kinds for p in _swinging(problem, design, noise, c, long)]


def _swinging(
    problem: Problem, design: Design, noise: Noise, kind: type[AbstractEffect], long: Sequence[int]
) -> list[Proposal]:
    """Of one effect, in recordings that are long enough."""
    alone = kind.swinging(problem.dof, (problem.traces[0].name,), _SLOWEST)
    expected = np.array([k.scale for k in alone.coefficients], float)
    found = {r: _frequencies(problem, design, noise, kind, r, expected) for r in long}
    finest = max((frequency for frequency, *_ in found.values()), key=len)
    each = {r: np.interp(finest, frequency, score) for r, (frequency, score, _) in found.items()}
    out = []
    for some in dict.fromkeys([tuple(found), *((r,) for r in found)]):
        score = np.sum([each[r] for r in some], 0)
        names = tuple(problem.traces[r].name for r in some)
        top = int(np.argmax(score))
        effect = kind.swinging(problem.dof, names, float(finest[top])).counted_from(problem.grid.began)
        deviation = np.concatenate(
            [np.interp(finest[top], found[r][0], found[r][2]) * expected for r in some]
        )
        best, prior = float(score[top]), effect.form_prior
        steps = (0.4 * float(finest[1] / finest[top] - finest[0] / finest[top]),)
        out.append(Proposal(effect, float(log_mean_exp(score)) + prior, best + prior, deviation, steps))
    return out


def _frequencies(
    problem: Problem,
    design: Design,
    noise: Noise,
    kind: type[AbstractEffect],
    r: int,
    expected: Float[np.ndarray, " n"],
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    """Frequencies of what swings in a recording, the evidence of each, and its likeliest scale."""
    trace, rows = problem.traces[r], problem.rows[r]
    dt = trace.motion.dt
    size = 1 << (_FINER * trace.motion.samples - 1).bit_length()
    frequency = np.fft.rfftfreq(size, dt)
    tried = np.flatnonzero((frequency > _SLOWEST) & (frequency < 0.9 * trace.cutoff))
    frequency = frequency[tried]
    begin = np.exp(2j * np.pi * frequency * trace.motion.time[0])
    swung = kind.swung(trace.motion)
    n = len(expected)
    b, G = np.zeros((len(tried), n)), np.zeros((len(tried), n, n))
    for joint, columns in enumerate(np.swapaxes(swung, 0, 1)):
        weights = problem.weights(noise, r, joint)
        back = noise.transposed(design.left[joint][rows], joint, weights, rows)
        spectrum = np.fft.rfft(back[:, None] * columns, size, axis=0)[tried].conj() * begin[:, None]
        b += np.concatenate([spectrum.imag, spectrum.real], 1)
        passed = 0.5 * noise.response(joint, 2 * np.pi * frequency * dt)
        felt = weights[:, None] * columns
        G += passed[:, None, None] * np.kron(np.eye(2), felt.T @ felt)
    return frequency, *log_bayes(b, G, np.tile(expected, (len(b), 1)), PHYSICAL_SCALES)


def windows(problem: Problem, design: Design, noise: Noise) -> Iterator[Proposal]:
    """Of each effect that begins or ends within a recording, at each place and in each recording the likeliest
    time.

    Beside slow errors a window tells by its edges, and one whose edges are a little off tells next to nothing:
    there those of a scan that knows of no slow errors are given too.
    """
    yield from _windows(problem, design, noise)
    if any(noise.has_slow(j) for j in range(problem.dof)):
        plain = dataclasses.replace(noise, slow=None)
        yield from _windows(problem, problem.design(design.terms, plain), plain)


def _windows(problem: Problem, design: Design, noise: Noise) -> Iterator[Proposal]:
    """By one scan."""
    for r, (trace, on) in enumerate(zip(problem.traces, problem.active, strict=True)):
        places = problem.grid.at_some_time(r)
        if not (on and places):
            continue
        bins = max(2, round(BIN / trace.motion.dt))
        edges = np.arange(0, trace.motion.samples, bins)
        clock = trace.motion.time[edges]
        count = len(edges)
        pairs = np.array(
            [
                (s, s + w)
                for w in _WIDTHS
                for s in range(_EDGE, count - max(_EDGE, w - 1), max(1, w // 6))
                if s + w <= count
            ]
        )  # fmt: skip
        stops = np.append(clock, trace.motion.time[-1] + trace.motion.dt)
        parts = parallel(
            lambda j, r=r, bins=bins: _binned(problem, design, noise, r, bins, j), range(problem.dof)
        )
        b = _cumulated(sum(p[0] for p in parts[1:]) + parts[0][0])
        grams = [_cumulated(sum(p[1][k] for p in parts[1:]) + parts[0][1][k]) for k in range(len(places))]
        C = np.zeros((len(b), len(design.g), b.shape[1]))
        for *_, of_joint in parts:
            for at, products in of_joint:
                C[1:, at] += products
        np.cumsum(C, 0, out=C)
        slow = any(noise.has_slow(j) for j in range(problem.dof))
        each = np.stack([_passed(noise, j, bins, count) for j in range(problem.dof)]) if slow else None
        flat = design.lowered(np.swapaxes(C, 0, 1).reshape(C.shape[1], -1))
        C = np.swapaxes(flat.reshape(C.shape[1], len(C), -1), 0, 1)
        switches = np.arange(_EDGE, count - _EDGE)
        spans = {
            (True, True): pairs,
            (True, False): np.stack([switches, np.full_like(switches, count)], 1),
            (False, True): np.stack([np.zeros_like(switches), switches], 1),
        }
        done = 0
        for k, (forms, G) in enumerate(zip(places, grams, strict=True)):
            here = slice(done, done + G.shape[1])
            done, passed = here.stop, None
            if each is not None:
                power = np.array([np.trace(p[1][k].sum(0)) for p in parts]) + 1e-300
                passed = power @ each / power.sum()
            for effect in forms:
                when = spans[effect.ends]
                if len(when):
                    sums = window_sums((b[:, here], G, C[:, :, here]), when, passed)
                    yield _event(effect, *sums, stops, when)


def _cumulated(x: Float[np.ndarray, "bins ..."]) -> Float[np.ndarray, "edges ..."]:
    return np.concatenate([np.zeros((1, *x.shape[1:])), np.cumsum(x, 0)])


def _binned(
    problem: Problem, design: Design, noise: Noise, r: int, bins: int, joint: int
) -> tuple[np.ndarray, list[np.ndarray], list[tuple[slice, np.ndarray]]]:
    r"""What a joint adds, bin by bin of a recording, to $\Phi^\top r$, to the Gram matrix of each place, and to
    $A^\top \Phi$, of this the rows of what acts there. What depends on the joint's noise alone is kept."""
    here, rows = problem.whitened_joint(noise, joint, design.terms), problem.rows[r]
    weights = problem.weights(noise, r, joint)

    def split(x: np.ndarray) -> np.ndarray:
        return np.concatenate([x, np.zeros((-len(x) % bins, *x.shape[1:]))]).reshape(-1, bins, *x.shape[1:])

    def turned_back(x: np.ndarray) -> np.ndarray:
        return noise.settled(_turned_back(noise, joint, x[rows]), joint, weights, rows)

    def with_model(A: np.ndarray, F: np.ndarray) -> np.ndarray:
        return np.swapaxes(split(turned_back(A)), 1, 2) @ F

    if ("windows", r) not in here.blocks:
        places = [columns[:, joint] for columns in problem.grid.throughout(r)]
        F = split(noise.innovations(np.concatenate(places, 1), joint) * weights[:, None])
        each = np.split(F, np.cumsum([p.shape[1] for p in places])[:-1], 2)
        grams = [np.swapaxes(f, 1, 2) @ f for f in each]
        here.blocks["windows", r] = F, {"grams": grams, "nuisance": with_model(here.nuisance, F)}
    F, kept = here.blocks["windows", r]
    place = here.nuisance.shape[1]
    products = [(slice(0, place), kept["nuisance"])]
    for term in design.terms:
        width, A = term.width, here.terms[id(term)][1]
        if A is not None:
            if id(term) not in kept:
                kept[id(term)] = with_model(A, F)
            products.append((slice(place, place + width), kept[id(term)]))
        place += width
    b = np.einsum("ts,tsk->tk", split(turned_back(design.left[joint])), F)
    return b, kept["grams"], products


def window_sums(sums, pairs, passed):
    """b and G in windows. `passed`, of the power of a window of so many bins, where errors are slow, is that of a
    constant force: where one that changes passes more, all of it counts. Of one that is sharp more than all may
    pass, and be explained: of that nothing is left."""
    b, G, C = (x[pairs[:, 1]] - x[pairs[:, 0]] for x in sums)
    explained = np.matmul(np.swapaxes(C, 1, 2), C)
    if passed is None:
        return b, G - explained
    left = G * passed[pairs[:, 1] - pairs[:, 0], None, None] - explained
    size = np.sqrt(np.maximum(np.diagonal(G, axis1=1, axis2=2), 1e-300))
    scale = size[:, :, None] * size[:, None, :]
    more = np.linalg.eigvalsh(left / scale)[:, 0] < _SOME
    values, vectors = np.linalg.eigh((G - explained)[more] / scale[more])
    positive = vectors * np.maximum(values, 0.0)[:, None, :] @ np.swapaxes(vectors, 1, 2)
    left[more] = positive * scale[more]
    return b, left


def _turned_back(
    noise: Noise, joint: int, x: Float[np.ndarray, "_time ..."]
) -> Float[np.ndarray, "_time ..."]:
    r"""$L^\top x$ with L what makes slow errors level, but for where it begins."""
    if not noise.has_slow(joint):
        return x
    return levelled(x[::-1], noise.slow[joint])[0][::-1]  # pyright: ignore


def _passed(noise: Noise, joint: int, bins: int, count: int) -> Float[np.ndarray, " edges"]:
    """Of a force that is constant through so many bins, the share of its power that slow errors leave."""
    if not noise.has_slow(joint):
        return np.ones(count + 1)
    lasts = np.arange(1, count + 1) * bins
    step, _ = levelled(np.ones(2 * count * bins), noise.slow[joint])  # pyright: ignore
    within = np.cumsum(step**2)[lasts - 1]  # of a force that ends, the same again with its sign
    tails = [np.sum((step[n : n + count * bins] - step[: count * bins]) ** 2) for n in lasts]
    return np.append(1.0, (within + tails) / lasts)


def _event(effect: AbstractEffect, b, G, clock, spans) -> Proposal:
    """The likeliest window of an effect, from b and G in each window."""
    deviation = np.tile(np.array([k.scale for k in effect.coefficients], float), (len(b), 1))
    signs = np.array([float(k.sign) for k in effect.coefficients])
    G = 0.5 * (G + np.swapaxes(G, 1, 2)) + 1e-9 * np.eye(len(signs)) / deviation[:1, :, None] ** 2
    score, scale = log_bayes(b, G, deviation, PHYSICAL_SCALES, signs)
    top = int(score.argmax())
    placed = effect.placed_between(float(clock[spans[top, 0]]), float(clock[spans[top, 1]]))
    evidence, best = (value + placed.form_prior for value in (float(log_mean_exp(score)), float(score[top])))
    return Proposal(placed, evidence, best, deviation[0] * scale[top], (BIN, BIN))
