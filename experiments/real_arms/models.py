"""A model as its user would have it: identified on recordings of the healthy arm."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxpanda_kernels import regressor

from jaxpanda import signals
from jaxpanda.arms.arm import Arm
from jaxpanda.arms.export import write_parameters
from jaxpanda.arms.source import from_mjcf
from jaxpanda.friction import Friction
from jaxpanda.identification import identify
from jaxpanda.recordings import Recording

_SPREAD = 0.2
"""Of a link's nominal parameters while rotor inertias are estimated, as a share of its size."""


def identified(
    nominal: str, recordings: Sequence[Recording], folder: Path, *, rotors=False, friction=True
) -> Path:
    """The nominal MJCF with feasible links and friction identified on recordings; `rotors` adds armature."""
    path = folder / "nominal.xml"
    path.write_text(nominal)
    arm, source = from_mjcf(path)
    if rotors:
        arm = _with(arm, armature=np.maximum(rotor_inertias(arm, recordings), 0.0))
    law = "coulomb_viscous_offset"
    found = identify(recordings, arm, method="one_step", friction=law, folds=0, starts=4)
    assert found.friction is not None
    kept = found.friction.viscous, found.friction.coulomb, np.zeros(arm.dof)
    held = dict(zip(("viscous", "coulomb", "offset"), kept, strict=True))
    result = write_parameters(source, arm, found.standard, Friction(law, held) if friction else None)
    out = folder / "model.xml"
    out.write_text(result.text)
    return out


def _with(arm: Arm, **values: np.ndarray) -> Arm:
    return dataclasses.replace(arm, **{name: jnp.asarray(value) for name, value in values.items()})


def rotor_inertias(arm: Arm, recordings: Sequence[Recording]) -> np.ndarray:
    r"""Reflected inertia of each rotor [kg m²], by least squares beside links, friction and an offset.

    Torque hardly tells the first joints' rotors from their links: these stay near the nominal ones,
    $\phi \sim N(\phi_0, (0.2\,s)^2)$ with s the size of a link's mass, moments and inertias.
    """
    rows, left = [], []
    for recording in recordings:
        s = signals.prepare(recording, rate=20.0)
        Y = np.asarray(jax.jit(jax.vmap(lambda *x: regressor(arm.chain, *x)))(s.q, s.qd, s.qdd))
        Y = Y.reshape(len(Y), arm.dof, -1)
        joints = np.stack([s.qdd, s.qd, np.sign(s.qd), np.ones_like(s.qd)], -1)
        wide = np.einsum("tjk,ji->tjki", joints, np.eye(arm.dof)).reshape(len(Y), arm.dof, -1)
        rows.append(s.lowpass(np.concatenate([Y, wide], 2)))
        assert s.tau is not None
        left.append(s.lowpass(s.tau) - s.lowpass(Y @ np.asarray(arm.standard).ravel()))
    A, b = np.concatenate(rows), np.concatenate(left)
    mass = np.asarray(arm.standard)[:, :1]
    spread = _SPREAD * mass * np.array([1.0, *[0.1] * 3, *[0.04] * 6])
    precision = np.zeros(A.shape[2])
    precision[: spread.size] = spread.ravel() ** -2.0
    weight = np.ones(arm.dof)
    x = np.zeros(A.shape[2])
    for _ in range(4):
        H = np.einsum("tja,j,tjb->ab", A, weight, A) + np.diag(precision + 1e-9)
        x = np.linalg.solve(H, np.einsum("tja,j,tj->a", A, weight, b))
        weight = 1 / np.mean((b - A @ x) ** 2, 0)
    return x[spread.size : spread.size + arm.dof]
