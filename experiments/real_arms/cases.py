"""Which cases are made of each arm's recordings: generators of (Split, Secret). All choices come from `rng`."""

import dataclasses
import functools
import itertools

import added
import chain as c
import conceal as m
import logs as real
import numpy as np
from chain import from_com
from reference import identify, lag


def _ratio(rng):
    return float(np.exp(rng.uniform(np.log(m.WEAK), np.log(m.STRONG))))


def _way(rng):
    x = rng.normal(size=3)
    return np.round(x / np.linalg.norm(x), 3)


def _contact(rng, chain, train, link):
    """Somewhere in the first training recording, away from its ends."""
    t = train[0].time
    length = rng.uniform(0.6, 1.6)
    start = rng.uniform(t[0] + 0.8, t[-1] - 0.8 - length)
    interval = (round(float(start), 2), round(float(start + length), 2))
    point = np.round(rng.uniform(-0.06, 0.06, 3), 3)
    return added.contact(chain, link, point, _way(rng), interval)


def _middle(log, rng):
    """(start, stop): from somewhere in the middle on to the end."""
    t = log.time
    return round(float(t[0] + rng.uniform(0.35, 0.65) * (t[-1] - t[0])), 2), round(float(t[-1]) + 0.01, 2)


# -------------------------------------------------------------------------------------------------- Panda


def _several(rng, s, other, menu, count, reference=1):
    """`count` additions out of the menu (split -> Added), half of them on each split; some with --reference."""
    for k, which in enumerate(rng.choice(len(menu), count, replace=False)):
        at = (s, other)[k % 2]
        yield at, m.semi(at, menu[which](at), _ratio(rng), rng, reference=k < reference)


def panda(data, rng):
    """21 s that repeat themselves after 13.33 s: 6 to 9 s each for the model, the tool and the test."""
    log = real.panda(data)
    shift = rng.uniform(-0.4, 0.4)
    cuts = {
        "early": (0.1, 8.5 + shift, 14.8 + shift, 20.9),
        "late": (20.9, 13.2 + shift, 6.6 + shift, 0.1),
    }

    @functools.cache
    def split(which):
        a, b, c, d = cuts[which]
        part = lambda x, y: log.part(min(x, y), max(x, y))
        nominal = real.panda_nominal(data)
        return m.split(
            "panda",
            nominal,
            [part(a, b)],
            [part(b, c)],
            part(c, d),
            [part(a, b)],
            rotors=False,
            tilt=True,
            spread=0.1,
        )

    pick = lambda *joints: int(rng.choice(joints))
    s, other = (split(x) for x in rng.permutation(["early", "late"]))
    yield s, m.control(s)
    yield other, m.control(other, reference=True)
    yield s, m.friction_lost(s)
    yield other, m.placeholders(other)
    yield (
        s,
        m.too_much_damping(s, sorted(int(j) for j in rng.choice(7, 2, False) + 1), _ratio(rng)),
    )
    com = np.round([*rng.uniform(-0.03, 0.03, 2), rng.uniform(0.1, 0.2)], 3)
    one, two = pick(1, 2, 3), pick(4, 5, 6)
    menu = [
        lambda s: added.payload(s.ref.chain, com, 0.04),
        lambda s: added.gain(pick(2, 3, 4)),
        lambda s: added.encoder(pick(2, 4, 6)),
        lambda s: _contact(rng, s.ref.chain, s.train, pick(4, 5, 6, 7)),
        lambda s: added.hysteresis(7, pick(1, 2, 3, 4), 0.01),
        lambda s: added.delay(),
        lambda s: added.viscous(7, pick(1, 2, 3, 4)),
        lambda s: added.crosstalk(s.ref.chain, one, two),
        lambda s: added.offset(7, pick(1, 2, 3, 4, 5, 6, 7)),
        lambda s: added.ripple(
            7,
            pick(1, 2, 3, 4),
            int(rng.integers(4, 20)),
            round(float(rng.uniform(0, 6)), 2),
        ),
        lambda s: added.tilt(s.ref.chain, round(float(rng.uniform(0, 6.28)), 2)),
    ]
    yield from _several(rng, other, s, menu, 5)


# -------------------------------------------------------------------------------------------------- UR10e


def ur10e(data, rng):
    """Files of several days: the model from two, the tool gets another, the test is a fourth."""

    @functools.cache
    def split(ident, train, held, seconds=20.0):
        read = lambda k: real.ur10e(data, k)
        start = float(np.round(rng.uniform(1.0, 3.0), 1))
        cut = lambda k: read(k).part(start, start + seconds)
        return m.split(
            "ur10e",
            real.ur10e_nominal(data),
            [read(k) for k in ident],
            [cut(train)],
            cut(held),
            [read(ident[0]).part(0, 15)],
            tare=False,
            rotors=True,
            offsets=False,
        )

    pick = lambda *joints: int(rng.choice(joints))
    a, b, c_, d = (str(x) for x in rng.permutation(list("ABCD")))
    s, other, slow = split(a + b, c_, d), split(c_ + a, d, b), split(b + d, "P", a)
    yield s, m.control(s)
    yield other, m.control(other, reference=True)
    # a real body of 2.805 kg: the model is of unloaded days, two pieces of the loaded recording are left
    loaded = real.ur10e(data, "load")
    base = split("AB" if rng.random() < 0.5 else "BC", "D", "D")
    for reference in (True, False):
        yield (
            base,
            _mounted(base, loaded, real.ur10e(data, "D").part(1, 25) if reference else None),
        )
    joints = sorted(int(j) for j in rng.choice(6, 2, False) + 1)
    yield other, m.friction_lost(other, joints)
    yield s, m.rotors_lost(s)
    yield slow, m.friction_lost(slow)
    com = np.round([*rng.uniform(-0.05, 0.05, 2), rng.uniform(0.12, 0.22)], 3)
    rise, speed = (
        round(float(rng.uniform(1.8, 3)), 2),
        round(float(rng.uniform(0.05, 0.15)), 3),
    )
    menu = [
        lambda s: _only_there(added.payload(s.ref.chain, com, 0.06, _middle(s.train[0], rng))),
        lambda s: added.spring(6, pick(1, 2, 3, 4), round(float(rng.uniform(-0.5, 0.5)), 2)),
        lambda s: added.gain(pick(2, 3, 4)),
        lambda s: added.stribeck(6, pick(4, 5, 6), rise, speed),
        lambda s: added.encoder(pick(2, 3)),
        lambda s: added.drift(6, pick(2, 3, 4, 5, 6), round(float(rng.uniform(5, 15)), 1)),
        lambda s: added.load_friction(s.ref.chain, pick(2, 3)),
        lambda s: added.asymmetric(6, pick(3, 4, 5, 6), round(float(rng.uniform(0.2, 0.5)), 2)),
        lambda s: added.tilt(s.ref.chain, round(float(rng.uniform(0, 6.28)), 2)),
        lambda s: _contact(rng, s.ref.chain, s.train, pick(3, 4, 5, 6)),
    ]
    yield from _several(rng, s, other, menu, 4)


def _only_there(change):
    """A body taken up in the training recording is not held in the other file."""
    return dataclasses.replace(change, lasts=False)


def _mounted(s, loaded, reference):
    """The loaded twin of recording D: its first half for the tool, its second for the test."""
    half = loaded.time[-1] / 2
    train, held = loaded.part(1.0, half - 0.5), loaded.part(half + 0.5, 2 * half - 1.0)
    n = s.ref.chain.dof
    chain = s.ref.chain

    def forms(log):
        """A body's ten numbers at the last link."""
        return c.regressor(chain, *m.motion(log))[:, :, -10:]

    def fit(logs):
        A = np.concatenate([m.lowpass(forms(x), x.rate)[m.inner(x)] for x in logs])
        b = np.concatenate([m.errors(x, c.torque(chain, *m.motion(x))) for x in logs])
        A, b = (A / s.noise[:, None]).reshape(-1, 10), (b / s.noise).ravel()
        prior = np.array([0, 0.02, 0.02, 0.02, *[0.1] * 6]) * np.sqrt(len(b))
        return np.linalg.lstsq(np.concatenate([A, np.diag(prior)]), np.concatenate([b, np.zeros(10)]))[0]

    phi = fit([train])
    say = lambda log: c.torque(chain, *m.motion(log)) + forms(log) @ phi
    rms = np.sqrt(np.mean((forms(train) @ phi)[m.inner(train)] ** 2, 0))
    effect = {
        "effect": "payload",
        "joints": [n],
        "intervals": None,
        "parameters": [m.number("mass", None, 2.805, "kg")],
        "rms_torque": rms,
        "also": ["inertial_parameters", "payload_change"],
    }
    note = f"mounted: 2.805 kg; by these currents, its independent fit weighs {phi[0]:.3g} kg"
    return m.lost(
        s,
        "a mounted load of 2.805 kg",
        chain,
        [effect],
        forms,
        train=[train],
        held=held,
        note=note,
        reference=[] if reference is None else [reference],
        say=say,
    )


# --------------------------------------------------------------------------------------------------- iiwa


def iiwa(data, rng):
    """One joint moves at a time. Late torque is moved back by the lag that is found first, or left late."""
    cut = float(rng.uniform(-1.0, 1.0))
    nominal = real.iiwa_nominal(data)
    how = {"rotors": False, "spread": 0.3}

    def chirp(name, blocks):
        log = real.iiwa(data, name)[0]
        a, b, *others = (log.part(*block) for block in blocks)
        train, held = (others[k] for k in rng.permutation(2))
        return [a, b], [train], held

    def aligned(parts):
        """(split of logs without lag, lag [s], (train, held) as recorded)."""
        ident, train, held = parts
        late = lag(nominal, ident, np.arange(0, 0.081, 0.005), how["spread"])
        back = lambda log: m.put_right(log, late)
        s = m.split(
            "iiwa",
            nominal,
            [back(x) for x in ident],
            [back(x) for x in train],
            back(held),
            **how,
        )
        return s, late, (train, held)

    six = chirp(
        "J6_chirp",
        [(0.5, 12 + cut), (34 + cut, 45), (12 + cut, 23 + cut), (23 + cut, 34 + cut)],
    )
    three = chirp(
        "J3_chirp",
        [(0.5, 12 + cut), (34 + cut, 46), (12 + cut, 23 + cut), (23 + cut, 34 + cut)],
    )
    first, second = real.iiwa(data, "J5_chirp")
    five = (
        [first.part(0.5, 10 + cut), second.part(0.5, 8)],
        [first.part(10 + cut, 18.3)],
        second.part(8, 15.3),
    )
    s6, lag6, late6 = aligned(six)
    s5, lag5, late5 = aligned(five)
    s3, lag3, _ = aligned(three)
    yield s6, m.control(s6, note=f"torque moved by {1e3 * lag6:.0f} ms")
    yield s3, m.control(s3, note=f"torque moved by {1e3 * lag3:.0f} ms")
    yield s6, m.late(s6, lag6, late6)
    yield s5, m.late(s5, lag5, late5)
    yield s3, m.friction_lost(s3, [3])
    yield s6, m.semi(s6, added.gain(6), _ratio(rng), rng)
    # sweeps at constant speed: two speeds for the model and the tool, the third as test
    slow, mid, fast = (real.iiwa(data, f"friction_joint1_vel_{v}")[0] for v in ("p15", "p3", "p6"))
    s = m.split(
        "iiwa",
        nominal,
        [mid.part(44, 86), slow.part(60, 118)],
        [mid.part(1, 26), slow.part(2, 22)],
        fast.part(1, 24),
        **how,
    )
    yield s, m.friction_lost(s, [1])


# ------------------------------------------------------------------------------------------------- Kinova


def kinova(data, rng):
    """4.7 s and 2.3 s. Sensors behind the gears, and motor currents."""
    one, two = (real.kinova(data, k, "TorqueSm") for k in (1, 2))
    nominal = real.kinova_nominal(data)
    how = {"rotors": False, "spread": 0.1}
    cut = rng.uniform(-0.1, 0.1)
    s = m.split(
        "kinova",
        nominal,
        [one.part(2.0 + cut, 4.8)],
        [one.part(0, 2.0 + cut)],
        two,
        [one.part(2.0 + cut, 4.8)],
        **how,
    )
    yield s, m.control(s)
    menu = [
        lambda s: added.coulomb(7, int(rng.choice([3, 4, 6]))),
        lambda s: added.viscous(7, int(rng.choice([3, 4, 6]))),
    ]
    yield from _several(rng, s, s, menu, 1, reference=int(rng.integers(2)))
    current = [real.kinova(data, k, "TorqueCur") for k in (1, 2)]
    sensors = m.split("kinova", nominal, [one], [one], two, **how)
    motors = m.split(
        "kinova",
        sensors.ref.chain,
        [current[0]],
        [current[0]],
        current[1],
        rotors=True,
        spread=0.02,
        offsets=True,
    )
    yield motors, m.before_the_gear(motors, sensors)


# ------------------------------------------------------------------------------------------------- Doosan


def doosan(data, rng):
    """40.7 s: every other block is the model's; the links by the controller's own model torque there.

    Measured torque is late, the controller's own is not: it is moved to where the own links fit, or left.
    """
    recorded, own = real.doosan(data), real.doosan(data, "model")
    noiseless = {"rotors": False, "friction": False, "offsets": False, "spread": 1.0}
    everywhere = identify(real.doosan_nominal(data), [own], **noiseless).chain
    late = lag(everywhere, [recorded], np.arange(0, 0.151, 0.005), 0.05)
    log, note = m.put_right(recorded, late), f"torque moved by {1e3 * late:.0f} ms"
    shift = rng.uniform(-1.0, 1.0)
    edges = (0.2, 10 + shift, 20 + shift, 30 + shift, 40.5)
    parts = list(itertools.pairwise(edges))

    @functools.cache
    def split(train, held, tare=True):
        ident = [parts[k] for k in range(4) if k not in (train, held)]
        links = identify(real.doosan_nominal(data), [own.part(*p) for p in ident], **noiseless)
        return m.split(
            "doosan",
            links.chain,
            [log.part(*p) for p in ident],
            [log.part(*parts[train])],
            log.part(*parts[held]),
            [log.part(*p) for p in ident],
            tare,
            rotors=True,
            spread=0.05,
        )

    pick = lambda *joints: int(rng.choice(joints))
    order = [int(k) for k in rng.permutation(2)]
    which = [((1, 3), (2, 0))[k] for k in order]
    s, other = (split(*k) for k in which)
    train, held = (recorded.part(*parts[k]) for k in which[0])
    yield s, m.control(s, note=note)
    yield other, m.control(other, reference=True, note=note)
    yield s, m.untared(s)
    yield s, m.late(s, late, ([train], held))
    yield other, m.friction_lost(other)
    yield s, m.placeholders(s)
    yield other, m.nominal_links(other, real.doosan_nominal(data))
    menu = [
        lambda s: added.coulomb(6, pick(1, 2, 3, 4)),
        lambda s: added.drift(6, pick(1, 2, 3, 4, 5), round(float(rng.uniform(4, 12)), 1)),
        lambda s: added.tilt(s.ref.chain, round(float(rng.uniform(0, 6.28)), 2)),
        lambda s: _contact(rng, s.ref.chain, s.train, pick(4, 5, 6)),
        lambda s: added.payload(s.ref.chain, [0.0, 0.0, 0.1], 0.05),
        lambda s: added.encoder(pick(2, 3)),
        lambda s: added.spring(6, pick(1, 4, 5), 0.0),
        lambda s: added.gain(pick(2, 3, 4)),
    ]
    yield from _several(rng, s, other, menu, 4)


# ---------------------------------------------------------------------------------------------------- UR5


LOAD = 1.6 * 0.4536
"""Of the UR5's gripper, by the name of its file [kg]."""


def ur5(data, rng):
    """63 s of picking with 1.6 lb, at half speed. The identification starts from links that hold the load."""
    log = real.ur5(data)
    shift = rng.uniform(-2.0, 2.0)
    parts = [
        (0.5, 16 + shift),
        (16 + shift, 32 + shift),
        (32 + shift, 48 + shift),
        (48 + shift, 63),
    ]
    bare = real.ur5_nominal(data)
    body = from_com(LOAD, [0, 0, 0.0823 + 0.05], 0.4 * LOAD * 0.04**2 * np.eye(3))
    phi = bare.phi.copy()
    phi[-1] += body

    @functools.cache
    def split(train, held):
        ident = [parts[k] for k in range(4) if k not in (train, held)]
        return m.split(
            "ur5",
            bare.but(phi=phi),
            [log.part(*p) for p in ident],
            [log.part(*parts[train])],
            log.part(*parts[held]),
            [log.part(*p) for p in ident],
            rotors=True,
            spread=0.1,
        )

    pick = lambda *joints: int(rng.choice(joints))
    s, other = split(1, 3), split(2, 0)
    yield s, m.control(s)
    yield other, m.control(other, reference=True)
    yield other, m.friction_lost(other)
    yield s, m.load_taken_out(s, body)
    menu = [
        lambda s: added.gain(2),
        lambda s: added.viscous(6, pick(1, 2, 3, 4)),
        lambda s: added.coulomb(6, pick(1, 2, 3, 4)),
        lambda s: added.offset(6, pick(1, 2, 3, 4, 5)),
    ]
    yield from _several(rng, other, s, menu, 2, reference=0)


ARMS = {
    "panda": panda,
    "ur10e": ur10e,
    "iiwa": iiwa,
    "kinova": kinova,
    "doosan": doosan,
    "ur5": ur5,
}
