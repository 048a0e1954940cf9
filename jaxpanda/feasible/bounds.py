"""`Bounds`: boxes on the parameters of every link, and where they come from."""

import csv
import dataclasses
import re
from importlib import resources
from pathlib import Path

import jax
import numpy as np
from jaxpanda_kernels import inertia
from jaxtyping import Float

from .. import inputs
from ..arms.arm import Arm
from ..arms.source import is_panda
from ..errors import InputError

INERTIA = ("xx", "yy", "zz", "xy", "xz", "yz")
"""Order of the six entries of an inertia tensor in tables and files."""


@dataclasses.dataclass(frozen=True)
class Bounds:
    """Lower and upper bounds of each link; last axis (lower, upper), SI units, the link's frame.

    Raises:
        InputError: a bound is not a number, a lower one exceeds its upper one, masses or centres of mass
            are not bounded (random starts are drawn inside the box), or a link may have no mass, unless both
            bounds say that it has none.
    """

    mass: Float[np.ndarray, "dof 2"]
    """[kg]"""
    com: Float[np.ndarray, "dof 3 2"]
    """Centre of mass [m]."""
    inertia: Float[np.ndarray, "dof 6 2"]
    """xx, yy, zz, xy, xz, yz about the centre of mass [kg m²]; infinite where there is no bound."""
    total_mass: Float[np.ndarray, " 2"] | None = None
    """Sum of all links' masses [kg]."""

    def __post_init__(self):
        for name, box in self.boxes():
            lower, upper = box
            if np.isnan(lower) or np.isnan(upper) or lower > upper:
                raise InputError(
                    f"bounds of {name}: [{lower:g}, {upper:g}] is empty; lower must not exceed upper"
                )
            if not name.startswith("I") and not (np.isfinite(lower) and np.isfinite(upper)):
                raise InputError(f"bounds of {name}: [{lower:g}, {upper:g}] must be finite")
            if name.startswith("m") and upper <= 0 and (lower, upper) != (0, 0):  # a link that has none
                raise InputError(
                    f"bounds of {name}: the upper bound {upper:g} kg leaves no mass; give a positive one"
                )
            if name.startswith("m") and lower < 0:
                raise InputError(
                    f"bounds of {name}: the lower bound {lower:g} kg is negative; a mass is at least 0"
                )
        if self.total_mass is not None:
            least, most = self.mass.sum(0)
            if self.total_mass[0] > most or self.total_mass[1] < least:
                raise InputError(
                    f"bounds of total_mass: [{self.total_mass[0]:g}, {self.total_mass[1]:g}] kg cannot be "
                    f"met, the links' masses add up to [{least:g}, {most:g}] kg"
                )

    @property
    def dof(self) -> int:
        return len(self.mass)

    def boxes(self) -> list[tuple[str, Float[np.ndarray, " 2"]]]:
        """Every bound under its name in tables: `m1`, `c1x`, `I1xx`, ..., `total_mass`."""
        named = [(f"m{i + 1}", self.mass[i]) for i in range(self.dof)]
        named += [
            (f"c{i + 1}{axis}", self.com[i, k]) for i in range(self.dof) for k, axis in enumerate("xyz")
        ]
        named += [
            (f"I{i + 1}{s}", self.inertia[i, k]) for i in range(self.dof) for k, s in enumerate(INERTIA)
        ]
        return named + ([("total_mass", self.total_mass)] if self.total_mass is not None else [])

    @classmethod
    def panda(cls) -> "Bounds":
        """The Panda's, as Gaz et al. 2019 published them (file bounds_gM), with 16 to 20 kg in total."""
        with resources.as_file(resources.files("jaxpanda").joinpath("published/gaz2019_bounds.csv")) as path:
            boxes = cls.from_csv(path)
        return dataclasses.replace(boxes, total_mass=np.array([16.0, 20.0]))

    @classmethod
    def of(cls, arm: Arm) -> "Bounds":
        """The published ones for the project's own Panda, `around` any other arm."""
        return cls.panda() if is_panda(arm) else cls.around(arm)

    @classmethod
    def from_csv(cls, path: str | Path) -> "Bounds":
        """Read a table with the columns `name,lower,upper`.

        Names: `m1` [kg], `c1x` [m], `I1xx` (about the centre of mass [kg m²]), 1-based, and `total_mass`
        [kg]. Mass and centre of mass are required for every link; what is absent of the rest is unbounded.

        Raises:
            InputError: naming the file, row and column of the first thing that is wrong.
        """
        table = _read_table(Path(path))
        dof = max((int(m[1]) for name in table if (m := re.match(r"[mcI](\d+)", name))), default=0)
        wanted = [f"m{i + 1}" for i in range(dof)] + [f"c{i + 1}{a}" for i in range(dof) for a in "xyz"]
        missing = [name for name in wanted if name not in table]
        if missing or dof == 0:
            raise InputError(
                f"{path}: no row for {', '.join(missing) or 'm1'}; every link needs m, cx, cy, cz"
            )
        diagonal, product = (0.0, np.inf), (-np.inf, np.inf)
        unbounded = dict(zip(INERTIA, [diagonal] * 3 + [product] * 3, strict=True))
        return cls(
            mass=np.array([table[f"m{i + 1}"] for i in range(dof)]),
            com=np.array([[table[f"c{i + 1}{a}"] for a in "xyz"] for i in range(dof)]),
            inertia=np.array(
                [[table.get(f"I{i + 1}{s}", unbounded[s]) for s in INERTIA] for i in range(dof)]
            ),
            total_mass=np.array(table["total_mass"]) if "total_mass" in table else None,
        )

    @classmethod
    def around(cls, arm: Arm) -> "Bounds":
        """Bounds for an arm without published ones, from its nominal parameters and its geometry.

        Mass: a fifth to three times the nominal one (at least up to 0.1 kg; none for a link that has none).
        Centre of mass: the box around the link's own joint, the next joint and the nominal centre of mass,
        widened by 0.05 m and a quarter
        of its size. Inertia: what the largest mass at the box's corners would have (at least twice the
        nominal one). Total mass: nominal within 25 %. Wide on purpose: they keep the starts near the arm,
        they are not knowledge about it.
        """
        mass, com, I_com = (np.asarray(x) for x in jax.vmap(inertia.to_com)(arm.standard))
        # The next joint in this link's frame; the last link has none, its own origin stands in.
        tips = np.concatenate([np.asarray(arm.chain.p)[1:], np.zeros((1, 3))])
        corners = np.stack([np.zeros_like(tips), tips, com])
        low, high = corners.min(0), corners.max(0)
        margin = 0.05 + 0.25 * (high - low)
        low, high = low - margin, high + margin
        heaviest = np.where(mass == 0, 0.0, np.maximum(3 * mass, 0.1))  # between two joints of one body
        nominal = np.abs(I_com).max((1, 2))
        largest = np.maximum(heaviest * np.sum((high - low) ** 2, -1), 2 * nominal)
        return cls(
            mass=np.stack([mass / 5, heaviest], -1),
            com=np.stack([low, high], -1),
            inertia=np.stack([np.outer(largest, [0, 0, 0, -1, -1, -1]), np.outer(largest, np.ones(6))], -1),
            total_mass=mass.sum() * np.array([0.75, 1.25]),
        )


def _read_table(path: Path) -> dict[str, tuple[float, float]]:
    """Rows of a `name,lower,upper` table."""
    text = inputs.read_text(path, 1 << 20, "a CSV table of bounds")
    reader = csv.DictReader(text.splitlines())
    columns = {"name", "lower", "upper"}
    if not columns <= set(reader.fieldnames or ()):
        raise InputError(f"{path}: row 1 has no columns name,lower,upper; a header row with these would work")
    table: dict[str, tuple[float, float]] = {}
    for number, row in enumerate(reader, start=2):
        name = (row["name"] or "").strip()
        if not re.fullmatch(
            r"(m@|c@[xyz]|I@(xx|yy|zz|xy|xz|yz)|total_mass)".replace("@", r"[1-9]\d{0,2}"), name
        ):
            raise InputError(
                f"{path}: row {number}, column name: '{name[:60]}' is none of m1, c1x, I1xx, total_mass"
            )
        if name in table:
            raise InputError(f"{path}: row {number}, column name: '{name}' occurs twice")
        table[name] = (_number(path, number, row, "lower"), _number(path, number, row, "upper"))
    return table


def _number(path: Path, number: int, row: dict[str, str | None], column: str) -> float:
    cell = row[column] or ""
    try:
        return float(cell)
    except ValueError:
        raise InputError(f"{path}: row {number}, column {column}: '{cell[:60]}' is not a number") from None
