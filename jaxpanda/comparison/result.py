"""`Comparison`: where two results differ beyond their uncertainty."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..files import Kind, output_folder, write_json
from ..report import Figure, Section, Table, number, to_html

SCHEMA = "jaxpanda.comparison/1"
FILE, PAGE = "comparison.json", "comparison.html"
KIND = Kind("compare", (FILE, PAGE))


@dataclasses.dataclass(frozen=True)
class Parameter:
    """One number that both tell."""

    name: str
    joint: int | None
    """From 1; None for a base parameter."""
    unit: str
    a: float
    b: float
    std_a: float
    std_b: float
    t: float
    """Difference over its standard deviation."""
    p: float
    p_corrected: float
    """For how many parameters there are."""
    differs: bool


@dataclasses.dataclass(frozen=True)
class Explanation:
    """One change that takes much of the difference."""

    what: str
    """`friction`, `payload`, `link` or `torque_scale`."""
    joint: int | None
    gained: float
    """By how much chi-square falls."""
    p: float
    """How probable that is where nothing changed, corrected for how many laws were tried."""
    parameters: tuple[Mapping[str, Any], ...]

    def sentence(self) -> str:
        told = [p for p in self.parameters if p["std"] > 0 and abs(p["change"]) > 2 * p["std"]]
        sizes = ", ".join(f"{p['name']} by {p['change']:+.3g} ± {p['std']:.2g}" for p in told[:4])
        where = {
            "friction": f"the friction of joint {self.joint} changed",
            "payload": "the last link carries another body (a payload or a tool)",
            "link": f"link {self.joint} differs",
            "torque_scale": "all torque has another scale",
        }[self.what]
        sizes = f": {sizes}" if sizes else ""
        return f"{where[0].upper()}{where[1:]}{sizes} (chi-square falls by {self.gained:.0f})."


@dataclasses.dataclass(frozen=True)
class Comparison:
    """Two results of one kind."""

    kind: str
    a: str
    b: str
    verdict: str
    """`agree` or `differ`."""
    chi_squared: float
    count: int
    """Of parameters that both tell."""
    p: float
    """How probable a chi-square as large is where nothing differs."""
    parameters: tuple[Parameter, ...]
    explanations: tuple[Explanation, ...]
    findings: tuple[Mapping[str, Any], ...]
    """Of two diagnoses: what is in both, or in one only."""
    settings: tuple[Mapping[str, Any], ...]
    """In which the runs differ."""
    recordings: tuple[tuple[str, ...], tuple[str, ...]]
    joints: tuple[str, ...]
    torque: Mapping[str, Any]
    """On a common motion."""
    notes: tuple[str, ...] = ()

    def sections(self, *, page: bool = False) -> Sequence[Section]:
        """As a terminal and the page show it."""
        return sections(self, page=page)

    def to_json(self) -> dict[str, Any]:
        """As `comparison.json` holds it."""
        return {
            "schema": SCHEMA,
            "kind": self.kind,
            "a": self.a,
            "b": self.b,
            "verdict": self.verdict,
            "chi_squared": self.chi_squared,
            "count": self.count,
            "p": self.p,
            "parameters": [dataclasses.asdict(one) for one in self.parameters],
            "explanations": [
                {**dataclasses.asdict(one), "summary": one.sentence()} for one in self.explanations
            ],
            "findings": [dict(one) for one in self.findings],
            "settings": [dict(one) for one in self.settings],
            "recordings": {"a": list(self.recordings[0]), "b": list(self.recordings[1])},
            "joints": list(self.joints),
            "torque": dict(self.torque),
            "notes": list(self.notes),
        }

    def save(self, folder: str | Path) -> Path:
        """Write `comparison.json` and `comparison.html`; both or neither."""
        with output_folder(folder, KIND) as scratch:
            write_json(scratch / FILE, self.to_json())
            to_html("jaxpanda: comparison", self.sections(page=True), scratch / PAGE)
        return Path(folder) / FILE


def sections(found: Comparison, *, page: bool = False) -> Sequence[Section]:
    """The verdict, what explains a difference, and every number: all on a page, what differs on a terminal."""
    agree = found.verdict == "agree"
    sentences = [
        f"The two {found.kind} results agree within their uncertainty."
        if agree
        else f"The two {found.kind} results differ beyond their uncertainty.",
        f"A is {found.a}, B is {found.b}.",
        f"All {found.count} parameters that both tell: chi-square {found.chi_squared:.1f}, "
        f"probability {found.p:.2g} where nothing differs.",
        *(one.sentence() for one in found.explanations),
    ]
    if not agree and not found.explanations and any(one.differs for one in found.parameters):
        sentences.append("No single change of friction, payload, link or torque scale explains it.")
    for one in found.findings:
        if one["in"] != "both":
            joints = ", ".join(map(str, one["joints"]))
            sentences.append(
                f"{one['effect'].replace('_', ' ')} at joint {joints} was found in {one['in'].upper()} only."
            )
    sentences += [f"Setting {one['setting']}: {one['a']} in A, {one['b']} in B." for one in found.settings]
    shown = sorted(found.parameters, key=lambda one: one.p_corrected)
    rows = [
        [
            one.name if one.joint is None else f"{one.name} of joint {one.joint}",
            f"{one.a:.5g} ± {one.std_a:.2g}",
            f"{one.b:.5g} ± {one.std_b:.2g}",
            f"{one.t:+.1f}",
            f"{one.p_corrected:.2g}",
            "differs" if one.differs else "",
        ]
        for one in (shown if page else shown[:12])
    ]
    caption = "Parameters, those that differ most first" + (
        "" if page or len(shown) <= 12 else " (12 of them)"
    )
    tables = [Table(["parameter", "A", "B", "difference / std", "probability, corrected", ""], rows, caption)]
    torque = found.torque
    columns = {
        "difference": torque["rms_difference"],
        "expected": torque["expected_std"],
        "noise": torque["noise"],
    }
    columns = {name: values for name, values in columns.items() if values is not None}
    tables.append(
        Table(
            ["joint", *columns],
            [
                [joint, *(number(values[j], 3) for values in columns.values())]
                for j, joint in enumerate(found.joints)
            ],
            f"Torque on {torque['motion']}: rms difference, standard deviation expected of it, noise "
            f"[{torque['unit']}]",
        )
    )
    matched = [(one, p) for one in found.findings for p in one["parameters"]]
    if matched:
        tables.append(
            Table(
                ["finding", "parameter", "A", "B", "difference / std", ""],
                [
                    [
                        one["effect"].replace("_", " "),
                        f"{p['name']} of joint {p['joint']}",
                        f"{p['a']:.4g}",
                        f"{p['b']:.4g}",
                        f"{p['t']:+.1f}",
                        "differs" if p["differs"] else "",
                    ]
                    for one, p in matched
                ],
                "Findings that both have",
            )
        )
    figures = [
        Figure(lambda canvas: _draw(found, canvas), "Differences over their standard deviations", (9.0, 3.6))
    ]
    return [
        Section(
            "Comparison",
            [*sentences, *found.notes],
            tables,
            figures if page else (),
            tone="good" if agree else "bad",
            figures_first=True,
        )
    ]


def _draw(found: Comparison, canvas: Any) -> None:
    """Every parameter's difference in deviations, base parameters and friction apart."""
    axes = canvas.add_subplot()
    t = np.array([one.t for one in found.parameters])
    differs = np.array([one.differs for one in found.parameters])
    place = np.arange(len(t))
    axes.axhspan(-2, 2, color="0.9", label="two standard deviations")
    axes.bar(place[~differs], t[~differs], color="#146eb4")
    axes.bar(place[differs], t[differs], color="#be3c1e", label="differs")
    names = [one.name if one.joint is None else f"{one.name} {one.joint}" for one in found.parameters]
    short = [name if len(name) <= 14 else f"{name[:12]}…" for name in names]
    axes.set_xticks(place, short, rotation=90, fontsize=5)
    axes.set_ylabel("(B - A) / std")
    axes.legend(loc="upper right")
