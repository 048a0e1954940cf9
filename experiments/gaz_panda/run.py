"""Identification of the Panda on the data behind Gaz et al. 2019: the paper's figures beside jaxpanda's."""

import argparse
import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxpanda_kernels import inertia

from jaxpanda.arms.arm import Arm
from jaxpanda.arms.panda import published
from jaxpanda.friction import SIGMOID, Friction
from jaxpanda.identification import (
    Identification,
    MassGravity,
    identify,
    identify_mass_gravity,
    load_mass_gravity,
)
from jaxpanda.identification.regression import regression
from jaxpanda.parameters import arm_base_parameters
from jaxpanda.recordings import load
from jaxpanda.signals import Signals, prepare


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True, help="folder that holds gaz_panda")
    parser.add_argument("--sigmoid", action="store_true", help="fit the friction of eq. 25 too (slower)")
    options = parser.parse_args()
    folder, arm = options.data / "gaz_panda", Arm.panda()

    from_mass_and_gravity(load_mass_gravity(folder / "mass_gravity_1010.npz"), arm)

    recording = load(folder)
    signals = prepare(recording)
    heading("torque of the exciting trajectory, 5 Hz: published parameters, no fit [N m]")
    row("coefficients of Table III (classical) and their friction", classical_set(signals, arm))
    row("retrieved links as printed, and sigmoid friction", retrieved_set(signals, as_printed(arm)))
    row("the same with the misprinted c6z corrected", retrieved_set(signals, arm))

    heading("identified here, in sample [N m]")
    found = {
        "classical, joints weighted": identify(recording, arm),
        "classical, unweighted": identify(recording, arm, weighting="none"),
        "feasible in one step": identify(recording, arm, method="one_step"),
        "feasible in one step, no prior": identify(
            recording, arm, method="one_step", prior=np.inf, starts=64
        ),
    }
    if options.sigmoid:
        found["classical, sigmoid friction"] = identify(recording, arm, friction="sigmoid")
    for name, result in found.items():
        line(name, result.rmse, result.relative_error_percent)
    line("noise floor (repeat of the motion)", found["classical, joints weighted"].noise, None)
    heading("identified here, phase-blocked 5-fold cross-validation [N m]")
    for name, result in found.items():
        line(name, result.cross_validated_rmse, result.cross_validated_relative_error_percent)
    reliability(found["classical, joints weighted"])


def from_mass_and_gravity(samples: MassGravity, arm: Arm) -> None:
    heading("reverse engineering from M(q), g(q) at 1,010 configurations")
    result = identify_mass_gravity(samples, arm)
    mass, gravity = (
        MassGravity(samples.name, samples.q, M, g) for M, g in ((samples.M, None), (None, samples.g))
    )
    ranks = [arm_base_parameters(arm).rank, result.rank]
    ranks += [identify_mass_gravity(part, arm).rank for part in (mass, gravity)]
    print("rank of torque's regressor, of [M; g], of M, of g:", *ranks)
    print(f"condition number: {result.condition_number:.3f}")
    print(f"relative error: {result.relative_error_percent:.5f} %")
    print(f"gravity that M and g agree on: {result.settings['preferred_gravity']:.4f} m/s²")
    print(f"relative error with it: {result.settings['preferred_gravity_relative_error_percent']:.5f} %")
    print(f"coefficients beyond 30 %: {np.sum(~result.reliable)}")
    print("coefficient | value | std % | published value")
    for expression, value, std, entry in zip(
        result.expressions, result.beta, result.std, published()["coefficients"], strict=True
    ):
        print(f"  {expression} | {value:.6f} | {100 * std / abs(value):.3f} | {entry['value']:.6f}")


def classical_set(signals: Signals, arm: Arm) -> tuple[np.ndarray, np.ndarray]:
    """Residual and torque, joints first, of the authors' classical coefficients."""
    problem = regression(signals, arm, arm_base_parameters(arm), "coulomb_viscous_offset")
    beta = [entry["published"]["classical"] for entry in published()["coefficients"]]
    friction = published()["classical_friction"]
    theta = np.array([friction[name] for name in ("viscous", "coulomb", "offset")]).T.ravel()
    return problem.residual(np.concatenate([beta, theta])), problem.tau


def as_printed(arm: Arm) -> Arm:
    """The Panda with c6z as Table VIII prints it."""
    mass, com, I_com = inertia.to_com(arm.standard[5])
    printed = com.at[2].set(published()["retrieved_links"][5]["com"][2])
    phi = arm.standard.at[5].set(inertia.from_com(mass, printed, I_com))
    return dataclasses.replace(arm, standard=phi)


def retrieved_set(signals: Signals, arm: Arm) -> tuple[np.ndarray, np.ndarray]:
    """The same of the links that the authors retrieved, with their sigmoid friction."""
    assert signals.tau is not None
    friction = Friction(
        "sigmoid", {name: np.array(published()["sigmoid_friction"][name]) for name in SIGMOID}
    )
    q, qd, qdd = (jnp.asarray(x) for x in (signals.q, signals.qd, signals.qdd))
    model = jax.jit(jax.vmap(arm.inverse_dynamics))(q, qd, qdd) + friction.torque(qd)
    tau = signals.lowpass(signals.tau)
    return (tau - signals.lowpass(np.asarray(model))).T, tau.T


def heading(text: str) -> None:
    print(f"\n{text}")


def row(name: str, residual_and_torque: tuple[np.ndarray, np.ndarray]) -> None:
    e, tau = residual_and_torque
    line(name, np.sqrt(np.mean(e**2, 1)), 100 * np.linalg.norm(e) / np.linalg.norm(tau))


def line(name: str, rmse: np.ndarray | None, percent: float | None) -> None:
    joints = " ".join(f"{value:.3f}" for value in (() if rmse is None else rmse))
    print(f"{name:58s} {joints}" + ("" if percent is None else f"   {percent:.2f} %"))


def reliability(result: Identification) -> None:
    heading("classical coefficients: how sure")
    assert result.std is not None
    assert result.classical_std is not None
    print(f"condition number: {result.condition_number:.1f}")
    print(f"reliable, by the jackknife: {np.sum(result.reliable)} of {result.rank}")
    textbook = np.sum(result.classical_std <= 0.3 * np.abs(result.beta))
    print(f"reliable, by the textbook's deviations: {textbook} of {result.rank}")
    print(f"median ratio of the two deviations: {np.median(result.std / result.classical_std):.1f}")


if __name__ == "__main__":
    main()
