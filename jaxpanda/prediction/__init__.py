"""Torque of a motion, by the model that a diagnosis found."""

from .commands import Prediction as Prediction
from .commands import predict_files as predict_files
from .predict import predict as predict
from .predict import predict_sides as predict_sides
