"""Whether two identifications, retrievals or diagnoses agree, and what explains where they do not."""

from .commands import compare_files as compare_files
from .compare import compare as compare
from .result import Comparison as Comparison
