"""The arithmetic of serial arms: arrays in, arrays out, one sample at a time."""

from . import inertia as inertia
from .chain import Chain as Chain
from .chain import from_modified_dh as from_modified_dh
from .chain import joint_placement as joint_placement
from .chain import link_poses as link_poses
from .dynamics import coriolis_matrix as coriolis_matrix
from .dynamics import coriolis_torque as coriolis_torque
from .dynamics import forward_dynamics as forward_dynamics
from .dynamics import gravity_torque as gravity_torque
from .dynamics import mass_matrix as mass_matrix
from .dynamics import regressor as regressor
from .dynamics import rnea as rnea
