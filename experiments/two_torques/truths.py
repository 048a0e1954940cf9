"""truth.json's list of effects: names of INTERFACE.md, joints from 1, numbers, and what is equally right."""

import numpy as np
from causes import rms_below_band
from plant import Record, Truth

BY_JOINT = {  # (side, effect): (name and unit of its number, its value at each joint)
    ("drive", "coulomb_friction"): ("level", lambda tr, held: tr.drive.coulomb - held["coulomb"]),
    ("drive", "viscous_friction"): ("damping", lambda tr, held: tr.drive.viscous - held["viscous"]),
    ("drive", "armature"): ("armature", lambda tr, held: tr.drive.armature - held["armature"]),
    ("drive", "stribeck_friction"): ("level", lambda tr, held: tr.drive.stribeck),
    ("drive", "load_dependent_friction"): ("per torque", lambda tr, held: tr.drive.load),
    ("drive", "asymmetric_friction"): ("asymmetry", lambda tr, held: tr.drive.asymmetry),
    ("drive", "friction_drift"): ("relative change", lambda tr, held: tr.drive.warming),
    ("drive", "torque_ripple"): ("amplitude", lambda tr, held: tr.drive.ripple),
    ("drive", "torque_offset"): ("offset", lambda tr, held: tr.sensors.motor_offset),
    ("drive", "torque_gain"): ("gain error", lambda tr, held: tr.sensors.motor_gain),
    ("drive", "torque_drift"): ("drift", lambda tr, held: tr.sensors.motor_drift),
    ("link", "joint_spring"): ("stiffness", lambda tr, held: tr.links.hose),
    ("link", "torque_offset"): ("offset", lambda tr, held: tr.sensors.offset),
    ("link", "torque_gain"): ("gain error", lambda tr, held: tr.sensors.gain),
    ("link", "torque_drift"): ("drift", lambda tr, held: tr.sensors.drift),
    ("link", "encoder_offset"): ("offset", lambda tr, held: tr.sensors.encoder),
}
OF_THE_ARM = {
    "payload": lambda tr: {"mass": tr.links.load},
    "payload_change": lambda tr: {"mass": tr.links.gained, "time": tr.links.gained_at},
    "external_contact": lambda tr: {"force": float(np.linalg.norm(tr.links.push))},
    "gravity_direction": lambda tr: {"tilt": float(np.linalg.norm(tr.links.tilt))},
    "inertial_parameters": lambda tr: (
        {
            f"link {j + 1}, relative mass": float(factor - 1)
            for j, factor in enumerate(tr.links.mass_factor)
            if factor != 1
        }
        | {
            f"link {j + 1}, shift": float(np.linalg.norm(s))
            for j, s in enumerate(tr.links.com_shift)
            if np.any(s)
        }
    ),
}
ALSO = {  # equally right at the same joint
    ("drive", "coulomb_friction"): ("presliding_hysteresis",),
    ("drive", "asymmetric_friction"): ("torque_offset",),
    ("drive", "torque_offset"): ("asymmetric_friction",),
    ("link", "payload"): ("inertial_parameters",),
}
ALLOWED = {  # neither right nor wrong at the same joint
    ("drive", "torque_drift"): ("torque_offset",),
    ("link", "torque_drift"): ("torque_offset",),
    ("link", "joint_spring"): ("torque_offset",),
    ("drive", "friction_drift"): ("coulomb_friction", "viscous_friction"),
    ("drive", "load_dependent_friction"): ("coulomb_friction",),
    ("drive", "stribeck_friction"): ("coulomb_friction",),
}


def joint_values(truth: Truth, held: dict, side: str, effect: str) -> np.ndarray:
    return BY_JOINT[side, effect][1](truth, held)


def is_there(truth: Truth, held: dict, side: str, effect: str) -> bool:
    if effect == "presliding_hysteresis":
        return True
    if effect in OF_THE_ARM:
        return any(OF_THE_ARM[effect](truth).values())
    return bool(np.any(np.abs(joint_values(truth, held, side, effect)) > 1e-9))


def equally_right(truth: Truth, side: str, effect: str) -> list[str]:
    also = list(ALSO.get((side, effect), ()))
    if effect == "coulomb_friction" and np.any(truth.drive.stribeck):
        also.append("stribeck_friction")
    if effect == "inertial_parameters":
        links = truth.links
        if links.mass_factor[-1] != 1 or np.any(links.com_shift[-1]):
            also.append("payload")
    return also


def acting(effect: str, truth: Truth) -> list | None:
    links = truth.links
    if effect == "external_contact":
        return [[links.push_at, links.push_at + links.push_length]]
    return [[links.gained_at, None]] if effect == "payload_change" else None


def entry(side, effect, part, truth: Truth, held, records: list[Record], names, noise) -> dict:
    rms = rms_below_band(effect, part, truth, records)
    if effect in OF_THE_ARM:
        joints = np.flatnonzero(rms >= noise)
        told = [{"name": k, "joint": None, "value": v} for k, v in OF_THE_ARM[effect](truth).items()]
    elif effect == "presliding_hysteresis":
        joints = np.arange(len(rms))
        told = [
            {"name": "breakaway", "joint": int(j) + 1, "value": float(truth.drive.breakaway[j])}
            for j in joints
        ]
    else:
        values = joint_values(truth, held, side, effect)
        joints = np.flatnonzero(np.abs(values) > 1e-9)
        name = BY_JOINT[side, effect][0]
        told = [{"name": name, "joint": int(j) + 1, "value": float(values[j])} for j in joints]
    there = rms if effect in OF_THE_ARM else rms[joints]
    where = noise if effect in OF_THE_ARM else noise[joints]
    return {
        "effect": effect,
        "side": side,
        "joints": [int(j) + 1 for j in joints],
        "recordings": names,
        "intervals": acting(effect, truth),
        "parameters": told,
        "rms_torque": rms.tolist(),
        "detectable": bool(np.any(there >= where)),
        "also": equally_right(truth, side, effect),
        "optional": effect == "presliding_hysteresis",
    }


def effects(truth: Truth, held, old, added: dict, records: list[Record], names, noise: dict) -> list[dict]:
    """Entries of all causes that are there and not in `old`; `added` has the parts over all records in a row."""
    return [
        entry(side, effect, part, truth, held, records, names, noise[side])
        for side in ("link", "drive")
        for effect, part in added[side].items()
        if effect != "file" and effect not in old and is_there(truth, held, side, effect)
    ]


def allowed(entries: list[dict]) -> list[dict]:
    return [
        {"effect": name, "joints": e["joints"], "side": e["side"]}
        for e in entries
        for name in ALLOWED.get((e["side"], e["effect"]), ())
    ]
