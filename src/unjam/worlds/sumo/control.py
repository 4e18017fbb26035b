"""Which type a vehicle has in SUMO, and how it carries out commands."""

from collections.abc import Iterable
from typing import Any, NamedTuple

from unjam.scenarios.scenario import Actuation

SPEED_MODES = {"shielded": 31, "raw": 30, "flow": 25, "cruise": 31}
"""SUMO's speed mode bits for each way of actuation: bit 0 is the check for a safe speed."""
SAFE_SPEED_BIT = 1
"""the bit that stays where vehicles need not obey the right of way: who is surprised stops as it must"""
ACCELERATION_LIMIT_BITS = 2 | 4
"""the bits by which vehicles keep to the acceleration and the braking of their type"""


class VehicleLimits(NamedTuple):
    """Limits of acceleration of a vehicle [m/s2]."""

    acceleration: float
    deceleration: float
    """comfortable"""
    emergency_deceleration: float
    """hardest"""


class VehicleControl:
    """The part of a simulation that changes how SUMO drives a vehicle."""

    _sumo: Any

    def command_humans(self, ids: Iterable[str], right_of_way: bool, has_acceleration_limits: bool) -> None:
        """Let SUMO keep `ids` safe and to the right of way and, if `bounded`, to limits of acceleration."""
        mode = SPEED_MODES["flow"] if right_of_way else SPEED_MODES["flow"] & SAFE_SPEED_BIT
        mode |= ACCELERATION_LIMIT_BITS if has_acceleration_limits else 0
        for name in ids:
            self._sumo.vehicle.setSpeedMode(name, mode)

    def change_type(self, name: str, kind: str, is_modified_later: bool = False) -> None:
        """Give a vehicle another type; its speed factor, which SUMO draws anew, stays its own.

        SUMO draws it once more when the first property of the vehicle itself is changed. If one
        `is_changed_later`, that happens here.
        """
        vehicle = self._sumo.vehicle
        factor = vehicle.getSpeedFactor(name)
        vehicle.setType(name, kind)
        if is_modified_later:
            vehicle.setMaxSpeed(name, vehicle.getMaxSpeed(name))
        vehicle.setSpeedFactor(name, factor)

    def type_of(self, name: str) -> str:
        """Return a vehicle's type, without what SUMO adds where one vehicle's properties were changed."""
        return self._sumo.vehicle.getTypeID(name).removesuffix(f"@{name}")

    def type_limits(self, kind: str) -> VehicleLimits:
        """Return the limits of acceleration of a vehicle type."""
        types = self._sumo.vehicletype
        return VehicleLimits(types.getAccel(kind), types.getDecel(kind), types.getEmergencyDecel(kind))

    def limit_braking(self, kind: str, max_braking: float) -> None:
        """Let vehicles of a type brake with at most so much [m/s2]."""
        types = self._sumo.vehicletype
        for set_limit in (types.setDecel, types.setEmergencyDecel, types.setApparentDecel):
            set_limit(kind, max_braking)

    def take_control(
        self, ids: Iterable[str], actuation: Actuation, right_of_way: bool = True, type_template: str = "cav"
    ) -> None:
        """Make `ids` CAVs: from now on they obey `command_speeds`.

        Their type becomes `types`, in which `{}` stands for the type that they had.
        """
        mode = SPEED_MODES[actuation] if right_of_way else SPEED_MODES[actuation] & SAFE_SPEED_BIT
        for name in ids:
            self.change_type(name, type_template.format(self.type_of(name)), actuation == "cruise")
            self._sumo.vehicle.setSpeedMode(name, mode)
