r"""From the weights of the models that were compared to a probability of being right.

The models compared are those of the catalogue, each with one other term in a place. What the catalogue lacks is
not among them, so that their weights are too sure: most where something stays unexplained; where a law is small
beside what the model gets wrong of torque that it was not fitted to, and may be what that is off by; where its
torque is not clear of what its coefficients may be off; and where it acts for a while only, when nothing else in
the recordings tests it. How often findings like this one are right was counted in trials, simulated ones and on
recordings of real arms, and a logistic regression on the count (Platt, Advances in Large Margin Classifiers 1999)
says

$$\operatorname{logit} P = w_0 + w_1 \operatorname{logit} p
  + w_2 \log_{10} a + w_3 f + w_4 u + w_5 e + w_6 \log_{10} z$$

with p the weight; a the finding's torque over the held-out error, at the joint where that is most;
$f = \operatorname{sgn}(F) \log_{10}(1 + |F|)$ of the nats F by which it makes torque likelier that nothing was
fitted to (`Finding.foretold`); u whether something is left unexplained; e whether it is a law that acts in an
interval only; and z its torque there over the deviation of that (`Finding.torque_std`).
`experiments/calibrate.py` fits w.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
import scipy.special
from jaxtyping import Bool, Float

from .finding import Finding, Fit

WEIGHTS = (-1.68, 0.09, 2.19, 0.93, -0.91, -1.4, 0.9)
"""$w_0 \\ldots w_6$."""
SUREST = 0.995
"""No finding is surer."""
TOLD = 0.25
"""Confidence from which a finding is told, as one that is missed costs three times what a false one does."""
_LEAST_SIZE = 1e-2
_CLEAR = 0.3, 30.0
"""Deviations that a torque may be clear by, beyond which it makes no difference."""
UNTOLD = 5.0
"""The same of a torque whose deviation nobody knows."""


def calibrated(findings: Sequence[Finding], verdict: str, fit: Fit) -> list[Finding]:
    """The findings with the probability that they are right in the place of their weight, which stays as
    `posterior`.

    Args:
        findings: those of one diagnosis.
        verdict: of the diagnosis.
        fit: its errors of torque.
    """
    if not findings:
        return []
    sizes = np.stack([f.rms_torque for f in findings]) / _error(fit)
    foretold = [f.evidence if f.foretold is None else f.foretold for f in findings]
    at_times = np.array([bool(f.parameters) and f.intervals is not None for f in findings])
    unsure = [f.rms_torque / UNTOLD if f.torque_std is None else f.torque_std for f in findings]
    x = features(sizes, np.array(foretold), verdict == "explained", at_times, np.stack(unsure) / _error(fit))
    return [_calibrated(f, of_one) for f, of_one in zip(findings, x, strict=True)]


def _error(fit: Fit) -> Float[np.ndarray, " dof"]:
    """Of torque that nothing was fitted to, and no less than the noise [N m]."""
    return np.maximum(fit.held_out_rmse_after, fit.noise_floor)


def features(
    sizes: Float[np.ndarray, "findings dof"],
    foretold: Float[np.ndarray, " findings"],
    explained: bool,
    at_times: Bool[np.ndarray, " findings"],
    unsure: Float[np.ndarray, "findings dof"],
) -> Float[np.ndarray, "findings 6"]:
    r"""What tells how often a weight is right, beside the weight: 1, $\log_{10} a$, f, u, e and $\log_{10} z$.

    Args:
        sizes: torque of each finding at each joint over the held-out error.
        foretold: nats by which each makes torque likelier that nothing was fitted to.
        explained: whether nothing is left unexplained.
        at_times: which are laws that act in an interval only.
        unsure: deviation of the torque of each, over the same error.
    """
    at = sizes.argmax(1)
    each = np.arange(len(sizes))
    return np.stack(
        [
            np.ones(len(sizes)),
            np.log10(np.maximum(sizes[each, at], _LEAST_SIZE)),
            np.sign(foretold) * np.log10(1 + np.abs(foretold)),
            np.full(len(sizes), 0.0 if explained else 1.0),
            at_times.astype(float),
            np.log10(np.clip(sizes[each, at] / np.maximum(unsure[each, at], 1e-300), *_CLEAR)),
        ],
        1,
    )


def weight_of(posterior: float) -> float:
    """Logit of a weight, within what may be said."""
    return float(scipy.special.logit(np.clip(posterior, 1 - SUREST, SUREST)))


def _calibrated(finding: Finding, x: Float[np.ndarray, " 6"]) -> Finding:
    first, own, *others = WEIGHTS
    sure = float(scipy.special.expit(own * weight_of(finding.confidence) + x @ [first, *others]))
    # what is taken from the finding goes to what nobody thought of; what it gains, the others lose
    rest = min(1.0, (1 - sure) / max(1 - finding.confidence, 1e-9))
    alternatives = tuple((name, rest * p) for name, p in finding.alternatives)
    return dataclasses.replace(
        finding, confidence=min(sure, SUREST), alternatives=alternatives, posterior=finding.confidence
    )
