"""The body on a flange, from recordings of the same arm without and with it."""

from .commands import payload_files as payload_files
from .estimate import estimate_payload as estimate_payload
from .result import PayloadEstimate as PayloadEstimate
