"""What a result knows, in a form in which two of them can be compared."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from ..arms.arm import Arm
from ..corrected import FILE as CORRECTED
from ..corrected import Corrected
from ..errors import InputError
from ..friction import MODELS
from ..identification import Identification
from ..identification.result import FILE as IDENTIFICATION
from ..inputs import read_json
from ..parameters import expression, linear_forms
from ..posterior import Posterior, named
from ..retrieval import FILE as RETRIEVAL
from ..retrieval import Retrieval

KINDS = {"diagnosis": CORRECTED, "retrieval": RETRIEVAL, "identification": IDENTIFICATION}
"""Kinds of results and the file that tells each; the first that a folder has is meant."""


@dataclasses.dataclass(frozen=True)
class Known:
    """One result: told linear forms of links and friction with their covariance, and how it was made."""

    kind: str
    folder: str
    arm: Arm
    told: Float[np.ndarray, "told standard"]
    """Forms of the links' standard parameters; friction stands apart."""
    names: tuple[str, ...]
    """Of the friction told, as `coulomb_1`."""
    mean: Float[np.ndarray, " unknowns"]
    """Of the forms, then of friction."""
    covariance: Float[np.ndarray, "unknowns unknowns"]
    settings: Mapping[str, Any]
    recordings: tuple[str, ...]
    noise: Float[np.ndarray, " dof"]
    """Rms of torque beyond the model [N m]."""
    findings: tuple[Mapping[str, Any], ...] = ()
    corrected: Corrected | None = None


def known(folder: str | Path, kind: str | None = None) -> Known:
    """What the result in a folder knows.

    Raises:
        InputError: no result of that kind is there, or none with its uncertainty.
    """
    folder = Path(folder)
    found = kind or next((k for k, name in KINDS.items() if (folder / name).is_file()), None)
    if found is None or not (folder / KINDS[found]).is_file():
        what = (
            "a result of identify, retrieve or diagnose"
            if kind is None
            else f"{KINDS[kind]}, as the other has"
        )
        raise InputError(f"{folder}: holds no {what}" if kind else f"{folder}: is not {what}")
    return {"identification": _identification, "retrieval": _retrieval, "diagnosis": _diagnosis}[found](
        folder
    )


def kind_of(folder: str | Path) -> str:
    """Kind of the result in a folder."""
    return known(folder).kind


def _identification(folder: Path) -> Known:
    found = Identification.load(folder)
    arm = found.model or (Arm.panda() if found.arm in ("", "panda") and found.dof == 7 else None)
    C = found.joint_covariance if found.joint_covariance is not None else found.covariance
    if C is None or arm is None:
        raise InputError(
            f"{folder / IDENTIFICATION}: has no covariance or no arm, as an older version or a bare table;"
            " identify again"
        )
    names: tuple[str, ...] = ()
    mean = found.beta
    if found.joint_covariance is not None and found.friction is not None:
        kinds = MODELS[found.friction.model]
        names = named(kinds, found.dof)
        mean = np.concatenate(
            [mean, np.stack([found.friction.parameters[kind] for kind in kinds], 1).ravel()]
        )
    keep = np.diag(C) < 1e6  # what the motion did not tell
    rank = len(found.beta)
    return Known(
        kind="identification",
        folder=str(folder),
        arm=arm,
        told=found.projection[keep[:rank]],
        names=tuple(name for name, kept in zip(names, keep[rank:], strict=True) if kept),
        mean=mean[keep],
        covariance=C[np.ix_(keep, keep)],
        settings={"method": found.method, **found.settings},
        recordings=found.recordings,
        noise=np.zeros(found.dof) if found.rmse is None else found.rmse,
    )


def _retrieval(folder: Path) -> Known:
    found = Retrieval.load(folder)
    arm = found.model or (Arm.panda() if found.arm in ("", "panda") and found.dof == 7 else None)
    if found.posterior is None or arm is None:
        raise InputError(f"{folder}: holds no posterior.npz or no arm, as an older version; retrieve again")
    settings = {
        "weighting": found.weighting,
        "starts": found.starts,
        "friction": found.friction.model if found.friction else "none",
    }
    return _of_posterior("retrieval", folder, arm, found.posterior, settings, (), (), None)


def _diagnosis(folder: Path) -> Known:
    corrected = Corrected.load(folder)
    document = read_json(folder / "diagnosis.json")
    if not isinstance(document, dict) or not isinstance(document.get("findings"), list):
        raise InputError(f"{folder / 'diagnosis.json'}: is not as `diagnose` writes it; diagnose again")
    sources = document.get("sources", [])
    recordings = tuple(str(one.get("name")) for one in sources if one.get("role") == "recording")
    settings = {"knowledge": document.get("knowledge")}
    return _of_posterior(
        "diagnosis",
        folder,
        corrected.arm,
        Posterior.load(folder),
        settings,
        recordings,
        tuple(document["findings"]),
        corrected,
    )


def _of_posterior(
    kind: str,
    folder: Path,
    arm: Arm,
    posterior: Posterior,
    settings: Mapping[str, Any],
    recordings: tuple[str, ...],
    findings: tuple[Mapping[str, Any], ...],
    corrected: Corrected | None,
) -> Known:
    columns = 10 * posterior.dof
    of_links = np.flatnonzero(np.any(posterior.told[:, :columns] != 0, 1))
    rows, names = [*of_links], []
    for k, name in enumerate(posterior.names):
        own = np.flatnonzero(posterior.told[:, columns + k])
        if not name.startswith("effect_") and len(own) == 1:
            rows.append(own[0])
            names.append(name)
    return Known(
        kind=kind,
        folder=str(folder),
        arm=arm,
        told=posterior.told[of_links][:, :columns],
        names=tuple(names),
        mean=posterior.mean[rows],
        covariance=posterior.covariance[np.ix_(rows, rows)],
        settings=settings,
        recordings=recordings,
        noise=posterior.noise,
        findings=findings,
        corrected=corrected,
    )


def in_common(
    a: Known, b: Known, forms: Float[np.ndarray, "base standard"]
) -> tuple[
    Float[np.ndarray, "common standard"], tuple[str, ...], list[np.ndarray], list[np.ndarray], tuple[str, ...]
]:
    """Forms that both tell, of the arm's base parameters where they do; friction that both tell.

    Returns:
        The forms, their names, and of each result mean and covariance of forms and friction; names of friction.
    """
    rows, labels = [], []
    texts = [expression(terms) for terms in linear_forms(forms)]
    maps: list[list[np.ndarray]] = [[], []]
    scale = np.maximum(np.abs(forms).max(0), 1e-12)
    for form, text in zip(forms, texts, strict=True):
        shares = [np.linalg.lstsq((k.told / scale).T, form / scale, rcond=1e-10)[0] for k in (a, b)]
        left = [np.linalg.norm((k.told.T @ x - form) / scale) for k, x in zip((a, b), shares, strict=True)]
        if max(left) < 1e-5 * np.linalg.norm(form / scale):
            rows.append(form)
            labels.append(text)
            for place, x in zip(maps, shares, strict=True):
                place.append(x)
    names = tuple(name for name in a.names if name in b.names)
    means, covariances = [], []
    for k, of_forms in zip((a, b), maps, strict=True):
        T = np.zeros((len(rows) + len(names), len(k.mean)))
        for i, x in enumerate(of_forms):
            T[i, : len(k.told)] = x
        for i, name in enumerate(names):
            T[len(rows) + i, len(k.told) + k.names.index(name)] = 1.0
        means.append(T @ k.mean)
        covariances.append(T @ k.covariance @ T.T)
    return np.array(rows).reshape(len(rows), forms.shape[1]), tuple(labels), means, covariances, names


def differing(a: Mapping[str, Any], b: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Settings in which two runs differ."""
    counts = ("samples", "period", "derivative_cutoff", "converged", "objective", "max_violation")
    keys: Sequence[str] = [key for key in {**a, **b} if key not in counts]
    return [{"setting": key, "a": a.get(key), "b": b.get(key)} for key in keys if a.get(key) != b.get(key)]
