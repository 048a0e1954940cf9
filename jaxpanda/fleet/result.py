"""`Fleet`: what became of every recording, and what the recordings of each arm say together."""

import dataclasses
import functools
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ..errors import MissingExtraError
from ..files import Kind, output_folder, write_bytes, write_json, write_text
from ..report import Section, number
from ..report import Table as ReportTable
from . import page
from .arms import ArmHistory, Quantity, arms
from .table import Table
from .work import DIAGNOSED

FILE, HTML = "fleet.json", "fleet.html"
RECORDINGS, FINDINGS, ESTIMATES = "recordings.parquet", "findings.parquet", "estimates.parquet"
KIND = Kind("fleet", (FILE, HTML, RECORDINGS, FINDINGS, ESTIMATES))
_SHOWN = 20
"""Arms, recordings and sentences that a terminal is told of."""


@dataclasses.dataclass(frozen=True)
class Fleet:
    """A table of recordings, diagnosed."""

    table: Table
    told: Mapping[int, Mapping[str, Any]]
    """The document of each row's shard, by the row's number."""
    made: int
    """How many of them were made now; the others were there."""
    seconds: float
    """That took so long."""
    knowledge: str

    @functools.cached_property
    def arms(self) -> tuple[ArmHistory, ...]:
        """The one whose model is furthest off first."""
        return arms(self.table, self.told)

    @property
    def time_unit(self) -> str:
        """That drifts are told by."""
        return "day" if self.table.dated or self.table.time == "day" else ""

    @property
    def untold(self) -> list[tuple[int, str, str, str]]:
        """Number, recording, status and sentence of every row that was not diagnosed."""
        return [
            (row.number, row.recording, document["status"], document["message"])
            for row in self.table.rows
            if (document := self.told[row.number])["status"] != DIAGNOSED
        ]

    def to_json(self) -> dict[str, Any]:
        """fleet.json."""
        statuses = Counter(self.told[row.number]["status"] for row in self.table.rows)
        return {
            "schema": "jaxpanda.fleet/1",
            "table": self.table.path.name,
            "recordings": len(self.table.rows),
            "statuses": dict(sorted(statuses.items())),
            "knowledge": self.knowledge,
            "time": {"column": self.table.time or None, "unit": self.time_unit or None},
            "arms": [arm.to_json(self.time_unit) for arm in self.arms],
            "not_diagnosed": [
                {"row": n, "recording": name, "status": status, "message": message}
                for n, name, status, message in self.untold
            ],
            "claims": [{"arm": arm, "sentence": sentence} for arm, sentence in self.claims()],
        }

    def claims(self) -> list[tuple[str, str]]:
        """Arm and sentence of all that can be claimed."""
        return [(arm.name, said) for arm in self.arms for q in arm.quantities for said in self.sentences(q)]

    def sentences(self, q: Quantity) -> list[str]:
        """What can be claimed of a quantity."""
        h, out = q.history, []
        if h is None:
            return out
        if q.for_good:
            differ = f"by {number(h.between, 2)} beside" if h.between else "no more than by"
            out.append(
                f"{q.title}: {_pm(h.mean.value, h.mean.std)} {q.unit} beyond the model, for good"
                f" ({h.count} recordings, which differ {differ} their deviations)"
            )
        if q.drifts and h.drift is not None:
            per = f"{q.unit} a {self.time_unit}" if self.time_unit else f"{q.unit} a unit of time"
            out.append(f"{q.title}: drifts by {_pm(h.drift.value, h.drift.std)} {per}")
        names = {row.number: row.recording for row in self.table.rows}
        out += [
            f"{q.title}: once, in {names[q.rows[o.index]]}, {number(o.value, 3)} where the others foresee"
            f" {number(o.expected, 3)} ± {number(o.std, 2)} {q.unit}"
            for o in h.once
            if q.rows[o.index] in q.apart
        ]
        return out

    def sections(self) -> Sequence[Section]:
        """For the terminal."""
        statuses = Counter(document["status"] for document in self.told.values())
        counts = ", ".join(f"{count} {status}" for status, count in sorted(statuses.items()))
        pace = f" {self.made / self.seconds * 60:.3g} a minute" if self.made and self.seconds > 0 else ""
        kept = sum(bool(document["key"]) for document in self.told.values()) - self.made
        sentences = [f"{len(self.table.rows)} recordings of {len(self.arms)} arms: {counts}."]
        sentences.append(
            f"Made now: {self.made} in {self.seconds:.0f} s,{pace or ' nothing'}; already there: {kept}."
        )
        rows = [
            [
                arm.name,
                str(len(arm.recorded)),
                number(arm.off_by_noise, 3),
                ", ".join(
                    f"{count} {verdict.replace('_', ' ')}" for verdict, count in arm.verdicts.most_common()
                ),
                "; ".join(
                    f"{s.effect.replace('_', ' ')} {','.join(map(str, s.joints))} ({len(s.rows)}/{s.of})"
                    for s in arm.seen[:3]
                ),
            ]
            for arm in self.arms[:_SHOWN]
        ]
        glance = ReportTable(
            ["arm", "recordings", "× noise", "verdicts", "findings (in how many recordings)"],
            rows,
            "Arms, the worst first: by the torque that findings explain, over the noise"
            + _more(len(self.arms)),
        )
        out = [Section("Fleet", sentences, [glance])]
        if claims := self.claims():
            lines = [f"{arm}: {sentence}." for arm, sentence in claims[:_SHOWN]]
            out.append(Section("For good, drifting, once" + _more(len(claims)), lines))
        if self.untold:
            lines = [f"row {n}: {status}: {message}" for n, _, status, message in self.untold[:_SHOWN]]
            out.append(Section("Not diagnosed" + _more(len(self.untold)), lines))
        return out

    def save(self, folder: str | Path) -> Path:
        """Write fleet.json, fleet.html and the tables, as one set.

        Raises:
            MissingExtraError: pyarrow is not installed.
            InputError: a file of such a name stands there that no earlier fleet left; nothing is written.
        """
        require_parquet()
        with output_folder(folder, KIND) as scratch:
            write_bytes(scratch / RECORDINGS, self.recordings())
            write_bytes(scratch / FINDINGS, self.findings())
            write_bytes(scratch / ESTIMATES, self.estimates())
            write_text(scratch / HTML, page.html(self))
            write_json(scratch / FILE, self.to_json())
        return Path(folder) / FILE

    def recordings(self) -> bytes:
        """recordings.parquet: a row a recording."""
        rows = []
        for row in self.table.rows:
            document = self.told[row.number]
            rows.append(
                {
                    **self._of(row.number),
                    "model": None if row.model is None else str(row.model),
                    "status": document["status"],
                    "message": document.get("message"),
                    "verdict": document.get("verdict"),
                    "findings": len(document.get("findings", ())),
                    "off_by_noise": document.get("off_by_noise"),
                    "key": document["key"],
                    **row.extra,
                }
            )
        a = _arrow()[0]
        more = [("model", a.string()), ("status", a.string()), ("message", a.string()), ("verdict", a.string()),
                ("findings", a.int64()), ("off_by_noise", a.float64()), ("key", a.string()),
                *((name, a.string()) for name in self.table.columns)]  # fmt: skip
        return _parquet(rows, more)

    def findings(self) -> bytes:
        """findings.parquet: a row a finding."""
        names = ("effect", "family", "kind", "joints", "intervals", "confidence", "alternatives", "equation",
                 "parameters", "rms_torque", "evidence_nats", "summary")  # fmt: skip
        rows = [
            {**self._of(row.number), **{name: finding[name] for name in names}}
            for row in self.table.rows
            for finding in self.told[row.number].get("findings", ())
        ]
        a = _arrow()[0]
        parameter = [("name", a.string()), ("joint", a.int64()), ("value", a.float64()), ("std", a.float64()),
                     ("unit", a.string())]  # fmt: skip
        kinds = {
            "joints": a.list_(a.int64()),
            "intervals": a.list_(a.list_(a.float64())),
            "confidence": a.float64(),
            "alternatives": a.list_(a.struct([("effect", a.string()), ("confidence", a.float64())])),
            "parameters": a.list_(a.struct(parameter)),
            "rms_torque": a.list_(a.float64()),
            "evidence_nats": a.float64(),
        }
        return _parquet(rows, [(name, kinds.get(name, a.string())) for name in names])

    def estimates(self) -> bytes:
        """estimates.parquet: a row a number of a recording."""
        rows = [
            {**self._of(row.number), **estimate}
            for row in self.table.rows
            for estimate in self.told[row.number].get("estimates", ())
        ]
        a = _arrow()[0]
        more = [("quantity", a.string()), ("joint", a.int64()), ("value", a.float64()), ("std", a.float64()),
                ("unit", a.string())]  # fmt: skip
        return _parquet(rows, more)

    def _of(self, number: int) -> dict[str, Any]:
        """Columns that every table has."""
        row = self.table.rows[number - 1]
        own = ("recording", "arm", "when", "reference")
        return {"row": number, **{name: getattr(row, name) for name in own}}


def require_parquet() -> None:
    """Refuse before the work is done what could not be written after it."""
    _arrow()


def _arrow() -> tuple[Any, Any]:
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        raise MissingExtraError("a fleet's tables (Parquet)", "fleet") from None
    return pyarrow, pyarrow.parquet


def _parquet(rows: Sequence[Mapping[str, Any]], more: Sequence[tuple[str, Any]]) -> bytes:
    arrow, parquet = _arrow()
    kinds = [("row", arrow.int64()), ("recording", arrow.string()), ("arm", arrow.string()),
             ("when", arrow.float64()), ("reference", arrow.bool_()), *more]  # fmt: skip
    out = arrow.BufferOutputStream()
    parquet.write_table(
        arrow.Table.from_pylist(list(rows), schema=arrow.schema(kinds)), out, compression="zstd"
    )
    return out.getvalue().to_pybytes()


def _pm(value: float, std: float) -> str:
    return f"{value:+.3g} ± {number(std, 2)}"


def _more(count: int) -> str:
    return f" ({_SHOWN} of {count}; fleet.html has all)" if count > _SHOWN else ""
