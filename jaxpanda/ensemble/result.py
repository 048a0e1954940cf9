"""`Ensemble`: arms that recordings cannot tell apart, as arrays, torque, MJX models and MJCF."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxpanda_kernels import inertia, regressor
from jaxtyping import Array, Float

from ..arms import markup
from ..arms.arm import Arm
from ..arms.export import ExportResult, panda_mjcf, write_parameters
from ..arms.mjcf import MjcfSource, move_standard
from ..arms.source import from_document, from_mjcf
from ..corrected import Corrected
from ..effects import AbstractEffect, AbstractJointEffect, Stretches, joint_columns
from ..errors import InputError
from ..files import Kind, finite, output_folder, settle, write_json, write_npz
from ..friction import MODELS, Friction
from ..inputs import read_json, read_npz
from ..recordings import Recording
from ..signals import prepare
from ..traces import trajectory
from ..validation import mjx_package

SCHEMA = "jaxpanda.ensemble/1"
FILE, ARRAYS = "ensemble.json", "ensemble.npz"
KIND = Kind("ensemble", (FILE, ARRAYS))
MIXED = 1.2
"""R-hat up to which chains count as mixed: members of one chain and of all then differ by less than 0.7 of a
standard deviation in any direction, and there are hundreds of chains."""
LEAVES = (
    "body_mass",
    "body_ipos",
    "body_iquat",
    "body_inertia",
    "body_subtreemass",
    "body_invweight0",
    "dof_M0",
    "dof_invweight0",
    "dof_damping",
    "dof_frictionloss",
    "dof_armature",
)
"""Fields of an MJX model that differ from member to member."""
_QUANTILES = (0.05, 0.5, 0.95)


@dataclasses.dataclass(frozen=True)
class Ensemble:
    """Members drawn from one posterior."""

    arm: Arm
    """With its nominal parameters, and what the model holds beyond rigid links."""
    standard: Float[np.ndarray, "count dof 10"]
    """Order and units as in `jaxpanda_kernels.inertia`."""
    extra: Float[np.ndarray, "count extra"]
    """What was drawn with the links."""
    names: tuple[str, ...]
    """Of `extra`: `viscous_1` and other friction by joint, `effect_1_1` by effect of `corrected` and number."""
    friction: str
    """A model of `jaxpanda.friction`, of what comes beyond the arm's own friction; "none" for a diagnosis."""
    corrected: Corrected | None
    """What the diagnosis found, whose numbers members differ from; None for a retrieval."""
    noise: Float[np.ndarray, " dof"]
    """Rms of what a recording's torque has beyond any member, below the cutoff of the fit [N m]."""
    source: str
    """`retrieval` or `diagnosis`."""
    model_file: str
    """The MJCF of the arm; "" for the project's own Panda."""
    seed: int
    chains: int
    sweeps: int
    rhat: float
    """Largest split R-hat over all coordinates of the draws."""
    effective: float
    """Least number of independent draws that all draws of the chains are worth, over all coordinates."""
    seconds: float
    notes: tuple[str, ...] = ()

    @property
    def count(self) -> int:
        return len(self.standard)

    @property
    def dof(self) -> int:
        return self.standard.shape[1]

    def bodies(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Mass (count, dof), centre of mass (count, dof, 3), and the inertia about it (count, dof, 6) as xx, yy,
        zz, xy, xz, yz, in the links' frames."""
        mass, com, I = (np.asarray(x) for x in jax.vmap(jax.vmap(inertia.to_com))(jnp.asarray(self.standard)))
        return mass, com, I[..., [0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]

    def own(self, kind: str) -> Float[np.ndarray, "count dof"]:
        """One parameter of every joint's friction beyond the arm's own: `viscous`, `coulomb`, `offset`,
        `armature`, or one of a sigmoid; zero where it was not drawn."""
        out = np.zeros((self.count, self.dof))
        for k, name in enumerate(self.names):
            if name.rpartition("_")[0] == kind:
                out[:, int(name.rpartition("_")[2]) - 1] = self.extra[:, k]
        return out

    @property
    def friction_names(self) -> tuple[str, ...]:
        """What `own` knows."""
        kinds = (name.rpartition("_")[0] for name in self.names if not name.startswith("effect_"))
        return tuple(dict.fromkeys(kinds))

    @property
    def effect_names(self) -> tuple[str, ...]:
        """Columns of `effects`."""
        return tuple(name for name in self.names if name.startswith("effect_"))

    @property
    def effects(self) -> Float[np.ndarray, "count coefficients"]:
        """Coefficients of the effects of a diagnosis."""
        at = [k for k, name in enumerate(self.names) if name.startswith("effect_")]
        return self.extra[:, at]

    # Torque

    def torque(
        self, motion: Recording, members: slice | Sequence[int] = slice(None), *, cutoff: float = 5.0
    ) -> tuple[Float[np.ndarray, " time"], Float[np.ndarray, "members time dof"]]:
        """Torque of members over a motion [N m], and its times [s].

        Of a retrieval, low-passed at `cutoff` [Hz] as identification does; of a diagnosis, as `predict` gives it.
        """
        motion.require_dof(self.dof)
        chosen = np.arange(self.count)[members]
        if self.corrected is not None:
            return self._diagnosed(motion, chosen)
        signals = prepare(motion, cutoff=cutoff)
        arrays = tuple(jnp.asarray(x) for x in (signals.q, signals.qd, signals.qdd))
        known = np.asarray(jax.vmap(self.arm.known_torque)(*arrays))
        base = signals.lowpass(known)
        rigid = signals.lowpass(np.asarray(_regressors(self.arm, *arrays)))  # (time, dof, 10 dof)
        tau = np.einsum("tjp,mp->mtj", rigid, self.standard[chosen].reshape(len(chosen), -1), optimize=True)
        for kind in MODELS[self.friction] if self.friction != "sigmoid" else ():
            column = signals.lowpass(np.asarray(Friction(self.friction, _unit(self.friction, kind, self.dof))
                                                .torque(arrays[1])))  # fmt: skip
            tau += column * self.own(kind)[chosen][:, None, :]
        if self.friction == "sigmoid":
            for m, i in enumerate(chosen):
                law = Friction("sigmoid", {kind: self.own(kind)[i] for kind in MODELS["sigmoid"]})
                tau[m] += signals.lowpass(np.asarray(law.torque(arrays[1])))
        return signals.times, tau + base

    def _diagnosed(self, motion: Recording, chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        found = self.corrected
        assert found is not None
        arm, later = found.for_motion(motion)
        trace = trajectory(later).trace(self.arm).showing(found.friction_shown)
        shown = arm.measured_torque(trace.motion, trace.channels, trace.sign)
        change = (self.standard[chosen] - np.asarray(self.arm.standard)).reshape(len(chosen), -1)
        tau = trace.motion.torque + np.einsum("tjp,mp->mtj", trace.motion.regressor, change, optimize=True)
        tau += trace.motion.qd * self.own("viscous")[chosen][:, None]
        tau += trace.sign * self.own("coulomb")[chosen][:, None]
        tau += trace.motion.qdd * self.own("armature")[chosen][:, None]
        stretches = {
            last: Stretches(dataclasses.replace(trace.channels, shown=shown if last else None))
            for last in (False, True)
        }
        for i, (bound, mean) in enumerate(zip(found.effects, found.coefficients, strict=True)):
            effect = bound.placed("", later=True)
            over = bound.passes and later is not motion
            if effect is None or over or self._is_drawn_rotor(i):
                continue
            c = self._coefficients(i, np.asarray(mean))[chosen]
            if isinstance(effect, AbstractJointEffect):
                columns = joint_columns([effect], stretches[effect.takes_shown], trace.motion.dt)[:, 0]
                tau[:, :, effect.joints[0]] += c @ columns.T
            else:
                tau += np.einsum("tjk,mk->mtj", effect.over(trace.motion), c)  # pyright: ignore
        return trace.motion.time - later.time[0] + motion.time[0], tau

    def _is_drawn_rotor(self, i: int) -> bool:
        """Whether an effect of `corrected` is a rotor of the model, which members have as `armature`."""
        assert self.corrected is not None
        drawn = any(name.startswith(f"effect_{i + 1}_") for name in self.names)
        return (
            self.corrected.effects[i].name == "armature" and not drawn and "armature" in self.friction_names
        )

    def _coefficients(self, i: int, mean: Float[np.ndarray, " n"]) -> Float[np.ndarray, "count n"]:
        """Of an effect in every member."""
        out = np.tile(mean, (self.count, 1))
        for k, name in enumerate(self.names):
            if name.startswith(f"effect_{i + 1}_"):
                out[:, int(name.rpartition("_")[2]) - 1] = self.extra[:, k]
        return out

    def _of_effects(self) -> list[tuple[AbstractEffect, Float[np.ndarray, "count n"]]]:
        """The effects of a diagnosis, with their coefficients in every member."""
        if self.corrected is None:
            return []
        out = []
        for i, (effect, mean) in enumerate(
            zip(self.corrected.effects, self.corrected.coefficients, strict=True)
        ):
            drawn = self._is_drawn_rotor(i)
            rotor = self.own("armature")[:, effect.joints[:1]]
            out.append((effect, rotor if drawn else self._coefficients(i, np.asarray(mean))))
        return out

    def band(
        self,
        motion: Recording,
        *,
        level: float = 0.9,
        measured: bool = True,
        members: int = 400,
        cutoff: float = 5.0,
    ) -> tuple[Float[np.ndarray, " time"], Float[np.ndarray, "time dof"], Float[np.ndarray, "time dof"]]:
        """Times [s], and between which torques [N m] that of a motion lies with probability `level`.

        Args:
            motion: not one that the arm was identified from.
            level: between 0 and 1.
            measured: the torque that a sensor shows, below the cutoff, with all that no member explains; else the
                torque of the members alone.
            members: how many at most are looked at.
            cutoff: as `torque` takes it.
        """
        if not 0 < level < 1:
            raise InputError(f"level: {level} is no probability between 0 and 1")
        chosen = np.unique(np.linspace(0, self.count - 1, members).round().astype(int))
        times, tau = self.torque(motion, chosen.tolist(), cutoff=cutoff)
        if measured:  # mixtures of a Gaussian about each member, by draws of their own
            random = np.random.default_rng(self.seed)
            tau = tau + self.noise * random.normal(size=tau.shape)
        low, high = np.quantile(tau, [(1 - level) / 2, (1 + level) / 2], axis=0)
        return times, low, high

    # Simulators

    def _source(self, model: str | Path | None) -> MjcfSource:
        path = model or self.model_file
        if not path:
            return from_document(markup.parse(panda_mjcf(), "mujoco", Path("panda.xml")))[1]
        if not Path(path).is_file():
            raise InputError(f"{path}: the MJCF is not there any more; name it")
        return from_mjcf(path)[1]

    def _native(self, chosen: np.ndarray) -> dict[str, np.ndarray]:
        """What MuJoCo's attributes hold of members: standard, damping, frictionloss, armature."""
        if self.corrected is None:
            return {
                "standard": self.standard[chosen],
                "damping": np.asarray(self.arm.damping) + self.own("viscous")[chosen],
                "frictionloss": np.asarray(self.arm.frictionloss) + self.own("coulomb")[chosen],
                "armature": np.tile(np.asarray(self.arm.armature), (len(chosen), 1)),
            }
        parts = [self.member(int(i)) for i in chosen]
        natives = [part.native for part in parts]
        numbers = {
            name: np.stack([np.asarray(getattr(native, name)) for native in natives])
            for name in ("standard", "damping", "frictionloss", "armature")
        }
        for name in ("damping", "frictionloss", "armature"):
            numbers[name] = np.maximum(numbers[name], 0.0)
        return numbers

    def member(self, i: int) -> Corrected:
        """One member as a corrected arm, whose dynamics are JAX functions; of a retrieval without the constant
        torque and a sigmoid, which no corrected arm holds."""
        change = jnp.asarray(self.standard[i]) - self.arm.standard
        viscous, coulomb = (jnp.asarray(self.own(kind)[i]) for kind in ("viscous", "coulomb"))
        if self.corrected is None:
            return Corrected(self.arm, change, viscous, coulomb, (), ())
        coefficients = [jnp.asarray(values[i]) for _, values in self._of_effects()]
        return eqx.tree_at(
            lambda c: (c.change, c.damping_change, c.frictionloss_change, c.coefficients),
            self.corrected,
            (change, viscous, coulomb, tuple(coefficients)),
        )

    def mjx(
        self, model: str | Path | None = None, members: slice | Sequence[int] = slice(None)
    ) -> tuple[Any, Any]:
        """Members as one MJX model whose leaves `LEAVES` have an axis in front, and `in_axes` for `jax.vmap`.

            model, in_axes = members.mjx()
            data = mjx.make_data(members.template())
            step = jax.vmap(mjx.step, in_axes=(in_axes, None))

        Args:
            model: the MJCF that members go into; that of the arm where it is not given.
            members: which.

        Raises:
            InputError: no such file, MJX is not installed or would ignore part of the model.
        """
        source = self._source(model)
        engine, notes = mjx_package(source.model)
        if engine is None:
            raise InputError(notes[0])
        leaves = self.leaves(source, members)
        # the first member's model decides what is compiled in
        base = engine.put_model(
            _with_leaves(source.model, {name: values[0] for name, values in leaves.items()})
        )
        stacked = base.tree_replace({name: jnp.asarray(values) for name, values in leaves.items()})
        axes = jax.tree_util.tree_map(lambda _: None, base)
        return stacked, axes.tree_replace(dict.fromkeys(leaves, 0))

    def template(self, model: str | Path | None = None) -> mujoco.MjModel:
        """The compiled MJCF that members of `mjx` are made of."""
        return self._source(model).model

    def leaves(
        self, source: MjcfSource, members: slice | Sequence[int] = slice(None)
    ) -> dict[str, Float[np.ndarray, "members ..."]]:
        """The fields of a MuJoCo model that differ from member to member, as the engine itself derives them."""
        chosen = np.arange(self.count)[members]
        native = self._native(chosen)
        work = _with_leaves(source.model, {})
        data = mujoco.MjData(work)
        mass, com, moments, quat = _bodies_of(source, native["standard"])
        ids, dofs = [link.body_id for link in source.links], [link.dof for link in source.links]
        out: dict[str, list[np.ndarray]] = {name: [] for name in LEAVES}
        for k in range(len(chosen)):
            work.body_mass[ids], work.body_ipos[ids] = mass[k], com[k]
            work.body_inertia[ids], work.body_iquat[ids] = moments[k], quat[k]
            work.dof_damping[dofs] = native["damping"][k]
            work.dof_frictionloss[dofs] = native["frictionloss"][k]
            work.dof_armature[dofs] = native["armature"][k]
            mujoco.mj_setConst(work, data)
            for name, values in out.items():
                values.append(np.array(getattr(work, name)))
        return {name: np.stack(values) for name, values in out.items()}

    def mjcf(self, i: int, model: str | Path | None = None) -> ExportResult:
        """A member as MJCF: the arm's file with its numbers.

        Raises:
            InputError: the file is gone, or cannot hold them.
        """
        source = self._source(model)
        arm, _ = from_document(source.document)
        if self.corrected is None:
            friction = None
            if self.friction != "none":
                values = {kind: self.own(kind)[i] for kind in MODELS[self.friction]}
                friction = Friction(self.friction, values)
            return write_parameters(source, self.arm, self.standard[i], friction)
        native = self._native(np.array([i]))
        names = ("damping", "frictionloss", "armature")
        arm = eqx.tree_at(
            lambda a: tuple(getattr(a, name) for name in names),
            arm,
            tuple(jnp.asarray(native[name][0]) for name in names),
        )
        return write_parameters(source, arm, native["standard"][0])

    # Files

    def to_json(self) -> dict[str, Any]:
        """As `ensemble.json` holds it."""
        mass, com, six = self.bodies()
        spread = lambda values: [finite(v) for v in np.quantile(values, _QUANTILES)]
        return {
            "schema": SCHEMA,
            "source": self.source,
            "count": self.count,
            "seed": self.seed,
            "arm": self.arm.to_json(),
            "model_file": self.model_file or None,
            "friction": {"model": self.friction, "names": list(self.friction_names)},
            "effects": list(self.effect_names),
            "effect_coefficients": [
                {
                    "effect": effect.title,
                    "joints": [j + 1 for j in effect.joints],
                    "name": of.name,
                    "unit": effect.unit(of.unit, self.arm),
                    "value": spread(x),
                }
                for effect, values in self._of_effects()
                for of, x in zip(effect.coefficients, values.T, strict=True)
            ],
            "corrected": None if self.corrected is None else self.corrected.to_json(),
            "noise": self.noise.tolist(),
            "mixing": {
                "chains": self.chains,
                "sweeps": self.sweeps,
                "rhat": self.rhat,
                "effective": self.effective,
                "mixed": self.rhat <= MIXED,
            },
            "total_mass": spread(mass.sum(1)),
            "links": [
                {
                    "name": name,
                    "mass": spread(mass[:, i]),
                    "com": [spread(com[:, i, k]) for k in range(3)],
                    "inertia": [spread(six[:, i, k]) for k in range(6)],
                }
                for i, name in enumerate(self.arm.link_names)
            ],
            "joints": [
                {
                    "name": joint,
                    **{kind: spread(self.own(kind)[:, j]) for kind in self.friction_names},
                }
                for j, joint in enumerate(self.arm.joint_names)
            ],
            "seconds": self.seconds,
            "notes": list(self.notes),
        }

    def save(self, folder: str | Path, *, mjcf: int = 0) -> tuple[str, ...]:
        """Write `ensemble.json`, `ensemble.npz` and the first members as `member_1.xml`, ...; all or nothing.

        Returns:
            What the MJCF files cannot hold, a sentence each.
        """
        mass, com, six = self.bodies()
        said: list[str] = []
        with output_folder(folder, KIND) as scratch:
            for i in range(min(mjcf, self.count)):
                written = self.mjcf(i)
                said += written.warnings
                said += written.save(scratch / f"member_{i + 1}.xml")
            said = list(dict.fromkeys(said))
            notes = [*self.notes, *said]
            write_json(scratch / FILE, {**self.to_json(), "notes": notes, "mjcf": min(mjcf, self.count)})
            write_npz(
                scratch / ARRAYS,
                {
                    "mass": mass,
                    "com": com,
                    "inertia": six,
                    "standard": self.standard,
                    "friction": np.stack([self.own(kind) for kind in self.friction_names], 2)
                    if self.friction_names
                    else np.zeros((self.count, self.dof, 0)),
                    "effects": self.effects,
                },
            )
        return tuple(said)

    @classmethod
    def load(cls, folder: str | Path) -> "Ensemble":
        """What `ensemble` wrote.

        Raises:
            InputError: it is not there, or not as it was written.
        """
        path = Path(folder) / FILE
        settle(folder)
        document = read_json(path)
        if not isinstance(document, dict) or document.get("schema") != SCHEMA:
            raise InputError(f"{path}: is no ensemble (schema '{SCHEMA}'); `ensemble` writes one")
        arrays = read_npz(path.with_name(ARRAYS))
        try:
            kinds, effects = document["friction"]["names"], tuple(document["effects"])
            standard = np.asarray(arrays["standard"], float)
            count, dof = standard.shape[:2]
            friction = np.asarray(arrays["friction"], float).reshape(count, dof, len(kinds))
            names = tuple(f"{kind}_{j + 1}" for j in range(dof) for kind in kinds)
            coefficients = np.asarray(arrays["effects"], float).reshape(count, len(effects))
            return cls(
                arm=Arm.from_json(document["arm"]),
                standard=standard,
                extra=np.concatenate([friction.reshape(count, -1), coefficients], 1),
                names=names + effects,
                friction=document["friction"]["model"],
                corrected=None
                if document["corrected"] is None
                else Corrected.from_json(document["corrected"]),
                noise=np.array(document["noise"], float),
                source=document["source"],
                model_file=document["model_file"] or "",
                seed=int(document["seed"]),
                **{name: document["mixing"][name] for name in ("chains", "sweeps", "rhat", "effective")},
                seconds=float(document["seconds"]),
                notes=tuple(document["notes"]),
            )
        except (LookupError, TypeError, ValueError, AttributeError) as error:
            raise InputError(f"{path}: is not as `ensemble` writes it ({error}); draw it again") from None


def _unit(model: str, kind: str, dof: int) -> dict[str, np.ndarray]:
    return {name: np.full(dof, float(name == kind)) for name in MODELS[model]}


@eqx.filter_jit
def _regressors(
    arm: Arm, q: Float[Array, "time dof"], qd: Float[Array, "time dof"], qdd: Float[Array, "time dof"]
) -> Float[Array, "time dof standard"]:
    one = lambda sample: regressor(arm.chain, *sample).reshape(arm.dof, -1)
    return jax.lax.map(one, (q, qd, qdd), batch_size=1024)


def _with_leaves(model: mujoco.MjModel, leaves: dict[str, np.ndarray]) -> mujoco.MjModel:
    """A copy with other numbers, of which MuJoCo is told that no body's axes are its frame's."""
    import copy

    out = copy.copy(model)
    out.body_simple[:] = 0
    out.body_sameframe[:] = int(mujoco.mjtSameFrame.mjSAMEFRAME_NONE)
    for name, values in leaves.items():
        getattr(out, name)[:] = values
    return out


def _bodies_of(
    source: MjcfSource, standard: Float[np.ndarray, "members dof 10"]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Mass, centre of mass, principal moments and axes of the links' own bodies, without what they carry."""
    from scipy.spatial.transform import Rotation

    parts = []
    for i, link in enumerate(source.links):
        moved = np.stack([move_standard(unit, link.R, link.p) for unit in np.eye(10)], 1)
        parts.append((standard[:, i] - link.lumped_standard) @ moved.T)
    phi = np.stack(parts, 1)
    mass, com, I = (np.asarray(x) for x in jax.vmap(jax.vmap(inertia.to_com))(jnp.asarray(phi)))
    if not np.all(mass > 0):
        i = int(np.argmin(mass.min(0)))
        raise InputError(
            f"{source.path}: what is fixed to {source.links[i].body} weighs more than the link"
            " with it in some member"
        )
    moments, axes = np.linalg.eigh(I)
    axes[..., 0] *= np.linalg.det(axes)[..., None]
    quat = Rotation.from_matrix(axes.reshape(-1, 3, 3)).as_quat(scalar_first=True).reshape(*mass.shape, 4)
    return mass, com, moments, quat
