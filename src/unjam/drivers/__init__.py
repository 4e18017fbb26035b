"""Drivers of CAVs: experts, learned residuals, and the user's own drivers."""

from unjam.drivers.car_following import ACC, BCM, IDM, LACC, OVM, Constant, FollowerStopper, Human
from unjam.drivers.check import check_driver
from unjam.drivers.command import Command, Limits
from unjam.drivers.driver import Decision, Driver, Memory
from unjam.drivers.local_state import LocalState
from unjam.drivers.pi_saturation import PIFromGap, PISaturation
from unjam.drivers.registry import DRIVERS
from unjam.drivers.residual import ResidualDriver
from unjam.drivers.road_experts import JamAbsorber, Pacer
from unjam.drivers.smooth_acc import SmoothACC
from unjam.drivers.user_driver import DriverLike, as_driver

__all__ = ["ACC", "BCM", "DRIVERS", "IDM", "LACC", "OVM", "Command", "Constant", "Decision", "Driver", "DriverLike"]
__all__ += ["FollowerStopper", "Human", "JamAbsorber", "Limits", "LocalState", "Memory", "PIFromGap", "PISaturation"]
__all__ += ["Pacer", "ResidualDriver", "SmoothACC", "as_driver", "check_driver"]
