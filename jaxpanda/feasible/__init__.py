"""Least squares over the links that could be built: bounds, constraints and the many-start solver."""

from .bounds import Bounds as Bounds
from .constraints import Constraint as Constraint
from .constraints import Links as Links
from .constraints import com_in_cylinder as com_in_cylinder
from .constraints import com_in_hull as com_in_hull
from .constraints import mass_in_ellipsoid as mass_in_ellipsoid
from .constraints import total_mass as total_mass
from .constraints import triangle_inequality as triangle_inequality
from .constraints import when as when
from .exact import exact_penalty as exact_penalty
from .solver import Solutions as Solutions
from .solver import solve as solve
