r"""`compare`: whether two results agree beyond their uncertainty, and what explains where they do not.

With the difference d of what both tell, and its covariance $S = C_a + C_b$ for recordings that are independent,
$\chi^2 = d^\top S^{-1} d$ weighs all of it at once. Covariances are estimated from a few blocks of time:
$\chi^2/n$ is held against an F distribution and single differences against Student's t, whose tails allow for
that. Single ones are corrected for their number by Holm's method.

Explanations are laws of few parameters, $d = D\theta + e$: another friction at one joint, another body on the
last link, one link that differs, another scale of all torque. The one that takes most from $\chi^2$ beyond what
its own parameters are expected to is taken, and another after it, as long as what is left does not agree.

References:
    Holm, "A simple sequentially rejective multiple test procedure", Scandinavian J. Statistics 1979.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import scipy.stats
from jaxtyping import Float

from ..arms.arm import Arm
from ..errors import InputError, require_x64
from ..friction import UNITS
from ..identification.regression import base_rows
from ..identification.statistics import BLOCKS
from ..parameters import arm_base_parameters, linear_forms, unit_of_form
from ..prediction import predict
from ..recordings import Recording
from ..signals import prepare
from .knowledge import KINDS, Known, differing, in_common, kind_of, known
from .result import Comparison, Explanation, Parameter

LEVEL = 0.05
"""Share of pairs that agree in truth and are said to differ; half for all at once, half for single ones."""
_FREEDOM = BLOCKS - 1
"""Degrees of freedom of a covariance."""
_EXPLANATIONS = 4
_SECONDS, _RATE = 20.0, 100.0


def compare(
    a: str | Path,
    b: str | Path,
    *,
    motion: Recording | None = None,
) -> Comparison:
    """Whether two results of `identify`, `retrieve` or `diagnose` agree, and what explains the difference.

    Args:
        a: folder of one result.
        b: folder of the other, of the same arm and kind.
        motion: on which torque is compared too; without it one within the joints' ranges.

    Raises:
        InputError: no results, of different kinds or arms, or without their uncertainty.
    """
    require_x64("a comparison")
    kinds = [kind_of(folder) for folder in (a, b)]
    shared = [kind for kind in KINDS if all((Path(folder) / KINDS[kind]).is_file() for folder in (a, b))]
    if not shared:
        raise InputError(
            f"{a} holds a result of kind {kinds[0]} and {b} one of kind {kinds[1]}; two of a kind are needed"
        )
    one, other = (known(folder, shared[0]) for folder in (a, b))
    _check_arms(one, other)
    base = arm_base_parameters(one.arm)
    forms, labels, means, covariances, names = in_common(one, other, base.projection)
    if not labels and not names:
        raise InputError(f"{a}, {b}: tell nothing in common; their recordings show different parameters")
    d, S = means[1] - means[0], covariances[0] + covariances[1]
    chi_squared, p = overall(d, S)
    parameters = _parameters(labels, forms, names, means, covariances, d, S, one.arm)
    differ = p < LEVEL / 2 or any(row.differs for row in parameters)
    explanations = explained(d, S, forms, names, one.arm, means[0]) if differ else ()
    findings = _findings(one, other)
    notes = []
    if one.recordings and set(one.recordings) == set(other.recordings):
        notes.append(
            "both are of recordings of the same names: if these are the same, their noise is shared and"
            " deviations of the difference are overstated"
        )
    if len(labels) < base.rank:
        notes.append(
            f"both tell {len(labels)} of the arm's {base.rank} base parameters; the others are not compared"
        )
    different = any(row["in"] != "both" or row["differs"] for row in findings)
    torque = _torque(one, other, d, S, forms, names, motion)
    return Comparison(
        kind=one.kind,
        a=one.folder,
        b=other.folder,
        verdict="differ" if differ or different else "agree",
        chi_squared=chi_squared,
        count=len(d),
        p=p,
        parameters=tuple(parameters),
        explanations=tuple(explanations),
        findings=tuple(findings),
        settings=tuple(differing(one.settings, other.settings)),
        recordings=(one.recordings, other.recordings),
        joints=one.arm.joint_names,
        torque=torque,
        notes=tuple(notes),
    )


def _check_arms(a: Known, b: Known) -> None:
    if a.arm.dof != b.arm.dof or not all(
        np.allclose(getattr(a.arm.chain, name), getattr(b.arm.chain, name), atol=1e-6)
        for name in ("R", "p", "prismatic")
    ):
        raise InputError(
            f"{a.folder}, {b.folder}: are of arms of different geometry ({a.arm.name}, {b.arm.name}); two"
            " results of one arm are needed"
        )


def overall(d: Float[np.ndarray, " n"], S: Float[np.ndarray, "n n"]) -> tuple[float, float]:
    """Chi-square of a difference, and how probable one as large is where nothing differs."""
    scale = np.sqrt(np.diag(S))
    z = scipy.linalg.solve(S / np.outer(scale, scale) + 1e-9 * np.eye(len(d)), d / scale, assume_a="pos")
    chi_squared = float(z @ (d / scale))
    return chi_squared, float(scipy.stats.f.sf(chi_squared / len(d), len(d), 2 * _FREEDOM))


def holm(p: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Probabilities corrected for how many they are."""
    order = np.argsort(p)
    corrected = np.maximum.accumulate(p[order] * np.arange(len(p), 0, -1))
    out = np.empty_like(p)
    out[order] = np.minimum(corrected, 1.0)
    return out


def _parameters(
    labels: Sequence[str],
    forms: Float[np.ndarray, "base standard"],
    names: Sequence[str],
    means: Sequence[np.ndarray],
    covariances: Sequence[np.ndarray],
    d: np.ndarray,
    S: np.ndarray,
    arm: Arm,
) -> list[Parameter]:
    std = np.sqrt(np.diag(S))
    t = d / std
    p = 2 * scipy.stats.t.sf(np.abs(t), 2 * _FREEDOM)
    corrected = holm(p)
    out = []
    for i, label in enumerate((*labels, *names)):
        kind, _, joint = label.rpartition("_")
        friction = i >= len(labels)
        if friction:
            unit = arm.unit({**UNITS, "armature": "kg m²"}.get(kind, ""), int(joint) - 1)
        else:
            unit = unit_of_form(linear_forms(forms[i : i + 1])[0])
        out.append(
            Parameter(
                name=kind if friction else label,
                joint=int(joint) if friction else None,
                unit=unit,
                a=float(means[0][i]),
                b=float(means[1][i]),
                std_a=float(np.sqrt(covariances[0][i, i])),
                std_b=float(np.sqrt(covariances[1][i, i])),
                t=float(t[i]),
                p=float(p[i]),
                p_corrected=float(corrected[i]),
                differs=bool(corrected[i] < LEVEL / 2),
            )
        )
    return out


def explained(
    d: Float[np.ndarray, " n"],
    S: Float[np.ndarray, "n n"],
    forms: Float[np.ndarray, "forms standard"],
    names: Sequence[str],
    arm: Arm,
    mean: Float[np.ndarray, " n"],
) -> list[Explanation]:
    """Laws that take the difference, the likeliest first, until what is left agrees."""
    L = np.linalg.cholesky(S + 1e-12 * np.diag(np.diag(S)))
    whiten = lambda x: scipy.linalg.solve_triangular(L, x, lower=True)
    r, found, taken = whiten(d), [], np.zeros((len(d), 0))
    laws = _laws(forms, names, arm, mean)
    while len(found) < _EXPLANATIONS and overall_left(r, taken) < LEVEL / 2:
        best = None
        for what, joint, D, unknowns in laws:
            if any(one.what == what and one.joint == joint for one in found):
                continue
            Q = np.linalg.qr(np.column_stack([taken, whiten(D)]))[0]
            before = np.sum((r - _projected(taken, r)) ** 2)
            gained, k = float(before - np.sum((r - Q @ (Q.T @ r)) ** 2)), np.linalg.matrix_rank(whiten(D))
            if k == 0:
                continue
            p = float(scipy.stats.f.sf(gained / k, k, 2 * _FREEDOM)) * len(laws)
            worth = gained - 3.0 * k
            if p < LEVEL and (best is None or worth > best[0]):
                best = worth, what, joint, D, unknowns, gained, min(p, 1.0)
        if best is None:
            break
        _, what, joint, D, unknowns, gained, p = best
        W = whiten(D)
        theta = np.linalg.pinv(W, rcond=1e-6) @ (r - _projected(taken, r))
        std = np.sqrt(np.maximum(np.diag(np.linalg.pinv(W.T @ W, rcond=1e-10, hermitian=True)), 0))
        found.append(
            Explanation(
                what=what,
                joint=joint,
                gained=gained,
                p=p,
                parameters=tuple(
                    {"name": name, "change": float(value), "std": float(sd)}
                    for name, value, sd in zip(unknowns, theta, std, strict=True)
                ),
            )
        )
        taken = np.column_stack([taken, W])
    return found


def overall_left(r: np.ndarray, taken: np.ndarray) -> float:
    """How probable what laws leave of a whitened difference is where nothing else differs."""
    left = float(np.sum((r - _projected(taken, r)) ** 2))
    n = max(1, len(r) - (np.linalg.matrix_rank(taken) if taken.shape[1] else 0))
    return float(scipy.stats.f.sf(left / n, n, 2 * _FREEDOM))


def _projected(A: np.ndarray, r: np.ndarray) -> np.ndarray:
    return A @ np.linalg.lstsq(A, r, rcond=1e-8)[0] if A.shape[1] else np.zeros_like(r)


_LINK = ("m", "mx", "my", "mz", "Ixx", "Ixy", "Iyy", "Ixz", "Iyz", "Izz")


def _laws(
    forms: np.ndarray, names: Sequence[str], arm: Arm, mean: np.ndarray
) -> list[tuple[str, int | None, np.ndarray, tuple[str, ...]]]:
    """What may have changed: a name, a joint or link from 1, columns, and what these are."""
    n, rows = len(forms) + len(names), len(forms)
    out: list[tuple[str, int | None, np.ndarray, tuple[str, ...]]] = []
    for j in range(1, arm.dof + 1):
        own = [k for k, name in enumerate(names) if int(name.rpartition("_")[2]) == j]
        if own:
            D = np.zeros((n, len(own)))
            D[[rows + k for k in own], range(len(own))] = 1.0
            out.append(("friction", j, D, tuple(names[k].rpartition("_")[0] for k in own)))
    for link in range(arm.dof):
        D = np.zeros((n, 10))
        D[:rows] = forms[:, 10 * link : 10 * link + 10]
        if np.any(D):
            what = "payload" if link == arm.dof - 1 else "link"
            out.append((what, link + 1, D, _LINK))
    out.append(("torque_scale", None, mean[:, None], ("scale",)))
    return out


def _findings(a: Known, b: Known) -> list[dict[str, Any]]:
    """Findings of two diagnoses, matched by effect and joints; parameters of those that both have."""
    keyed = [{(str(f.get("effect")), tuple(f.get("joints", ()))): f for f in one.findings} for one in (a, b)]
    rows = []
    for key in dict.fromkeys([*keyed[0], *keyed[1]]):
        here = [side.get(key) for side in keyed]
        row: dict[str, Any] = {
            "effect": key[0],
            "joints": list(key[1]),
            "in": "both" if all(here) else "a" if here[0] else "b",
            "confidence": [None if f is None else f.get("confidence") for f in here],
            "parameters": [],
            "differs": False,
        }
        if here[0] and here[1]:
            row["parameters"] = _matched(here[0], here[1])
            row["differs"] = any(p["differs"] for p in row["parameters"])
        rows.append(row)
    every = [p for row in rows for p in row["parameters"]]
    if every:
        corrected = holm(np.array([p["p"] for p in every]))
        for p, value in zip(every, corrected, strict=True):
            p["p_corrected"], p["differs"] = float(value), bool(value < LEVEL / 2)
        for row in rows:
            row["differs"] = any(p["differs"] for p in row["parameters"])
    return rows


def _matched(a: Any, b: Any) -> list[dict[str, Any]]:
    other = {(p.get("name"), p.get("joint")): p for p in b["parameters"]}
    out = []
    for p in a["parameters"]:
        q = other.get((p.get("name"), p.get("joint")))
        if q is None or not p.get("std") or not q.get("std"):
            continue
        t = (q["value"] - p["value"]) / float(np.hypot(p["std"], q["std"]))
        probability = float(2 * scipy.stats.t.sf(abs(t), 2 * _FREEDOM))
        out.append(
            {
                "name": p["name"],
                "joint": p.get("joint"),
                "unit": p.get("unit", ""),
                "a": p["value"],
                "b": q["value"],
                "t": float(t),
                "p": probability,
                "differs": False,
            }
        )
    return out


def common_motion(arm: Arm) -> Recording:
    """A motion of all joints within the middle half of their ranges, slow enough for any arm."""
    time = np.arange(int(_SECONDS * _RATE)) / _RATE
    random = np.random.default_rng(0)
    reach = np.where(np.asarray(arm.chain.prismatic), 0.2, np.pi / 2)
    lower = np.where(np.isfinite(arm.lower), arm.lower, -reach)
    upper = np.where(np.isfinite(arm.upper), arm.upper, reach)
    w = 2 * np.pi * np.array([0.1, 0.15, 0.25])
    a, b = random.normal(size=(2, arm.dof, 3))
    size = np.sum(np.hypot(a, b), 1)
    a, b = (x / size[:, None] for x in (a, b))
    s, c = np.sin(time[:, None] * w), np.cos(time[:, None] * w)
    half = 0.25 * (upper - lower)
    q = 0.5 * (lower + upper) + half * (s @ a.T + c @ b.T)
    qd = half * ((c * w) @ a.T - (s * w) @ b.T)
    return Recording("common motion", time, q, qd=qd)


def _torque(
    a: Known,
    b: Known,
    d: np.ndarray,
    S: np.ndarray,
    forms: np.ndarray,
    names: Sequence[str],
    motion: Recording | None,
) -> dict[str, Any]:
    """By how much the two differ in the torque of one motion [N m, rms by joint], and what is expected of it."""
    arm = a.arm
    given = motion or common_motion(arm)
    given.require_dof(arm.dof)
    if a.kind == "diagnosis":
        difference = predict(b.folder, given) - predict(a.folder, given)
        rms, expected = np.sqrt(np.mean(difference**2, 0)), None
    else:
        signals = prepare(given)
        q, qd, qdd = (jnp.asarray(x) for x in (signals.q, signals.qd, signals.qdd))
        every, joints = jnp.arange(10 * arm.dof), jnp.arange(arm.dof)
        rows = np.asarray(base_rows(arm.chain, every, joints, q, qd, qdd))
        rigid = np.stack([signals.lowpass(of_joint) for of_joint in rows], 1)
        size = np.maximum(np.abs(forms).max(0), 1e-12) if len(forms) else np.ones(10 * arm.dof)
        back = np.linalg.pinv(forms / size, rcond=1e-10) if len(forms) else np.zeros((10 * arm.dof, 0))
        columns = np.zeros((*rigid.shape[:2], len(d)))
        columns[:, :, : len(forms)] = rigid @ (back / size[:, None])
        law = {"viscous": qd, "coulomb": jnp.sign(qd), "offset": jnp.ones_like(qd), "armature": qdd}
        for k, name in enumerate(names):
            kind, _, joint = name.rpartition("_")
            j = int(joint) - 1
            if kind in law:
                columns[:, j, len(forms) + k] = signals.lowpass(np.asarray(law[kind])[:, j])
        difference = columns @ d
        variance = np.einsum("tjk,kl,tjl->tj", columns, S, columns, optimize=True)
        rms = np.sqrt(np.mean(difference**2, 0))
        expected = np.sqrt(np.mean(variance, 0)).tolist()
    noise = np.maximum(a.noise, b.noise)
    return {
        "motion": given.name,
        "unit": arm.unit("N m"),
        "rms_difference": rms.tolist(),
        "expected_std": expected,
        "noise": noise.tolist(),
    }
