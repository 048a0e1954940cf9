"""The command `jaxpanda`: tyro over one dataclass a stage.

JAX takes seconds to import, so this module and `jaxpanda --help` do without; each command imports what it
needs when it runs.
"""

import contextlib
import dataclasses
import difflib
import io
import os
import re
import shutil
import signal
import sys
import textwrap
import threading
import traceback
import typing
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from .arms.model_file import WHOLE, Part
from .convention import PLAIN, Convention
from .errors import InputError, OutputError, RankError, printable
from .reading import Reading

# Before numpy is imported: its matrices are small here, and threads on them cost more than they save (a
# diagnosis takes half the time without).
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


_Read = Annotated[Reading, tyro.conf.arg(name="")]
_Convention = Annotated[Convention, tyro.conf.arg(name="")]
"""Options of every command that reads recordings: which part of a log is read, then what its columns mean."""
_Part = Annotated[Part, tyro.conf.arg(name="")]
"""Options of every command that takes a model: which arm of it is meant."""


@dataclasses.dataclass(frozen=True)
class Demo:
    """The whole chain: identify, retrieve, export, validate; on its own virtual recording, or on yours."""

    out: Path
    """Folder for panda.xml, report.html and what the other commands leave."""
    recording: tuple[Path, ...] = ()
    """Recordings (any log that docs/files.md lists); without any, a virtual Panda is recorded."""
    model: Path | None = None
    """The simulation as you have it (MJCF or URDF); without it, the project's own Panda."""
    starts: int = 2048
    """Random starts of the retrieval."""
    seed: int = 0
    read: _Read = dataclasses.field(default_factory=Reading)
    convention: _Convention = PLAIN
    part: _Part = WHOLE
    json: bool = False
    """Print the main result as one JSON document and nothing else."""

    def run(self) -> Any:
        from .demo import demonstrate

        return demonstrate(
            self.out,
            recordings=self.recording,
            model=self.part.of_any(self.model),
            starts=self.starts,
            seed=self.seed,
            reading=self.read,
            convention=self.convention,
        )


@dataclasses.dataclass(frozen=True)
class Inspect:
    """What is in a recording: channels, rate, gaps, units, signs, noise, and what it can identify."""

    file: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Recordings to look at."""
    recording: tuple[Path, ...] = ()
    """The same, as an option."""
    model: Path | None = None
    """The arm (MJCF or URDF); without it, the project's own Panda."""
    read: _Read = dataclasses.field(default_factory=Reading)
    convention: _Convention = PLAIN
    part: _Part = WHOLE
    json: bool = False
    """Print the main result as one JSON document and nothing else."""

    def run(self) -> Any:
        from . import pipeline

        files = (*self.file, *self.recording)
        if not files:
            raise InputError("inspect needs a FILE; see jaxpanda inspect --help")
        return pipeline.inspect_files(files, self.part.of_any(self.model), self.read, self.convention)


@dataclasses.dataclass(frozen=True)
class Identify:
    """Base parameters and friction, from recordings or from samples of M(q), g(q)."""

    out: Path
    """Folder for identification.json."""
    recording: tuple[Path, ...] = ()
    """Recordings with torque."""
    mass_gravity: Path | None = None
    """Table of M(q), g(q) instead of recordings: .npz with q (N, n), M (N, n, n), g (N, n)."""
    model: Path | None = None
    """The arm (MJCF or URDF); without it, the project's own Panda."""
    method: Literal["trajectory", "one_step"] = "trajectory"
    """Classical least squares, or feasible parameters straight from torque."""
    friction: Literal["coulomb_viscous_offset", "coulomb_viscous", "viscous", "sigmoid", "none"] = (
        "coulomb_viscous_offset"
    )
    weighting: Literal["joint", "none"] = "joint"
    """Weigh each joint by its residual, or all alike."""
    cutoff: float = 5.0
    """Of the zero-phase low-pass on regressor and torque alike [Hz]."""
    folds: int = 5
    """Of the phase-blocked cross-validation."""
    read: _Read = dataclasses.field(default_factory=Reading)
    convention: _Convention = PLAIN
    part: _Part = WHOLE
    json: bool = False
    """Print the main result as one JSON document and nothing else."""

    def run(self) -> Any:
        from . import pipeline

        return pipeline.identify_files(
            self.out,
            self.recording,
            self.mass_gravity,
            self.part.of_any(self.model),
            method=self.method,
            friction=self.friction,
            weighting=self.weighting,
            cutoff=self.cutoff,
            folds=self.folds,
            reading=self.read,
            convention=self.convention,
        )


@dataclasses.dataclass(frozen=True)
class Retrieve:
    """Physically feasible link parameters behind identified coefficients, from many random starts."""

    identification: Path
    """identification.json, or a table of coefficients with the same fields."""
    out: Path
    """Folder for retrieval.json and starts.npz."""
    starts: int = 2048
    """Random starts."""
    seed: int = 0
    bounds: Path | None = None
    """CSV with name, lower, upper for each link parameter; without it, the published bounds of the Panda."""
    model: Path | None = None
    """The arm (MJCF or URDF) to set bounds around and to stay near to; without it, the one that was
    identified."""
    weighting: Literal["auto", "torque", "none"] = "auto"
    """Each direction of the coefficients by the torque that it moved, or the reliable ones alike, as the paper
    has it. Unless told, by torque where recordings were identified."""
    processes: str = ""
    """Share the starts with other processes, here or on other machines: RANK/COUNT@HOST:PORT in each of them,
    with ranks from 0 and HOST:PORT free on the machine of rank 0, all started within 10 s; or `auto` under
    Slurm. Every process spreads its share over all its devices; rank 0 alone writes and prints."""
    part: _Part = WHOLE
    json: bool = False
    """Print the main result as one JSON document and nothing else."""

    def run(self) -> Any:
        from . import pipeline, ranks, session

        session.spread_over_cores()
        with ranks.joined(self.processes) as together:
            return pipeline.retrieve_files(
                self.out,
                self.identification,
                self.bounds,
                self.part.of_any(self.model),
                weighting=self.weighting,
                starts=self.starts,
                seed=self.seed,
                ranks=together,
            )


@dataclasses.dataclass(frozen=True)
class Export:
    """Write retrieved parameters into an MJCF, touching only what changes."""

    retrieval: Path
    """Folder that `retrieve` wrote."""
    out: Path
    """The MJCF to write; a .urdf suffix writes URDF instead."""
    model: Path | None = None
    """Your MJCF or URDF, kept as it is but for the parameters; without it, the one that was identified."""
    part: _Part = WHOLE
    json: bool = False
    """Print the main result as one JSON document and nothing else."""

    def run(self) -> Any:
        from . import pipeline
        from .retrieval import Retrieval

        return pipeline.to_mjcf(Retrieval.load(self.retrieval), self.out, self.part.of_any(self.model))


@dataclasses.dataclass(frozen=True)
class Validate:
    """Check an MJCF in MuJoCo and MJX, and against recordings."""

    model: Path
    """The MJCF or URDF to check."""
    recording: tuple[Path, ...]
    """Recordings with torque."""
    out: Path
    """Folder for validation.json."""
    cutoff: float = 5.0
    """Of the zero-phase low-pass on both torques [Hz]."""
    no_mjx: bool = False
    """Leave MJX out, which takes most of the time on a CPU; roll-outs are then C MuJoCo's alone."""
    read: _Read = dataclasses.field(default_factory=Reading)
    convention: _Convention = PLAIN
    part: _Part = WHOLE
    json: bool = False
    """Print the main result as one JSON document and nothing else."""

    def run(self) -> Any:
        from . import pipeline

        return pipeline.validate_files(
            self.out,
            self.part.of(self.model),
            self.recording,
            cutoff=self.cutoff,
            in_mjx=not self.no_mjx,
            reading=self.read,
            convention=self.convention,
        )


@dataclasses.dataclass(frozen=True)
class Diagnose:
    """Which physics the simulation is missing: located, named, modelled, and shown to help."""

    recording: tuple[Path, ...]
    """Recordings with torque."""
    out: Path
    """Folder for diagnosis.json, report.html and corrected.xml."""
    model: Path | None = None
    """The simulation as you have it (MJCF or URDF); without it, the project's own Panda."""
    reference: tuple[Path, ...] = ()
    """Recordings of the same arm from when nothing was wrong."""
    knowledge: Literal["exact", "identified", "rough", "unknown"] = "identified"
    """How well the numbers in the model are known: as they are, by an identification, as a data sheet has them,
    or not at all."""
    read: _Read = dataclasses.field(default_factory=Reading)
    convention: _Convention = PLAIN
    part: _Part = WHOLE
    json: bool = False
    """Print the main result as one JSON document and nothing else."""

    def run(self) -> Any:
        from . import diagnosis

        return diagnosis.diagnose_files(
            self.out,
            self.part.of_any(self.model),
            self.recording,
            self.reference,
            self.knowledge,
            reading=self.read,
            convention=self.convention,
        )


@dataclasses.dataclass(frozen=True)
class Predict:
    """Torque of a motion, from the corrected model."""

    diagnosis: Path
    """Folder that `diagnose` wrote."""
    recording: Path
    """The motion: a recording, with or without torque."""
    out: Path
    """The CSV to write."""
    read: _Read = dataclasses.field(default_factory=Reading)
    convention: _Convention = PLAIN
    json: bool = False
    """Print the main result as one JSON document and nothing else."""

    def run(self) -> Any:
        from . import prediction

        return prediction.predict_files(
            self.diagnosis, self.recording, self.out, reading=self.read, convention=self.convention
        )


@dataclasses.dataclass(frozen=True)
class Payload:
    """The body on the flange, from recordings without and with it: mass, centre of mass, inertia."""

    without: tuple[Path, ...]
    """Recordings of the arm without the body."""
    with_: Annotated[tuple[Path, ...], tyro.conf.arg(name="with")]
    """Recordings of the same arm with it; other motions will do."""
    out: Path
    """Folder for payload.json, payload.xml and with_payload.xml."""
    model: Path | None = None
    """The simulation as you have it (MJCF or URDF); without it, the project's own Panda."""
    frame: str = ""
    """Body or site of the MJCF, fixed to the last link, in which to tell the result; without it, one that is
    called a flange, else the last link's body."""
    torque_scale_std: float = 0.0
    """By which share all torques may be off together, as 0.1 for motor currents times gains known to 10 %."""
    read: _Read = dataclasses.field(default_factory=Reading)
    convention: _Convention = PLAIN
    part: _Part = WHOLE
    json: bool = False
    """Print the main result as one JSON document and nothing else."""

    def run(self) -> Any:
        from . import payload

        return payload.payload_files(
            self.out,
            self.part.of_any(self.model),
            self.without,
            self.with_,
            frame=self.frame,
            torque_scale_std=self.torque_scale_std,
            reading=self.read,
            convention=self.convention,
        )


@dataclasses.dataclass(frozen=True)
class Convert:
    """Write a log of any kind as the canonical CSV."""

    file: tyro.conf.Positional[Path]
    """The log: file or folder."""
    out: Path
    """The CSV to write; .csv.gz, .npz and .parquet too, by the name."""
    read: _Read = dataclasses.field(default_factory=Reading)
    convention: _Convention = PLAIN
    json: bool = False
    """Print the main result as one JSON document and nothing else."""

    def run(self) -> Any:
        from . import pipeline

        return pipeline.convert_file(self.file, self.out, self.read, self.convention)


@dataclasses.dataclass(frozen=True)
class Excite:
    """The motion to record: it tells base parameters and friction best, within limits and without collision."""

    out: Path
    """Folder for excitation.json, excitation.csv, joint_trajectory.yaml; for six joints excitation.script."""
    model: Path | None = None
    """The arm, perhaps in its scene (MJCF or URDF); without it, the project's own Panda."""
    seconds: float = 20.0
    """Length of the motion, which starts and ends at rest and can be repeated."""
    identification: Path | None = None
    """What an earlier `identify` knows: the new motion asks for the rest."""
    criterion: Literal["logdet", "condition"] = "logdet"
    """The parameters' standard deviations, or the condition number; joints weighted by their torque noise."""
    rate: float = 1000.0
    """Of excitation.csv [Hz]."""
    highest_frequency: float = 0.5
    """Of the motion [Hz]."""
    velocity: tuple[float, ...] = ()
    """Limits, one for all joints or one a joint [rad/s]; without them what is published for the arm, or a guess
    that is told. Ranges are the model's."""
    acceleration: tuple[float, ...] = ()
    """[rad/s²]"""
    jerk: tuple[float, ...] = ()
    """[rad/s³]"""
    torque: tuple[float, ...] = ()
    """[N m]; without it the actuators'."""
    torque_noise: tuple[float, ...] = ()
    """Rms of what a fit leaves of torque below 5 Hz, one for all joints or one a joint [N m]."""
    share: float = 0.9
    """Of the limits that the motion may use."""
    margin: float = 0.05
    """To the ends of the joints' ranges [rad, m]."""
    clearance: float = 0.05
    """To keep from itself, the floor and the scene [m]."""
    floor: float = 0.0
    """Height of the floor, where the model has none [m]."""
    no_floor: bool = False
    """There is no floor."""
    no_collisions: bool = False
    """Do not look for collisions."""
    starts: int = 8
    """Random motions to start from."""
    seed: int = 0
    part: _Part = WHOLE
    json: bool = False
    """Print the main result as one JSON document and nothing else."""

    def run(self) -> Any:
        from . import excitation

        limits = {name: getattr(self, name) for name in ("velocity", "acceleration", "jerk", "torque")}
        return excitation.excite_files(
            self.out,
            self.part.of_any(self.model),
            limits,
            seconds=self.seconds,
            rate=self.rate,
            highest_frequency=self.highest_frequency,
            criterion=self.criterion,
            identification=self.identification,
            torque_noise=self.torque_noise,
            share=self.share,
            margin=self.margin,
            clearance=self.clearance,
            floor=None if self.no_floor else self.floor,
            collisions=not self.no_collisions,
            count=self.starts,
            seed=self.seed,
        )


@dataclasses.dataclass(frozen=True)
class Ensemble:
    """Arms that recordings cannot tell apart, each of which could be built: links, friction, effects."""

    out: Path
    """Folder for ensemble.json, ensemble.npz and member_1.xml, ..."""
    retrieval: Path | None = None
    """Folder that `retrieve` wrote."""
    diagnosis: Path | None = None
    """Folder that `diagnose` wrote, instead."""
    count: int = 1000
    """Members."""
    seed: int = 0
    mjcf: int = 0
    """How many members, the first ones, to write as MJCF too."""
    sweeps: int = 400
    """Of each chain; more where the result says that chains have not mixed."""
    json: bool = False
    """Print the main result as one JSON document and nothing else."""

    def run(self) -> Any:
        from . import ensemble

        return ensemble.ensemble_files(
            self.out,
            self.retrieval,
            self.diagnosis,
            count=self.count,
            seed=self.seed,
            mjcf=self.mjcf,
            sweeps=self.sweeps,
        )


@dataclasses.dataclass(frozen=True)
class Compare:
    """Whether two results of identify, retrieve or diagnose agree, and what explains where they do not."""

    a: tyro.conf.Positional[Path]
    """Folder of one result."""
    b: tyro.conf.Positional[Path]
    """Folder of another, of the same arm."""
    out: Path
    """Folder for comparison.json and comparison.html."""
    motion: Path | None = None
    """On which the torque of both is compared; without it one within the joints' ranges."""
    json: bool = False
    """Print the main result as one JSON document and nothing else."""

    def run(self) -> Any:
        from . import comparison

        return comparison.compare_files(self.out, self.a, self.b, self.motion)


@dataclasses.dataclass(frozen=True)
class Rehearse:
    """What a motion would recover of an arm, how precisely, and which faults it would show; in simulation."""

    motion: Path
    """The motion: a recording with or without torque, such as excitation.csv."""
    out: Path
    """Folder for rehearsal.json."""
    model: Path | None = None
    """The arm (MJCF or URDF); without it, the project's own Panda."""
    draws: int = 3
    """Of the sensors' noise, each identified."""
    seed: int = 0
    torque_noise: tuple[float, ...] = ()
    """Of the torque sensors, one for all joints or one a joint [N m]."""
    diagnose: bool = False
    """Plant a fault, too, and diagnose it; takes a minute more."""
    part: _Part = WHOLE
    json: bool = False
    """Print the main result as one JSON document and nothing else."""

    def run(self) -> Any:
        from . import rehearsal

        return rehearsal.rehearse_files(
            self.out,
            self.part.of_any(self.model),
            self.motion,
            draws=self.draws,
            seed=self.seed,
            torque_noise=self.torque_noise,
            diagnose=self.diagnose,
        )


@dataclasses.dataclass(frozen=True)
class Fleet:
    """Many recordings of many arms: each diagnosed, and each arm's together: for good, drifting, once."""

    table: tyro.conf.Positional[Path]
    """CSV with a row a recording: recording, and arm, model, time or day, reference (docs/files.md)."""
    out: Path
    """Folder for fleet.json, fleet.html, Parquet tables, and what is finished."""
    model: Path | None = None
    """The simulation as you have it (MJCF), of rows that name none; without it, the project's own Panda."""
    knowledge: Literal["exact", "identified", "rough", "unknown"] = "identified"
    """How well the numbers in the models are known."""
    address: str = ""
    """Of a Ray cluster, or auto for the one of this machine; without it, Ray is started here."""
    workers: int | None = None
    """Processes; without it as many as there are cores. 0 works in this process, without Ray."""
    worker_memory: float = 3.0
    """Beyond which a worker is replaced [GB]."""
    read: _Read = dataclasses.field(default_factory=Reading)
    convention: _Convention = PLAIN
    json: bool = False
    """Print the main result as one JSON document and nothing else."""

    def run(self) -> Any:
        from . import fleet

        return fleet.fleet_files(
            self.out,
            self.table,
            model=self.model,
            knowledge=self.knowledge,
            reading=self.read,
            convention=self.convention,
            workers=self.workers,
            address=self.address,
            memory=self.worker_memory,
        )


_COMMANDS = (
    Demo,
    Inspect,
    Identify,
    Retrieve,
    Export,
    Validate,
    Diagnose,
    Predict,
    Payload,
    Convert,
    Excite,
    Ensemble,
    Compare,
    Rehearse,
    Fleet,
)


def _parse(arguments: list[str]) -> Any:
    """The command that the arguments spell; bad usage ends in one line and status 2."""
    union: Any = None
    for command in _COMMANDS:
        spelled = Annotated[command, tyro.conf.subcommand(command.__name__.lower())]
        union = spelled if union is None else union | spelled
    given = _options(arguments)
    if twice := [option for option in given if given.count(option) > 1]:  # the last would silently win
        raise InputError(f"{twice[0]} is given twice; values that belong to one option stand after one flag")
    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint):
            return tyro.cli(
                union,
                prog="jaxpanda",
                description="From recordings of a robot arm to a model that could be built.",
                args=arguments,
                config=(tyro.conf.FlagCreatePairsOff, tyro.conf.OmitSubcommandPrefixes),
            )
    except SystemExit as stop:
        if stop.code:
            raise InputError(_sentence(arguments, complaint.getvalue())) from None
        raise


def _sentence(arguments: list[str], panel: str) -> str:
    """What is wrong with the arguments, as one sentence; `panel` is how tyro said it."""
    commands = {command.__name__.lower(): command for command in _COMMANDS}
    name = arguments[0] if arguments else ""
    if name not in commands:
        known = [*commands, "--help", "--version"]
        if meant := _meant(name, known):
            return f"no command {name!r}{meant}: see jaxpanda --help"
        what = f"no command {name!r}" if name else "no command given"
        return f"{what}; there are {', '.join(commands)}: see jaxpanda --help"
    fields = dict(_spelled(commands[name]))
    given = _options(arguments)
    if arguments[1:] and not arguments[1].startswith("-"):  # what stands first without an option
        given += [field for field in fields if field.isupper()]
    words = " ".join(line.strip("╭╮╰╯│─+|- ") for line in panel.splitlines())  # a frame, of lines or of ASCII
    text = " ".join(re.sub(r"[-─]{3,}", " ", words).split())
    unknown = [option for option in given if option not in fields]
    missing = [
        option
        for option, field in fields.items()
        if option not in given and field.default is dataclasses.MISSING
    ]
    if unknown:
        what = f"{name} has no option {unknown[0]}{_meant(unknown[0], fields)}"
    elif choice := re.search(r"invalid choice '(.*?)' for argument '(.*?)'.*?\((.*?)\)", text):
        what = f"{choice[2]} {choice[1]}: is none of {choice[3].replace(chr(39), '')}"
    elif wrong := re.search(r"Error parsing (--[\w-]+): (.*?) Argument helptext", text):
        what = f"{wrong[1]}: {_no_number(wrong[2])}"
    elif empty := re.search(r"Missing value for argument '(--[\w-]+)", text):
        what = f"{empty[1]} has no value after it"
    elif stray := re.search(r"Unrecognized options: ([^\s,]+)", text):
        what = f"{name}: no option takes {stray[1]!r}"
        what += f", and {' and '.join(missing)} must be given" if missing else ""
    elif missing:
        what = f"{name} needs {' and '.join(missing)}"
    else:
        what = re.sub(r"^[A-Z][a-z]+ [a-z]+ | ?For full helptext.*$", "", text).replace("•", " ").strip()
    return f"{what}; see jaxpanda {name} --help"


def _spelled(command: Any) -> Iterator[tuple[str, dataclasses.Field[Any]]]:
    """Every field of a command as it is written, those of options that it shares with others included."""
    for field in dataclasses.fields(command):
        kind, *marks = typing.get_args(field.type) or (field.type,)
        if dataclasses.is_dataclass(kind):
            yield from _spelled(kind)
        elif tyro.conf.Positional in marks:
            yield field.name.upper(), field
        else:
            yield "--" + field.name.rstrip("_").replace("_", "-"), field


def _options(arguments: list[str]) -> list[str]:
    """The options given, as they are called in the help."""
    return [word.split("=")[0].replace("_", "-") for word in arguments[1:] if re.match("--?[A-Za-z]", word)]


def _no_number(complaint: str) -> str:
    """Python's complaint about a number, in words."""
    for said, kind in (
        (r"invalid literal for int\(\) with base 10: (.*)", "whole number"),
        (r"could not convert string to float: (.*)", "number"),
    ):
        if found := re.fullmatch(said, complaint):
            return f"{found[1]} is no {kind}"
    return complaint


def _meant(word: str, known: Iterable[str]) -> str:
    close = difflib.get_close_matches(word, list(known), 1)
    return f" (did you mean {close[0]}?)" if close else ""


def _complain(sentence: str) -> None:
    """One line on standard error; on a terminal, broken between words."""
    line = f"jaxpanda: {printable(sentence)}"
    if sys.stderr.isatty():
        width = shutil.get_terminal_size().columns
        line = textwrap.fill(line, width, break_long_words=False, break_on_hyphens=False)
    print(line, file=sys.stderr)


def main(arguments: list[str] | None = None) -> int:
    """Run one command; returns the exit status that docs and INTERFACE promise."""
    arguments = sys.argv[1:] if arguments is None else arguments
    if arguments == ["--version"]:
        from . import __version__

        print(f"jaxpanda {__version__}")
        return 0
    try:
        with _terminable():
            return _run(arguments)
    except InputError as error:
        _complain(str(error))
        return 2
    except KeyboardInterrupt as stop:
        _complain(f"interrupted; {str(stop) or 'nothing was left half-written'}")
    except BrokenPipeError:  # who read the output has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    except (OutputError, RankError) as error:
        _complain(str(error))
    except Exception as error:
        if "JAXPANDA_TRACEBACK" in os.environ:
            raise
        _complain(_unforeseen(error))
    return 1


def _run(arguments: list[str]) -> int:
    command = _parse(arguments)
    if getattr(command, "seed", 0) < 0:
        raise InputError(f"--seed {command.seed}: a whole number from 0 is needed")
    if sys.stderr.isatty():  # JAX takes seconds to import
        print(f"jaxpanda {arguments[0]}: starting", file=sys.stderr, flush=True)
    from . import inputs, session

    session.start()
    with inputs.remembered():
        result = command.run()
    if isinstance(
        sys.stdout, io.TextIOWrapper
    ):  # a file's name may have what the terminal's encoding has not
        sys.stdout.reconfigure(errors="backslashreplace")
    if result is None:  # another process has it
        return 0
    if command.json:
        from .files import stamped, to_json

        sys.stdout.write(to_json(stamped(result.to_json())))
    else:
        from . import report, summaries

        report.to_terminal(summaries.of(result))
    sys.stdout.flush()
    return 0


@contextlib.contextmanager
def _terminable() -> Iterator[None]:
    """SIGTERM ends a command as Ctrl-C does: what it had begun is cleared away, and that is said.

    Python drops what is raised in a destructor or a callback of its garbage collector, of which JAX has one: an
    interrupt that falls there comes again a moment later.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    again: list[threading.Timer] = []

    def stop(*_: Any) -> None:
        raise KeyboardInterrupt

    def dropped(what: Any) -> None:
        if not issubclass(what.exc_type, KeyboardInterrupt):
            other(what)
            return
        again.append(threading.Timer(0.1, signal.pthread_kill, (threading.get_ident(), signal.SIGTERM)))
        again[-1].start()

    before, other = signal.signal(signal.SIGTERM, stop), sys.unraisablehook
    sys.unraisablehook = dropped
    try:
        yield
    finally:
        for timer in again:
            timer.cancel()
        sys.unraisablehook = other
        signal.signal(signal.SIGTERM, signal.SIG_DFL if before is None else before)


def _unforeseen(error: Exception) -> str:
    """One sentence for what no stage has one for."""
    said = " ".join(str(error).split())[:300]
    if isinstance(error, MemoryError):
        return f"out of memory ({said or 'MemoryError'}); shorter recordings or fewer starts need less"
    if isinstance(error, OSError):
        return f"{error.filename or 'the system'}: {error.strerror or said}"
    frame = traceback.extract_tb(error.__traceback__)[-1]
    return (
        f"{type(error).__name__}: {said} ({Path(frame.filename).name}, line {frame.lineno}): a defect of jaxpanda"
        " or a library; with JAXPANDA_TRACEBACK=1 in the environment it says where"
    )


if __name__ == "__main__":
    sys.exit(main())
