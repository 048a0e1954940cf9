r"""Torque measured before and behind the drives: what the drives lose, and what the links take.

$$\tau = \mathrm{ID}_{links}(q, \dot q, \ddot q) + \ldots, \qquad
\tau_{motor} = \tau + F(\dot q, \tau) + J\,\ddot q + \ldots$$

The first is a diagnosis of `tau` by the arm's links alone: payloads, contacts, links and the sensors at the
joints are seen in it, and friction behind the sensors if there is any. The second is one of `tau_motor` by the
drives alone, friction and rotors of the user's file among them, less what the first left of `tau`: no body and no
force from outside can be mistaken for friction there, nor friction for them. What the first says of the joints'
sensors is taken off before.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from .. import files
from ..arms import markup
from ..arms.arm import Arm
from ..arms.export import missing_assets
from ..arms.mjcf import MjcfSource
from ..corrected import KIND, Corrected
from ..effects import AbstractEffect
from ..posterior import FILE as POSTERIOR_FILE
from ..prediction.predict import at_rows, passed_on
from ..recordings import Recording
from . import saved
from .diagnosis import Diagnosis
from .finding import VERDICTS, Finding, Fit
from .posterior import posterior_of_sides


@dataclasses.dataclass(frozen=True)
class TwoSided:
    """What the simulation is missing behind the drives, and in them; other fields as of `Diagnosis`."""

    link: Diagnosis
    """Of `tau`, by the links alone."""
    drive: Diagnosis
    """Of `tau_motor`, by the drives alone."""
    corrected: Corrected
    """The whole arm, as its motors move it."""
    written: markup.Document
    warnings: tuple[str, ...]
    """What the corrected file cannot hold."""
    notes: tuple[str, ...]
    sources: tuple[Mapping[str, str], ...] = ()
    replays: tuple[Mapping[str, Any], ...] = ()

    @property
    def bare(self) -> "TwoSided":
        """The same, without what its searches keep and can be made again."""
        return dataclasses.replace(self, link=self.link.bare, drive=self.drive.bare)

    @property
    def source(self) -> MjcfSource:
        return self.link.source

    @property
    def fit(self) -> Fit:
        """Of `tau` [N m]."""
        return self.link.fit

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Of both sides, those first that explain most torque over its noise."""
        sided = []
        for found, side in ((self.link, "link"), (self.drive, "drive")):
            for finding in found.findings:
                # physics of the drive is in the drive, wherever its torque is seen
                here = "drive" if finding.family == "drive" else side
                size = float(np.sum(np.square(finding.rms_torque / found.fit.noise_floor)))
                sided.append((size, dataclasses.replace(finding, side=here)))
        return tuple(finding for _, finding in sorted(sided, key=lambda one: -one[0]))

    @property
    def verdict(self) -> str:
        """Of both sides together."""
        both = {self.link.verdict, self.drive.verdict}
        return both.pop() if len(both) == 1 else _joined(both - {"consistent"})

    def to_json(self) -> dict[str, Any]:
        """diagnosis.json; what belongs to one side stands in that side's own."""
        return saved.document(
            self,
            self.link.knowledge,
            fit_motor=self.drive.fit.to_json(),
            log=[*self.link.log, *self.drive.log],
            sides={"link": self.link.to_json(), "drive": self.drive.to_json()},
        )

    def lines(self) -> list[str]:
        """Verdict and findings in plain sentences."""
        where = {"link": "Behind the drives", "drive": "In the drives"}
        told = [f"{where[f.side]}: {f.summary} Confidence {f.confidence:.2f}." for f in self.findings]
        opening = VERDICTS[self.verdict]
        if self.verdict == "consistent":
            opening = "The simulation agrees with the recordings, in the drives and behind them."
        return [opening, *dict.fromkeys((*self.link.not_judged, *self.drive.not_judged)), *told]

    def save(self, folder: str | Path) -> tuple[str, ...]:
        """Write diagnosis.json, corrected.xml with what it includes, corrected.json, which has both sides beside
        the whole arm, and posterior.npz. What corrected.xml will not find there comes back, a sentence each.

        Raises:
            InputError: a file of such a name stands there that no earlier diagnosis left; nothing is written.
        """
        sides = {
            side: saved.with_noise(found.corrected, found.fit)
            for side, found in (("link", self.link), ("drive", self.drive))
        }
        whole = {**saved.with_noise(self.corrected, self.drive.fit), "sides": sides}
        with files.output_folder(folder, KIND) as scratch:
            saved.write(self, scratch, whole)
            posterior_of_sides(self.link, self.drive).save(scratch / POSTERIOR_FILE)
        return missing_assets(self.written, Path(folder))


def notes_of(link: Diagnosis, drive: Diagnosis, warnings: Sequence[str]) -> tuple[str, ...]:
    """Those of both sides, each once."""
    first = (
        "damping, frictionloss and armature of your file were taken for the drives', between tau_motor and tau;"
        " corrected.xml and simulations have the torque of the motors"
    )
    return tuple(dict.fromkeys((first, *link.notes, *drive.notes, *warnings)))


def _joined(verdicts: set[str]) -> str:
    """One verdict of sides that differ, those left out where nothing is missing."""
    return verdicts.pop() if len(verdicts) == 1 else "partly_explained"


def links_alone(arm: Arm) -> Arm:
    """The arm behind its drives."""
    still = jnp.zeros(arm.dof)
    return eqx.tree_at(lambda a: (a.damping, a.frictionloss, a.armature), arm, (still, still, still))


def drive_alone(arm: Arm) -> Arm:
    """The drives of the arm, without what they move."""
    nothing = jnp.zeros_like(arm.standard), jnp.zeros(arm.dof)
    return eqx.tree_at(lambda a: (a.standard, a.stiffness), arm, nothing)


def on_drives(catalogue: Sequence[type[AbstractEffect]]) -> tuple[type[AbstractEffect], ...]:
    """Effects that can act between the torque of the motors and that behind the drives."""
    return tuple(e for e in catalogue if not e.on_links and e.acts_on != "position")


def on_motors(found: Diagnosis, recordings: Sequence[Recording]) -> list[Recording]:
    """The recordings as the drives see them: the load that they carry is the fitted torque of the links, without
    the noise of `tau`, which would pass for a wrong scale of `tau_motor` where little torque is carried; what
    that leaves of `tau` was measured on both sides, and is taken off `tau_motor`.

    Args:
        found: the diagnosis of `tau` in all of them.
        recordings: with both torques.
    """
    views = []
    problem = found.problem
    each = zip(recordings, problem.traces, found.residuals(), problem.active, strict=True)
    for recording, trace, (_, time, _, left), on in each:
        fitted = at_rows(recording, time, trace.tau - left)
        measured = recording.require_tau()
        if on:
            fitted, measured = (passed_on(found.corrected, recording, tau) for tau in (fitted, measured))
        motors = recording.of_motor_side()
        shown = motors.require_tau() - measured + fitted
        views.append(dataclasses.replace(motors, tau=shown, transmitted=fitted))
    return views


def both(arm: Arm, links: Corrected, drives: Corrected) -> Corrected:
    """The whole arm as its motors move it, by what was found on either side; the sensors behind the drives show
    nothing of that."""
    pairs = [*zip(links.effects, links.coefficients, strict=True)]
    pairs = [(e, c) for e, c in pairs if e.acts_on != "torque"]
    pairs += zip(drives.effects, drives.coefficients, strict=True)
    return Corrected(
        arm,
        links.change,
        links.damping_change + drives.damping_change,
        links.frictionloss_change + drives.frictionloss_change,
        tuple(e for e, _ in pairs),
        tuple(c for _, c in pairs),
        drives.turns,
        friction_shown=drives.friction_shown,
    )
