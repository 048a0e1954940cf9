"""Every stage's result in sentences, tables and figures: once, for the terminal and for the page."""

import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from .report import Figure, Section, Table, estimate, number


def of(result: Any) -> Sequence[Section]:
    """The sections that say what a stage found."""
    return _SUMMARIES[type(result).__name__](result)


def inspections(result: Any) -> Sequence[Section]:
    """One section a recording."""
    return [inspection(one) for one in result.recordings]


def inspection(one: Any) -> Section:
    """Facts and verdicts of one recording; a column a joint, so that it fits a terminal."""
    heads, rows = one.table()
    columns = [heads[0], *(row[0] for row in rows)]
    quantities = [[head, *(row[k] for row in rows)] for k, head in enumerate(heads) if k]
    return Section(f"Recording {one.name}", one.lines(), [Table(columns, quantities)])


def conversion(made: Any) -> Sequence[Section]:
    """What was read of a log, and where it was written."""
    log = made.recording
    lines = [f"{log.samples} samples of {log.dof} joints, written to {made.path}"]
    lines += log.origin.lines() if log.origin else []
    lines += [f"{what}: {count}" for what, count in log.repairs.items()]
    return [Section(f"Recording {log.name}", [*lines, *log.notes])]


def identification(found: Any) -> Sequence[Section]:
    """Coefficients with their deviations, friction, and what is left unexplained."""
    names = found.joint_names or [f"joint {i + 1}" for i in range(found.dof)]
    unit = _unit(found.model)
    with_friction = "" if found.friction is None else " with friction columns"
    sentences = [
        f"{len(found.beta)} base parameters (rank {found.rank}, condition number{with_friction} "
        f"{number(found.condition_number)}) leave {number(found.relative_error_percent)} % of the data "
        "unexplained."
    ]
    if found.cross_validated_relative_error_percent is not None:
        sentences.append(
            f"On motion it had not seen, nor any repeat of it: "
            f"{number(found.cross_validated_relative_error_percent)} %."
        )
    sentences += _repairs(found.repairs) + list(found.notes)
    tables = [_coefficients(found)]
    if found.friction is not None and found.friction.parameters:
        tables.append(_friction(found.friction, names, unit))
    if found.rmse is not None:
        tables.append(
            by_joint(
                f"Torque error at each joint [{unit('N m')}]",
                names,
                {"fitted": found.rmse, "held out": found.cross_validated_rmse, "noise floor": found.noise},
            )
        )
    return [Section("Identification", sentences, tables)]


def _coefficients(found: Any) -> Table:
    rows = []
    for row in found.coefficients:
        std = row.get("std")
        share = "–"
        if std is not None and row["value"] != 0:
            percent = 100 * std / abs(row["value"])
            share = f"{percent:.0f} %" if 10 <= percent < 1e6 else f"{percent:.2g} %"
        mark = "" if row["reliable"] else "unreliable"
        rows.append([row["expression"], f"{row['value']:.6g}", number(std, 2), share, mark])
    return Table(["coefficient", "value", "std", "std/value", ""], rows, "Base parameters [kg m², kg m]")


def _unit(arm: Any) -> Callable[[str], str]:
    """The unit of a number at an arm's joints, given that where they turn; that one where no arm is known."""
    return (lambda turning: turning) if arm is None else arm.unit


def _friction(friction: Any, names: Sequence[str], unit: Callable[[str], str]) -> Table:
    from .friction import UNITS

    columns = ["joint"]
    cells: list[list[str]] = [[name] for name in names]
    for parameter, values in friction.parameters.items():
        columns.append(f"{parameter} [{unit(UNITS[parameter])}]")
        deviations = None if friction.std is None else friction.std.get(parameter)
        for i, value in enumerate(values):
            spread = "" if deviations is None or not np.isfinite(deviations[i]) else f" ± {deviations[i]:.2g}"
            cells[i].append(f"{value:.4g}{spread}")
    return Table(columns, cells, f"Friction beyond the model: {friction.model}")


def retrieval(links: Any) -> Sequence[Section]:
    """Links that could be built, and what torque cannot tell about them."""
    document = links.to_json()
    best = document["objective"]
    sentences = [
        *_explained(document),
        f"Chosen among what {document['starts']} random starts led to, these links miss the coefficients by "
        f"phi = {best:.6g}"
        f"{' (weighed by torque, in variances of a sample)' if document['weighting'] == 'torque' else ''}; "
        f"largest violation of any constraint {document['max_violation']:.2g}; "
        f"total mass {document['total_mass']:.2f} kg.",
    ]
    if document["lower_bound"] is not None:
        sentences.append(
            f"No feasible links can do better than {document['lower_bound']:.6g} (convex certificate)."
        )
    seconds = document["seconds"]
    sentences.append(f"{seconds['compile']:.1f} s to compile, {seconds['run']:.1f} s to run.")
    rows = [
        [
            link["name"],
            f"{link['mass']:.4f}",
            *(f"{x:.4f}" for x in link["com"]),
            *(f"{x:.5f}" for x in link["inertia"]),
        ]
        for link in document["links"]
    ]
    mass = {name: pair for name, pair in document["spread"].items() if name.startswith("m")}
    open_ = [[name, f"{low:.3g}", f"{high:.3g}"] for name, (low, high) in mass.items()]
    sentences.append(
        f"{document['as_good']} starts are as good as the best (within 1 %). What differs between them is what "
        "torque cannot tell: do not read a single mass as measured. The complete list stands in retrieval.json."
    )
    sentences += [f"Nobody would build this: {what}." for what in document["warnings"]]
    sentences += document["notes"]
    figures = []
    if links.solutions is not None:
        figures.append(outcome_figure(links.solutions.objective, document["lower_bound"]))
    heads = ["link", "m kg", "cx m", "cy m", "cz m", "Ixx", "Iyy", "Izz", "Ixy", "Ixz", "Iyz"]
    return [
        Section(
            "Retrieval of feasible links",
            sentences,
            [
                Table(
                    heads,
                    rows,
                    "In each link's modified Denavit-Hartenberg frame; inertia about the com [kg m²]",
                ),
                Table(
                    ["mass", "least kg", "most kg"],
                    open_,
                    "Over these links and the starts that are as good as the best",
                ),
                *_errors(document, _unit(links.model)("N m")),
            ],
            figures,
        )
    ]


def _explained(document: Mapping[str, Any]) -> list[str]:
    """How much of the recorded torque the links leave."""
    if document["relative_error_percent"] is None:
        return []
    unseen = document["cross_validated_relative_error_percent"]
    return [
        "Of the torque that they were identified from, these links and their friction leave "
        f"{number(document['relative_error_percent'])} % unexplained"
        + (
            "."
            if unseen is None
            else f"; links found without a block of it, {number(unseen)} % of that block."
        )
    ]


def _errors(document: Mapping[str, Any], force: str) -> list[Table]:
    if not document["rmse"]:
        return []
    columns = {"fitted": document["rmse"], "held out": document["cross_validated_rmse"]}
    names = [link["name"] for link in document["links"]]
    return [by_joint(f"Torque error at the joint of each link [{force}]", names, columns)]


def export(written: Any) -> Sequence[Section]:
    """What an export changed."""
    sentences = [f"Wrote {written.path}.", *written.warnings]
    rows = [
        [
            f"{change.file}:{change.line}",
            change.element,
            change.attribute,
            _short(change.old) or "–",
            _short(change.new) or "–",
        ]
        for change in written.changes
    ]
    tables = [Table(["where", "element", "attribute", "was", "is"], rows)] if rows else []
    return [Section("Export", sentences, tables)]


def _short(value: str | None) -> str | None:
    """The numbers of an attribute with six digits; the file holds them whole."""
    if value is None:
        return None
    return re.sub(r"-?\d+\.\d+(?:[eE][-+]?\d+)?", lambda found: f"{float(found[0]):.6g}", value)


def validation(checked: Any) -> Sequence[Section]:
    """Agreement of three inverse dynamics, torque error and tracking."""
    document = checked.to_json()
    unit = checked.arm.unit
    force = unit("N m")
    apart = f"kernel against MuJoCo {number(document['kernel_vs_mujoco'], 2)} {force}"
    if document["mjx_vs_mujoco"] is not None:
        apart += f", MJX against MuJoCo {number(document['mjx_vs_mujoco'], 2)} {force}"
    sentences = [
        f"Largest difference of inverse dynamics on the recorded states: {apart}.",
        f"Torque error on the recording: {number(document['relative_error_percent'])} %.",
        *document.get("notes", []),
    ]
    columns: dict[str, Any] = {f"torque rmse [{force}]": document["rmse"]}
    for engine, name in (("mjx", "MJX"), ("mujoco", "MuJoCo")):
        if document["rollout"][engine] is not None:
            columns[f"tracking in {name}, rmse [{unit('rad')}]"] = document["rollout"][engine]["rmse_rad"]
    names = checked.joints
    labels = [f"{name} [{unit('N m', j)}]" for j, name in enumerate(names)]
    figures = [
        torque_figure(
            one.times,
            {"measured": one.measured, "model": one.modelled},
            labels,
            f"{one.name}: measured torque and the model's, both below {checked.cutoff:g} Hz, and what is left",
        )
        for one in checked.torque
    ]
    return [Section("Validation", sentences, [by_joint("", names, columns)], figures)]


def diagnosis(found: Any) -> Sequence[Section]:
    """Verdict, each finding with its numbers, and the fit before and after; the page has more."""
    document = found.to_json()
    names, force = found.corrected.arm.joint_names, found.corrected.arm.unit("N m")
    errors = by_joint(
        f"Torque error in the band of the diagnosis [{force}]", names, fit_columns(document["fit"])
    )
    sections = [Section("Verdict", found.lines(), [errors])]
    sections += [_finding(i, one, names, force) for i, one in enumerate(document["findings"])]
    notes = [*document["notes"]]
    if document["next_experiment"] is not None:
        notes.append(f"{document['next_experiment']['file']} holds the motion that would decide.")
    return [*sections, Section("Notes", notes)] if notes else sections


def _finding(place: int, one: Mapping[str, Any], names: Sequence[str], force: str) -> Section:
    sentences = [one["summary"], f"Equation: {one['equation']}", f"Confidence: {one['confidence']:.2f}."]
    if one["intervals"]:
        spans = ", ".join(f"{a:.2f} to {b:.2f} s" for a, b in one["intervals"])
        sentences.append(f"In {', '.join(one['recordings'])}, from {spans}.")
    if one["alternatives"]:
        rivals = ", ".join(f"{a['effect']} ({a['confidence']:.2f})" for a in one["alternatives"])
        sentences.append(f"What else it could be: {rivals}.")
    rows = [
        [
            p["name"],
            number(p["joint"]),
            estimate(p["value"], p.get("std")),
            number(p.get("std"), 2),
            p["unit"],
        ]
        for p in one["parameters"]
    ]
    tables = [Table(["parameter", "joint", "value", "std", "unit"], rows)] if rows else []
    tables.append(by_joint(f"Torque that it explains, rms [{force}]", names, {"rms": one["rms_torque"]}))
    return Section(f"{place + 1}. {one['effect'].replace('_', ' ')}", sentences, tables)


def prediction(made: Any) -> Sequence[Section]:
    """Where the torque was written and, where torque was recorded, how far the two are apart."""
    sentences = [f"{made.rows} rows of torque in {made.path}."]
    columns: dict[str, Any] = {"rms": made.rms}
    if made.rmse is not None:
        share = made.relative_error_percent
        sentences.append(
            "The recorded torque is zero throughout, so that there is no relative error."
            if share is None
            else f"Error against the recorded torque, its noise included: {number(share)} %."
        )
        columns["error, rms"] = made.rmse
    if made.rmse_motor is not None:
        columns["error of tau_motor, rms"] = made.rmse_motor
    caption = f"Predicted torque [{made.unit}]"
    return [Section("Prediction", sentences, [by_joint(caption, made.joints, columns)])]


def by_joint(caption: str, names: Sequence[str], columns: Mapping[str, Any]) -> Table:
    """A row a joint; columns without values are left out."""
    present = {head: values for head, values in columns.items() if values is not None and len(values)}
    rows = [[name, *(number(values[i]) for values in present.values())] for i, name in enumerate(names)]
    return Table(["joint", *present], rows, caption)


def fit_columns(fit: Mapping[str, Any]) -> dict[str, Any]:
    """`fit` of diagnosis.json as columns of a table."""
    return {
        "before": fit["rmse_before"],
        "after": fit["rmse_after"],
        "held out, before": fit["held_out_rmse_before"],
        "held out, after": fit["held_out_rmse_after"],
        "noise floor": fit["noise_floor"],
    }


def _repairs(repairs: Mapping[str, int]) -> list[str]:
    return (
        ["In the data: " + "; ".join(f"{what}: {count}" for what, count in repairs.items()) + "."]
        if repairs
        else []
    )


def torque_figure(
    time: Float[np.ndarray, " time"],
    curves: Mapping[str, Float[np.ndarray, "time dof"]],
    labels: Sequence[str],
    caption: str,
) -> Figure:
    """Torques of every joint over time, and beside each by how much the first is larger than the others."""

    def draw(canvas: Any) -> None:
        axes = canvas.subplots(len(labels), 2, sharex=True, squeeze=False, width_ratios=[2, 1])
        thin = max(1, len(time) // 1500)
        measured = next(iter(curves.values()))
        for j, named in enumerate(labels):
            for k, (label, values) in enumerate(curves.items()):
                axes[j, 0].plot(time[::thin], values[::thin, j], label=label, color=f"C{k}")
                if k:
                    axes[j, 1].plot(time[::thin], (measured - values)[::thin, j], color=f"C{k}", label=label)
            axes[j, 0].set_ylabel(named)
        axes[0, 0].legend(loc="upper right", ncols=len(curves))
        axes[0, 0].set_title("torque")
        axes[0, 1].set_title("what is left")
        for axis in axes[-1]:
            axis.set_xlabel("time [s]")

    return Figure(draw, caption, size=(10.0, 1.5 * len(labels)))


def outcome_figure(objective: Float[np.ndarray, " start"], lower_bound: float | None) -> Figure:
    """Objective of every start, sorted: how many reach the optimum."""

    def draw(canvas: Any) -> None:
        axis = canvas.subplots()
        share = np.linspace(0, 100, len(objective))
        axis.semilogy(share, np.sort(objective), label="starts, sorted")
        if lower_bound is not None:
            axis.axhline(lower_bound, color="C3", linestyle="--", label="certified lower bound")
        axis.set(xlabel="share of starts [%]", ylabel="objective")
        axis.legend()

    return Figure(draw, "Objective of every random start", size=(7.0, 3.0))


def payload(found: Any) -> Sequence[Section]:
    """The body at the flange, and what robots take as its numbers."""
    rows = [_told("mass [kg]", found.mass, 0)]
    if found.com is not None:
        rows += [_told(f"centre of mass {axis} [m]", found.com, k) for k, axis in enumerate("xyz")]
        names = ("xx", "yy", "zz", "xy", "xz", "yz")
        rows += [_told(f"inertia {name} [kg·m²]", found.inertia, k) for k, name in enumerate(names)]
    sections = [
        Section("Payload", found.sentences, [Table(["", "value", "from", "to"], rows, "95 % intervals")])
    ]
    if (takes := found.commands()) is not None:
        load, note = takes["franka"]["setLoad"], takes["franka"]["note"]
        inside = [f"Numbers in the frame of {takes['frame']!r}; {note}."]
        if takes["stand_ins"]:
            inside.append(f"Not told by the motion, a stand-in: {', '.join(takes['stand_ins'])}.")
        inside += [
            f"Franka Desk / setLoad: mass {load['load_mass']}, F_x_Cload {load['F_x_Cload']}, "
            f"load_inertia {load['load_inertia']}",
            f"UR: {takes['ur']['script']} ({takes['ur']['note']})",
            f"MJCF, in the body {found.frame.body!r}: {found.snippet.strip()}",
        ]
        sections.append(Section("What controllers and MuJoCo take", inside))
    if found.notes:
        sections.append(Section("Notes", found.notes))
    return sections


def excitation(found: Any) -> Sequence[Section]:
    """What the motion tells, what it takes of the limits, and the files."""
    document = found.to_json()
    conditions, check, names = document["condition_number"], document["check"], document["joints"]
    unit = found.arm.unit
    sentences = [
        f"A periodic motion of {found.seconds:g} s from rest to rest; condition number of the regressor "
        f"{number(conditions['base'], 3)}, with friction columns {number(conditions['with_friction'], 3)} "
        f"(weighted by torque noise {number(conditions['base_weighted'], 3)} and "
        f"{number(conditions['with_friction_weighted'], 3)}).",
    ]
    if (closest := check["closest"])["distance"] is not None:
        sentences.append(
            f"MuJoCo's smallest distance along it is {closest['distance']:.3f} m, between {closest['pair']} at "
            f"{closest['time']:.2f} s."
        )
    sentences += [f"Limit of {name}: {text}." for name, text in document["limits"]["sources"].items()]
    limits = document["limits"]
    taken = {
        "lowest": check["low"],
        "highest": check["high"],
        **{
            f"{name} %": [
                None if most is None else 100 * value / most
                for value, most in zip(check[name], limits[name], strict=True)
            ]
            for name in ("velocity", "acceleration", "jerk", "torque")
        },
    }
    rows = [
        [row["expression"], f"{row['nominal']:.4g}", number(row.get("std_before"), 2), number(row["std"], 2)]
        for row in document["parameters"]
    ]
    friction = {
        f"{name}": [row["std"][name] for row in document["friction"]] for name in found.precision.friction
    }
    tables = [
        by_joint("Positions reached, and shares of the limits that the motion takes", names, taken),
        Table(
            ["coefficient", "nominal", "std before", "std"],
            rows,
            "Standard deviation that a recording would give [kg m², kg m]",
        ),
        by_joint(
            f"The same of friction [{unit('N m s/rad')}, {unit('N m')}, {unit('N m')}]", names, friction
        ),
    ]
    sentences.append(f"Files: {', '.join(document['files'])}.")
    return [Section("Excitation", [*sentences, *document["notes"]], tables)]


def ensemble(found: Any) -> Sequence[Section]:
    """How members differ, and whether the chains that they were drawn by agree."""
    document, unit = found.to_json(), found.arm.unit
    mixing, total = document["mixing"], document["total_mass"]
    between = lambda low, middle, high: f"{middle:.4g} ({low:.4g} to {high:.4g})"
    sentences = [
        f"{document['count']} members, each of which could be built; {mixing['chains']} chains of "
        f"{mixing['sweeps']} sweeps, R-hat {mixing['rhat']:.3f} at most, {mixing['effective']:.0f} independent "
        f"draws at least; {document['seconds']:.1f} s.",
        f"Total mass {between(*total)} kg. In brackets 5 % and 95 % of the members.",
    ]
    rows = [
        [link["name"], between(*link["mass"]), *(between(*pair) for pair in link["com"])]
        for link in document["links"]
    ]
    kinds = document["friction"]["names"]
    tables = [Table(["link", "m kg", "cx m", "cy m", "cz m"], rows, "Links: what the recordings leave open")]
    effects = document["effect_coefficients"]
    if kinds:
        rows = [[joint["name"], *(between(*joint[kind]) for kind in kinds)] for joint in document["joints"]]
        beyond = "Friction beyond the model" + (" and what was found" if effects else "")
        tables.append(Table(["joint", *kinds], rows, f"{beyond} [{unit('N m s/rad')}, {unit('N m')}]"))
    if effects:
        rows = [
            [
                one["effect"].replace("_", " "),
                ", ".join(map(str, one["joints"])),
                f"{one['name']} {one['unit']}",
                between(*one["value"]),
            ]
            for one in effects
        ]
        tables.append(Table(["effect", "joints", "coefficient", "value"], rows, "What the diagnosis found"))
    return [Section("Ensemble", [*sentences, *document["notes"]], tables)]


def _told(name: str, numbers: Any, k: int) -> list[str]:
    """A row: a number and its interval, or the range of what it can be."""
    low, high = numbers.interval[k]
    value = f"{numbers.value[k]:.5g}" if numbers.told[k] else "not told"
    return [name, value, f"{low:.4g}", f"{high:.4g}"]


_SUMMARIES: Mapping[str, Callable[[Any], Sequence[Section]]] = {
    "Inspections": inspections,
    "Identification": identification,
    "Retrieval": retrieval,
    "Export": export,
    "Validation": validation,
    "Diagnosis": diagnosis,
    "AtRest": diagnosis,
    "Misread": diagnosis,
    "TwoSided": diagnosis,
    "Prediction": prediction,
    "PayloadEstimate": payload,
    "Conversion": conversion,
    "Excitation": excitation,
    "Fleet": lambda result: result.sections(),
    "Ensemble": ensemble,
    "Comparison": lambda found: found.sections(),
    "Rehearsal": lambda found: found.sections(),
    "Demonstration": lambda result: result.sections,
}
