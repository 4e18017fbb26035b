"""Vehicle types in SUMO, and how vehicles carry out commands."""

from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

from unjam.scenarios.scenario import Actuation

SPEED_MODES = {"shielded": 31, "raw": 30, "flow": 25, "cruise": 31}
"""SUMO's speed mode for each kind of actuation: bit 0 is the check for a safe speed"""
SAFE_SPEED_BIT = 1
"""the bit that stays without right of way: surprised vehicles still stop"""
ACCELERATION_LIMIT_BITS = 2 | 4
"""bits by which vehicles keep the acceleration and deceleration limits of their type"""


class VehicleLimits(NamedTuple):
    """Maximum acceleration, comfortable deceleration and maximum deceleration of a vehicle [m/s2]."""

    acceleration: float
    deceleration: float
    emergency_deceleration: float


class VehicleControl:
    """The part of a simulation that changes how SUMO drives a vehicle."""

    _sumo: Any

    def command_humans(self, ids: Iterable[str], right_of_way: bool, has_acceleration_limits: bool) -> None:
        """Set which of SUMO's checks apply to commanded human-driven vehicles; their speed is always safe."""
        mode = SPEED_MODES["flow"] if right_of_way else SPEED_MODES["flow"] & SAFE_SPEED_BIT
        mode |= ACCELERATION_LIMIT_BITS if has_acceleration_limits else 0
        for name in ids:
            self._sumo.vehicle.setSpeedMode(name, mode)

    def change_type(self, name: str, kind: str, is_modified_later: bool = False) -> None:
        """Change the type of a vehicle without changing its speed factor, which SUMO would draw again.

        SUMO also draws it again when a property of the vehicle itself changes for the first time. With
        `is_modified_later`, this change is made here.
        """
        vehicle = self._sumo.vehicle
        factor = vehicle.getSpeedFactor(name)
        vehicle.setType(name, kind)
        if is_modified_later:
            vehicle.setMaxSpeed(name, vehicle.getMaxSpeed(name))
        vehicle.setSpeedFactor(name, factor)

    def type_of(self, name: str) -> str:
        """Return a vehicle's type, without the suffix that SUMO adds when properties of one vehicle change."""
        return self._sumo.vehicle.getTypeID(name).removesuffix(f"@{name}")

    def type_limits(self, kind: str) -> VehicleLimits:
        """Return the acceleration limits of a vehicle type."""
        types = self._sumo.vehicletype
        return VehicleLimits(types.getAccel(kind), types.getDecel(kind), types.getEmergencyDecel(kind))

    def limit_braking(self, kind: str, max_braking: float) -> None:
        """Limit the braking of a vehicle type [m/s2]."""
        types = self._sumo.vehicletype
        for set_limit in (types.setDecel, types.setEmergencyDecel, types.setApparentDecel):
            set_limit(kind, max_braking)

    def take_control(
        self,
        ids: Iterable[str],
        actuation: Actuation,
        right_of_way: bool = True,
        type_template: str = "cav",
        parameters: Mapping[str, str] = MappingProxyType({}),
    ) -> None:
        """Make vehicles CAVs, which obey `command_speeds`, with or without right of way.

        Their new type is `type_template`, in which `{}` stands for the old one. `parameters` are further parameters of
        the vehicles, by SUMO's names.
        """
        mode = SPEED_MODES[actuation] if right_of_way else SPEED_MODES[actuation] & SAFE_SPEED_BIT
        for name in ids:
            self.change_type(name, type_template.format(self.type_of(name)), actuation == "cruise")
            self._sumo.vehicle.setSpeedMode(name, mode)
            for key, value in parameters.items():
                self._sumo.vehicle.setParameter(name, key, value)
