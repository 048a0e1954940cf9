"""Many recordings of many arms: each diagnosed once, whatever happens to who does it, and each arm's together."""

from .commands import diagnose_fleet as diagnose_fleet
from .commands import fleet_files as fleet_files
from .hierarchy import History as History
from .hierarchy import history as history
from .result import Fleet as Fleet
