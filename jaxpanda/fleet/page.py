"""`fleet.html`: the fleet at a glance, and each arm's history. One file, no script, no network."""

import datetime
from collections import Counter
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import printable
from ..report import number
from .arms import ERRORS, LEVELS, ArmHistory, Quantity, Recorded

if TYPE_CHECKING:
    from .result import Fleet

VERDICTS = ("consistent", "explained", "partly_explained", "unexplained", "unread")
_EFFECTS = 12
"""Columns of effects, the most frequent."""
_FIGURES = 6
"""Histories of an arm that are drawn at any rate; what is claimed is drawn up to twice as often."""
_OPEN = 3
_WIDTH, _HEIGHT, _LEFT, _BELOW = 240, 96, 40, 12
"""Of a history's picture, and of the room for its scales."""


def html(fleet: "Fleet") -> str:
    """The page."""
    import jinja2

    pages = jinja2.Environment(
        loader=jinja2.PackageLoader("jaxpanda"), autoescape=True, trim_blocks=True, lstrip_blocks=True
    )
    pages.filters["words"] = lambda text: text.replace("_", " ").replace("unread", "not diagnosed")
    count: Counter[str] = Counter()
    for arm in fleet.arms:
        for seen in arm.seen:
            count[seen.effect] += len(seen.rows)
    effects = [effect for effect, _ in sorted(count.items(), key=lambda pair: (-pair[1], pair[0]))[:_EFFECTS]]
    told = sum("verdict" in document for document in fleet.told.values())
    more = len(count) - len(effects)
    premises = [
        f"The models' numbers are taken as {fleet.knowledge}; each number below is a correction to a model.",
        "Of all that is said to be for good, to drift, or to have happened once, at most one in twenty is so by"
        " chance, each kind by itself (Benjamini and Hochberg).",
    ]
    premises += [f"{more} rarer effects have no column; they stand with each recording."] if more else []
    text = pages.get_template("fleet.html.j2").render(
        sentence=f"{len(fleet.table.rows)} recordings of {len(fleet.arms)} arms, {told} of them diagnosed.",
        premises=premises,
        verdicts=VERDICTS,
        effects=effects,
        arms=[_arm(fleet, arm, effects) for arm in fleet.arms],
        untold=[tuple(printable(str(part)) for part in row) for row in fleet.untold],
        when=fleet.table.time,
        open=_OPEN,
        marks="Red: it happened once, and does not count in the rest. Grey: from when nothing was wrong.",
    )
    return text


def _arm(fleet: "Fleet", arm: ArmHistory, effects: list[str]) -> dict[str, Any]:
    verdicts = Counter(arm.verdicts)
    verdicts["unread"] = sum(not one.told for one in arm.recorded)
    total = max(sum(verdicts.values()), 1)
    told = [f"{verdicts[v]} {v.replace('_', ' ')}" for v in VERDICTS[:4] if verdicts[v]]
    told += [f"{verdicts['unread']} not diagnosed"] if verdicts["unread"] else []
    told += [f"{n} from when nothing was wrong"] if (n := sum(r.row.reference for r in arm.recorded)) else []
    off = "–" if arm.off_by_noise is None else number(arm.off_by_noise, 3)
    return {
        "name": printable(arm.name),
        "count": len(arm.recorded),
        "off": off,
        "verdict_text": ", ".join(told),
        "bar": [(v, f"{100 * verdicts[v] / total:.1f}") for v in VERDICTS if verdicts[v]],
        "good": sum(q.for_good for q in arm.quantities),
        "drifts": sum(q.drifts for q in arm.quantities),
        "once": len({row for q in arm.quantities for row in q.apart}),
        "cells": [_cell(arm, effect) for effect in effects],
        "summary": f"{len(arm.recorded)} recordings: {', '.join(told)}; {off} × noise",
        "claims": [printable(said) for q in arm.quantities for said in fleet.sentences(q)],
        "figures": [_figure(fleet, arm, q) for q in _drawn(arm)],
        "recordings": [_recording(fleet, one) for one in arm.recorded],
    }


def _cell(arm: ArmHistory, effect: str) -> dict[str, str] | None:
    seen = [s for s in arm.seen if s.effect == effect]
    if not seen:
        return None
    rows, of = {row for s in seen for row in s.rows}, seen[0].of
    at = sorted({j for s in seen for j in s.joints})
    sure = float(np.average([s.confidence for s in seen], weights=[len(s.rows) for s in seen]))
    where = f"joints {', '.join(map(str, at))}; " if at else ""
    title = f"{where}confidence {sure:.2f}"
    return {"text": f"{len(rows)}/{of}", "title": title, "shade": f"{0.08 + 0.5 * sure * len(rows) / of:.2f}"}


def _recording(fleet: "Fleet", one: Recorded) -> dict[str, str]:
    document = one.document
    findings = [
        f"{f['effect'].replace('_', ' ')}{' ' + ','.join(map(str, f['joints'])) if f['joints'] else ''}"
        f" ({f['confidence']:.2f})"
        for f in one.findings
    ]
    verdict = document.get("verdict", document["status"]).replace("_", " ")
    return {
        "name": printable(one.row.recording),
        "when": _when(fleet, one.row.when),
        "verdict": f"{verdict}, nothing was wrong then" if one.row.reference else verdict,
        "off": number(document.get("off_by_noise"), 3),
        "findings": ", ".join(findings),
    }


def _when(fleet: "Fleet", when: float | None) -> str:
    if when is None:
        return ""
    if not fleet.table.dated:
        return f"{when:g}"
    date = datetime.datetime.fromtimestamp(0, datetime.UTC) + datetime.timedelta(days=when)
    return date.strftime("%Y-%m-%d" if when == int(when) else "%Y-%m-%d %H:%M")


def _drawn(arm: ArmHistory) -> list[Quantity]:
    """Histories to draw: what is claimed, then levels and errors that stand out of their deviations most."""
    several = [q for q in arm.quantities if q.history is not None]
    claimed = [q for q in several if q.claimed]
    claimed.sort(key=lambda q: (not q.apart, not q.drifts))
    rest = [q for q in several if not q.claimed and q.name in (*LEVELS, *ERRORS)]
    rest.sort(key=lambda q: (q.name not in LEVELS, -abs(q.history.mean.value) / q.history.mean.std))  # pyright: ignore
    drawn = claimed[: 2 * _FIGURES]
    return drawn + rest[: max(0, _FIGURES - len(drawn))]


def _figure(fleet: "Fleet", arm: ArmHistory, q: Quantity) -> dict[str, str]:
    h = q.history
    assert h is not None
    says = f"{h.mean.value:.3g} ± {number(h.mean.std, 2)} {q.unit}"
    if q.drifts and h.drift is not None:
        says += f", {h.drift.value:+.2g} a {fleet.time_unit or 'unit of time'}"
    return {"svg": _svg(fleet, arm, q), "title": q.title, "says": says}


def _svg(fleet: "Fleet", arm: ArmHistory, q: Quantity) -> str:
    h = q.history
    assert h is not None
    time = np.arange(len(q.value), dtype=float) if q.time is None else q.time
    wide = (h.mean.interval[1] - h.mean.interval[0]) / 2
    law = np.full(2, h.mean.value)
    ends = np.array([time.min(), time.max()])
    if q.drifts and h.drift is not None and h.centre is not None:
        law = h.mean.value + h.drift.value * (ends - h.centre)
    shown = [*(q.value - q.std), *(q.value + q.std), *law]
    low, high = float(np.min(shown)), float(np.max(shown))
    room = 0.08 * (high - low) or max(abs(high), 1e-9) * 0.1
    low, high = low - room, high + room
    right, floor = _WIDTH - 6, _HEIGHT - _BELOW

    def x(t: Any) -> Any:
        span = ends[1] - ends[0]
        return _LEFT + 8 + (np.asarray(t, float) - ends[0]) / (span or 1.0) * (right - _LEFT - 16)

    def y(v: Any) -> Any:
        return np.clip(floor - (np.asarray(v, float) - low) / (high - low) * (floor - 4), 4, floor)

    references = {one.row.number for one in arm.recorded if one.row.reference}
    dots = {"pt": "", "ref": "", "once": ""}
    bars = ""
    for row, a, b, top, bottom in zip(
        q.rows, x(time), y(q.value), y(q.value + 2 * q.std), y(q.value - 2 * q.std), strict=True
    ):
        kind = "once" if row in q.apart else "ref" if row in references else "pt"
        dots[kind] += f"M{a:.0f} {b:.0f}h0"
        bars += f"M{a:.0f} {top:.0f}V{bottom:.0f}"
    (x0, x1), (y0, y1) = x(ends), y(law)
    (t0, t1), (b0, b1) = y(law + wide), y(law - wide)
    parts = [
        f'<svg viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" aria-label="history">',
        f'<rect class="frame" x="{_LEFT}" y="4" width="{right - _LEFT}" height="{floor - 4}"/>',
        f'<path class="zero" d="M{_LEFT} {y(0):.0f}H{right}"/>' if low < 0 < high else "",
        f'<path class="band" d="M{x0:.0f} {t0:.1f}L{x1:.0f} {t1:.1f}V{b1:.1f}L{x0:.0f} {b0:.1f}z"/>',
        f'<path class="mean" d="M{x0:.0f} {y0:.1f}L{x1:.0f} {y1:.1f}"/><path class="err" d="{bars}"/>',
        *(f'<path class="{kind}" d="{d}"/>' for kind, d in dots.items() if d),
        f'<text x="{_LEFT - 3}" y="11" text-anchor="end">{_scale(high, high - low)}</text>',
        f'<text x="{_LEFT - 3}" y="{floor}" text-anchor="end">{_scale(low, high - low)}</text>',
    ]
    if q.time is not None:
        first, last = (_when(fleet, float(t)) for t in ends)
        parts.append(f'<text x="{_LEFT}" y="{_HEIGHT - 2}">{first}</text>')
        parts.append(
            f'<text x="{right}" y="{_HEIGHT - 2}" text-anchor="end">{last}</text>' if last != first else ""
        )
    return "".join([*parts, "</svg>"])


def _scale(value: float, span: float) -> str:
    """A number at the end of a scale, as exact as the scale is long."""
    digits = int(np.clip(1 - np.floor(np.log10(span)), 0, 6)) if span > 0 else 2
    return f"{value:.{digits}f}" if abs(value) < 1e5 else f"{value:.2g}"
