"""From torque, or from M(q) and g(q), to base parameters and friction, with how sure they are."""

from .mass_gravity import MassGravity as MassGravity
from .mass_gravity import configurations as configurations
from .mass_gravity import identify_mass_gravity as identify_mass_gravity
from .mass_gravity import load_mass_gravity as load_mass_gravity
from .mass_gravity import mass_gravity_from_mujoco as mass_gravity_from_mujoco
from .mass_gravity import mass_gravity_regressor as mass_gravity_regressor
from .mass_gravity import sample_mass_gravity as sample_mass_gravity
from .result import Identification as Identification
from .trajectory import identify as identify
