"""Mutated inputs of every format, and what becomes of them: accepted, refused in a sentence, or a defect.

    python experiments/hostile/run.py --seed 1 --count 200 [--format csv mjcf ...]

Each format has a process of its own with a limit on its memory, so that a crash or a hang counts as what it is.
"""

import argparse
import dataclasses
import gzip
import json
import random
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

LIMIT_SECONDS, LIMIT_BYTES = 10.0, 2 << 30
TOKENS = [
    "nan",
    "inf",
    "-1",
    "1e999",
    "9" * 400,
    "1e-320",
    "0",
    "",
    "$x^",
    "\x1b[2J",
    "'",
    '"',
    "null",
    "é",
    "1,5",
]
VALUES: list[Any] = [None, True, -1, 0, 1e300, 10**18, "", "nan", [], {}, [[]], [1], {"a": 1}, "\x00", 0.5]


def mutated_bytes(content: bytes, rng: random.Random) -> bytes:
    """One to three changes anywhere: flipped, cut, repeated, or a number put in the place of another."""
    data = bytearray(content)
    for _ in range(rng.randint(1, 3)):
        at = rng.randrange(len(data) + 1)
        end = min(len(data), at + rng.choice([1, 4, 40, 4000]))
        kind = rng.randrange(6)
        if kind == 0 and data:
            data[at % len(data)] ^= 1 << rng.randrange(8)
        elif kind == 1:
            del data[at:end]
        elif kind == 2:
            data[at:at] = data[at:end]
        elif kind == 3:
            del data[at:]
        else:  # the word that stands there
            start = at
            while start and data[start - 1 : start] not in (b",", b'"', b" ", b"\n"):
                start -= 1
            stop = at
            while stop < len(data) and data[stop : stop + 1] not in (b",", b'"', b" ", b"\n"):
                stop += 1
            data[start:stop] = rng.choice(TOKENS).encode()
    return bytes(data)


def mutated_json(content: bytes, rng: random.Random) -> bytes:
    """One value of the document, anywhere in it, is another, gone, or twice there."""
    document = json.loads(content)
    places: list[tuple[Any, Any]] = []
    layer = [document]
    while layer:
        keys = [(one, k) for one in layer for k in (one if isinstance(one, dict) else range(len(one)))]
        places += keys
        layer = [one[k] for one, k in keys if isinstance(one[k], dict | list)]
    for _ in range(rng.randint(1, 2)):
        holder, key = rng.choice(places)
        if (isinstance(holder, list) and key >= len(holder)) or (
            isinstance(holder, dict) and key not in holder
        ):
            continue
        if rng.random() < 0.2:
            del holder[key]
        elif isinstance(holder, list) and rng.random() < 0.3:
            holder.append(holder[key])
        else:
            holder[key] = rng.choice(VALUES)
    return json.dumps(document).encode()


def attempt(action: Callable[[], Any]) -> tuple[str, str]:
    """What became of an input, and the sentence."""
    from jaxpanda.errors import InputError

    began = time.monotonic()
    try:
        action()
        kind, said = "accepted", ""
    except InputError as error:
        said = str(error)
        kind = "refused" if "\n" not in said and len(said) < 1000 else "no sentence"
    except MemoryError as error:
        kind, said = "memory", str(error)
    except Exception as error:
        frames = error.__traceback__
        while frames is not None and frames.tb_next is not None:
            frames = frames.tb_next
        where = f"{Path(frames.tb_frame.f_code.co_filename).name}:{frames.tb_lineno}" if frames else ""
        kind, said = "defect", f"{type(error).__name__} in {where}: {str(error)[:120]}"
    if time.monotonic() - began > LIMIT_SECONDS:
        kind = "slow"
    return kind, said


def thinned(log: Any) -> Any:
    """Every tenth sample of a recording."""
    channels = {name: getattr(log, name)[::10] for name in ("time", "q", "qd", "tau")}
    return dataclasses.replace(log, **channels)


def material(folder: Path) -> dict[str, Path]:
    """A small valid input of each format."""
    import jax.numpy as jnp

    import jaxpanda
    from jaxpanda.arms.export import panda_mjcf
    from jaxpanda.arms.urdf import to_urdf
    from jaxpanda.demo import record
    from jaxpanda.feasible import Bounds
    from jaxpanda.files import write_json, write_npz, write_text
    from jaxpanda.recordings import save

    short = thinned(record(seed=3, duration=2.0).recording)
    out = {name: folder / f"arm.{name}" for name in ("csv", "csv.gz", "npz", "parquet")}
    for path in out.values():
        save(short, path)
    out["raw_logs"] = folder / "raw"
    out["raw_logs"].mkdir()
    for name, channel in (("time", short.time), ("positions", short.q), ("torques", short.tau)):
        lines = [" ".join(map(repr, row)) for row in channel.reshape(short.samples, -1).tolist()]
        write_text(out["raw_logs"] / f"log_{name}.txt", "\n".join(lines) + "\n")
    out["mjcf"] = folder / "arm.xml"
    write_text(out["mjcf"], panda_mjcf())
    arm = jaxpanda.Arm.panda()
    zero = jnp.zeros(arm.dof)
    nothing = jaxpanda.Corrected(arm, jnp.zeros((arm.dof, 10)), zero, zero, (), ())
    out["corrected"] = folder / "corrected.json"
    write_json(out["corrected"], {**nothing.to_json(), "torque_noise": [0.05] * arm.dof})
    out["table"] = folder / "table.json"
    rows = [{"expression": "m7", "terms": {"m7": 1, "m6": 1}, "value": 0.7, "std": 0.1, "reliable": True}]
    write_json(
        out["table"],
        {"schema": "jaxpanda.identification/1", "coefficients": rows, "links": list(arm.link_names)},
    )
    out["urdf"] = folder / "arm.urdf"
    write_text(out["urdf"], to_urdf(arm))
    out["bounds"] = folder / "bounds.csv"
    rows = [",".join(map(str, (name, *box))) for name, box in Bounds.panda().boxes()]
    write_text(out["bounds"], "\n".join(["name,lower,upper", *rows]) + "\n")
    out["mass_gravity"] = folder / "mg.npz"
    write_npz(out["mass_gravity"], {"q": short.q[:20], "g": short.q[:20]})
    return out


def logs_of_other_tools(folder: Path) -> dict[str, Path]:
    """The same recording as others write it, by the libraries of their formats."""
    import h5py
    import numpy as np
    import pyarrow
    import pyarrow.parquet
    import scipy.io
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    from jaxpanda.recordings import load

    short = load(folder / "arm.npz")
    arrays = {"time": short.time, "q": short.q, "dq": short.qd, "tau": short.tau}
    out = {name: folder / f"log.{name}" for name in ("mat", "h5")}
    scipy.io.savemat(out["mat"], arrays, do_compression=True)
    with h5py.File(out["h5"], "w") as file:
        names = ("joint_positions", "joint_velocities", "motor_torques_measured")
        for name, array in zip(names, (short.q, short.qd, short.tau), strict=True):
            file.create_dataset(f"observation/robot_state/{name}", data=array, compression="gzip")
        where = "observation/timestamp/robot_state/robot_timestamp_"
        file[f"{where}seconds"] = np.floor(short.time)
        file[f"{where}nanos"] = np.round(1e9 * (short.time % 1))
    store = get_typestore(Stores.ROS2_HUMBLE)
    types = store.types
    for name, plugin in (("mcap", StoragePlugin.MCAP), ("db3", StoragePlugin.SQLITE3)):
        out[name] = folder / f"bag_{name}"
        with Writer(out[name], version=9, storage_plugin=plugin) as bag:
            kind = "sensor_msgs/msg/JointState"
            connection = bag.add_connection("/joint_states", kind, typestore=store)
            joints = [f"panda_joint{j + 1}" for j in range(short.dof)]
            for t, *row in zip(short.time, short.q, short.qd, short.tau, strict=True):
                at = round(1e9 * t) + 10**18
                stamp = types["builtin_interfaces/msg/Time"](at // 10**9, at % 10**9)
                header = types["std_msgs/msg/Header"](stamp, "")
                bag.write(connection, at, store.serialize_cdr(types[kind](header, joints, *row), kind))
    out["lerobot"] = folder / "lerobot"
    data = out["lerobot"] / "data" / "chunk-000"
    data.mkdir(parents=True)
    (out["lerobot"] / "meta").mkdir()
    joints = [f"joint_{j + 1}.pos" for j in range(short.dof)]
    info = {"codebase_version": "v3.0", "features": {"observation.state": {"names": joints}}}
    (out["lerobot"] / "meta" / "info.json").write_text(json.dumps(info))
    table = {"timestamp": short.time, "observation.state": short.q.tolist()}
    table["episode_index"] = np.zeros(short.samples, int)
    pyarrow.parquet.write_table(pyarrow.table(table), data / "file-000.parquet")
    return out


def reader(format: str) -> Callable[[Path], Any]:
    """What a command does first with such a file; what is accepted must read again once it is written."""
    import numpy as np

    from jaxpanda import corrected, recordings
    from jaxpanda.arms.source import from_mjcf
    from jaxpanda.demo import record
    from jaxpanda.diagnosis import predict
    from jaxpanda.feasible import Bounds
    from jaxpanda.files import to_json
    from jaxpanda.identification import Identification, load_mass_gravity

    motion = record(seed=4, duration=1.0).recording

    def recording(path: Path) -> None:
        found = recordings.load(path)
        again = path.parent / "again.npz"
        recordings.save(found, again)
        np.testing.assert_array_equal(recordings.load(again).q, found.q)

    def result(path: Path) -> None:
        found = corrected.read(path.parent)[0] if format == "corrected" else Identification.load(path)
        text = json.loads(to_json(found.to_json()))
        assert type(found).from_json(text) is not None
        if format == "corrected":
            predict(path.parent, motion)

    readers = {"mjcf": from_mjcf, "urdf": from_mjcf, "corrected": result, "table": result}
    readers |= {"mass_gravity": load_mass_gravity, "bounds": Bounds.from_csv}
    return readers.get(format, recording)


def work(format: str, seed: int, count: int) -> dict[str, Any]:
    """Mutate one format `count` times, here."""
    from jaxpanda import session

    session.start()
    rng, read, found = random.Random(f"{seed} {format}"), reader(format), Counter()
    examples: dict[str, str] = {}
    with tempfile.TemporaryDirectory() as name:
        made = material(Path(name))
        given = (made if format in made else logs_of_other_tools(Path(name)))[format]
        case = Path(name) / "case"
        for number in range(count):
            shutil.rmtree(case, ignore_errors=True)
            case.mkdir()
            path = case / given.name
            if given.is_dir():
                shutil.copytree(given, path)
                target = rng.choice(sorted(file for file in path.rglob("*") if file.is_file()))
            else:
                shutil.copy(given, path)
                target = path
            content = target.read_bytes()
            if target.suffix == ".json" and rng.random() < 0.8:
                content = mutated_json(content, rng)
            elif target.suffix == ".gz" and rng.random() < 0.7:
                content = gzip.compress(mutated_bytes(gzip.decompress(content), rng))
            else:
                content = mutated_bytes(content, rng)
            target.write_bytes(content)
            kind, said = attempt(lambda path=path: read(path))
            found[kind] += 1
            if kind not in ("accepted", "refused"):
                examples.setdefault(f"{kind}: {said}", f"number {number}")
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss >> 10
    return {"format": format, "found": dict(found), "examples": examples, "memory_mib": memory}


RECORDINGS = ("csv", "csv.gz", "npz", "parquet", "raw_logs", "mat", "h5", "mcap", "db3", "lerobot")
FORMATS = (*RECORDINGS, "mjcf", "urdf", "corrected", "table", "bounds", "mass_gravity")


def main() -> int:
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--seed", type=int, default=1)
    options.add_argument("--count", type=int, default=200, help="of each format")
    options.add_argument("--format", nargs="*", default=FORMATS, choices=FORMATS)
    options.add_argument("--worker", action="store_true", help=argparse.SUPPRESS)
    given = options.parse_args()
    if given.worker:
        resource.setrlimit(resource.RLIMIT_DATA, (LIMIT_BYTES, LIMIT_BYTES))
        print(json.dumps(work(given.format[0], given.seed, given.count)))
        return 0
    bad = 0
    print(
        "| format | accepted | refused in a sentence | anything else | memory, MiB |\n|---|---|---|---|---|"
    )
    for format in given.format:
        command = [
            sys.executable,
            __file__,
            "--worker",
            "--seed",
            str(given.seed),
            "--count",
            str(given.count),
        ]
        done = subprocess.run([*command, "--format", format], capture_output=True, text=True, check=False)
        if done.returncode:
            bad += 1
            print(f"| {format} | | | ended with {done.returncode}: {done.stderr[-300:]!r} | |")
            continue
        one = json.loads(done.stdout.splitlines()[-1])
        ordinary = [one["found"].get(kind, 0) for kind in ("accepted", "refused")]
        bad += given.count - sum(ordinary)
        print(
            f"| {format} | {ordinary[0]} | {ordinary[1]} | {given.count - sum(ordinary)} | {one['memory_mib']} |"
        )
        for example, number in one["examples"].items():
            print(f"<!-- {format}, {number}: {example} -->", file=sys.stderr)
    return int(bad > 0)


if __name__ == "__main__":
    sys.exit(main())
