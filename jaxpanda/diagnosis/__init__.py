"""Which physics a model is missing: located, named, modelled, and shown to help."""

from .commands import Prediction as Prediction
from .commands import diagnose_files as diagnose_files
from .commands import predict_files as predict_files
from .diagnosis import Diagnosis as Diagnosis
from .diagnosis import Finding as Finding
from .diagnosis import Fit as Fit
from .entry import diagnose as diagnose
from .entry import predict as predict
from .entry import predict_sides as predict_sides
from .two_sided import TwoSided as TwoSided
