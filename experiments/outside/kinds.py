"""The kinds of cases, and how often each comes."""

from dataclasses import replace

import causes
import numpy as np
from arms import draw_arm, inverse, perturb_links
from draft import Draft, Step, replace_arm
from sensors import draw_sensors

RATIO = {"strong": 15.0, "medium": 5.0, "weak": 1.5}

# How many of forty cases are of each kind.
SHARES = {
    "null_exact": 2,
    "null_sticking": 5,
    "null_identified": 2,
    "null_coarse": 2,
    "null_rough_noise": 2,
    "null_walk": 2,
    "friction_missing": 3,
    "lugre_all": 2,
    "placeholders": 3,
    "several": 4,
    "single": 10,
    "outside": 3,
}
STRATUM = {"single": "single", "outside": "outside"}


def base(rng: np.random.Generator, kind: str) -> Draft:
    arm = draw_arm(rng)
    sensors = draw_sensors(rng, clean=kind.startswith("null") or rng.random() < 0.5)
    seconds = float(rng.choice([8.0, 12.0, 20.0, 30.0, 60.0], p=[0.15, 0.3, 0.3, 0.17, 0.08]))
    return Draft(rng, arm, sensors, seconds)


def draw_ratio(rng: np.random.Generator) -> float:
    name = rng.choice(list(RATIO), p=[0.35, 0.4, 0.25])
    return RATIO[name] * float(np.exp(0.2 * rng.standard_normal()))


def maybe_known_friction(d: Draft, share: float = 0.5):
    if d.rng.random() < share:
        d.know_friction(range(d.n), scale=d.rng.uniform(0.2, 1.0))


def null_exact(d: Draft):
    maybe_known_friction(d, 0.3)


def null_sticking(d: Draft):
    """Friction that the file has sticks with bristles of 0.3-2 mrad; dq is the vendor's."""
    d.sensors = replace(d.sensors, dq_mode="filtered", dq_cut=float(d.rng.uniform(10, 30)))
    d.know_friction(range(d.n))


def null_identified(d: Draft):
    """Links a few percent off, in nearly all directions in which torque does not tell."""
    rng = np.random.default_rng(d.rng.integers(2**31))
    q = d.user.home + d.user.reach * rng.uniform(-1, 1, (80, d.n))
    qdd = 1.5 * d.user.speed * rng.standard_normal(q.shape)
    size = 0.04
    state = rng.bit_generator.state
    while True:
        rng.bit_generator.state = state
        other = perturb_links(d.user, rng, size, 0.05 * size, size)
        off = inverse(other, q, 0 * q, qdd) - inverse(d.user, q, 0 * q, qdd)
        if np.max(np.sqrt(np.mean(off**2, axis=0)) / d.noise) < 0.4:
            break
        size *= 0.75
    d.steps.append(Step("links", replace_arm(links=other.links)))
    d.nominal = "identified"
    d.allow("inertial_parameters")
    maybe_known_friction(d, 0.3)


def null_coarse(d: Draft):
    step = 2 * np.pi / float(d.rng.choice([2**12, 2**13, 2**14]))
    d.sensors = replace(d.sensors, q_step=step, q_std=step / 20)
    maybe_known_friction(d, 0.3)


def null_rough_noise(d: Draft):
    """Heavy tails, or spikes, or both."""
    which = d.rng.integers(3)
    d.sensors = replace(
        d.sensors,
        tails=3.0 if which != 1 else 0.0,
        spikes=float(d.rng.uniform(0.2, 2.0)) if which != 0 else 0.0,
        spike_size=float(d.rng.uniform(8, 40)),
    )
    maybe_known_friction(d, 0.3)


def null_walk(d: Draft):
    d.sensors = replace(d.sensors, walk=float(d.rng.uniform(0.3, 1.0)))
    maybe_known_friction(d, 0.3)
    d.allow("torque_drift")
    d.allow("torque_offset")


def friction_missing(d: Draft):
    """No friction in the file, Coulomb and viscous friction at every joint; links off by up to 20 %."""
    every = range(d.n)
    spread = np.exp(0.3 * d.rng.standard_normal((2, d.n)))
    causes.coulomb_friction(d, 0.0, every, d.user.friction * spread[0])
    causes.viscous_friction(d, 0.0, every, 0.7 * d.user.friction * spread[1])
    if d.rng.random() < 0.5:
        rough_links(d, float(d.rng.uniform(0.05, 0.2)))


def rough_links(d: Draft, size: float):
    rng = np.random.default_rng(d.rng.integers(2**31))
    truth = perturb_links(d.user, rng, size, 0.05 * size, size)
    key = d.add("inertial_parameters", None, also=["payload"])
    d.steps.append(Step(key, replace_arm(links=truth.links)))
    d.nominal = "rough"


def lugre_all(d: Draft):
    every = range(d.n)
    level = d.user.friction * np.exp(0.3 * d.rng.standard_normal(d.n))
    causes.stribeck_friction(d, 0.0, every, 0.8 * level)
    causes.viscous_friction(d, 0.0, every, 0.5 * level)


def placeholders(d: Draft):
    causes.placeholders(d)


def several(d: Draft):
    """Two to five causes at once, friction at every joint among them in half of the cases."""
    pool = [
        causes.gravity_direction,
        causes.payload,
        causes.torque_ripple,
        causes.torque_offset,
        causes.torque_drift,
        causes.armature,
        causes.external_contact,
        causes.joint_spring,
        causes.encoder_offset,
        causes.time_delay,
        causes.stribeck_friction,
        causes.torque_crosstalk,
    ]
    if d.rng.random() < 0.5:
        friction_missing(d)
    else:
        maybe_known_friction(d)
    count = d.rng.integers(2, 5) - (1 if d.entries else 0)
    for k in d.rng.choice(len(pool), count, replace=False):
        pool[k](d, draw_ratio(d.rng))


def single(d: Draft, name: str, boost: float):
    maybe_known_friction(d)
    getattr(causes, name)(d, boost * draw_ratio(d.rng))


def outside(d: Draft, name: str, boost: float):
    maybe_known_friction(d)
    getattr(causes, name)(d, boost * max(draw_ratio(d.rng), 3.0))


def draw(rng: np.random.Generator, kind: str, detail: str, boost: float = 1.0) -> Draft:
    """A case of a kind; a lone cause aims at `boost` times the usual size."""
    d = base(rng, kind)
    if detail:
        {"single": single, "outside": outside}[kind](d, detail, boost)
    else:
        globals()[kind](d)
    return d


def schedule(seed: int, count: int, kinds: list[str] | None) -> list[tuple[str, str]]:
    """Kind and detail of every case: shares as in SHARES in every lot of forty, details in turn."""
    rng = np.random.default_rng([seed, 7])
    shares = {kind: SHARES[kind] for kind in kinds or SHARES}
    lists = {"single": [f.__name__ for f in causes.SINGLES], "outside": [f.__name__ for f in causes.OUTSIDE]}
    queues = {kind: [] for kind in lists}
    plan = []
    while len(plan) < count:
        lot = [kind for kind, share in shares.items() for _ in range(share)]
        for kind in rng.permutation(lot):
            if kind in queues and not queues[kind]:
                queues[kind] = [str(x) for x in rng.permutation(lists[kind])]
            plan.append((str(kind), queues[kind].pop() if kind in queues else ""))
    return plan[:count]
