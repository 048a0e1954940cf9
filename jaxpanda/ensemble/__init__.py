"""Feasible arms drawn from what recordings tell: what torque cannot tell is a distribution."""

from .commands import ensemble_files as ensemble_files
from .result import Ensemble as Ensemble
from .sample import draw_ensemble as draw_ensemble
