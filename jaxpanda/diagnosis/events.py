"""Scans over what the grids cannot hold: windows in time, and orders of ripple."""

import dataclasses
from collections.abc import Callable, Iterable, Iterator

import numpy as np
from jaxtyping import Float

from ..effects import AbstractEffect
from ..effects.contact import ExternalContact
from ..effects.drive import TorqueRipple
from ..effects.load import EVER, PayloadChange
from ..effects.unknown import SIGN_WIDTH, UnknownAt, UnknownShaking
from .evidence import PHYSICAL_SCALES, SCALES, Design, Noise, levelled, log_bayes, log_mean_exp
from .host import parallel
from .problem import Problem

BIN = 0.1
"""Resolution of the scan over time [s]."""
_WIDTHS = (2, 3, 5, 8, 12, 18, 27, 40, 60, 90, 135)
_EDGE = 3
_SPOTS, _PLACES = (0.03, 0.08), 64
"""Widths of a torque at one place [rad], and how many places are tried at most."""
_SOME = 1e-3
"""Share of a window's power that nothing in the model explains, where it is told at all."""
_SLOWEST = 5.0
"""Least order of a ripple [1/rad]."""
_SLOWEST_SHAKING, _FINER, _LONG = 2.0, 3, 8.0
"""Least frequency of a base that shakes [Hz]; how much closer those lie that are tried than a recording's own, at
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


def slowest(travel: float) -> float:
    """The least order of which a travel [rad] shows a period and a half, lest it be a spring [1/rad]."""
    return max(_SLOWEST, 3 * np.pi / travel)


def ripple(problem: Problem, design: Design, noise: Noise, joints: Iterable[int]) -> list[Proposal]:
    """For each of these joints that turns far enough the likeliest order."""

    def one(j: int) -> Proposal | None:
        q = [t.motion.q[:, j] for t in problem.traces]
        travel = max(np.ptp(x) for x in q)
        speed = np.sqrt(np.mean(np.concatenate([t.motion.qd[:, j] for t in problem.traces]) ** 2))
        if travel < 0.1 or speed < 0.02:
            return None
        step = np.pi / (2 * travel)
        highest = min(400.0, 2 * np.pi * 0.9 * problem.traces[0].cutoff / speed)
        orders = np.arange(slowest(travel), highest, step)
        if not len(orders):
            return None
        top, evidence, best, deviation = _likeliest(
            problem,
            "ripple",
            lambda: [
                np.stack([np.sin(x[:, None] * orders), np.cos(x[:, None] * orders)], 2) * on
                for x, on in zip(q, problem.active, strict=True)
            ],
            noise,
            design,
            j,
        )
        return Proposal(
            TorqueRipple(j, float(orders[top]), "one"), evidence, best, deviation, (0.4 * step / orders[top],)
        )

    return [p for p in parallel(one, joints) if p is not None]


def shaking(problem: Problem, design: Design, noise: Noise) -> list[Proposal]:
    """The likeliest frequency at which the base shakes, in all recordings and in each; none where the catalogue
    has no force from outside, as of drives alone.

    By one transform a recording: what of such torque the model could take is left out of account. In short ones a
    frequency is as wide as what an arm does by itself, swinging on its gears.
    """
    if ExternalContact not in problem.catalogue:
        return []
    acting = zip(problem.traces, problem.active, strict=True)
    long = [r for r, (t, on) in enumerate(acting) if on and np.ptp(t.motion.time) > _LONG]
    if not long:
        return []
    found = {r: _shaking(problem, design, noise, r) for r in long}
    finest = max((frequency for frequency, *_ in found.values()), key=len)
    each = {r: np.interp(finest, frequency, score) for r, (frequency, score, _) in found.items()}
    out = []
    for some in dict.fromkeys([tuple(found), *((r,) for r in found)]):
        score = np.sum([each[r] for r in some], 0)
        names = tuple(problem.traces[r].name for r in some)
        top = int(np.argmax(score))
        effect = UnknownShaking(problem.dof, names, float(finest[top]))
        scale = [np.repeat(np.interp(finest[top], found[r][0], found[r][2]), 6) for r in some]
        deviation = np.concatenate(scale) * np.array([k.scale for k in effect.coefficients])
        best, prior = float(score[top]), effect.form_prior
        steps = (0.4 * float(finest[1] / finest[top] - finest[0] / finest[top]),)
        out.append(Proposal(effect, float(log_mean_exp(score)) + prior, best + prior, deviation, steps))
    return out


def _shaking(
    problem: Problem, design: Design, noise: Noise, r: int
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Frequencies of a base that shakes in a recording, the evidence of each, and its likeliest scale."""
    trace, rows = problem.traces[r], problem.rows[r]
    dt = trace.motion.dt
    size = 1 << (_FINER * trace.motion.samples - 1).bit_length()
    frequency = np.fft.rfftfreq(size, dt)
    tried = np.flatnonzero((frequency > _SLOWEST_SHAKING) & (frequency < 0.9 * trace.cutoff))
    frequency = frequency[tried]
    begin = np.exp(2j * np.pi * frequency * trace.motion.time[0])
    b, G = np.zeros((len(tried), 6)), np.zeros((len(tried), 6, 6))
    for joint, columns in enumerate(np.swapaxes(trace.motion.gravity_columns, 0, 1)):
        weights = problem.weights(noise, r, joint)
        back = noise.transposed(design.left[joint][rows], joint, weights, rows)
        spectrum = np.fft.rfft(back[:, None] * columns, size, axis=0)[tried].conj() * begin[:, None]
        b -= np.concatenate([spectrum.imag, spectrum.real], 1)
        passed = 0.5 * noise.response(joint, 2 * np.pi * frequency * dt)
        felt = weights[:, None] * columns
        G += passed[:, None, None] * np.kron(np.eye(2), felt.T @ felt)
    expected = np.array([k.scale for k in UnknownShaking(problem.dof, (trace.name,), 1.0).coefficients])
    return frequency, *log_bayes(b, G, np.tile(expected, (len(b), 1)), PHYSICAL_SCALES)


def spots(problem: Problem, design: Design, noise: Noise, joints: Iterable[int]) -> list[Proposal]:
    """For each of these joints the likeliest place on its way at which a torque is alone."""

    def one(j: int) -> Proposal | None:
        q = [t.motion.q[:, j] for t in problem.traces]
        low, high = np.quantile(np.concatenate(q), (0.005, 0.995))
        widths = [max(w, (high - low) / _PLACES) for w in _SPOTS]
        tried = [(at, w) for w in widths for at in np.arange(low + w, high - w, w)]
        if not tried:
            return None
        place, width = np.transpose(tried)

        def columns() -> list[np.ndarray]:
            out = []
            for trace, on in zip(problem.traces, problem.active, strict=True):
                x = (trace.motion.q[:, j, None] - place) / width
                sign = np.tanh(trace.motion.qd[:, j, None] / SIGN_WIDTH)
                bump = np.exp(-0.5 * x**2) * on
                out.append(np.stack([bump, x * bump, sign * bump], 2))
            return out

        top, evidence, best, deviation = _likeliest(problem, "spots", columns, noise, design, j)
        effect = UnknownAt(j, place=float(place[top]), width=float(width[top]))
        return Proposal(effect, evidence, best, deviation, (0.4 * float(width[top]), 0.3))

    return [p for p in parallel(one, joints) if p is not None]


def _likeliest(
    problem: Problem,
    key: str,
    columns: Callable[[], list[np.ndarray]],
    noise: Noise,
    design: Design,
    joint: int,
) -> tuple[int, float, float, Float[np.ndarray, " n"]]:
    """Of shapes of a size that only the noise tells: which is likeliest, the evidence averaged over all, its own,
    and the prior deviations of its coefficients. `columns` are those of all shapes, as `Problem.projected` has
    them."""
    b, G = problem.projected(key, columns, noise, design, joint)
    deviation = np.full(b.shape, noise.std[joint] * np.sqrt(2))
    score, scale = log_bayes(b, G, deviation, SCALES)
    top = int(score.argmax())
    return top, float(log_mean_exp(score)), float(score[top]), deviation[top] * scale[top]


def windows(problem: Problem, design: Design, noise: Noise) -> Iterator[Proposal]:
    """For each link and recording the likeliest window of a contact, and the likeliest change of payload; none
    where the catalogue has neither, as of drives alone.

    Beside slow errors a window tells by its edges, and one whose edges are a little off tells next to nothing:
    there those of a scan that knows of no slow errors are given too.
    """
    if not {ExternalContact, PayloadChange} <= set(problem.catalogue):
        return
    yield from _windows(problem, design, noise)
    if any(noise.has_slow(j) for j in range(problem.dof)):
        plain = dataclasses.replace(noise, slow=None)
        yield from _windows(problem, problem.design(design.terms, plain), plain)


def _windows(problem: Problem, design: Design, noise: Noise) -> Iterator[Proposal]:
    """By one scan."""
    first = np.cumsum([0, *(t.motion.samples for t in problem.traces)])
    for r, (trace, on) in enumerate(zip(problem.traces, problem.active, strict=True)):
        if not on:
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
        contact = [ExternalContact(i, 0.0, 1.0, trace.name, "base") for i in range(problem.dof)]
        change = PayloadChange(problem.dof - 1, 0.0, 1.0, trace.name, "gained")
        always = dataclasses.replace(change, start=-1e9, stop=1e9)
        rows = slice(first[r], first[r + 1])
        parts = parallel(
            lambda j, r=r, rows=rows, bins=bins, always=always: _binned(
                problem, design, noise, r, rows, bins, j, always
            ),
            range(problem.dof),
        )
        b, G, H = (_cumulated(sum(p[k] for p in parts[1:]) + parts[0][k]) for k in range(3))
        C = np.zeros((len(b), len(design.g), b.shape[1]))
        for *_, of_joint in parts:
            for at, products in of_joint:
                C[1:, at] += products
        np.cumsum(C, 0, out=C)
        passed = None
        if any(noise.has_slow(j) for j in range(problem.dof)):
            power = np.array([np.trace(p[1].sum((0, 1))) for p in parts]) + 1e-300
            each = np.stack([_passed(noise, j, bins, count) for j in range(problem.dof)])
            passed = power @ each / power.sum()
        flat = design.lowered(np.swapaxes(C, 0, 1).reshape(C.shape[1], -1))
        C = np.swapaxes(flat.reshape(C.shape[1], len(C), -1), 0, 1)
        n = 6 * problem.dof  # of the contacts; the rest is the payload
        if len(pairs):
            found = [
                _window_sums((b[:, k], G[:, i], C[:, :, k]), pairs, passed)
                for i, k in enumerate(np.arange(n).reshape(-1, 6))
            ]
            yield from _events(contact, found, stops, pairs)
        switches = np.arange(_EDGE, count - _EDGE)
        gained = np.stack([switches, np.full_like(switches, count)], 1)
        lost = np.stack([np.zeros_like(switches), switches], 1)
        for form, spans in (("gained", gained), ("lost", lost), ("carried", pairs)):
            if len(spans):
                sums = _window_sums((b[:, n:], H, C[:, :, n:]), spans, passed)
                yield from _events([dataclasses.replace(change, form=form)], [sums], stops, spans)


def _cumulated(x: Float[np.ndarray, "bins ..."]) -> Float[np.ndarray, "edges ..."]:
    return np.concatenate([np.zeros((1, *x.shape[1:])), np.cumsum(x, 0)])


def _binned(
    problem: Problem,
    design: Design,
    noise: Noise,
    r: int,
    rows: slice,
    bins: int,
    joint: int,
    payload: PayloadChange,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[tuple[slice, np.ndarray]]]:
    r"""What a joint adds, bin by bin of a recording, to $\Phi^\top r$, to the Gram matrices of the contacts and
    of the payload, and to $A^\top \Phi$, of this the rows of what acts there. What depends on the joint's noise
    alone is kept."""
    here, trace = problem.whitened_joint(noise, joint, design.terms), problem.traces[r]
    weights = problem.weights(noise, r, joint)

    def split(x: np.ndarray) -> np.ndarray:
        return np.concatenate([x, np.zeros((-len(x) % bins, *x.shape[1:]))]).reshape(-1, bins, *x.shape[1:])

    def turned_back(x: np.ndarray) -> np.ndarray:
        return noise.settled(_turned_back(noise, joint, x[rows]), joint, weights, rows)

    def with_model(A: np.ndarray, F: np.ndarray) -> np.ndarray:
        return np.swapaxes(split(turned_back(A)), 1, 2) @ F

    if ("windows", r) not in here.blocks:
        contacts = trace.motion.wrench_columns[:, :, joint].reshape(trace.motion.samples, -1)
        columns = np.concatenate([contacts, payload.over(trace.motion)[:, joint]], 1)
        F = split(noise.innovations(columns, joint) * weights[:, None])
        apart = F[:, :, : contacts.shape[1]].reshape(*F.shape[:2], -1, 6).swapaxes(1, 2)
        whole = F[:, :, contacts.shape[1] :]
        grams = apart.swapaxes(2, 3) @ apart, whole.swapaxes(1, 2) @ whole
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
    return b, *kept["grams"], products


def _window_sums(sums, pairs, passed):
    """b and G in windows. `passed`, of the power of a window of so many bins, where errors are slow, is that of a
    constant force: where one that changes passes more, all of it counts."""
    b, G, C = (x[pairs[:, 1]] - x[pairs[:, 0]] for x in sums)
    explained = np.matmul(np.swapaxes(C, 1, 2), C)
    if passed is None:
        return b, G - explained
    left = G * passed[pairs[:, 1] - pairs[:, 0], None, None] - explained
    unit = 1 / np.sqrt(np.maximum(np.diagonal(G, axis1=1, axis2=2), 1e-300))
    least = np.linalg.eigvalsh(unit[:, :, None] * left * unit[:, None, :])[:, 0]
    return b, np.where((least < _SOME)[:, None, None], G - explained, left)


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


def _events(effects, found, clock, pairs) -> Iterator[Proposal]:
    """For each effect of one kind the likeliest window, from b and G in each window."""
    coefficients = effects[0].coefficients
    b, G = (np.concatenate([f[k] for f in found]) for k in (0, 1))
    deviation = np.tile([k.scale for k in coefficients], (len(b), 1))
    signs = np.array([float(k.sign) for k in coefficients])
    n = b.shape[1]
    G = 0.5 * (G + np.swapaxes(G, 1, 2)) + 1e-9 * np.eye(n) / deviation[:1, :, None] ** 2
    scores, scales = log_bayes(b, G, deviation, PHYSICAL_SCALES, signs)
    for effect, score, scale in zip(
        effects, *(np.split(x, len(effects)) for x in (scores, scales)), strict=True
    ):
        top = int(score.argmax())
        start, stop = float(clock[pairs[top, 0]]), float(clock[pairs[top, 1]])
        if isinstance(effect, PayloadChange):
            start, stop = start if effect.form != "lost" else -EVER, stop if effect.form != "gained" else EVER
        placed = dataclasses.replace(effect, start=start, stop=stop)
        evidence = float(log_mean_exp(score)) + placed.form_prior
        yield Proposal(
            placed, evidence, float(score[top]) + placed.form_prior, deviation[0] * scale[top], (BIN, BIN)
        )
