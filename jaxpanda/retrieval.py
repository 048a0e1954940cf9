"""`retrieve`: links that could be built behind identified coefficients, from many starts at once."""

import dataclasses
import importlib.util
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxpanda_kernels import inertia
from jaxtyping import Bool, Float

from .arms.arm import Arm
from .arms.model_file import WHOLE, Part
from .arms.source import is_panda
from .certificate import lower_bound
from .errors import InputError
from .feasible import Bounds, Constraint, Links, Solutions, exact_penalty, solve
from .feasible.bounds import INERTIA
from .feasible.buildable import doubts, reach
from .feasible.nearest import are_buildable
from .feasible.schedule import Device
from .feasible.solver import NOTHING, STARTS
from .files import Kind, finite, output_folder, settle, write_json, write_npz
from .friction import MODELS, Friction, least_beyond
from .identification import Identification
from .identification.condensed import Condensed, Evidence, linear_names, own_parameters, with_own_parameters
from .identification.one_step import Prior
from .identification.result import known_physics
from .identification.statistics import samples_as_one
from .inputs import read_json, read_npz, require_written
from .parameters import coefficient_matrix
from .posterior import FILE as POSTERIOR_FILE
from .posterior import Posterior, named
from .ranks import ALONE, Ranks

SCHEMA = "jaxpanda.retrieval/1"
FILE = "retrieval.json"
STARTS_FILE = "starts.npz"
KIND = Kind("retrieve", (FILE, STARTS_FILE))
CHECKPOINT_FILE = "starts.partial"
AS_GOOD = 1.01
"""A solution is as good as the best where its objective is within this factor of it."""
CONCESSION = 5e-4
"""Share of the objective that may be given up to stay near the nominal parameters."""
ACTIVE = 1e-5
"""A constraint is active where its margin is below this share of its box (triangle inequality: [kg m²])."""
_POINT = 1e-9
_DOUBT = (
    1.05  # factor of the torque error, or of the objective's root, that the room for carried bodies may cost
)
_LOST = 2.0  # factor of the coefficients' torque error from which links are said to miss it
_BLOCK = 16384  # starts described at once


@dataclasses.dataclass(frozen=True)
class Retrieval:
    """Feasible parameters of every link, and what the coefficients do not tell about them."""

    standard: Float[np.ndarray, "dof 10"]
    """Order and units as in `jaxpanda_kernels.inertia`."""
    objective: float
    """Weighted sum of squared differences between the coefficients of these links and the identified ones."""
    max_violation: float
    """Largest amount by which a bound or constraint is missed; 0.0 where all hold."""
    margins: Mapping[str, Any]
    """Of every constraint [SI]: `triangle`, `mass`, `com`, `inertia`, `total_mass`, `user`."""
    active: tuple[str, ...]
    """Constraints that hold the solution back."""
    spread: Mapping[str, tuple[float, float]]
    """Least and largest value of `m1`, `c1x`, `I1xx`, ... over the starts as good as the best, and these links:
    what the coefficients cannot tell."""
    as_good: int
    """How many starts those are."""
    starts: int
    seed: int
    lower_bound: float | None
    """Certified: no feasible links have a lower objective. None where no certificate was computed."""
    weighting: str
    penalty: str
    compile_seconds: float
    run_seconds: float
    link_names: tuple[str, ...]
    arm: str = ""
    own: bool = True
    """Whether that is the project's own Panda, into which links are exported where no file is named."""
    friction: Friction | None = None
    """For the export: as identified or, under the weighting "torque", as it serves these links best, none of it
    negative."""
    known: Mapping[str, Float[np.ndarray, " dof"]] = dataclasses.field(default_factory=dict)
    """What the model that was identified held beyond rigid links; carried along too."""
    model_file: str = ""
    """The MJCF that was identified, where that is known."""
    model_part: Part = WHOLE
    """Which arm of that file it is."""
    rmse: Float[np.ndarray, " dof"] | None = None
    """What these links and this friction leave of the torque that they were identified from [N m]."""
    relative_error_percent: float | None = None
    cross_validated_rmse: Float[np.ndarray, " dof"] | None = None
    """The same on blocks of it of which links and friction were found without them."""
    cross_validated_relative_error_percent: float | None = None
    warnings: tuple[str, ...] = ()
    """Links that nobody would build, each with its reason."""
    notes: tuple[str, ...] = ()
    """What the user should know before relying on this."""
    solutions: Solutions | None = None
    """Every start's outcome."""
    posterior: Posterior | None = None
    """What `jaxpanda.ensemble` draws from; None where the coefficients have no standard deviations."""
    model: Arm | None = None
    """The arm that was identified, with its nominal parameters, where that is known."""

    @property
    def dof(self) -> int:
        return len(self.standard)

    @property
    def links(self) -> list[dict[str, Any]]:
        """Name, mass, centre of mass and inertia about it of every link, as files hold them."""
        mass, com, six = _described(self.standard)
        return [
            {"name": name, "mass": float(mass[i]), "com": com[i].tolist(), "inertia": six[i].tolist()}
            for i, name in enumerate(self.link_names)
        ]

    def to_json(self) -> dict[str, Any]:
        """As `retrieval.json` holds it."""
        return {
            "schema": SCHEMA,
            "arm": self.arm,
            "own": self.own,
            "starts": self.starts,
            "seed": self.seed,
            "objective": self.objective,
            "lower_bound": self.lower_bound,
            "max_violation": self.max_violation,
            "total_mass": float(self.standard[:, 0].sum()),
            "links": self.links,
            "standard": self.standard.tolist(),
            "friction": [] if self.friction is None else self.friction.to_json(),
            "known": {name: values.tolist() for name, values in self.known.items()},
            "margins": dict(self.margins),
            "active": list(self.active),
            "as_good": self.as_good,
            "spread": {name: list(pair) for name, pair in self.spread.items()},
            "weighting": self.weighting,
            "model_file": self.model_file or None,
            "model_part": self.model_part.to_json(),
            "model": None if self.model is None else self.model.to_json(),
            "rmse": [] if self.rmse is None else self.rmse.tolist(),
            "relative_error_percent": self.relative_error_percent,
            "cross_validated_rmse": (
                [] if self.cross_validated_rmse is None else self.cross_validated_rmse.tolist()
            ),
            "cross_validated_relative_error_percent": self.cross_validated_relative_error_percent,
            "warnings": list(self.warnings),
            "penalty": self.penalty,
            "seconds": {"compile": self.compile_seconds, "run": self.run_seconds},
            "notes": list(self.notes),
        }

    def save(self, folder: str | Path) -> Path:
        """Write `retrieval.json`, every start's outcome as `starts.npz`, and `posterior.npz`; all or nothing."""
        with output_folder(folder, KIND) as scratch:
            write_json(scratch / FILE, self.to_json())
            if self.solutions is not None:  # as it is: random numbers do not compress
                names = [field.name for field in dataclasses.fields(self.solutions)]
                write_npz(scratch / STARTS_FILE, {name: getattr(self.solutions, name) for name in names})
            if self.posterior is not None:
                self.posterior.save(scratch / POSTERIOR_FILE)
        return Path(folder) / FILE

    @classmethod
    def load(cls, path: str | Path) -> "Retrieval":
        """Read `retrieval.json` or the folder that holds it, with what stands beside it.

        Raises:
            InputError: naming the file and the field that is wrong.
        """
        path = Path(path)
        file = path / FILE if path.is_dir() else path
        settle(file.parent)
        if path.is_dir():
            require_written(file, "retrieve")
        document = read_json(file)
        if not isinstance(document, Mapping) or document.get("schema") != SCHEMA:
            raise InputError(f"{file}: is no retrieval (schema '{SCHEMA}'); `retrieve` writes one")
        try:
            return cls(
                standard=np.array(document["standard"], float).reshape(len(document["links"]), 10),
                objective=float(document["objective"]),
                max_violation=float(document["max_violation"]),
                margins=document["margins"],
                active=tuple(document["active"]),
                spread={name: (low, high) for name, (low, high) in document["spread"].items()},
                as_good=int(document["as_good"]),
                starts=int(document["starts"]),
                seed=int(document["seed"]),
                lower_bound=document["lower_bound"],
                weighting=document["weighting"],
                penalty=document["penalty"],
                compile_seconds=float(document["seconds"]["compile"]),
                run_seconds=float(document["seconds"]["run"]),
                link_names=tuple(link["name"] for link in document["links"]),
                arm=document["arm"],
                own=bool(document.get("own", document["arm"] in ("", "panda"))),
                friction=Friction.from_json(document["friction"]) if document["friction"] else None,
                known=known_physics(document["known"], len(document["links"]), str(file)),
                model_file=document.get("model_file") or "",
                model_part=Part.from_json(document.get("model_part")),
                rmse=_array(document.get("rmse")),
                relative_error_percent=document.get("relative_error_percent"),
                cross_validated_rmse=_array(document.get("cross_validated_rmse")),
                cross_validated_relative_error_percent=document.get("cross_validated_relative_error_percent"),
                warnings=tuple(document.get("warnings", ())),
                notes=tuple(document["notes"]),
                solutions=_load_starts(file.with_name(STARTS_FILE)),
                posterior=Posterior.load(file.parent) if file.with_name(POSTERIOR_FILE).is_file() else None,
                model=Arm.from_json(document["model"]) if document.get("model") else None,
            )
        except InputError:
            raise
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(
                f"{file}: field missing or malformed ({error}); `retrieve` writes it whole"
            ) from None


def retrieve(
    identification: Identification | Mapping[str, Any] | str | Path,
    *,
    bounds: Bounds | str | Path | None = None,
    arm: Arm | None = None,
    constraints: Sequence[Constraint] = (),
    weighting: Literal["auto", "torque", "none"] = "auto",
    penalty: Literal["smooth", "exact"] = "smooth",
    prefer: Literal["best", "nominal"] = "nominal",
    starts: int = STARTS,
    seed: int = 0,
    certificate: bool | Literal["auto"] = "auto",
    devices: Sequence[Device] | None = None,
    ranks: Ranks = ALONE,
    checkpoint: str | Path | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Retrieval:
    r"""Feasible parameters of the links behind identified coefficients (Gaz et al. 2019, section IV).

    $\min_\phi \lVert K\phi - \hat\beta\rVert^2$ over links that could be built, $K$ and $\hat\beta$ the
    coefficients that are reliable.

    Args:
        identification: a result, a table with the field `coefficients`, or the file that holds either.
        bounds: boxes on the links' parameters, or their table. Without them: the published ones for the
            project's Panda, around `arm` for any other.
        arm: whose nominal parameters to set bounds around, and to stay near to under `prefer="nominal"`. Without
            it, the arm that was identified; of a bare table of coefficients, the Panda.
        constraints: further ones, as functions of `Links` that return margins.
        weighting: "torque" weighs every direction of all coefficients by the torque it moved in the data, so that
            the links lose as little of the fit as they can; "none", as in the paper, takes the reliable
            coefficients alike and leaves out the others. "auto" is "torque" where motion and torque were
            identified, of which most coefficients are not reliable one by one, and "none" for M(q) and g(q),
            which show each of them, and for a bare table.
        penalty: "smooth" is `feasible.solve`; "exact" is the paper's Algorithm 1, for comparison.
        prefer: "best", the lowest objective; "nominal", near to the nominal parameters (of `arm`) in all that
            the coefficients do not tell, at an objective no more than `CONCESSION` higher or, under "torque"
            and where recordings were identified, as the links that torque and `Prior.around` the nominal ones
            together make likely ("smooth" penalty only).
        starts: random starts.
        seed: same seed, same answer.
        certificate: lower bound by convex optimisation; "auto" where the extra [sdp] is installed.
        devices: over which the starts are spread, with the same answer: all of this process when None.
        ranks: processes that make this same call and share the starts (`jaxpanda.ranks.joined`).
        checkpoint: file that keeps the starts as they finish, so that an interrupted run goes on where it was
            ("smooth" penalty only). Remove it when the result is saved.
        progress: called with (starts done, starts).

    Raises:
        InputError: malformed table or bounds, no start ends feasible, or a checkpoint of another run.
        MissingExtraError: `certificate=True` without the extra [sdp].
    """
    table = _identified(identification)
    arm = arm or _arm(table)
    boxes = _bounds(bounds, arm, table)
    if arm is not None and arm.dof != boxes.dof:
        arm = None  # bounds of other links say nothing of this arm's
    if weighting == "auto":
        weighting = "torque" if table.method in ("trajectory", "one_step") else "none"
    expected, as_one = None, 1.0
    if table.evidence is not None:
        expected, as_one = _with_expected_offsets(table, table.evidence)
    A, b = _equations(table, expected, boxes.dof, weighting)
    constraints = tuple(constraints)
    carried = None if arm is None or arm.lumped is None else np.asarray(arm.lumped)
    smooth = partial(solve, carried=carried, devices=devices, ranks=ranks, checkpoint=checkpoint)
    run = {"smooth": smooth, "exact": exact_penalty}[penalty]
    found = run(A, b, boxes, constraints=constraints, starts=starts, seed=seed, progress=progress)
    feasible = found.violation == 0
    if not feasible.any() and penalty == "smooth":
        raise InputError(
            f"no start of {starts} satisfies all bounds and constraints (nearest misses by "
            f"{found.violation.min():.2g}); widen them, or give more starts"
        )
    best = found.objective[found.best]
    as_good = feasible & (found.objective <= max(AS_GOOD * best, NOTHING * float(b @ b)))
    as_good[found.best] = True
    phi, violation = found.phi[found.best], float(found.violation[found.best])
    notes = _notes(table, found, weighting)
    if table.model is None and table.arm == "panda" and bounds is None:
        notes.append("no model stands in the table: by its name it was taken for the Panda without hand")
    prior = None
    if arm is not None and prefer == "nominal" and penalty == "smooth":
        prior = Prior.around(arm, boxes)
    pull = partial(_pulled, bounds=boxes, constraints=constraints, carried=carried)
    if prior is not None and feasible.any():
        if weighting == "torque" and expected is not None and table.method == "trajectory":
            likely = pull(A, b, prior, weight=as_one, initial=[phi, prior.phi])
            if likely.violation[likely.best] == 0:
                phi = likely.phi[likely.best]
        else:
            phi = _towards(pull, A, b, prior, phi, CONCESSION * best + NOTHING * float(b @ b))
        violation = 0.0
    if carried is not None and arm is not None and penalty == "smooth":
        known = 0.0  # squares that no links explain
        if weighting == "torque" and table.evidence is not None:
            known = float(table.evidence.whole.dof * table.evidence.whole.samples)
        nothing, standard = NOTHING * float(b @ b), Prior.around(arm, boxes)
        weight = nothing / max(standard.distance(phi), np.finfo(float).tiny)
        free = pull(
            A, b, standard, weight=weight, initial=[phi, standard.phi], carried=np.zeros_like(carried)
        )
        less = known + float(np.sum((A @ free.phi[free.best].ravel() - b) ** 2)) + nothing
        if known + best > _DOUBT**2 * less:
            notes.append(
                "links that explain the torque leave no room for the bodies that the model fixes to them, which"
                f" makes the error {100 * (np.sqrt((known + best) / less) - 1):.0f} % higher: does the recorded"
                " arm carry those?"
            )
    wanted = certificate is True or (
        certificate == "auto" and importlib.util.find_spec("clarabel") is not None
    )
    margins = _margins(phi, boxes, constraints)
    names = table.link_names if len(table.link_names) == boxes.dof else ()
    names = names or tuple(f"link{i + 1}" for i in range(boxes.dof))
    friction, errors = table.friction, {}
    if table.evidence is not None and expected is not None:
        if weighting == "torque" and friction is not None:
            own = expected.whole.following(table.projection @ phi.ravel(), _least(table))
            friction = with_own_parameters(friction, own)
        errors = _torque_errors(
            table, table.evidence.whole, expected.folds, friction, pull, phi, weighting, prior, as_one
        )
    notes += _lost(table, errors.get("relative_error_percent"))
    return Retrieval(
        standard=phi,
        objective=float(np.sum((A @ phi.ravel() - b) ** 2)),
        max_violation=violation,
        margins=margins,
        active=tuple(_active(margins, boxes)),
        spread=_spread(found.phi, as_good, phi),
        as_good=int(as_good.sum()),
        starts=starts,
        seed=seed,
        lower_bound=lower_bound(A, b, boxes).lower_bound if wanted else None,
        weighting=weighting,
        penalty=penalty,
        compile_seconds=found.compile_seconds,
        run_seconds=found.run_seconds,
        link_names=names,
        arm=table.arm,
        own=table.arm in ("", "panda") if table.model is None else is_panda(table.model),
        friction=friction,
        known=table.known,
        model_file=table.model_file,
        model_part=table.model_part,
        **errors,
        warnings=tuple(doubts(phi, names, None if arm is None else reach(arm))),
        notes=tuple(notes),
        solutions=found,
        posterior=_posterior(table, boxes, constraints, phi, arm),
        model=table.model or (arm if table.arm in ("", "panda") else None),
    )


def _posterior(
    table: Identification,
    bounds: Bounds,
    constraints: tuple[Constraint, ...],
    phi: Float[np.ndarray, "dof 10"],
    arm: Arm | None,
) -> Posterior | None:
    """What the coefficients tell, friction with them; None where they have no deviations."""
    if table.std is None or not np.all(table.std > 0):
        return None
    told = np.isfinite(table.std)
    covariance = (
        np.diag(np.where(told, table.std, 1.0) ** 2) if table.covariance is None else table.covariance
    )
    K, mean, names = coefficient_matrix(table.terms, bounds.dof), table.beta, ()
    own, kinds = np.zeros((bounds.dof, 0)), ()
    friction = table.friction
    if table.joint_covariance is not None:
        covariance = table.joint_covariance
        if friction is not None:
            kinds = MODELS[friction.model]
            names = named(kinds, bounds.dof)
            own = np.stack([np.asarray(friction.parameters[kind]) for kind in kinds], 1)
            std = np.stack([np.asarray((friction.std or friction.parameters)[kind]) for kind in kinds], 1)
            told = np.concatenate([told, np.isfinite(std.ravel())])
    mean = np.concatenate([mean, own.ravel()])
    G = np.zeros((len(mean), K.shape[1] + own.size))
    G[: len(K), : K.shape[1]] = K
    G[len(K) :, K.shape[1] :] = np.eye(own.size)
    least = least_beyond(kinds, table.known, bounds.dof).ravel()
    at = np.flatnonzero(told)
    carried = np.zeros((bounds.dof, 10))
    if arm is not None and arm.lumped is not None and are_buildable(phi - np.asarray(arm.lumped)):
        carried = np.asarray(arm.lumped)
    covariance = covariance[np.ix_(at, at)]
    return Posterior(
        told=G[at],
        mean=mean[at],
        covariance=covariance,
        names=names,
        least=least,
        bounds=bounds,
        carried=carried,
        noise=_noise(table, covariance, at),
    )


def _noise(
    table: Identification, covariance: Float[np.ndarray, "told told"], told: np.ndarray
) -> Float[np.ndarray, " dof"]:
    r"""Of a recording's torque beyond the model, rms [N m]: what the fit left, and what it took from it.

    With any noise of covariance Σ, least squares leave $\mathrm{tr}\,\Sigma$ less what their own estimate varies
    by: $\mathrm{E}\lVert e\rVert^2 = \mathrm{tr}\,\Sigma - \mathrm{tr}(A^\top A\,C)$.
    """
    if table.rmse is None:
        return np.zeros(table.dof)
    square = table.rmse**2
    if (
        table.evidence is None
        or table.method != "trajectory"
        or len(told) != len(table.beta) + (table.evidence.whole.R[:, 0, len(table.beta) : -1].size)
    ):
        return np.sqrt(square)
    whole, rank = table.evidence.whole, len(table.beta)
    extra = whole.R.shape[2] - 1 - rank
    for j, R in enumerate(whole.R):
        at = np.r_[0:rank, rank + j * extra : rank + (j + 1) * extra]
        A = R[:, :-1]
        square[j] += np.trace(A.T @ A @ covariance[np.ix_(at, at)]) / whole.samples
    return np.sqrt(square)


def _identified(identification: Identification | Mapping[str, Any] | str | Path) -> Identification:
    if isinstance(identification, Identification):
        return identification
    if isinstance(identification, Mapping):
        return Identification.from_json(identification)
    return Identification.load(identification)


def _arm(table: Identification) -> Arm | None:
    """The arm that was identified; the Panda where nothing says otherwise."""
    return table.model or (Arm.panda() if table.arm in ("", "panda") and table.dof <= 7 else None)


def _bounds(bounds: Bounds | str | Path | None, arm: Arm | None, table: Identification) -> Bounds:
    if bounds is None:
        if arm is None:
            whose = f"the arm '{table.arm}'" if table.arm else f"an arm of {table.dof} links"
            raise InputError(
                f"bounds: none are known for {whose}; give its MJCF by --model, or a table of bounds by --bounds"
            )
        chosen = Bounds.of(arm)
    else:
        chosen = bounds if isinstance(bounds, Bounds) else Bounds.from_csv(bounds)
    if chosen.dof < table.dof:
        whose = (
            "of the Panda, taken as no others were given, " if bounds is None and table.model is None else ""
        )
        raise InputError(f"bounds: {whose}cover {chosen.dof} links, the coefficients name link {table.dof}")
    if (known := len(table.link_names)) not in (0, chosen.dof):
        raise InputError(
            f"bounds: cover {chosen.dof} links, the identified arm has {known}: give its own model (--model) or"
            " bounds (--bounds)"
        )
    return chosen


def _equations(
    table: Identification, expected: Evidence | None, dof: int, weighting: str
) -> tuple[Float[np.ndarray, "rows columns"], Float[np.ndarray, " rows"]]:
    """Rows of the coefficients, weighed."""
    A, b = coefficient_matrix(table.terms, dof), table.beta
    if weighting == "none":
        if not table.reliable.any():
            raise InputError("coefficients: none is reliable, so there is nothing to retrieve from")
        return A[table.reliable], b[table.reliable]
    if expected is not None and table.method == "trajectory":
        # a covariance of what is told next to what is not has too many digits
        T, estimate, _, _ = _weighed(table, expected.whole)
        return T @ A, T @ estimate
    covariance = table.classical_covariance
    if covariance is None:
        if table.std is None or not np.all((table.std > 0) & np.isfinite(table.std)):
            raise InputError("coefficients: weighting by torque needs a positive 'std' of every coefficient")
        covariance = np.diag(table.std**2)
    values, vectors = np.linalg.eigh(covariance)
    if values[-1] <= 0:
        raise InputError("coefficients: their covariance is zero, so torque cannot weigh them")
    root = vectors / np.sqrt(np.maximum(values, 1e-14 * values[-1]))
    return root.T @ A, root.T @ b


def _weighed(table: Identification, part: Condensed) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Of a part of the recordings: the root of the coefficients' information, they themselves, friction, and the
    residuals that weigh the joints."""
    rank = len(table.beta)
    estimate, own, sigma = part.classical(rank, str(table.settings.get("weighting", "joint")))
    return part.weigh(rank, sigma), estimate, own, sigma


def _with_expected_offsets(table: Identification, evidence: Evidence) -> tuple[Evidence, float]:
    """The recordings where no offset of a torque sensor is expected to be larger than its joint's torque (rms).

    And how many of their residuals tell as much as an independent one.

    Links are used where the sensors are not. A motion that hardly tells an offset from gravity would have links
    take any torque that the offset then undoes, for the least bit of a better fit. What the recordings say
    against the expectation counts by as many samples as are independent.
    """
    names, whole, as_one = linear_names(table.friction), evidence.whole, 1.0
    T, estimate, own, sigma = _weighed(table, whole)
    left = whole.residual(estimate, own)
    if table.joint_covariance is not None:
        square = float(np.sum((left / sigma) ** 2)) / (whole.dof * whole.samples)
        as_one = samples_as_one(T, table.joint_covariance[: len(T), : len(T)], square)
        if not np.isfinite(as_one):
            raise InputError("joint_covariance: its variances are too large to be any; identify again")
    if "offset" not in names:
        return evidence, as_one
    torque = np.maximum(np.linalg.norm(whole.R[:, :, -1], axis=1), np.finfo(float).tiny)
    weights = np.zeros((whole.dof, len(names)))
    weights[:, names.index("offset")] = np.sqrt(as_one) * left / torque
    folds = tuple((train.expecting(weights), test) for train, test in evidence.folds)
    return Evidence(whole.expecting(weights), folds), as_one


def _towards(
    pull: Callable[..., Solutions],
    A: Float[np.ndarray, "rows columns"],
    b: Float[np.ndarray, " rows"],
    prior: Prior,
    best: Float[np.ndarray, "dof 10"],
    room: float,
) -> Float[np.ndarray, "dof 10"]:
    r"""Links nearer to the nominal ones that meet the coefficients as well as `best`, but for `room`.

    Minimises $\lVert A\phi - b\rVert^2 + \epsilon R(\phi)$ from `best`, R the squared distance from nominal in
    the prior's deviations. Its minimum has an objective of at most $\phi_{best} + \epsilon R(\phi_{best})$, and
    $\epsilon$ is what makes this `room` higher: only what the coefficients leave open moves.
    """
    objective = lambda phi: float(np.sum((A @ phi.ravel() - b) ** 2))
    weight = room / max(prior.distance(best), np.finfo(float).tiny)
    pulled = pull(A, b, prior, weight=weight, initial=[best, prior.phi])
    nearer = (
        (pulled.violation == 0)
        & np.array([objective(phi) <= objective(best) + room for phi in pulled.phi])
        & np.array([prior.distance(phi) < prior.distance(best) for phi in pulled.phi])
    )
    return pulled.phi[np.argmin(np.where(nearer, pulled.objective, np.inf))] if nearer.any() else best


def _pulled(
    A: Float[np.ndarray, "rows columns"],
    b: Float[np.ndarray, " rows"],
    prior: Prior,
    *,
    weight: float,
    initial: Sequence[Float[np.ndarray, "dof 10"]],
    bounds: Bounds,
    constraints: tuple[Constraint, ...],
    carried: Float[np.ndarray, "dof 10"] | None,
) -> Solutions:
    r"""$\min_\phi \lVert A\phi - b\rVert^2 + w\,R(\phi)$, R the squared distance from what the prior expects."""
    root = np.sqrt(weight) / prior.std.ravel()
    return solve(
        np.concatenate([A, np.diag(root)]),
        np.concatenate([b, root * prior.phi.ravel()]),
        bounds,
        constraints=constraints,
        carried=carried,
        initial=np.stack(initial),
        starts=len(initial),
    )


def _torque_errors(
    table: Identification,
    whole: Condensed,
    folds: Sequence[tuple[Condensed, Condensed]],
    friction: Friction | None,
    pull: Callable[..., Solutions],
    phi: Float[np.ndarray, "dof 10"],
    weighting: str,
    prior: Prior | None,
    as_one: float,
) -> dict[str, Any]:
    """What links and friction leave of the torque, and what they do on blocks that they were found without.

    The latter for links found by the torque of recordings only: which coefficients are reliable is not known
    block by block, and what `one_step` expects of links is not known here.
    """
    K = table.projection
    beta = K @ phi.ravel()
    left = whole.error(beta, own_parameters(friction, whole.dof))
    errors: dict[str, Any] = {
        "rmse": left / np.sqrt(whole.samples),
        "relative_error_percent": _percent(left, whole.torque),
    }
    if weighting != "torque" or table.method != "trajectory" or not folds:
        return errors
    squares, least = np.zeros(whole.dof), _least(table)
    prior = prior or Prior(phi, np.full_like(phi, np.inf))
    for train, test in folds:
        T, estimate, _, _ = _weighed(table, train)
        found = pull(T @ K, T @ estimate, prior, weight=as_one, initial=[phi, prior.phi])
        beta = K @ found.phi[found.best].ravel()
        squares += test.error(beta, train.following(beta, least)) ** 2
    samples = sum(test.samples for _, test in folds)
    torque = float(np.linalg.norm([test.torque for _, test in folds]))
    return errors | {
        "cross_validated_rmse": np.sqrt(squares / samples),
        "cross_validated_relative_error_percent": _percent(np.sqrt(squares), torque),
    }


def _least(table: Identification) -> Float[np.ndarray, "dof extra"]:
    return least_beyond(linear_names(table.friction), table.known, table.dof)


def _percent(left: Float[np.ndarray, " dof"], torque: float) -> float:
    return 100 * float(np.linalg.norm(left)) / torque if torque else 0.0


def _array(values: Any) -> np.ndarray | None:
    return np.array(values, float) if values else None


_to_com = jax.jit(jax.vmap(inertia.to_com))


def _described(
    phi: Float[np.ndarray, "*shape 10"],
) -> tuple[Float[np.ndarray, "*shape"], Float[np.ndarray, "*shape 3"], Float[np.ndarray, "*shape 6"]]:
    """Mass, centre of mass, and xx yy zz xy xz yz of the inertia about it."""
    flat = phi.reshape(-1, 10)
    mass, com, I_com = (np.asarray(x) for x in _to_com(flat))
    six = I_com[:, [0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    shape = phi.shape[:-1]
    return mass.reshape(shape), com.reshape(*shape, 3), six.reshape(*shape, 6)


def _spread(
    phi: Float[np.ndarray, "starts dof 10"],
    chosen: Bool[np.ndarray, " starts"],
    links: Float[np.ndarray, "dof 10"],
) -> dict[str, tuple[float, float]]:
    """Over these links and the chosen starts, in blocks of one size: that bounds memory, and compiles once."""
    numbers = np.flatnonzero(chosen)
    blocks = [_extremes(links[None])]
    for first in range(0, len(numbers), _BLOCK):
        here = np.minimum(np.arange(first, first + _BLOCK), len(numbers) - 1)
        blocks.append(_extremes(phi[numbers[here]]))
    low = {name: min(block[name][0] for block in blocks) for name in blocks[0]}
    return {name: (low[name], max(block[name][1] for block in blocks)) for name in low}


def _extremes(phi: Float[np.ndarray, "starts dof 10"]) -> dict[str, tuple[float, float]]:
    mass, com, six = _described(phi)
    columns = {}
    for i in range(phi.shape[1]):
        columns[f"m{i + 1}"] = mass[:, i]
        columns |= {f"c{i + 1}{axis}": com[:, i, k] for k, axis in enumerate("xyz")}
        columns |= {f"I{i + 1}{entry}": six[:, i, k] for k, entry in enumerate(INERTIA)}
    columns["total_mass"] = mass.sum(-1)
    return {name: (float(values.min()), float(values.max())) for name, values in columns.items()}


def _margins(
    phi: Float[np.ndarray, "dof 10"], bounds: Bounds, constraints: Sequence[Constraint]
) -> dict[str, Any]:
    """(value - lower, upper - value) of every box, the triangle inequality, and the user's margins."""
    mass, com, six = _described(phi)
    I_com = np.asarray(_to_com(phi)[2])
    Sigma = 0.5 * np.trace(I_com, axis1=1, axis2=2)[:, None, None] * np.eye(3) - I_com
    pair = lambda value, box: [finite(value - box[0]), finite(box[1] - value)]
    links = Links.from_phi(jnp.asarray(phi))
    total = bounds.total_mass
    return {
        "triangle": np.linalg.eigvalsh(Sigma)[:, 0].tolist(),
        "mass": [pair(mass[i], bounds.mass[i]) for i in range(len(phi))],
        "com": [[pair(com[i, k], bounds.com[i, k]) for k in range(3)] for i in range(len(phi))],
        "inertia": [[pair(six[i, k], bounds.inertia[i, k]) for k in range(6)] for i in range(len(phi))],
        "total_mass": None if total is None else pair(mass.sum(), total),
        "user": [[finite(v) for v in np.ravel(constraint(links))] for constraint in constraints],
    }


def _active(margins: Mapping[str, Any], bounds: Bounds) -> list[str]:
    """Names of the constraints without slack; boxes that are points are not constraints."""
    found = [
        f"triangle inequality of link {i + 1}"
        for i, m in enumerate(margins["triangle"])
        if m <= ACTIVE and bounds.mass[i, 1] > 0
    ]
    rows = [margins["mass"], *zip(*margins["com"], strict=True), *zip(*margins["inertia"], strict=True)]
    named = [f"m{i + 1}" for i in range(bounds.dof)]
    named += [f"c{i + 1}{axis}" for axis in "xyz" for i in range(bounds.dof)]
    named += [f"I{i + 1}{entry}" for entry in INERTIA for i in range(bounds.dof)]
    pairs = [*zip(named, (pair for row in rows for pair in row), strict=True)]
    if margins["total_mass"] is not None:
        pairs.append(("total_mass", margins["total_mass"]))
    for name, pair in pairs:
        width = np.inf if None in pair else sum(pair)
        if width <= _POINT:
            continue
        close = ACTIVE * (width if np.isfinite(width) else 1.0)
        found += [
            f"{name} {end}"
            for end, m in zip(("lower", "upper"), pair, strict=True)
            if m is not None and m <= close
        ]
    user = enumerate(margins["user"])
    return found + [f"constraint {i}" for i, ms in user if any(m is not None and m <= ACTIVE for m in ms)]


def _notes(table: Identification, found: Solutions, weighting: str) -> list[str]:
    discarded = int(np.sum(~table.reliable)) if weighting == "none" else 0
    stalled = int(np.sum((found.violation == 0) & ~found.converged))
    infeasible = int(np.sum(found.violation > 0))
    said = [
        (discarded, f"{discarded} coefficients were left out because they are not reliable"),
        (stalled, f"{stalled} starts were still improving when their steps were used up"),
        (infeasible, f"{infeasible} starts ended outside a bound or constraint and do not count"),
    ]
    return [text for count, text in said if count]


def _lost(table: Identification, error: float | None) -> list[str]:
    """A sentence where links that could be built explain the torque worse than the coefficients by far."""
    least = table.relative_error_percent
    if error is None or not least or error < _LOST * least:
        return []
    return [
        f"links that could be built leave {error:.2f} % of the torque, the coefficients {least:.2f} %: bounds,"
        " constraints or what the model holds beside its links (armature, damping, fixed bodies) contradict the"
        " recording"
    ]


def _load_starts(path: Path) -> Solutions | None:
    if not path.is_file():
        return None
    fields: dict[str, Any] = dict(read_npz(path))
    for name in ("compile_seconds", "run_seconds"):
        fields[name] = float(fields[name])
    return Solutions(**fields)
