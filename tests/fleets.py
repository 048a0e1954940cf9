"""Fleets for tests: tables of estimates as diagnoses leave them, drawn from a law that is known; small arms."""

from pathlib import Path
from typing import Any

import numpy as np

from jaxpanda.fleet.result import Fleet
from jaxpanda.fleet.table import Row, Table

STDS = {"viscous_friction": 0.02, "coulomb_friction": 0.03, "torque_offset": 0.05, "payload": 0.1}
UNITS = {"viscous_friction": "N·m·s/rad", "coulomb_friction": "N·m", "torque_offset": "N·m", "payload": "kg"}


def fleet(
    seed: int,
    arms: int,
    recordings: int,
    *,
    joints: int = 2,
    drift: tuple[int, ...] = (),
    once: tuple[int, ...] = (),
    level: float = 0.0,
    scatter: float = 1.0,
    found: bool = False,
) -> Fleet:
    """A fleet whose arms have these numbers.

    Args:
        seed: of the random numbers.
        arms: how many.
        recordings: of each, one a day.
        joints: of each arm.
        drift: arms whose Coulomb friction at joint 1 grows by a deviation a day.
        once: arms whose offset at joint 1 is 12 deviations off in the middle recording.
        level: of every quantity, in deviations.
        scatter: from one recording to the next, in deviations.
        found: whether recordings have findings.
    """
    rng = np.random.default_rng(seed)
    rows, told = [], {}
    for a in range(arms):
        for i in range(recordings):
            number = len(rows) + 1
            name = f"arm_{a:03}/day_{i:03}.csv"
            rows.append(
                Row(number, name, Path(name), f"arm {a:03}", None, 20000.0 + i, False, {"site": "lab"})
            )
            values: list[dict[str, Any]] = []
            for quantity, std in STDS.items():
                for joint in range(1, joints + 1) if quantity != "payload" else (None,):
                    own = std * rng.uniform(0.7, 1.4)
                    value = level * std + scatter * std * rng.normal() + own * rng.normal()
                    if (quantity, joint) == ("coulomb_friction", 1) and a in drift:
                        value += std * i
                    if (quantity, joint) == ("torque_offset", 1) and a in once and i == recordings // 2:
                        value += 12 * np.hypot(1, scatter) * std
                    values.append(
                        {
                            "quantity": quantity,
                            "joint": joint,
                            "value": value,
                            "std": own,
                            "unit": UNITS[quantity],
                        }
                    )
            findings = [finding(rng, joints)] if found and rng.random() < 0.5 else []
            told[number] = {
                "key": f"{number:032x}",
                "status": "diagnosed",
                "verdict": "explained" if findings else "consistent",
                "findings": findings,
                "off_by_noise": 5.0 * rng.random() if findings else 0.0,
                "estimates": values,
            }
    table = Table(Path("table.csv"), tuple(rows), ("site",), "day", True)
    return Fleet(table, told, len(rows), 1.0, "identified")


def finding(rng: np.random.Generator, joints: int) -> dict[str, Any]:
    """As `diagnosis.json` has it."""
    effect = str(
        rng.choice(["coulomb_friction", "stribeck_friction", "torque_ripple", "payload", "backlash"])
    )
    joint = int(rng.integers(1, joints + 1))
    return {
        "effect": effect,
        "family": "friction",
        "kind": "",
        "joints": [joint],
        "recordings": ["x.csv"],
        "intervals": None,
        "confidence": float(rng.uniform(0.5, 0.99)),
        "posterior": 0.9,
        "alternatives": [{"effect": "backlash", "confidence": 0.01}],
        "equation": "tau = c * sign(dq)",
        "parameters": [{"name": "c", "joint": joint, "value": 0.3, "std": 0.02, "unit": "N·m"}],
        "rms_torque": [0.3] * joints,
        "evidence_nats": 30.0,
        "summary": "Joint 1 has friction.",
    }
