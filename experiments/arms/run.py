"""Other people's arms, one after another: how far does each get through jaxpanda? See README.md."""

import argparse
import csv
import dataclasses
import tempfile
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

jax.config.update("jax_enable_x64", True)

from jaxpanda import ModelFile, Part, identify, retrieve, to_mjcf, validate  # noqa: E402
from jaxpanda.arms.mjcf import load_model  # noqa: E402
from jaxpanda.arms.source import from_mjcf  # noqa: E402
from jaxpanda.demo import record  # noqa: E402
from jaxpanda.errors import InputError  # noqa: E402

HERE = Path(__file__).parent
STATES = 20


class Done(Exception):
    """The last step that was asked for is done."""


@dataclasses.dataclass
class Row:
    """What an arm came to."""

    arm: str
    joints: int = 0
    carried: str = ""
    """Share of the mass that belongs to bodies fixed to links."""
    kernel: str = ""
    """Largest difference of inverse dynamics to C MuJoCo, as a share of the largest torque."""
    torque: str = ""
    """Error of the retrieved links' torque on the recording [%]."""
    changes: str = ""
    """Attributes that the export changed."""
    held_out: str = ""
    """Error of the exported file's torque on another motion [%], friction and sensors' noise included."""
    mjx: str = ""
    """Largest difference of MJX to C MuJoCo."""
    seconds: str = ""
    failed: str = ""
    """The step that it did not pass, and the sentence; or what MJX says of itself."""


def arms(models: Path, only: list[str]) -> list[tuple[str, Path, Part]]:
    """The rows of arms.csv whose file is there."""
    found = []
    with (HERE / "arms.csv").open() as file:
        for row in csv.DictReader(file):
            part = Part(row["root"], row["tip"], row["outside"] == "yes")
            name = f"{row['collection']}/{row['file']}" + "".join(
                f" --{option} {row[option]}" for option in ("root", "tip") if row[option]
            )
            if not only or any(word in name for word in only):
                found.append((name, models / row["collection"] / row["file"], part))
    return found


def beside(file: Path, folder: Path) -> Path:
    """Where to export to: a folder in which meshes are found as beside the model, by links."""
    folder.mkdir()
    for other in file.parent.glob("*/**/*"):
        if other.is_file() and other.suffix != ".xml":
            link = folder / other.relative_to(file.parent)
            link.parent.mkdir(parents=True, exist_ok=True)
            link.symlink_to(other.resolve())
    return folder / "exported.xml"


def states(arm, count: int) -> tuple[np.ndarray, ...]:
    rng = np.random.default_rng(0)
    return tuple(rng.uniform(-s, s, (count, arm.dof)) for s in (2.0, 2.0, 5.0))


def in_c(model: mujoco.MjModel, dofs: list[int], q, qd, qdd) -> np.ndarray:
    """Inverse dynamics in C MuJoCo, of the whole scene: contacts, constraints and actuators off."""
    flags = mujoco.mjtDisableBit
    model.opt.disableflags |= sum(
        int(flag) for flag in (flags.mjDSBL_CONTACT, flags.mjDSBL_CONSTRAINT, flags.mjDSBL_ACTUATION)
    )
    model.opt.density = model.opt.viscosity = 0.0
    model.body_gravcomp[:] = 0
    data, torque = mujoco.MjData(model), []
    for one in zip(q, qd, qdd, strict=True):
        data.qpos[:], data.qvel[:], data.qacc[:] = one
        mujoco.mj_inverse(model, data)
        torque.append(data.qfrc_inverse[dofs].copy())
    return np.array(torque)


def run(name: str, file: Path, part: Part, folder: Path, starts: int, seconds: float, until: str) -> Row:
    """All steps, as far as they go."""
    row, step, began = Row(name), "read", time.perf_counter()
    model = ModelFile(file, part)
    try:
        if not file.exists():
            raise InputError("is not in --models")
        arm, source = from_mjcf(model)
        mass = float(np.sum(arm.standard[:, 0]))
        row.joints = arm.dof
        row.carried = f"{0.0 if arm.lumped is None else 100 * float(np.sum(arm.lumped[:, 0])) / mass:.0f}"
        step = "kernel"
        q, qd, qdd = states(arm, STATES)
        ours = np.asarray(jax.vmap(arm.inverse_dynamics)(*map(jnp.asarray, (q, qd, qdd))))
        ours = ours - np.asarray(arm.frictionloss) * np.sign(qd)
        dofs = [link.dof for link in source.links]
        full = source.qpos(q), source.qvel(qd), source.qvel(qdd)
        theirs = in_c(from_mjcf(model)[1].model, dofs, *full)
        difference = float(np.abs(ours - theirs).max() / np.abs(theirs).max())
        row.kernel = f"{difference:.0e}"
        if not difference < 1e-9:
            raise InputError(f"inverse dynamics differ by {difference:.1e} of the largest torque")
        if until == "kernel":
            raise Done
        step = "record"
        virtual = record(1, model, duration=seconds)
        step = "identify"
        found = identify([virtual.recording], arm)
        step = "retrieve"
        links = retrieve(found, arm=arm, starts=starts, certificate=False)
        row.torque = f"{links.relative_error_percent:.2f}"
        if links.max_violation > 0:
            raise InputError(f"a bound is missed by {links.max_violation:.1e}")
        step = "export"
        out = beside(file, folder / f"{len(list(folder.iterdir()))}")
        written = to_mjcf(links, out, model)
        row.changes = str(len(written.changes))
        step = "compile"
        load_model(ModelFile(out, Part(outside=True)))
        part = dataclasses.replace(part, outside=True)  # the meshes are links to where they lie
        again, source = from_mjcf(ModelFile(out, part))
        same = np.abs(np.asarray(again.standard) - links.standard).max() / np.abs(links.standard).max()
        if not same < 1e-8:
            raise InputError(f"the file compiles to links that are {same:.1e} off")
        step = "urdf"
        to_mjcf(links, out.with_suffix(".urdf"), model)
        if not np.any(np.all(np.asarray(again.standard) == 0, 1)):
            there = from_mjcf(out.with_suffix(".urdf"))[0]
            torque = [
                np.asarray(jax.vmap(a.inverse_dynamics)(*map(jnp.asarray, (q, qd, 0 * qdd))))
                for a in (again, there)
            ]
            springs = np.asarray(again.stiffness * (q - again.springref))
            tilt = not np.allclose(again.chain.gravity, there.chain.gravity)
            off = np.abs(torque[0] - springs - torque[1]).max() / np.abs(torque[0]).max()
            if not (tilt or off < 1e-8):
                raise InputError(f"torque of the URDF is {off:.1e} off")
        step = "mjx"
        if until == "mjx":
            checked = validate(ModelFile(out, part), [virtual.held_out], rollout=False)
            row.held_out = f"{checked.relative_error_percent:.2f}"
            if checked.mjx_vs_mujoco is None:
                raise InputError("; ".join(note for note in checked.notes if "MJX" in note))
            row.mjx = f"{checked.mjx_vs_mujoco / np.abs(theirs).max():.0e}"
    except Done:
        pass
    except InputError as error:
        row.failed = f"{step}: {str(error).replace(str(file), file.name).replace(str(folder), 'OUT')}"
    row.seconds = f"{time.perf_counter() - began:.0f}"
    return row


def table(rows: list[Row]) -> str:
    names = [field.name for field in dataclasses.fields(Row)]
    lines = ["| " + " | ".join(names) + " |", "|" + "---|" * len(names)]
    for row in rows:
        lines.append("| " + " | ".join(str(getattr(row, name)).replace("|", "/") for name in names) + " |")
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--models", type=Path, required=True, help="folder that holds the collections of arms.csv"
    )
    parser.add_argument("--out", type=Path, required=True, help="folder for table.md")
    parser.add_argument("--only", nargs="*", default=[], help="arms whose row holds one of these words")
    parser.add_argument("--starts", type=int, default=16)
    parser.add_argument("--seconds", type=float, default=10.0, help="length of the recording")
    parser.add_argument("--until", choices=["kernel", "urdf", "mjx"], default="mjx", help="the last step")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    rows = []
    with tempfile.TemporaryDirectory() as scratch:
        for name, file, part in arms(options.models, options.only):
            rows.append(run(name, file, part, Path(scratch), options.starts, options.seconds, options.until))
            print(rows[-1], flush=True)
            (options.out / "table.md").write_text(table(rows))
    passed = sum(not row.failed for row in rows)
    print(f"{passed} of {len(rows)} arms pass every step")


if __name__ == "__main__":
    main()
