"""voraus-AD: episodes of one parquet file, one below the other, with a category and a variant each.

Columns, categories and variants are those of the authors' `voraus_ad.py` (github.com/vorausrobotik/
voraus-ad-dataset at a91a86a). Positions are in rad, velocities in rad/s, torques in N m at the joint:
`torque_sensor_a` behind the gear, `motor_torque` before it.
"""

from pathlib import Path

import arms
import numpy as np
from recording import BadFile, Case, Recording, checked, known_content, truth

LABELS = ("sample", "anomaly", "category", "setting")
CHANNELS = {
    "q": "joint_position",
    "qd": "joint_velocity",
    "tau": "torque_sensor_a",
    "tau_motor": "motor_torque",
}
JOINTS = range(1, 7)
NORMAL, FRICTION, WEIGHT, COMMUTATION = 12, 0, 1, 10
TRAINING = 72  # the variant PRE_A, the authors' training set
REFERENCES, CONTROLS = 3, 5

_NAMES = (
    "A1_A A1_B A2_A A2_B A3_A A3_B A3_C A4_A A4_B A4_C A5_A A5_B A6_A A6_B A1_115G A1_231G A1_500G A2_500G "
    "A2_231G A2_115G A3_115G A3_231G A3_500G A4_500G A4_231G A4_115G A5_115G A5_231G A5_500G A6_500G A6_231G "
    "A6_115G LARGE_FULL SMALL_FULL SMALL_STRIPE SMALL_HANGING_FULL LARGE_HANGING_FULL SMALL_HANGING_STRIPE "
    "CONNECTOR_TOP CONNECTOR_SIDE LAN STRIPE FULL_A FULL_B CONVEYOR NO_VACUUM DEFECT_GRIPPER_DROP_CAN "
    "DROP_1400MS DROP_1100MS DROP_100MS DROP_200MS LOSE_200MS LOSE_300MS LOSE_PLACE_100MS DECREASE_95G "
    "DECREASE_165G EMPTY INCREASE_242G INCREASE_373G INCREASE_407G CABLE PICK A1_HIGH A1_MEDIUM A2_MEDIUM "
    "A3_MEDIUM A4_MEDIUM A5_MEDIUM A6_MEDIUM LOW_DAMPING MEDIUM_DAMPING HIGH_DAMPING PRE_A PRE_B BETWEEN_A "
    "BETWEEN_B BETWEEN_C"
)
VARIANTS = tuple(_NAMES.split())
"""By number, as the column `setting` has it: A1 is axis 1."""

CONTACT, BODY = ("contact",), ("load",)
MEANING = {
    0: ("axis friction", ("friction",), ()),
    1: ("a weight at an axis", BODY, ("inertial_parameters", "payload")),
    2: ("collision with foam", CONTACT, ("external_contact",)),
    3: ("collision with a cable", CONTACT, ("external_contact",)),
    4: ("collision with a carton", CONTACT, ("external_contact",)),
    5: ("the can is not gripped", BODY, ("payload_change", "payload")),
    6: ("the can is lost", BODY, ("payload_change", "payload")),
    7: ("a can of another weight", BODY, ("payload_change", "payload")),
    8: ("entangled in a cable", ("contact", "load"), ("external_contact", "joint_spring")),
    10: ("motor commutation", ("drive", "sensor", "friction", "unknown"), ()),
    11: ("the station wobbles", ("load", "contact", "unknown"), ("gravity_direction", "external_contact")),
}
"""Category -> title, families and names that are right. 9, a wrong position, is no fault of an arm."""


def files(data: Path) -> list[Path]:
    return sorted((data / "voraus").glob("*.parquet"))


def labels(path: Path) -> dict[int, dict]:
    """Of each episode: anomaly, category, setting."""
    table = _read(path, LABELS)
    samples, first, which = np.unique(table["sample"], return_index=True, return_inverse=True)
    columns = {name: table[name].astype(int) for name in LABELS[1:]}
    for name, values in columns.items():
        changes = values != values[first][which]
        if changes.any():
            raise BadFile(f"{path}: {name} changes within sample {table['sample'][changes][0]}")
    found = {}
    for sample, row in zip(samples, first, strict=True):
        entry = {name: int(values[row]) for name, values in columns.items()}
        if not 0 <= entry["category"] <= NORMAL or not 0 <= entry["setting"] < len(VARIANTS):
            raise BadFile(f"{path}: sample {sample} has a category or setting that upstream does not list")
        found[int(sample)] = entry
    return found


def load(path: Path, samples) -> dict[int, Recording]:
    """These episodes."""
    samples = [int(s) for s in samples]
    source = known_content(path, "voraus")
    names = [f"{column}_{j}" for column in CHANNELS.values() for j in JOINTS]
    table = _read(path, ("time", "sample", *names), samples)
    found = {}
    for sample in samples:
        rows = table["sample"] == sample
        if not rows.any():
            raise BadFile(f"{path}: there is no sample {sample}")
        channels = {
            what: np.stack([table[f"{column}_{j}"][rows] for j in JOINTS], 1)
            for what, column in CHANNELS.items()
        }
        for what, most in (("q", 2 * np.pi + 0.1), ("qd", 20.0)):
            if np.abs(channels[what]).max() > most:
                raise BadFile(f"{path}: {CHANNELS[what]} of sample {sample} exceeds {most:.3g}: not rad")
        entry = {**source, "sample": sample}
        found[sample] = checked(path, f"sample {sample}", table["time"][rows], channels, entry)
    return found


def _read(path: Path, names, samples=None) -> dict[str, np.ndarray]:
    import pyarrow
    import pyarrow.parquet as parquet

    try:
        here = set(parquet.read_schema(path).names)
        missing = [name for name in names if name not in here]
        if missing:
            raise BadFile(f"{path}: has no column {missing[0]!r}, which voraus-AD has")
        only = None if samples is None else [("sample", "in", samples)]
        table = parquet.read_table(path, columns=list(names), filters=only)
    except (pyarrow.ArrowException, OSError) as error:
        raise BadFile(f"{path}: is no parquet file: {str(error).splitlines()[0]}") from error
    return {name: np.asarray(table[name]) for name in names}


def chosen(found: dict[int, dict], drives_only: bool) -> tuple[list[int], list[int], list[int]]:
    """(references, controls, anomalous): the first of each category and variant."""
    normal = [s for s, e in found.items() if e["category"] == NORMAL]
    references = [s for s in normal if found[s]["setting"] == TRAINING][:REFERENCES]
    others = [s for s in normal if s not in references]
    controls = sorted(others, key=lambda s: found[s]["setting"] == TRAINING)[:CONTROLS]
    first: dict = {}
    for sample, entry in found.items():
        judged = (FRICTION, COMMUTATION) if drives_only else MEANING
        if entry["anomaly"] and entry["category"] in judged:
            first.setdefault((entry["category"], entry["setting"]), sample)
    return references, controls, list(first.values())


def cases(data: Path, yu: str | None = None):
    """Of every file here. Without the arm's own MJCF only what is about the drives."""
    model = yu or arms.stand_in()
    common = {"arguments": ["--knowledge", "rough"], "side": None if yu else "drive"}
    for path in files(data):
        found = labels(path)
        references, controls, anomalous = chosen(found, drives_only=yu is None)
        if not references:
            raise BadFile(f"{path}: holds no normal episode of variant PRE_A to compare with")
        logs = load(path, [*references, *controls, *anomalous])
        before = tuple(logs[s] for s in references)
        for sample in [*controls, *anomalous]:
            entry = found[sample]
            variant = VARIANTS[entry["setting"]]
            if sample in controls:
                kind, title, families, effects, joints = "control", "normal episode", (), (), None
            else:
                kind = "fault"
                title, families, effects = MEANING[entry["category"]]
                by_axis = entry["category"] in (FRICTION, WEIGHT, COMMUTATION)
                joints = [int(variant[1])] if by_axis else None
            told = truth(kind, f"{title} ({variant})", families, effects, joints, **common)
            yield Case(f"voraus_{kind}_{sample:04d}", logs[sample], model, told, before)
