"""What KUKA's Sunrise controller calls the columns of the logs that its DataRecorder writes beside FRI.

Blanks between cells, a header after `%`; time in two columns, whole seconds and nanoseconds. Positions are in
the unit that the recorder was given, radians unless told. Time and `axisQMsr` are as public logs have them; no
public log with torque was at hand, and `axisTauMsr` goes by the same rule.
"""

from .table import MEASURED, Source

SUNRISE = Source(
    "KUKA Sunrise's DataRecorder (FRI)",
    {
        "time": "ZeitInSec+ZeitInNanoSec",
        "q": "axisQMsr_*[{j}]",
        "tau": "axisTauMsr_*[{j}]",
    },
    "measured",
    f"axisTauMsr is the {MEASURED}; axisTauExtMsr is what the arm's own model leaves of it",
)
