"""`Identification`: what torque or M(q), g(q) tell about an arm, and how sure that is."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from ..arms.arm import KNOWN, Arm
from ..arms.model_file import WHOLE, Part
from ..errors import InputError
from ..files import Kind, finite, output_folder, settle, write_json
from ..friction import Friction
from ..inputs import digest, read_json
from ..parameters import coefficient_matrix, expression, linear_forms
from .condensed import FILE as EVIDENCE_FILE
from .condensed import Evidence

SCHEMA = "jaxpanda.identification/1"
FILE = "identification.json"
KIND = Kind("identify", (FILE,))
METHODS = ("mass_gravity", "trajectory", "one_step")
RELIABLE = 0.30
"""Largest standard deviation, as a share of its value, of a coefficient that counts (Gaz et al. 2019)."""


@dataclasses.dataclass(frozen=True)
class Identification:
    r"""Base parameters $\beta = K\phi$ and friction, with their uncertainty and what they leave unexplained.

    Of a bare table of coefficients only `projection`, `beta` and what else the table says is known; the rest
    is None or empty.
    """

    method: str | None
    """One of `METHODS`; None for a bare table of coefficients."""
    projection: Float[np.ndarray, "base standard"]
    """K, columns in the order of `jaxpanda.parameters.standard_names`."""
    beta: Float[np.ndarray, " base"]
    """[kg m², kg m or kg, as the expression says]"""
    reliable: Bool[np.ndarray, " base"]
    """Standard deviation within `RELIABLE` of the value; the others, the paper discards."""
    expressions: tuple[str, ...]
    std: Float[np.ndarray, " base"] | None = None
    """Standard deviation, robust to autocorrelated residuals where these come from a motion. Of the
    unconstrained estimate: feasibility and a prior (`one_step`) narrow it. Infinite for what the data do not
    tell."""
    classical_std: Float[np.ndarray, " base"] | None = None
    """The textbook's, which takes all samples as independent."""
    covariance: Float[np.ndarray, "base base"] | None = None
    """Of which `std` is the diagonal's root."""
    classical_covariance: Float[np.ndarray, "base base"] | None = None
    """Of which `classical_std` is. Its inverse says how much torque a change of the coefficients moves."""
    joint_covariance: Float[np.ndarray, "unknowns unknowns"] | None = None
    """Of the base parameters and, after them, of friction, all of joint 1 first: robust, and of full rank
    (`statistics.shrunk`), to draw from and to compare by. None where no motion was identified."""
    friction: Friction | None = None
    """Beyond what the arm's model already holds."""
    standard: Float[np.ndarray, "dof 10"] | None = None
    """Feasible parameters of the links, where the method finds them (`one_step`)."""
    rank: int | None = None
    condition_number: float | None = None
    """Of the stacked regressor in base parameters and friction."""
    relative_error_percent: float | None = None
    r"""$100\,\lVert e\rVert / \lVert y\rVert$, all joints together."""
    rmse: Float[np.ndarray, " dof"] | None = None
    """What is left at each joint [N m]."""
    cross_validated_rmse: Float[np.ndarray, " dof"] | None = None
    """The same on samples that the fit has not seen, nor any repeat of them."""
    cross_validated_relative_error_percent: float | None = None
    noise: Float[np.ndarray, " dof"] | None = None
    """Noise of the filtered torque [N m] from a motion that repeats itself; no model can explain less."""
    known: Mapping[str, Float[np.ndarray, " dof"]] = dataclasses.field(default_factory=dict)
    """What the arm's model held beyond rigid links (`jaxpanda.arms.arm.KNOWN`) and was not fitted."""
    evidence: Evidence | None = None
    """The recordings, condensed, where the method is one of motion and torque."""
    arm: str = ""
    model: Arm | None = None
    """The arm as it was before, with its nominal parameters."""
    model_file: str = ""
    """The MJCF that it was read from, where that is known."""
    model_part: Part = WHOLE
    """Which arm of that file it is."""
    link_names: tuple[str, ...] = ()
    joint_names: tuple[str, ...] = ()
    recordings: tuple[str, ...] = ()
    settings: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """What was asked for, and numbers of interest to one method only."""
    repairs: Mapping[str, int] = dataclasses.field(default_factory=dict)
    """What was dropped, filled or moved in the data, and how often."""
    notes: tuple[str, ...] = ()
    """What the user should know before relying on this."""

    @property
    def dof(self) -> int:
        return self.projection.shape[1] // 10

    @property
    def terms(self) -> list[dict[str, float]]:
        """Each coefficient as a linear form: standard parameter to number."""
        return linear_forms(self.projection)

    @property
    def coefficients(self) -> list[dict[str, Any]]:
        """The table of coefficients, as files hold it."""
        rows = []
        for i, terms in enumerate(self.terms):
            row: dict[str, Any] = {
                "expression": self.expressions[i],
                "terms": terms,
                "value": float(self.beta[i]),
            }
            for name, values in (("std", self.std), ("classical_std", self.classical_std)):
                if values is not None:
                    row[name] = finite(values[i])
            rows.append({**row, "reliable": bool(self.reliable[i])})
        return rows

    def to_json(self) -> dict[str, Any]:
        """As `identification.json` holds it."""
        return {
            "schema": SCHEMA,
            "method": self.method,
            "arm": self.arm,
            "model": None if self.model is None else self.model.to_json(),
            "model_file": self.model_file or None,
            "model_part": self.model_part.to_json(),
            "rank": self.rank,
            "condition_number": self.condition_number,
            "relative_error_percent": self.relative_error_percent,
            "coefficients": self.coefficients,
            "friction": [] if self.friction is None else self.friction.to_json(),
            "rmse": _listed(self.rmse),
            "cross_validated_rmse": _listed(self.cross_validated_rmse),
            "cross_validated_relative_error_percent": self.cross_validated_relative_error_percent,
            "noise": _listed(self.noise),
            "known": {name: values.tolist() for name, values in self.known.items()},
            "links": list(self.link_names),
            "joints": list(self.joint_names),
            "recordings": list(self.recordings),
            "settings": dict(self.settings),
            "repairs": dict(self.repairs),
            "notes": list(self.notes),
            "standard": None if self.standard is None else self.standard.tolist(),
            "covariance": None if self.covariance is None else self.covariance.tolist(),
            "classical_covariance": None
            if self.classical_covariance is None
            else self.classical_covariance.tolist(),
            "joint_covariance": None if self.joint_covariance is None else self.joint_covariance.tolist(),
        }

    def save(self, folder: str | Path) -> Path:
        """Write `identification.json`, and the evidence as `identification.npz`; all or nothing."""
        document = self.to_json()
        with output_folder(folder, KIND) as scratch:
            if self.evidence is not None:
                self.evidence.save(scratch / EVIDENCE_FILE)
                document["evidence"] = {"file": EVIDENCE_FILE, "sha256": digest(scratch / EVIDENCE_FILE)}
            write_json(scratch / FILE, document)
        return Path(folder) / FILE

    @classmethod
    def load(cls, path: str | Path) -> "Identification":
        """Read identification.json, a folder that holds it, or a bare table of coefficients.

        The evidence comes along where it still stands beside the file.

        Raises:
            InputError: naming the file and the field of the first thing that is wrong.
        """
        path = Path(path)
        file = path / FILE if path.is_dir() else path
        settle(file.parent)
        document = read_json(file)
        found = cls.from_json(document, where=str(path))
        wanted = _Reader(document, str(path)).table("evidence")
        beside = file.with_name(EVIDENCE_FILE)
        if not wanted or not beside.is_file() or digest(beside) != wanted.get("sha256"):
            return found
        return dataclasses.replace(found, evidence=Evidence.load(beside))

    @classmethod
    def from_json(cls, document: Any, *, where: str = "identification") -> "Identification":
        """The inverse of `to_json`; a table needs only `coefficients`, each with `terms` and `value`.

        Raises:
            InputError: naming the field of the first thing that is wrong.
        """
        read = _Reader(document, where)
        if (schema := read.get("schema", SCHEMA)) != SCHEMA:
            raise InputError(f"{where}: schema is {schema!r}; {SCHEMA!r} is expected")
        method = read.get("method", None)
        if method not in (None, *METHODS):
            raise InputError(f"{where}: method is {method!r}; one of {', '.join(METHODS)} is expected")
        rows = read.get("coefficients", None)
        if not isinstance(rows, list) or not rows:
            raise InputError(f"{where}: needs 'coefficients', a list of entries with 'terms' and 'value'")
        links, joints = read.names("links"), read.names("joints")
        for i, row in enumerate(rows):
            if not isinstance(row, Mapping):
                raise InputError(f"{where}: coefficients[{i}] is no object with 'terms' and 'value'")
        terms = [row.get("terms", {}) for row in rows]
        projection = coefficient_matrix(terms, len(links) or None, where=f"{where}: coefficients")
        n, dof = len(rows), projection.shape[1] // 10
        std = _column(rows, "std", where)
        friction = read.get("friction", None)
        if friction is not None and not isinstance(friction, list):
            raise InputError(f"{where}: friction is no list of one entry a joint")
        rubs = Friction.from_json(friction, where=f"{where}: friction") if friction else None
        own = sum(len(values) for values in rubs.parameters.values()) if rubs else 0
        return cls(
            method=method,
            projection=projection,
            beta=_required(_column(rows, "value", where), where),
            reliable=np.array([_flag(row, i, where) for i, row in enumerate(rows)]),
            expressions=tuple(
                text if isinstance(text := row.get("expression"), str) else expression(form)
                for row, form in zip(rows, terms, strict=True)
            ),
            std=std,
            classical_std=_column(rows, "classical_std", where),
            covariance=read.covariance("covariance", n),
            classical_covariance=read.covariance("classical_covariance", n),
            joint_covariance=read.covariance("joint_covariance", n + own),
            friction=rubs,
            standard=read.array("standard", (dof, 10)),
            rank=None if (rank := read.number("rank")) is None else int(rank),
            condition_number=read.number("condition_number"),
            relative_error_percent=read.number("relative_error_percent"),
            rmse=read.array("rmse", (dof,)),
            cross_validated_rmse=read.array("cross_validated_rmse", (dof,)),
            cross_validated_relative_error_percent=read.number("cross_validated_relative_error_percent"),
            noise=read.array("noise", (dof,)),
            known=known_physics(read.table("known"), dof, where),
            arm=str(read.get("arm", "")),
            model=_model(read.table("model"), dof, where),
            model_file=str(read.get("model_file", "")),
            model_part=Part.from_json(read.get("model_part", None)),
            link_names=links,
            joint_names=joints,
            recordings=read.names("recordings"),
            settings=read.table("settings"),
            repairs=read.table("repairs"),
            notes=read.names("notes"),
        )


def known_physics(table: Mapping[str, Any], dof: int, where: str) -> dict[str, Float[np.ndarray, " dof"]]:
    """The field `known` of a file: one number a joint for each name of `jaxpanda.arms.arm.KNOWN`, or nothing."""
    reader = _Reader(table, f"{where}: known")
    if table and set(table) != set(KNOWN):
        raise InputError(f"{where}: known holds {', '.join(table)}; {', '.join(KNOWN)} are expected")
    return {name: values for name in table if (values := reader.array(name, (dof,))) is not None}


def of_model(arm: Arm) -> dict[str, Float[np.ndarray, " dof"]]:
    """What a model holds beyond rigid links, by name."""
    return {name: np.asarray(getattr(arm, name)) for name in KNOWN}


def check_folds(folds: int) -> None:
    """Refuse a cross-validation that cannot be."""
    if folds < 0 or folds == 1:
        raise InputError(f"folds: {folds} cannot be; at least 2, or 0 for no cross-validation")


def _model(document: Mapping[str, Any], dof: int, where: str) -> Arm | None:
    if not document:
        return None
    try:
        arm = Arm.from_json(document)
        shapes = {name: np.asarray(getattr(arm, name)).shape for name in ("standard", *KNOWN)}
        if shapes != {name: (dof, 10) if name == "standard" else (dof,) for name in shapes}:
            raise ValueError(f"it is not of {dof} joints")
    except (LookupError, TypeError, ValueError) as error:
        raise InputError(f"{where}: model is not as `identify` writes it ({error}); identify again") from None
    return arm


def _listed(values: np.ndarray | None) -> list[float]:
    return [] if values is None else [float(value) for value in values]


class _Reader:
    """Fields of a JSON document, each with a sentence for what is wrong with it."""

    def __init__(self, document: Any, where: str):
        if not isinstance(document, Mapping):
            raise InputError(
                f"{where}: holds no JSON object; identification.json or a table of coefficients is expected"
            )
        self.document, self.where = document, where

    def get(self, field: str, default: Any) -> Any:
        value = self.document.get(field)
        return default if value is None else value

    def number(self, field: str) -> float | None:
        value = self.get(field, None)
        if value is None:
            return None
        if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
            raise InputError(f"{self.where}: {field} is {value!r}, where a finite number is needed")
        return float(value)

    def array(self, field: str, shape: tuple[int, ...]) -> np.ndarray | None:
        value = self.get(field, None)
        if value is None or value == []:
            return None
        try:
            array = np.array(value, dtype=float)
        except (TypeError, ValueError):
            array = np.empty(0)
        if array.shape != shape or not np.all(np.isfinite(array)):
            size = " x ".join(str(n) for n in shape)
            raise InputError(f"{self.where}: {field} must hold {size} finite numbers")
        return array

    def covariance(self, field: str, n: int) -> np.ndarray | None:
        found = self.array(field, (n, n))
        if found is not None and np.any(np.diag(found) < 0):
            raise InputError(f"{self.where}: {field} has a negative variance; identify again")
        return found

    def names(self, field: str) -> tuple[str, ...]:
        value = self.get(field, [])
        if not isinstance(value, list) or not all(isinstance(name, str) for name in value):
            raise InputError(f"{self.where}: {field} must be a list of texts")
        return tuple(value)

    def table(self, field: str) -> Mapping[str, Any]:
        value = self.get(field, {})
        if not isinstance(value, Mapping):
            raise InputError(f"{self.where}: {field} must be an object")
        return dict(value)


def _column(rows: Sequence[Mapping[str, Any]], field: str, where: str) -> np.ndarray | None:
    """A number of every coefficient; None if no row has it, infinite (an unknown deviation) where null."""
    if not any(field in row for row in rows):
        return None
    values = np.empty(len(rows))
    for i, row in enumerate(rows):
        value = row.get(field)
        if value is None and field != "value":
            value = np.inf
        elif isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
            raise InputError(
                f"{where}: coefficients[{i}].{field} is {value!r}, where a finite number is needed"
            )
        values[i] = value
    return values


def _required(values: np.ndarray | None, where: str) -> np.ndarray:
    if values is None:
        raise InputError(f"{where}: coefficients have no 'value'")
    return values


def _flag(row: Mapping[str, Any], i: int, where: str) -> bool:
    value = row.get("reliable", True)
    if not isinstance(value, bool):
        raise InputError(f"{where}: coefficients[{i}].reliable is {value!r}, where true or false is needed")
    return value
