"""Formulas of car following: pure, batched, SI units, on NumPy arrays and torch tensors alike."""

from unjam.physics.idm import (
    PAPER_IDM,
    IDMParameters,
    IDMRows,
    desired_gap,
    equilibrium_gap,
    equilibrium_speed,
    idm_acceleration,
    parameter_rows,
)
from unjam.physics.kinematics import gap_on_loop, next_position, next_speed

__all__ = [
    "PAPER_IDM",
    "IDMParameters",
    "IDMRows",
    "desired_gap",
    "equilibrium_gap",
    "equilibrium_speed",
    "gap_on_loop",
    "idm_acceleration",
    "next_position",
    "next_speed",
    "parameter_rows",
]
