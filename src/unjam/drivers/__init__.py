"""Who drives a CAV: experts, learned residuals, your own."""

from unjam.drivers.acc import ACC, LACC
from unjam.drivers.bilateral import BCM
from unjam.drivers.check import check_driver
from unjam.drivers.command import Command, Limits
from unjam.drivers.constant import Constant
from unjam.drivers.driver import Decision, Driver, Memory
from unjam.drivers.follower_stopper import FollowerStopper
from unjam.drivers.idm import IDM, Human
from unjam.drivers.jam_absorber import JamAbsorber
from unjam.drivers.local_state import LocalState
from unjam.drivers.ovm import OVM
from unjam.drivers.pacer import Pacer
from unjam.drivers.pi_saturation import PISaturation
from unjam.drivers.registry import DRIVERS
from unjam.drivers.residual import ResidualDriver

__all__ = [
    "ACC",
    "BCM",
    "DRIVERS",
    "IDM",
    "LACC",
    "OVM",
    "Command",
    "Constant",
    "Decision",
    "Driver",
    "FollowerStopper",
    "Human",
    "JamAbsorber",
    "Limits",
    "LocalState",
    "Memory",
    "PISaturation",
    "Pacer",
    "ResidualDriver",
    "check_driver",
]
