"""What a motion would recover of an arm, before anybody moves hardware."""

from .commands import rehearse_files as rehearse_files
from .rehearse import rehearse as rehearse
from .result import Rehearsal as Rehearsal
