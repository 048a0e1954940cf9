"""The page of a diagnosis: what it found, the pictures that made it say so, and what it could not see."""

import dataclasses
import difflib
import platform
from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from .. import summaries
from ..arms.arm import Arm, joints_named
from ..effects import AbstractEffect
from ..inference.state import coefficients
from ..report import Figure, Listing, Section, Table, estimate, number
from ..versions import version
from .diagnosis import NEXT_MOTION, Diagnosis
from .finding import Finding
from .localise import REGIMES, Localisation, lag_profile, order_spectrum, since_reversal
from .next_motion import NOTHING, Told
from .two_sided import TwoSided
from .unnamed import sines

_POINTS = 900
"""Points of a cloud, and stretches of a curve, that a figure draws."""
_TONES = {"consistent": "good", "explained": "bad", "partly_explained": "unsure", "unexplained": "unsure"}
_WORSE = 1.05
"""Factor of an error from which it is told as worse."""
_CHANGED = 0.005
"""Share of a number of the model by which it must have changed to be told."""
_MANY = 12
"""Rows of a finding's parameters from which they are folded away, as the knots of a curve."""
_TRIED, _REJECTED = 5.0, 12
"""Gain from which an effect that was left out is told [nats], and how many are."""
_BEFORE, _AFTER, _FIT = "#e08a1e", "#1f6fb2", "#b3202a"


def sections(found: Diagnosis) -> list[Section]:
    """The page, in the order in which a reader asks."""
    document = found.to_json()
    names = found.corrected.arm.joint_names
    out = [_verdict(found, document, names)]
    out += [_finding(found, i, one, names) for i, one in enumerate(found.findings)]
    out.append(_held_out(found))
    if found.replays:
        out.append(_replays(found, names))
    if found.next_motion is not None:
        out.append(_next(found, names))
    out += [_where(found, names), _heat_map(found, names), _exclusion(found, names)]
    out += [_file(found), _method(found, names)]
    return out


def sides(found: TwoSided) -> list[Section]:
    """The page of torque before and behind the drives: both together, then each, then the whole arm's file."""
    document, names = found.to_json(), found.corrected.arm.joint_names
    force = found.corrected.arm.unit("N·m")
    errors = [
        summaries.by_joint(
            f"Error of {column} in the band of the diagnosis, rms [{force}]",
            names,
            summaries.fit_columns(document[fit]),
        )
        for column, fit in (("tau", "fit"), ("tau_motor", "fit_motor"))
    ]
    out = [Section("Verdict", found.lines(), errors, tone=_TONES[found.verdict])]
    for what, side in (("Behind the drives", found.link), ("In the drives", found.drive)):
        here = [_finding(side, i, one, names) for i, one in enumerate(side.findings)]
        here += [_held_out(side), _where(side, names), _heat_map(side, names), _exclusion(side, names)]
        here.append(_method(side, names))
        out += [dataclasses.replace(section, heading=f"{what}: {section.heading}") for section in here]
    whole = dataclasses.replace(
        found.drive,
        corrected=found.corrected,
        written=found.written,
        notes=found.warnings,
        replays=found.replays,
    )
    if found.replays:
        out.append(_replays(whole, names))
    return [*out, _file(whole)]


def _verdict(found: Diagnosis, document: Mapping[str, Any], names: Sequence[str]) -> Section:
    sentences = [*found.lines()]
    if not found.findings:
        sentences.append(
            "Effects below the sizes in the table of what would have shown cannot be excluded: "
            + _weakest(found)
            + "."
        )
    if found.next_motion is not None:
        told = found.next_motion.pairs[0]
        sentences.append(f"To learn {_question(told)}, record {NEXT_MOTION}: {found.next_motion.kind}.")
    columns = summaries.fit_columns(document["fit"])
    table = summaries.by_joint(
        f"Torque error in the band of the diagnosis, rms [{found.problem.arm.unit('N·m')}]", names, columns
    )
    floor = np.maximum(np.asarray(columns["noise floor"]), 1e-12)
    shades: list[list[float | None]] = []
    for j in range(len(names)):
        row: list[float | None] = [None]
        row += [-_faded(np.asarray(v)[j] / floor[j] - 1.15, 10.0) for v in list(columns.values())[:4]]
        shades.append([*row, None])
    rows, told = [list(row) for row in table.rows], list(columns.values())
    caption = table.caption
    for j, cells in enumerate(rows):
        for before, after in ((0, 1), (2, 3)):
            if told[after][j] > _WORSE * max(told[before][j], floor[j]):
                cells[1 + after] += " ▲"
                caption = table.caption + " ▲ worse than before."
    shaded = Table(table.columns, rows, caption, shades, less="beyond the noise")
    return Section(
        "Verdict",
        sentences,
        [shaded],
        [_bars(found, columns, names)],
        tone=_TONES[found.verdict],
        figures_first=True,
    )


def _bars(found: Diagnosis, columns: Mapping[str, Any], names: Sequence[str]) -> Figure:
    """What is left of each joint's torque by either model, over its noise, where it was not fitted."""
    floor = np.maximum(np.asarray(columns["noise floor"]), 1e-12)
    pairs = (
        ("your simulation", "held out, before", _BEFORE),
        ("corrected, on data that it was not fitted to", "held out, after", _AFTER),
    )

    def draw(canvas: Any) -> None:
        axis = canvas.subplots()
        canvas.subplots_adjust(left=0.07, right=0.995, bottom=0.12, top=0.97)
        for k, (label, column, colour) in enumerate(pairs):
            axis.bar(
                np.arange(len(names)) + 0.4 * (k - 0.5),
                np.asarray(columns[column]) / floor,
                0.38,
                color=colour,
                label=label,
            )
        axis.axhline(1.0, color="0.3", linewidth=1.0, linestyle="--", label="noise")
        axis.set_xticks(range(len(names)), [_short(name, 14) for name in names])
        axis.set_ylabel("torque error over noise")
        axis.set_yscale("log")
        axis.yaxis.set_major_formatter(lambda v, _: f"{v:g}")
        axis.legend(loc="upper left", fontsize=7)

    return Figure(draw, "Torque error of each joint, before and after", (7.6, 2.6), None)


def _weakest(found: Diagnosis) -> str:
    """For the reader of an empty verdict: what the recordings could show of the commonest effects."""
    parts = []
    for name in [c.name for c in found.problem.catalogue if c.commonplace]:
        rows = [one for one in found.least_shown if one.effect == name and one.size is not None]
        if rows:
            worst = max(rows, key=lambda one: one.size or 0.0)
            where = "" if worst.joint is None or len(rows) == 1 else f" (joint {worst.joint + 1})"
            parts.append(f"{_plain(name)} up to {number(worst.size, 2)} {worst.unit}{where}")
    return "; ".join(parts)


def _finding(found: Diagnosis, place: int, one: Finding, names: Sequence[str]) -> Section:
    sentences = [one.summary, f"Equation: {one.equation}."]
    sentences.append(
        f"Confidence {one.confidence:.2f} that this is its name; the recordings are {_odds(one.evidence)} times"
        " likelier with it than without."
    )
    if one.intervals:
        spans = ", ".join(f"{a:.2f} to {b:.2f} s" for a, b in one.intervals)
        sentences.append(f"In {', '.join(one.recordings)}, from {spans}.")
    tables = []
    rows = []
    for p in one.parameters:
        ends = [estimate(p["value"] + side * 1.96 * p["std"], p["std"]) for side in (-1, 1)]
        interval = " … ".join(ends) if p["std"] else "–"
        rows.append([p["name"], str(p["joint"] or "-"), estimate(p["value"], p["std"]), interval, p["unit"]])
    if rows:
        many = len(rows) > _MANY
        caption = f"Parameters, {len(rows)} rows" if many else ""
        heads = ["parameter", "joint", "value", "95 % interval", "unit"]
        tables.append(Table(heads, rows, caption, folded=many))
    felt = ["rms", *(number(float(v), 3) for v in one.rms_torque)]
    tables.append(Table(["", *names], [felt], f"Torque that it explains [{found.problem.arm.unit('N·m')}]"))
    if one.alternatives:
        reveals = {c.name: c.reveals for c in found.problem.catalogue}
        rows = [[_plain(name), f"{p:.2f}", reveals.get(name, "")] for name, p in one.alternatives]
        tables.append(Table(["what else it could be", "probability", "what would show that"], rows))
    return Section(
        f"{place + 1}. {_plain(one.effect)}" + _at(one.joints, len(names)),
        sentences,
        tables,
        _pictures(found, one, names),
        figures_first=True,
    )


def _at(joints: Sequence[int], dof: int) -> str:
    if not joints or len(joints) == dof:
        return ""
    return f" at {joints_named(joints)}"


def _plain(name: str) -> str:
    return name.replace("_", " ")


def _faded(value: float, strong: float) -> float:
    """0 where value is not positive, 1 where it is `strong`, by its logarithm."""
    return float(np.clip(np.log1p(max(value, 0.0)) / np.log1p(strong), 0.0, 1.0))


def _odds(nats: float) -> str:
    """A factor whose logarithm is given, as people write it."""
    return f"{np.exp(nats):.2g}" if nats < 7 else f"10^{nats / np.log(10):.0f}"


def _pictures(found: Diagnosis, one: Finding, names: Sequence[str]) -> list[Figure]:
    """The residual without everything but this finding, against what drives it, and over time."""
    problem, state = found.problem, found.state
    joint = int(np.argmax(one.rms_torque))
    effect = state.terms[one.terms[0]].effect if one.terms else None
    for i in one.terms:  # the term that acts where most is felt
        if joint in state.terms[i].effect.joints:
            effect = state.terms[i].effect
    force = problem.arm.unit("N·m", joint)
    own = [
        sum((t.columns[r] @ coefficients(state, i) for i, t in _terms(found, one)), np.zeros_like(residual))
        for r, residual in enumerate(problem.residual)
    ]
    _, _, after = zip(*((n, b, a) for n, _, b, a in found.residuals()), strict=True)
    rows = [np.flatnonzero(t.weight * on > 0) for t, on in zip(problem.traces, problem.active, strict=True)]
    fits = [np.asarray(f)[k, joint] for f, k in zip(own, rows, strict=True)]
    lefts = [a[k, joint] + f for a, k, f in zip(after, rows, fits, strict=True)]
    against = "time" if effect is None else effect.seen_against
    label, x, turned = _regime(found, effect, joint, against)
    signs = [s[k] for s, k in zip(turned, rows, strict=True)]
    xs = np.concatenate([v[k] for v, k in zip(x, rows, strict=True)])
    y = np.concatenate([r * s for r, s in zip(lefts, signs, strict=True)])
    f = np.concatenate([r * s for r, s in zip(fits, signs, strict=True)])
    named = [t.name for t in problem.traces].index(one.recordings[0])
    shown = int(np.argmax([np.sum(v**2) for v in fits])) if one.terms else named
    trace = problem.traces[shown]
    delayed, ordered = against == "lag", against == "order"
    hums = next((p["value"] for p in one.parameters if not one.terms and p["name"] == "frequency"), None)

    def regime(canvas: Any) -> None:
        axis = canvas.subplots()
        canvas.subplots_adjust(left=0.13, right=0.98, bottom=0.14, top=0.92)
        if delayed:
            _draw_lags(axis, found)
        elif ordered:
            orders, _, amplitude = order_spectrum(
                problem, problem.design((), state.noise), state.noise, joint
            )
            axis.vlines(orders, 0, amplitude, color=_AFTER, linewidth=0.8)
            axis.set(xlabel="order: periods in a turn of the joint", ylabel=f"amplitude [{force}]")
            axis.set_title("order spectrum of the residual")
        elif hums is not None:
            tau = np.asarray(trace.signals.tau)[:, joint]
            frequencies = np.fft.rfftfreq(len(tau), 1 / trace.signals.rate)
            axis.semilogy(frequencies, sines(tau), color=_AFTER, linewidth=0.8)
            axis.axvline(hums, color=_FIT, linewidth=0.8, linestyle=":")
            axis.set(
                xlabel="frequency [Hz]",
                ylabel=f"amplitude [{force}]",
                xlim=(0, min(3 * hums, frequencies[-1])),
            )
            axis.set_title("spectrum of the measured torque")
        else:
            _draw_regime(axis, xs, y, f)
            axis.set(xlabel=label, ylabel=f"residual of {names[joint]} [{force}]")
            axis.set_title("what is left without this finding, and its law")

    def over_time(canvas: Any) -> None:
        axis = canvas.subplots()
        canvas.subplots_adjust(left=0.13, right=0.98, bottom=0.14, top=0.92)
        trail = np.full((2, trace.motion.samples), np.nan)  # no line across what does not count
        trail[:, rows[shown]] = lefts[shown], fits[shown]
        _trail(axis, trace.motion.time, trail[0], color="0.6", label="residual without this finding")
        if one.terms:
            _trail(axis, trace.motion.time, trail[1], color=_FIT, label="what it explains")
        for a, b in one.intervals or ():
            axis.axvspan(a, b, color=_BEFORE, alpha=0.15, linewidth=0)
        axis.set(xlabel=f"time in {_short(trace.name)} [s]", ylabel=f"[{force}]")
        axis.set_title(f"{names[joint]} over time")
        axis.legend(loc="upper right", fontsize=7)

    why = f"Why: the residual of {names[joint]} against {'lag' if delayed else label}"
    if hums is not None:
        why = f"Why: what {names[joint]} measures has a line at one frequency"
    return [
        Figure(regime, why, (4.8, 3.4), None),
        Figure(over_time, f"The same over time, in {_short(trace.name)}", (4.8, 3.4), None),
    ]


def _terms(found: Diagnosis, one: Finding):
    return [(i, found.state.terms[i]) for i in one.terms]


def _short(name: str, most: int = 40) -> str:
    return name if len(name) <= most else name[: most - 1] + "…"


def _regime(found: Diagnosis, effect: AbstractEffect | None, joint: int, against: str):
    """A label, the variable in each recording, and by which sign the residual is turned."""
    traces, unit = found.problem.traces, found.problem.arm.unit
    source = int(getattr(effect, "source", joint))
    what = against.split(",")[0]
    if what in ("time", "lag"):
        label, x = "time [s]", [t.motion.time for t in traces]
    elif what == "reversal":
        label = f"distance since the last reversal [{unit('rad', joint)}]"
        since = [since_reversal(t, joint) for t in traces]
        x = [np.where(one > 0.2, np.nan, one) for one in since]
    else:
        words, turning, at, channel = {
            "velocity": ("velocity of", "rad/s", joint, lambda m: m.qd),
            "position": ("position of", "rad", joint, lambda m: m.q),
            "order": ("position of", "rad", joint, lambda m: m.q),
            "acceleration": ("acceleration of", "rad/s²", joint, lambda m: m.qdd),
            "load": ("load on", "N·m", joint, lambda m: m.load),
            "|load|": ("size of the load on", "N·m", joint, lambda m: np.abs(m.load)),
            "model torque": ("torque of the model at", "N·m", joint, lambda m: m.torque_shown),
            "source torque": ("torque of the model at", "N·m", source, lambda m: m.torque_shown),
            "source position": ("position of", "rad", source, lambda m: m.q),
            "source velocity": ("velocity of", "rad/s", source, lambda m: m.qd),
            "first joint": ("position of", "rad", 0, lambda m: m.q),
        }[what]
        label = f"{words} joint {at + 1} [{unit(turning, at)}]"
        x = [np.asarray(channel(t.motion)[:, at]) for t in traces]
    turned = [
        np.sign(t.motion.qd[:, joint]) if "turned" in against else np.ones(t.motion.samples) for t in traces
    ]
    if "turned" in against:
        label += "; torque times the sign of the velocity"
    return label, x, turned


def _draw_regime(axis: Any, x: np.ndarray, y: np.ndarray, f: np.ndarray) -> None:
    """Cloud, means in bins with their spread, and the law in the same bins."""
    good = np.isfinite(x)
    x, y, f = x[good], y[good], f[good]
    thin = slice(None, None, max(1, len(x) // _POINTS))
    axis.plot(x[thin], y[thin], ".", color="0.75", markersize=2, zorder=1)
    order = np.argsort(x)
    parts = [p for p in np.array_split(order, 40) if len(p) > 4]
    middle = np.array([x[p].mean() for p in parts])
    axis.errorbar(
        middle,
        [y[p].mean() for p in parts],
        [2 * y[p].std() / np.sqrt(len(p)) for p in parts],
        fmt="o",
        color="0.2",
        markersize=2.5,
        linewidth=0.8,
        label="mean residual, ± 2 deviations",
        zorder=2,
    )
    axis.plot(middle, [f[p].mean() for p in parts], color=_FIT, linewidth=1.6, label="law found", zorder=3)
    axis.legend(loc="best", fontsize=7)


def _draw_lags(axis: Any, found: Diagnosis) -> None:
    """Gain of every joint over its own best, so that all stand in one picture."""
    noise = found.state.noise
    design = found.problem.design((), noise)
    for j in range(found.problem.dof):
        lags, gain = lag_profile(found.problem, design, noise, j)
        gain = gain / max(float(gain.max()), 1.0)
        axis.plot(1e3 * lags, np.where(gain < -1, np.nan, gain), label=f"joint {j + 1}", linewidth=1.0)
    axis.set(xlabel="torque late by [ms]", ylabel="gain of likelihood, of each joint's best", ylim=(-1, 1.1))
    axis.set_title("lag scan between torque and model")
    axis.legend(fontsize=6, ncols=2)


def _trail(axis: Any, time: Float[np.ndarray, " time"], y: Float[np.ndarray, " time"], **style: Any) -> None:
    """A curve with no more points than a screen shows, its extremes kept."""
    count = len(y) // _POINTS
    if count < 2:
        axis.plot(time, y, **style)
        return
    whole = len(y) // (2 * count) * (2 * count)
    blocks = y[:whole].reshape(-1, 2 * count)
    clock = time[:whole].reshape(-1, 2 * count)[:, [0, count]]
    axis.plot(clock.ravel(), np.stack([blocks.min(1), blocks.max(1)], 1).ravel(), **style)


def _held_out(found: Diagnosis) -> Section:
    figures, arm = [], found.problem.arm
    rows = zip(found.problem.traces, found.problem.active, found.residuals(), found.held_out, strict=True)
    for trace, on, (name, time, before, _), (after, counts) in rows:
        if len(figures) == 2 or not on:
            continue
        figures.append(
            _curves(arm, name, time, before, np.where(counts[:, None], after, np.nan), trace.weight)
        )
    sentences = [
        "What is left of the measured torque: by your simulation, and by the corrected one, whose coefficients"
        " were fitted to other blocks of the recordings than those shown. What happened once has no other block,"
        " and is left out."
    ]
    if sum(found.problem.active) > len(figures):
        sentences.append(f"The first {len(figures)} of {sum(found.problem.active)} recordings are drawn.")
    return Section("Before and after, on data held out", sentences, figures=figures)


def _curves(
    arm: Arm,
    name: str,
    time: Float[np.ndarray, " time"],
    before: Float[np.ndarray, "time dof"],
    after: Float[np.ndarray, "time dof"],
    weight: Float[np.ndarray, " time"],
) -> Figure:
    names = arm.joint_names

    def draw(canvas: Any) -> None:
        axes = canvas.subplots(len(names), 1, sharex=True, squeeze=False)[:, 0]
        room = 1.05 * len(names)
        canvas.subplots_adjust(left=0.075, right=0.995, bottom=0.4 / room, top=1 - 0.1 / room, hspace=0.18)
        for j, axis in enumerate(axes):
            _trail(
                axis, time, np.where(weight > 0, before[:, j], np.nan), color=_BEFORE, label="your simulation"
            )
            _trail(axis, time, after[:, j], color=_AFTER, label="corrected, held out")
            axis.set_ylabel(f"{_short(names[j], 14)}\n[{arm.unit('N·m', j)}]")
            axis.locator_params(axis="y", nbins=4)
        axes[0].legend(loc="upper right", ncols=2, fontsize=7)
        axes[-1].set_xlabel("time [s]")

    return Figure(draw, f"{name}: measured less modelled torque", (10.0, 1.05 * len(names)), None)


def _replays(found: Diagnosis, names: Sequence[str]) -> Section:
    tables, rad = [], found.problem.arm.unit("rad")
    for one in found.replays:
        columns = {
            f"{what.replace('_', ' ').replace('rmse rad', f'tracking [{rad}]')}, {when}": one.get(
                f"{what}_{when}"
            )
            for what in ("rmse_rad", "feedback_rms")
            for when in ("before", "after")
        }
        if any(values is not None for values in columns.values()):
            caption = f"{one.get('recording', '')}: replayed in MuJoCo"
            tables.append(summaries.by_joint(caption, names, columns))
    said = [
        "Your simulation and the corrected one follow the recorded motion under the recorded torque and the"
        " same weak feedback."
    ]
    said += [
        f"{one.get('recording', '')}: {which} ran away."
        for one in found.replays
        for which, when in (("your simulation", "before"), ("the corrected one", "after"))
        if one.get(f"rmse_rad_{when}") is None
    ]
    return Section("Simulated again", said, tables)


def _question(told: Told) -> str:
    """What a pair leaves open, in words."""
    if told.rival == NOTHING:
        return f"whether {_plain(told.finding)} is there at all"
    return f"whether it is {_plain(told.finding)} or {_plain(told.rival)}"


def _next(found: Diagnosis, names: Sequence[str]) -> Section:
    motion = found.next_motion
    assert motion is not None
    rows = [
        [
            _question(p),
            number(None if p.joint is None else p.joint + 1),
            f"{p.nats:.1f}",
            f"{p.nats_repeated:.1f}",
        ]
        for p in motion.pairs
    ]
    tried = [[kind, f"{nats:.1f}"] for kind, nats in sorted(motion.tried, key=lambda one: -one[1])]
    again = motion.kind == motion.tried[0][0]

    def draw(canvas: Any) -> None:
        axis = canvas.subplots()
        canvas.subplots_adjust(left=0.06, right=0.995, bottom=0.18, top=0.97)
        for j, name in enumerate(names):
            _trail(axis, motion.time, motion.q[:, j], label=name)
        axis.set(xlabel="time [s]", ylabel=f"[{found.problem.arm.unit('rad')}]")
        axis.legend(ncols=len(names), fontsize=7, loc="upper right")

    return Section(
        "The experiment that would decide",
        [
            f"These recordings leave open what is in the table. Most would be learned from {motion.kind}"
            f"{' (nothing tried does better)' if again else ''}: {motion.time[-1]:.0f} s, in {NEXT_MOTION}.",
            "It stays within the joints' limits and near the box that was recorded, and is little faster."
            f" {motion.said} Look at it before it is run.",
        ],
        [
            Table(
                ["open", "joint", "expected of this motion", "of the recorded one again"],
                rows,
                "Expected log odds of whichever is true; 5 is 150 to 1",
            ),
            Table(["motion", "log odds"], tried, "What was compared, by the pair that it tells least"),
        ],
        [Figure(draw, f"{NEXT_MOTION}: joint positions", (10.0, 2.4), None)],
    )


def _where(found: Diagnosis, names: Sequence[str]) -> Section:
    before, after = found.localisation
    sentences = [
        "Share of each joint's whitened residual that goes with a regime, what noise would give taken off; empty"
        " where it is within noise, all joints and regimes taken together. Regimes overlap: friction shows under"
        " direction, speed and load at once."
    ]
    tables = [_regimes("Your simulation", before, names)]
    if found.findings:
        tables.append(_regimes("With the findings", after, names))
    rows = []
    for when, one in (("before", before), ("after", after)) if found.findings else (("before", before),):
        rows += [
            [
                names[o.joint],
                when,
                f"order {number(o.order, 3)}",
                f"{number(o.amplitude, 2)} {found.problem.arm.unit('N·m', o.joint)}",
                _chance(o.p),
            ]
            for o in one.orders
            if o.beyond
        ]
        rows += [
            [
                names[lag.joint],
                when,
                "torque late",
                f"{1e3 * lag.lag:.1f} ± {1e3 * lag.std:.1f} ms"
                if lag.std is not None
                else f"no best lag within {1e3 * abs(lag.lag):.0f} ms",
                _chance(lag.p),
            ]
            for lag in one.lags
            if lag.beyond
        ]
        strongest = sorted(one.changes, key=lambda c: -abs(c.z))[:6]
        rows += [
            [
                names[c.joint],
                when,
                f"{c.kind} changes",
                f"{_short(c.recording)}, {c.time:.2f} s",
                f"z = {c.z:.1f}",
            ]
            for c in sorted(strongest, key=lambda c: (c.joint, c.time))
        ]
    if rows:
        tables.append(
            Table(
                ["joint", "model", "what", "where, how much", "chance of noise"],
                rows,
                "Orders of position, lags, strongest change points",
            )
        )
    else:
        sentences.append("No order of position, no lag and no change point is beyond noise.")
    return Section("Where the difference lies", sentences, tables)


def _chance(p: float) -> str:
    return f"{p:.0e}" if p > 1e-12 else "< 1e-12"


def _regimes(caption: str, one: Localisation, names: Sequence[str]) -> Table:
    rows, shades = [], []
    for regime in REGIMES:
        cells = [r for r in one.regimes if r.name == regime]
        rows.append([f"{regime}", *(f"{100 * c.share:.1f} %" if c.beyond else "" for c in cells)])
        shades.append([None, *(c.share**0.5 if c.beyond else None for c in cells)])
    return Table(["by", *names], rows, caption, shades, more="share of the residual")


def _heat_map(found: Diagnosis, names: Sequence[str]) -> Section:
    heat = found.heat_map
    held = {(f.effect, j) for f in found.findings for j in f.joints}

    def table(values: np.ndarray, caption: str, marked: bool) -> Table:
        rows, shades = [], []
        for effect, gains in zip(heat.effects, values, strict=True):
            if np.all(np.isnan(gains)):
                continue
            found_here = [marked and (effect, j) in held for j in range(len(names))]
            rows.append(
                [
                    _plain(effect),
                    *(
                        "" if np.isnan(g) else _gain(g) + " ●" * m
                        for g, m in zip(gains, found_here, strict=True)
                    ),
                ]
            )
            shades.append([None, *(_shade(g) for g in gains)])
        return Table(["effect", *names], rows, caption, shades, more="predicts better", less="predicts worse")

    tables = [table(heat.alone, "One effect alone added to your simulation; ● was found", True)]
    if found.findings:
        tables.append(table(heat.beside, "One more effect beside everything found", False))
        tables += _left_out(found, held, names)
    return Section(
        "Every effect at every joint",
        [
            "Gain of log likelihood on blocks of the recordings that the effect was not fitted to, in its"
            " best shape; negative where it makes them worse. What acts in the whole arm is split into the"
            " joints' shares; what happens once (a contact, a change of payload) has no second block to be tested"
            " on. A gain of 5 is 150 to 1, of 14 a million to 1."
        ],
        tables,
    )


def _shade(gain: float) -> float | None:
    """How strongly a gain is coloured."""
    if np.isnan(gain) or abs(gain) < 3:
        return None
    return float(np.sign(gain)) * _faded(abs(gain), 3000.0)


def _left_out(found: Diagnosis, held: Collection[tuple[str, int]], names: Sequence[str]) -> list[Table]:
    """What would have explained something by itself and is not among the findings (`held`)."""
    heat, rows = found.heat_map, []
    needed = {effect.name: -effect.prior for effect in found.problem.catalogue}
    for effect, alone, beside in zip(heat.effects, heat.alone, heat.beside, strict=True):
        for j, (gain, left) in enumerate(zip(alone, beside, strict=True)):
            if not gain >= _TRIED or (effect, j) in held:  # NaN: was not tried
                continue
            if left < _TRIED or np.isnan(left):
                why = "the findings explain it"
            elif left < needed[effect]:
                why = f"it gains less than the {needed[effect]:.0f} by which it is unlikely beforehand"
            else:
                why = "torque is predicted better with it too; no likelier model that was tried has it"
            cells = [_plain(effect), names[j], _gain(gain), "" if np.isnan(left) else _gain(left), why]
            rows.append((gain, cells))
    if not rows:
        return []
    rows.sort(key=lambda row: -row[0])
    heads = ["effect", "joint", "gain alone", "beside the findings", "why it is not among them"]
    caption = f"What was tried and left out, the first {min(len(rows), _REJECTED)} of {len(rows)}"
    return [Table(heads, [row for _, row in rows[:_REJECTED]], caption, folded=True)]


def _gain(value: float) -> str:
    return f"{value:.0f}" if abs(value) >= 10 else f"{value:.1f}"


def _exclusion(found: Diagnosis, names: Sequence[str]) -> Section:
    rows, shades, arm = [], [], found.problem.arm
    for effect in dict.fromkeys(one.effect for one in found.least_shown):
        cells = {one.joint: one for one in found.least_shown if one.effect == effect}
        whole = cells.get(None)
        sizes = list(dict.fromkeys(f"{one.parameter} [{one.unit}]" for one in cells.values()))
        row = [f"{_plain(effect)}\n{' or '.join(sizes)}"]
        shade: list[float | None] = [None]
        for j in range(len(names)):
            one = whole if whole is not None else cells.get(j)
            if one is None:
                row.append("")
                shade.append(None)
                continue
            row.append(
                "not seen"
                if one.size is None or one.rms_torque is None
                else f"{number(one.size, 2)}{f' {one.unit}' if len(sizes) > 1 else ''}\n"
                f"{number(one.rms_torque, 2)} {arm.unit('N·m', one.joint)}"
            )
            shade.append(-0.5 if one.size is None else -0.35 * (one.survives < 0.05) or None)
        rows.append(row)
        shades.append(shade)
    return Section(
        "What would have shown",
        [
            "The smallest size of each effect that would have been found in these recordings"
            + (" beside the findings" if found.findings else "")
            + ", in its unit, and below that as rms torque at the joint that feels it most. What is smaller"
            " cannot be excluded. Coloured: over 95 % of the effect is absorbed by what is refitted anyway.",
        ],
        [Table(["effect", *names], rows, "", shades, less="absorbed by what is refitted")],
    )


def _numbers(found: Diagnosis) -> list[Table]:
    """Numbers of the user's model that the corrected one has otherwise, before and after."""
    arm, native = found.corrected.arm, found.corrected.native
    unit = arm.unit
    kinds = [
        ("mass of", "kg", np.asarray(arm.standard[:, 0]), np.asarray(native.standard[:, 0]), arm.link_names)
    ]
    for kind, of in (
        ("damping", "N·m·s/rad"),
        ("frictionloss", "N·m"),
        ("armature", "kg·m²"),
        ("stiffness", "N·m/rad"),
    ):
        before, after = (np.asarray(getattr(a, kind)) for a in (arm, native))
        kinds.append((f"{kind} of", of, before, after, arm.joint_names))
    rows = [
        [f"{what} {names[j]}", number(before[j]), number(after[j]), of if of == "kg" else unit(of, j)]
        for what, of, before, after, names in kinds
        for j in range(arm.dof)
        if abs(after[j] - before[j]) > _CHANGED * max(abs(before[j]), 1e-9)
    ]
    if not rows:
        return []
    caption = "Numbers of your model, refitted or with what was found"
    return [Table(["number", "before", "after", "unit"], rows, caption, folded=len(rows) > _MANY)]


def _file(found: Diagnosis) -> Section:
    lines = []
    for name, text in found.written.texts.items():
        before, after = found.source.document.texts[name].splitlines(), text.splitlines()
        names = f"your {name or 'model'}", name or "corrected.xml"
        for line in difflib.unified_diff(before, after, *names, n=2, lineterm=""):
            kind = "note" if line[:2] in ("++", "--", "@@") else {"+": "add", "-": "cut"}.get(line[:1], "")
            lines.append((kind, line))
    cannot = [note for note in found.notes if note.startswith("corrected.xml")]
    sentences = [
        "What MuJoCo's own attributes can hold of the findings:"
        if lines
        else "corrected.xml is your file as it was."
    ]
    sentences += cannot
    beyond = [e.name for e, _ in found.corrected.beyond]
    if beyond:
        sentences.append(
            f"{', '.join(map(_plain, dict.fromkeys(beyond)))}: `jaxpanda predict` and the corrected model in"
            " Python have it all the same."
        )
    many = len(lines) > 60
    caption = f"Difference, {len(lines)} lines" if many else ""
    listings = [Listing(lines, caption, many)] if lines else []
    return Section("Your file", sentences, _numbers(found), listings=listings)


def _method(found: Diagnosis, names: Sequence[str]) -> Section:
    problem, noise = found.problem, found.state.noise
    force = problem.arm.unit("N·m")
    localised = found.localisation[1]
    trace = problem.traces[0]
    rates = sorted({round(1 / t.motion.dt) for t in problem.traces})
    cutoffs = sorted({round(t.cutoff, 1) for t in problem.traces})
    sentences = [
        f"Torque and model were low-passed at {_listed(cutoffs)} Hz and compared at {_listed(rates)} Hz; physics"
        f" with corners was evaluated at {1 / trace.dt:.0f} Hz and filtered like the torque.",
        f"The model's own numbers were taken as known as “{found.knowledge}” says: "
        + {
            "exact": "inertial parameters and friction as they stand.",
            "identified": "as an identification motion would have left them, friction to 2 %.",
            "rough": "masses to 4 %, centres of mass to 3 mm, inertias to 10 %, friction to 20 %.",
            "unknown": "not at all.",
        }[found.knowledge],
    ]
    sentences += [note for note in found.notes if not note.startswith("corrected.xml")]
    table = summaries.by_joint(
        "Noise beside everything found: autoregressive of order 3",
        names,
        {
            f"deviation [{force}]": noise.std,
            f"innovations [{force}]": noise.sigma,
            **{f"a{k + 1}": noise.a[:, k] for k in range(noise.a.shape[1])},
            f"samples that count, of {localised.samples}": localised.effective_samples,
        },
    )
    tables = [table]
    if found.sources:
        rows = [[one["name"], one["role"], one["sha256"]] for one in found.sources]
        tables.append(Table(["file", "role", "sha256"], rows, "What went in"))
    packages = ("jaxpanda", "jax", "mujoco", "numpy", "scipy")
    versions = ", ".join(f"{name} {version(name)}" for name in packages)
    sentences.append(f"Python {platform.python_version()} on {platform.system()}; {versions}.")
    log = Listing(
        [("", line) for line in found.log], f"What the search tried, {len(found.log)} lines", folded=True
    )
    return Section("How this was found", sentences, tables, listings=[log] if found.log else [])


def _listed(values: Sequence[float | int]) -> str:
    return ", ".join(f"{v:g}" for v in values)
