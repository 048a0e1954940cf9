"""The recordings of each arm together: what is the arm's for good, what drifts, what happened once."""

import dataclasses
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from .hierarchy import APART, History, Number, discoveries, history
from .table import Row, Table
from .work import DIAGNOSED

LEVELS = ("viscous_friction", "coulomb_friction", "torque_offset", "payload")
"""Quantities that are zero where the model is right."""
ERRORS = ("error_of_model", "held_out_error")


@dataclasses.dataclass(frozen=True)
class Recorded:
    """A row of the table with what became of it."""

    row: Row
    document: Mapping[str, Any]

    @property
    def told(self) -> bool:
        return self.document["status"] == DIAGNOSED

    @property
    def findings(self) -> Sequence[Mapping[str, Any]]:
        return self.document.get("findings", ())


@dataclasses.dataclass(frozen=True)
class Quantity:
    """A number of an arm over its recordings, and what can be claimed of it."""

    name: str
    joint: int | None
    unit: str
    rows: tuple[int, ...]
    """Numbers of the rows that tell it."""
    value: np.ndarray
    std: np.ndarray
    time: np.ndarray | None
    history: History | None
    """None for a single recording."""
    for_good: bool = False
    """The model is off by the mean."""
    drifts: bool = False
    apart: tuple[int, ...] = ()
    """Numbers of the rows in which something happened once."""

    @property
    def claimed(self) -> bool:
        return self.for_good or self.drifts or bool(self.apart)

    @property
    def title(self) -> str:
        """In words, with its joint."""
        words = self.name.replace(".", ": ").replace("_", " ")
        return words if self.joint is None else f"{words}, joint {self.joint}"

    def to_json(self, time_unit: str) -> dict[str, Any]:
        h = self.history
        if h is None:
            value, std = float(self.value[0]), float(self.std[0])
            alone = {"value": value, "std": std, "interval": None, "p": None, "for_good": False}
            parts: dict[str, Any] = {"mean": alone, "between": None, "drift": None, "once": []}
        else:
            low, high = h.between_interval
            drift = None
            if h.drift is not None:
                unit = f"{self.unit}/{time_unit}" if time_unit else self.unit
                drift = {**_number(h.drift), "unit": unit, "about": h.centre, "drifts": self.drifts}
            parts = {
                "mean": {**_number(h.mean), "for_good": self.for_good},
                "between": {"value": h.between, "interval": [low, high]},
                "drift": drift,
                "once": [
                    {
                        "row": self.rows[o.index],
                        "value": o.value,
                        "expected": o.expected,
                        "std": o.std,
                        "p": o.p,
                        "happened_once": self.rows[o.index] in self.apart,
                    }
                    for o in h.once
                ],
            }
        head = {"quantity": self.name, "joint": self.joint, "unit": self.unit}
        return {**head, "recordings": len(self.rows), **parts}


def _number(one: Number) -> dict[str, Any]:
    return {"value": one.value, "std": one.std, "interval": list(one.interval), "p": one.p}


@dataclasses.dataclass(frozen=True)
class Seen:
    """A finding of an arm, over its recordings; those from when nothing was wrong do not count."""

    effect: str
    joints: tuple[int, ...]
    """1-based."""
    rows: tuple[int, ...]
    of: int
    """How many recordings there are."""
    confidence: float
    """Mean of those that have it."""
    event: bool
    """It acts in an interval."""

    def to_json(self) -> dict[str, Any]:
        return {
            "effect": self.effect,
            "joints": list(self.joints),
            "seen_in": len(self.rows),
            "of": self.of,
            "rows": list(self.rows),
            "confidence": self.confidence,
            "in_an_interval": self.event,
        }


@dataclasses.dataclass(frozen=True)
class ArmHistory:
    """All that a fleet knows of one arm."""

    name: str
    recorded: tuple[Recorded, ...]
    """In the order of time, where that is known."""
    seen: tuple[Seen, ...]
    """What is in most recordings first."""
    quantities: tuple[Quantity, ...]

    @property
    def judged(self) -> list[Recorded]:
        """Diagnosed, and not from when nothing was wrong."""
        return [one for one in self.recorded if one.told and not one.row.reference]

    @property
    def off_by_noise(self) -> float | None:
        """Torque of all findings over the noise, where that is most: the median over the recordings."""
        off = [one.document["off_by_noise"] for one in self.judged]
        return float(np.median(off)) if off else None

    @property
    def verdicts(self) -> Counter[str]:
        return Counter(one.document["verdict"] for one in self.judged)

    def to_json(self, time_unit: str) -> dict[str, Any]:
        statuses = Counter(one.document["status"] for one in self.recorded)
        model = self.recorded[0].row.model
        return {
            "arm": self.name,
            "model": None if model is None else model.name,
            "recordings": len(self.recorded),
            "references": sum(one.row.reference for one in self.recorded),
            "statuses": dict(sorted(statuses.items())),
            "verdicts": dict(sorted(self.verdicts.items())),
            "off_by_noise": self.off_by_noise,
            "findings": [one.to_json() for one in self.seen],
            "quantities": [one.to_json(time_unit) for one in self.quantities],
        }


def arms(table: Table, told: Mapping[int, Mapping[str, Any]]) -> tuple[ArmHistory, ...]:
    """The arms of a table, the one that its model is furthest off first."""
    groups: dict[str, list[Recorded]] = defaultdict(list)
    for row in table.rows:
        groups[row.arm].append(Recorded(row, told[row.number]))
    found = [_arm(name, group) for name, group in groups.items()]
    return tuple(sorted(_claimed(found), key=_badness, reverse=True))


def _badness(arm: ArmHistory) -> tuple[float, int]:
    """What the worst arm has most of; of arms that nothing was found in, what drifted or happened."""
    off = -1.0 if arm.off_by_noise is None else arm.off_by_noise
    return off, sum(q.drifts + len(q.apart) for q in arm.quantities)


def _arm(name: str, group: Sequence[Recorded]) -> ArmHistory:
    timed = all(one.row.when is not None for one in group)
    ordered = tuple(sorted(group, key=lambda one: (one.row.when or 0.0) if timed else 0.0))
    series: dict[tuple, list[tuple[Row, float, float]]] = defaultdict(list)
    for one in ordered:
        for e in one.document.get("estimates", ()):
            if e["quantity"].partition(".")[0] in LEVELS and "." in e["quantity"]:
                continue  # the same law's level is told of every recording
            series[e["quantity"], e["joint"], e["unit"]].append((one.row, e["value"], e["std"]))
    return ArmHistory(name, ordered, _seen(ordered), tuple(_quantity(key, series[key]) for key in series))


def _quantity(key: tuple[str, int | None, str], points: Sequence[tuple[Row, float, float]]) -> Quantity:
    rows, value, std = zip(*points, strict=True)
    y, s = np.array(value, float), np.array(std, float)
    when = [row.when for row in rows]
    time = None if None in when else np.array(when, float)
    told = history(y, s, time) if len(y) > 1 else None
    return Quantity(*key, tuple(row.number for row in rows), y, s, time, told)


def _claimed(found: Sequence[ArmHistory]) -> list[ArmHistory]:
    """With what can be claimed: of each kind of claims in a fleet, one in twenty may be by chance."""
    every = [(a, k) for a, arm in enumerate(found) for k in range(len(arm.quantities))]
    of = lambda place: found[place[0]].quantities[place[1]]
    levels = [p for p in every if of(p).history is not None and of(p).name in LEVELS]
    drifts = [p for p in every if (h := of(p).history) is not None and h.drift is not None]
    once = [p for p in every if (h := of(p).history) is not None and h.p_once is not None]
    good = _said(levels, [of(p).history.mean.p for p in levels])  # pyright: ignore
    drifting = _said(drifts, [of(p).history.drift.p for p in drifts])  # pyright: ignore
    happened = _said(once, [of(p).history.p_once for p in once])  # pyright: ignore
    out = []
    for a, arm in enumerate(found):
        quantities = []
        for k, q in enumerate(arm.quantities):
            apart = q.history.once if q.history is not None and (a, k) in happened else ()
            rows = tuple(q.rows[o.index] for o in apart if o.p <= APART)
            quantities.append(
                dataclasses.replace(q, for_good=(a, k) in good, drifts=(a, k) in drifting, apart=rows)
            )
        out.append(dataclasses.replace(arm, quantities=tuple(quantities)))
    return out


def _said(places: Sequence[tuple[int, int]], p: Sequence[float]) -> set[tuple[int, int]]:
    return {place for place, said in zip(places, discoveries(np.array(p)), strict=True) if said}


def _seen(recorded: Sequence[Recorded]) -> tuple[Seen, ...]:
    judged = [one for one in recorded if one.told and not one.row.reference]
    places: dict[tuple, list[tuple[int, float, bool]]] = defaultdict(list)
    for one in judged:
        for key, finding in {(f["effect"], tuple(f["joints"])): f for f in one.findings}.items():
            places[key].append((one.row.number, finding["confidence"], finding["intervals"] is not None))
    seen = [
        Seen(
            effect,
            joints,
            tuple(number for number, _, _ in many),
            len(judged),
            float(np.mean([c for _, c, _ in many])),
            all(event for _, _, event in many),
        )
        for (effect, joints), many in places.items()
    ]
    return tuple(sorted(seen, key=lambda s: (-len(s.rows) * s.confidence, s.effect, s.joints)))
