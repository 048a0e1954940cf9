"""What was found of the body at the flange: numbers with intervals, what stays open, and what robots take."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import scipy.stats
from jaxpanda_kernels import inertia
from jaxtyping import Float

from ..arms import markup
from ..arms.export import write_document
from ..arms.mjcf import MjcfSource, move_standard
from ..arms.source import from_document
from ..errors import InputError
from ..feasible.nearest import are_buildable, nearest_buildable
from ..files import Kind, output_folder, write_json, write_text
from .design import REACH
from .frame import Frame

SCHEMA = "jaxpanda.payload/1"
JSON, XML, MODEL_XML = "payload.json", "payload.xml", "with_payload.xml"
KIND = Kind("payload", (JSON, XML, MODEL_XML))
EXTENT = 0.3
"""How far from its centre of mass a body at a flange is taken to reach [m], where the motion does not tell."""
LEVEL = 0.95
_WIDTH = float(scipy.stats.norm.ppf(0.5 + LEVEL / 2))
_SEEN = 3.0
"""Deviations from 0 at which a mass is reported: at 2, one pair in 40 without a body would have one."""
_OPEN = 0.5
"""A direction is open where so much of its prior's deviation is left."""
_MOSTLY = 0.25
"""Share of a parameter that open directions make up, for it to be named."""
_CONTRADICTS = float(scipy.stats.chi2.ppf(LEVEL, 10))
"""Squared distance, in deviations, beyond which no real body is within the uncertainty of the estimate."""
_SOLID = 2700.0
"""Density of aluminium [kg/m³]: where the motion does not tell an inertia, that of a solid ball stands in."""
_EDGE = 1e-4
"""Least principal second moment of a body that is written, as a share of their sum: MuJoCo allows no rounding."""
NAMES = ("mass", "first moment x", "first moment y", "first moment z")
_SIX = ("xx", "yy", "zz", "xy", "xz", "yz")
_PLACE = [0, 2, 5, 1, 3, 4]  # of those in the order of `jaxpanda_kernels.inertia`
_STANDARD = (*NAMES, *(f"inertia {name}" for name in ("xx", "xy", "yy", "xz", "yz", "zz")))

Verdict = Literal["found", "no_difference", "lighter", "not_told"]


@dataclasses.dataclass(frozen=True)
class Numbers:
    """Some numbers with their 95 % intervals."""

    value: Float[np.ndarray, " n"]
    std: Float[np.ndarray, " n"]
    interval: Float[np.ndarray, "n 2"]
    """Where the motion does not tell a number, the range of what can be built."""
    told: tuple[bool, ...]
    """Whether the motion tells it; where it does not, `value` is a stand-in."""

    def to_json(self, unit: str, single: bool = False) -> dict[str, Any]:
        """Values that the motion does not tell are null."""
        value = [float(v) if t else None for v, t in zip(self.value, self.told, strict=True)]
        out = {
            "value": value,
            "std": self.std.tolist(),
            "interval": self.interval.tolist(),
            "told": list(self.told),
        }
        return {**({k: v[0] for k, v in out.items()} if single else out), "unit": unit}


@dataclasses.dataclass(frozen=True)
class PayloadEstimate:
    """The body that some recordings carry and others do not, in a frame fixed to the last link."""

    verdict: Verdict
    arm: str
    frame: Frame
    mass: Numbers
    """[kg]"""
    com: Numbers | None
    """Centre of mass in the frame [m]; None without a body."""
    inertia: Numbers | None
    """About the centre of mass along the frame's axes, xx, yy, zz, xy, xz, yz [kg m²]; None without a body."""
    standard: Float[np.ndarray, "10"]
    """As estimated, in the frame; order and units as in `jaxpanda_kernels.inertia`."""
    covariance: Float[np.ndarray, "10 10"]
    body: Float[np.ndarray, "10"] | None
    """The real body that the numbers above are of, stand-ins where the motion does not tell; None without."""
    feasible: bool
    """Whether `standard` itself could be built."""
    distance: float | None
    """From there to `body`, in deviations, squared: beyond 18.3 no real body is within the uncertainty."""
    prior: Float[np.ndarray, "10"]
    """Standard deviation of each parameter before anything is seen."""
    directions: tuple[dict[str, Any], ...]
    """What the motion does not tell: `vector`, a direction of the ten parameters in units of their prior, and how
    much of the prior's deviation is left along it."""
    fit: dict[str, Any]
    """Rms of what is left of the torque [N m], joint by joint, and of what the body's torque is."""
    sentences: tuple[str, ...]
    notes: tuple[str, ...]
    torque_scale_std: float
    """Share by which all torques may be off, as it was given."""
    snippet: str | None
    """`<body>` for an MJCF, to be put into the body of the last link."""
    written: markup.Document | None
    """The user's MJCF with it."""

    def to_json(self) -> dict[str, Any]:
        return {
            "schema": SCHEMA,
            "verdict": self.verdict,
            "arm": self.arm,
            "frame": {
                "name": self.frame.name,
                "last_link": self.frame.body,
                "position_in_last_link": self.frame.p.tolist(),
                "rotation_in_last_link": self.frame.R.tolist(),
                "says": self.frame.says,
            },
            "level": LEVEL,
            "torque_scale_std": self.torque_scale_std,
            "mass": self.mass.to_json("kg", single=True),
            "com": None if self.com is None else self.com.to_json("m"),
            "inertia": None
            if self.inertia is None
            else {"order": list(_SIX), **self.inertia.to_json("kg·m²")},
            "standard": {
                "names": list(_STANDARD),
                "value": self.standard.tolist(),
                "covariance": self.covariance.tolist(),
                "feasible": self.feasible,
                "distance_to_feasible": self.distance,
            },
            "not_told": {
                "names": list(_STANDARD),
                "prior_std": self.prior.tolist(),
                "directions": list(self.directions),
            },
            "commands": self.commands(),
            "mjcf": self.snippet,
            "fit": self.fit,
            "summary": list(self.sentences),
            "notes": list(self.notes),
        }

    def commands(self) -> dict[str, Any] | None:
        """What a Franka and a UR controller take; None without a body. Stand-ins are included."""
        if self.body is None:
            return None
        mass, com, I = (np.asarray(x) for x in inertia.to_com(jnp.asarray(self.body)))
        m, c = round(float(mass), 4), [round(float(v), 5) for v in com]
        full = [[round(float(v), 6) for v in row] for row in I]
        six = [full[0][0], full[1][1], full[2][2], full[0][1], full[0][2], full[1][2]]
        assert self.com is not None
        assert self.inertia is not None
        stands = [f"centre of mass {n}" for n, t in zip("xyz", self.com.told, strict=True) if not t]
        stands += [f"inertia {n}" for n, t in zip(_SIX, self.inertia.told, strict=True) if not t]
        return {
            "frame": self.frame.name,
            "stand_ins": stands,
            "franka": {
                "setLoad": {
                    "load_mass": m,
                    "F_x_Cload": c,
                    "load_inertia": [v for row in zip(*full, strict=True) for v in row],
                },
                "note": "load_inertia is about the centre of mass, column-major; the frame must be the flange's",
            },
            "ur": {
                "set_target_payload": {"m": m, "cog": c, "inertia": six},
                "script": f"set_target_payload({m}, {c}, {six})",
                "note": "older controllers: set_payload(m, cog); the frame must be the tool flange's",
            },
        }

    def save(self, folder: str | Path) -> None:
        """Write payload.json, and where a body was found payload.xml and the model with it; stale ones go."""
        with output_folder(folder, KIND) as scratch:
            if self.written is not None:
                write_document(self.written, scratch / MODEL_XML)
            if self.snippet is not None:
                write_text(scratch / XML, self.snippet)
            write_json(scratch / JSON, self.to_json())


def result_of(
    phi: Float[np.ndarray, "10"],
    covariance: Float[np.ndarray, "10 10"],
    prior: Float[np.ndarray, "10"],
    frame: Frame,
    source: MjcfSource,
    arm: str,
    fit: dict[str, Any],
    notes: Sequence[str],
    torque_scale_std: float,
) -> PayloadEstimate:
    """From parameters in the last link's frame, with their prior's deviations, to what is said of the body."""
    R, p = frame.R_link.T, -frame.R_link.T @ frame.p_link
    T = np.stack([move_standard(one, R, p) for one in np.eye(10)], 1)
    phi, covariance = T @ phi, T @ covariance @ T.T
    feasible = bool(phi[0] > 0 and are_buildable(phi[None]))
    directions = _directions(covariance, prior)
    verdict: Verdict = "found"
    std = float(np.sqrt(covariance[0, 0]))
    if std > _OPEN * prior[0]:
        verdict = "not_told"
    elif abs(phi[0]) < _SEEN * std:
        verdict = "no_difference"
    elif phi[0] < 0:
        verdict = "lighter"
    body, distance = _real(phi, covariance, feasible) if verdict == "found" else (None, None)
    scaled = phi if body is None else body  # which the scale of all torque leaves a body, or none
    covariance = covariance + torque_scale_std**2 * np.outer(scaled, scaled)
    low, high = phi[0] + _WIDTH * np.sqrt(covariance[0, 0]) * np.array([-1, 1])
    com, moments, snippet, written = None, None, None, None
    mass = Numbers(phi[:1], np.sqrt(covariance[:1, 0]), np.array([[low, high]]), (verdict != "not_told",))
    notes = list(notes)
    if body is not None:
        com, moments = _numbers(body, covariance, high)
        body = _with_stand_ins(body, com, moments)
        mass = Numbers(body[:1], mass.std, mass.interval, mass.told)
        moments = dataclasses.replace(moments, value=_six(np.asarray(inertia.to_com(jnp.asarray(body))[2])))
        snippet = _snippet(body, frame, source)
        try:
            written = _written(source, snippet)
        except InputError as error:
            notes.append(f"{MODEL_XML} was not written: {error}")
    found = PayloadEstimate(
        verdict, arm, frame, mass, com, moments, phi, covariance, body, feasible, distance, prior, directions,
        fit, (), tuple(notes), torque_scale_std, snippet, written,
    )  # fmt: skip
    return dataclasses.replace(found, sentences=tuple(_sentences(found)))


def _directions(covariance: np.ndarray, prior: np.ndarray) -> tuple[dict[str, Any], ...]:
    """Combinations of the ten parameters of which most of the prior's deviation is left."""
    values, vectors = np.linalg.eigh(covariance / np.outer(prior, prior))
    out = []
    for value, v in zip(values[::-1], vectors.T[::-1], strict=True):
        left = float(np.sqrt(max(value, 0.0)))
        if left < _OPEN:
            break
        v = v * np.sign(v[np.abs(v).argmax()])
        out.append({"vector": v.tolist(), "left_of_prior": left})
    return tuple(out)


def _real(
    phi: Float[np.ndarray, "10"], covariance: Float[np.ndarray, "10 10"], feasible: bool
) -> tuple[Float[np.ndarray, "10"], float]:
    """The real body nearest to the estimate, by its covariance, and the squared distance to it."""
    if feasible:
        return phi, 0.0
    com = phi[1:4] / phi[0]
    com = com * min(1.0, REACH / max(float(np.linalg.norm(com)), 1e-9))
    ball = _ball(float(phi[0])) * np.eye(3)
    begin = np.asarray(inertia.from_com(jnp.asarray(phi[0]), jnp.asarray(com), jnp.asarray(ball)))
    d = np.sqrt(np.diag(covariance))
    root = np.linalg.inv(np.linalg.cholesky(covariance / np.outer(d, d) + 1e-12 * np.eye(10))) / d
    body = nearest_buildable(phi[None], np.zeros((1, 10)), begin[None], root, [0])[0]
    return body, float(np.sum((root @ (body - phi)) ** 2))


def _ball(mass: float) -> float:
    """Moment of inertia of a solid ball [kg m²]."""
    return 0.4 * mass * (3 * mass / (4 * np.pi * _SOLID)) ** (2 / 3)


def _six(I: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "6"]:
    return I[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]


@jax.jit
def _about_com(phi):
    """Centre of mass and inertia about it (xx, yy, zz, xy, xz, yz), and their derivatives by the parameters."""

    def of(phi):
        _, com, I = inertia.to_com(phi)
        return jnp.concatenate([com, inertia.six(I)[np.array(_PLACE)]])

    return of(phi), jax.jacobian(of)(phi)


def _numbers(
    body: Float[np.ndarray, "10"], covariance: Float[np.ndarray, "10 10"], heaviest: float
) -> tuple[Numbers, Numbers]:
    """Centre of mass and inertia about it, with deviations to first order."""
    value, J = (np.asarray(x) for x in _about_com(jnp.asarray(body)))
    std = np.sqrt(np.diag(J @ covariance @ J.T))
    interval = value[:, None] + _WIDTH * std[:, None] * np.array([-1.0, 1.0])
    most = heaviest * EXTENT**2
    limits = np.array([[0.0, most]] * 3 + [[-most / 2, most / 2]] * 3)
    told = [bool(s * _WIDTH < EXTENT / 2) for s in std[:3]]
    size = np.mean(value[3:6])
    told += [bool(s * _WIDTH < size) for s in std[3:]]
    for k in range(6):
        low = max(interval[3 + k, 0], limits[k, 0])
        high = interval[3 + k, 1] if told[3 + k] else min(interval[3 + k, 1], limits[k, 1])
        interval[3 + k] = low, max(high, low)
    return (
        Numbers(value[:3], std[:3], interval[:3], tuple(told[:3])),
        Numbers(value[3:], std[3:], interval[3:], tuple(told[3:])),
    )


def _with_stand_ins(body: Float[np.ndarray, "10"], com: Numbers, moments: Numbers) -> Float[np.ndarray, "10"]:
    """The body, with a solid ball's inertia where the motion tells none of it, and inside what can be built."""
    mass, _, I = (np.asarray(x) for x in inertia.to_com(jnp.asarray(body)))
    if not any(moments.told[:3]):
        I = _ball(float(mass)) * np.eye(3)
    values, axes = np.linalg.eigh(0.5 * np.trace(I) * np.eye(3) - I)
    values = np.maximum(values, _EDGE * max(values.sum(), 1e-9))
    I = values.sum() * np.eye(3) - (axes * values) @ axes.T
    return np.asarray(inertia.from_com(jnp.asarray(mass), jnp.asarray(com.value), jnp.asarray(I)))


def _snippet(body: Float[np.ndarray, "10"], frame: Frame, source: MjcfSource) -> str:
    """The body as MJCF, placed in the body of the last link."""
    mass, com, I = (np.asarray(x) for x in inertia.to_com(jnp.asarray(body)))
    taken = {source.model.body(b).name for b in range(source.model.nbody)}
    name = next(n for n in ("payload", *(f"payload_{k}" for k in range(2, 1000))) if n not in taken)
    x, y = frame.R.T[:2]
    place = "" if frame.name == frame.body else f' pos="{_text(frame.p)}" xyaxes="{_text([*x, *y])}"'
    return (
        f'<body name="{name}"{place}><inertial pos="{_text(com)}" mass="{_text([mass])}" '
        f'fullinertia="{_text(_six(I))}"/></body>\n'
    )


def _text(values: Any) -> str:
    """Numbers to a billionth of the largest, far below any uncertainty here."""
    values = np.ravel(values)
    size = max(float(np.abs(values).max()), 1e-12)
    return " ".join(f"{v:.9g}" for v in np.where(np.abs(values) < 1e-9 * size, 0.0, values))


def _written(source: MjcfSource, snippet: str) -> markup.Document:
    """The user's file with the body in the body of its last link, checked by compiling it."""
    link = source.links[-1]
    elements = [e for e in source.document.root.walk() if e.tag == "body" and e.has_ancestor("worldbody")]
    named = [e for e in elements if e.attributes.get("name") == link.body]
    if len(named) != 1:
        raise InputError(
            f"the body of the last link, {link.body!r}, has no name of its own in {source.path.name}"
        )
    document = markup.edit(source.document, [markup.Edit(named[0], first_child=snippet.strip())])
    _, after = from_document(document, source.dropped)
    gained = float(after.standard[-1][0] - source.standard[-1][0])
    mass = float(snippet.split('mass="')[1].split('"')[0])
    if abs(gained - mass) > 1e-6 * mass:
        raise InputError(
            f"MuJoCo makes {gained:.4g} kg of the {mass:.4g} kg in {source.path.name} (compiler settings)"
        )
    return document


def _sentences(found: PayloadEstimate) -> list[str]:
    """In plain words."""
    (low, high), std = found.mass.interval[0], found.mass.std[0]
    between = f"{100 * LEVEL:.0f} % interval {low:.4g} to {high:.4g} kg"
    if found.verdict == "not_told":
        return [
            f"These motions do not tell the mass of a body at the flange (deviation {std:.2g} kg): move joints "
            "whose axes are not vertical, in several poses."
        ]
    if found.verdict == "no_difference":
        return [
            "Recordings with and without the body show no difference that tells a body from none: its mass is "
            f"{found.mass.value[0]:.2g} kg, {between}, less than {_SEEN:g} deviations from 0. No payload is "
            "reported."
        ]
    if found.verdict == "lighter":
        return [
            f"The arm is lighter in the recordings said to be with the body, by {-found.mass.value[0]:.4g} kg "
            f"({between}): no body has a negative mass. Perhaps --with and --without are swapped."
        ]
    assert found.com is not None
    assert found.inertia is not None
    said = [f"Mass {found.mass.value[0]:.4g} kg, {between}."]
    if found.torque_scale_std:
        said.append(
            f"Of the interval, {100 * found.torque_scale_std:.3g} % (deviation) is the torque's own scale."
        )
    else:
        said.append(
            "The torque's own scale is taken as right: where it is off by 1 %, mass and inertia are, and no "
            "recording tells (--torque-scale-std widens the intervals; gains that differ from joint to joint "
            "move the centre of mass too)."
        )
    said.append(f"Centre of mass and axes in {found.frame.says}; inertia is about the centre of mass.")
    if not all(found.com.told):
        axes = ", ".join(a for a, t in zip("xyz", found.com.told, strict=True) if not t)
        said.append(f"The motion does not tell where the centre of mass is along {axes}.")
    if not any(found.inertia.told):
        most = float(found.inertia.interval[:3, 1].max())
        why = (
            f"all is possible up to {most:.2g} kg·m², that of a body which reaches {EXTENT:g} m from its centre "
            "of mass"
            if most >= 0.99 * high * EXTENT**2
            else f"all that is known is that it is at most {most:.2g} kg·m² about the frame's axes"
        )
        said.append(
            f"The motion does not tell the inertia, which is small for it or moved too slowly: {why}. Where a "
            "controller needs a number, that of a solid ball of aluminium stands in."
        )
    elif not all(found.inertia.told):
        names = ", ".join(n for n, t in zip(_SIX, found.inertia.told, strict=True) if not t)
        said.append(f"The motion does not tell the inertia {names}: the range of what it can be is given.")
    if found.directions:
        open_ = np.sum([np.square(d["vector"]) for d in found.directions], 0)
        names = ", ".join(n for n, share in zip(_STANDARD, open_, strict=True) if share > _MOSTLY)
        said.append(
            f"Of the 10 parameters about the frame's origin the motion leaves {len(found.directions)} "
            f"combinations open, mostly of {names}."
        )
    if found.distance is not None and found.distance > _CONTRADICTS:
        said.append(
            "No real body (positive mass, positive semidefinite pseudo-inertia) has the estimated parameters: "
            f"the nearest lies {np.sqrt(found.distance):.2g} deviations away. Something else differs between the "
            "recordings (friction, offsets, a contact), or the model's geometry is off; do not trust the inertia."
        )
    elif not found.feasible:
        said.append(
            "The least-squares estimate is no real body (its pseudo-inertia is not positive semidefinite), by no "
            "more than its uncertainty: the numbers are those of the nearest real body."
        )
    return said
