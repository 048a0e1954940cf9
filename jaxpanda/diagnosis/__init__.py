"""Which physics a model is missing: located, named, modelled, and shown to help."""

from ..prediction import predict as predict
from ..prediction import predict_sides as predict_sides
from .commands import diagnose_files as diagnose_files
from .diagnosis import Diagnosis as Diagnosis
from .diagnosis import Finding as Finding
from .diagnosis import Fit as Fit
from .entry import diagnose as diagnose
from .two_sided import TwoSided as TwoSided
