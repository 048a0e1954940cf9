"""The linear scan: evidence of every shape that comes again, by a few large products a joint.

Candidates keep their columns from one step of a search to the next; what changes is the noise and what the model
holds. So columns lie side by side, coefficient by coefficient, `(rows, n m)`: they are whitened a slice at a
time, which never leaves the cache, and multiplied with everything in the model at once. Products stay as long
as the noise of their joint does; then a step costs small matrices only.
"""

import dataclasses
from collections import defaultdict
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from ..arms.arm import Arm
from ..effects import AbstractEffect
from ..host import parallel
from .evidence import PHYSICAL_SCALES, SCALES, Design, Noise, log_bayes
from .library import Candidates

if TYPE_CHECKING:
    from .problem import Problem, Term

_SLICE = 1 << 16
"""Numbers whitened at a time: half a megabyte."""


@dataclasses.dataclass
class Whitened:
    """What a joint's noise has been applied to, for as long as it stays; `products` are between the rows."""

    stamp: tuple
    residual: Float[np.ndarray, " rows"]
    nuisance: Float[np.ndarray, "rows n"]
    terms: dict[int, tuple["Term", Float[np.ndarray, "rows n"] | None]] = dataclasses.field(
        default_factory=dict
    )
    """By identity; None where a term does not act in the joint."""
    products: dict[tuple, np.ndarray] = dataclasses.field(default_factory=dict)
    transposed: dict[Any, Float[np.ndarray, "rows n"]] = dataclasses.field(default_factory=dict)
    """`Noise.transposed` of the rows."""
    blocks: dict[Any, tuple[np.ndarray, dict]] = dataclasses.field(default_factory=dict)
    """For each block of candidates its Gram matrices, and its products by what they are with."""

    def rows(self, key: Any) -> Float[np.ndarray, "rows ..."] | None:
        if key == "residual":
            return self.residual
        return self.nuisance if key == "nuisance" else self.terms[key][1]

    def product(self, left: Any, right: Any) -> np.ndarray:
        """$A^\\top B$ of two sets of rows."""
        if (left, right) not in self.products:
            A, B = self.rows(left), self.rows(right)
            assert A is not None
            assert B is not None
            self.products[left, right] = A.T @ B
        return self.products[left, right]


@dataclasses.dataclass(frozen=True)
class Block:
    """m candidates of n coefficients each, as columns of one joint: all of the first coefficient first."""

    key: Any
    joint: int
    n: int
    x: Float[np.ndarray, "rows nm"]

    def products(
        self, problem: "Problem", noise: Noise, design: Design
    ) -> tuple[Float[np.ndarray, "n n m"], Float[np.ndarray, " nm"], Float[np.ndarray, "acting nm"]]:
        r"""$\Phi^\top\Phi$ of each candidate (its lower triangle), $\Phi^\top r$ and $A^\top\Phi$ of what acts
        in the joint, whitened."""
        here = problem.whitened_joint(noise, self.joint, design.terms)
        acting = [id(t) for t in design.terms if here.terms[id(t)][1] is not None]
        G, kept = here.blocks.get(self.key, (None, {}))
        missing = [key for key in ("residual", "nuisance", *acting) if key not in kept]
        if G is None:
            G = self._grams(problem, noise)
        if missing:
            wanted = [problem.transposed(noise, self.joint, here, key) for key in missing]
            found = np.concatenate(wanted, 1).T @ self.x
            splits = np.cumsum([w.shape[1] for w in wanted])[:-1]
            kept = kept | dict(zip(missing, np.split(found, splits), strict=True))
            here.blocks[self.key] = G, kept
        return G, kept["residual"][0], np.concatenate([kept[key] for key in ("nuisance", *acting)])

    def _grams(self, problem: "Problem", noise: Noise) -> Float[np.ndarray, "n n m"]:
        x = self.x.reshape(len(self.x), self.n, -1)
        out = np.zeros((self.n, self.n, x.shape[2]))
        step = max(1, _SLICE // (len(x) * self.n))
        for low in range(0, x.shape[2], step):
            some = slice(low, low + step)
            F = problem.whitened([x[rows, :, some] for rows in problem.rows], noise, self.joint)
            for i in range(self.n):
                for k in range(i + 1):
                    out[i, k, some] = np.einsum("tm,tm->m", F[:, i], F[:, k])
        return out


def projected(
    problem: "Problem", noise: Noise, design: Design, blocks: Sequence[Block]
) -> tuple[Float[np.ndarray, "m n"], Float[np.ndarray, "m n n"]]:
    """b and G (its lower triangle) of candidates that act in the joints of the blocks at once."""
    n = blocks[0].n
    parts = [block.products(problem, noise, design) for block in blocks]
    G, Fr = (sum(p[k] for p in parts[1:]) + parts[0][k] for k in range(2))
    if len(blocks) == 1:
        places = design.columns.acting(blocks[0].joint)
        FA, C = parts[0][2], design.explained(blocks[0].joint, parts[0][2])
    else:
        places, FA = np.arange(len(design.g)), np.zeros((len(design.g), len(Fr)))
        for block, (*_, products) in zip(blocks, parts, strict=True):
            FA[design.columns.acting(block.joint)] += products
        C = design.lowered(FA)
    b, C, G = (Fr - design.x[places] @ FA).reshape(n, -1), C.reshape(len(C), n, -1), G.copy()
    for i in range(n):
        for k in range(i + 1):
            G[i, k] -= np.einsum("pm,pm->m", C[:, i], C[:, k])
    return b.T, np.moveaxis(G, 2, 0)


@dataclasses.dataclass(frozen=True)
class Family:
    """Candidates of as many coefficients and the same scales, at one joint or in the whole arm."""

    groups: tuple[Candidates, ...]
    blocks: tuple[Block, ...]
    signs: Float[np.ndarray, "m n"]
    plausible: Float[np.ndarray, "m n"]
    """Size that physics suggests; NaN where the noise decides."""
    size: Float[np.ndarray, "joints m n"]
    """rms of the columns in each joint of `blocks`."""
    scales: tuple[float, ...]

    @property
    def starts(self) -> np.ndarray:
        return np.cumsum([0, *(len(g.effects) for g in self.groups)])

    def deviation(self, noise: Noise) -> Float[np.ndarray, "m n"]:
        """Prior deviation of each coefficient: its plausible size, or that of an effect as large as the noise.

        Of an effect in several joints the one that feels most counts.
        """
        std = noise.std[[block.joint for block in self.blocks]]
        size = (self.size / std[:, None, None]).max(0)
        most = np.maximum.reduceat(size.max(1), self.starts[:-1])
        least = np.repeat(1e-9 * np.maximum(most, 1e-12), np.diff(self.starts))
        return np.where(np.isnan(self.plausible), 1 / np.maximum(size, least[:, None]), self.plausible)


def families(groups: Sequence[Candidates], arm: Arm) -> list[Family]:
    """Candidates sorted into as few products as can be."""
    sorted_: dict[tuple, list[Candidates]] = defaultdict(list)
    for group in groups:
        k = group.effects[0].coefficients
        sorted_[group.joint, len(k), scales_of(group.effects[0])].append(group)
    out = []
    for (joint, n, scales), members in sorted_.items():
        blocks, sizes = [], []
        for j in range(arm.dof) if joint is None else (joint,):
            x = np.concatenate(
                [np.concatenate([c if joint is not None else c[:, j] for c in g.columns]) for g in members], 1
            )
            sizes.append(np.sqrt((x**2).mean(0)))
            flat = np.ascontiguousarray(np.swapaxes(x, 1, 2)).reshape(len(x), -1)
            blocks.append(Block((joint, n, scales), j, n, flat))
        each = [k for g in members for k in [g.effects[0].coefficients] * len(g.effects)]
        signs = [k for g in members for k in [g.effects[0].signs(arm)] * len(g.effects)]
        out.append(
            Family(
                tuple(members),
                tuple(blocks),
                np.array(signs, float),
                np.array([[np.nan if c.scale is None else c.scale for c in k] for k in each]),
                np.stack(sizes),
                scales,
            )
        )
    return out


def scales_of(effect: AbstractEffect) -> tuple[float, ...]:
    """Multiples of the prior deviation that are expected alike."""
    return SCALES if effect.coefficients[0].scale is None else PHYSICAL_SCALES


Score = tuple[Float[np.ndarray, " m"], Float[np.ndarray, "m n"]]
"""Log Bayes factor of each shape of a group, and the prior deviations at its likeliest scale."""


def scan(problem: "Problem", design: Design, noise: Noise, some: Sequence[Family]) -> dict[int, Score]:
    """Scores of all groups of these families, by the group's identity."""

    def one(family: Family):
        return family, *projected(problem, noise, design, family.blocks), family.deviation(noise)

    problem.whitened_joints(noise, design.terms)
    alike: dict[tuple, list] = defaultdict(list)
    for part in parallel(one, some):
        alike[part[0].scales, part[1].shape[1]].append(part)
    out = {}
    for (scales, _), parts in alike.items():
        b, G, deviation = (np.concatenate([p[k] for p in parts]) for k in (1, 2, 3))
        signs = np.concatenate([p[0].signs for p in parts])
        value, scale = log_bayes(b, G, deviation, scales, signs)
        groups = [g for p in parts for g in p[0].groups]
        ends = np.cumsum([len(g.effects) for g in groups])[:-1]
        values, deviations = np.split(value, ends), np.split(deviation * scale[:, None], ends)
        out |= {id(g): (v, d) for g, v, d in zip(groups, values, deviations, strict=True)}
    return out
