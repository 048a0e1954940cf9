"""Motions that tell an arm's parameters best, within what the arm can do."""

from .commands import excite_files as excite_files
from .excite import excite as excite
from .result import Excitation as Excitation
