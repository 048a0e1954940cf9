"""What arms' logs say: read, checked, and every repair counted."""

from ..reading import Reading as Reading
from .checks import plausible as plausible
from .files import content_of as content_of
from .files import distinct as distinct
from .files import load as load
from .files import load_many as load_many
from .files import save as save
from .recording import Origin as Origin
from .recording import Recording as Recording
