"""Fuel rate of a car from the power at its wheels, without an engine map, with a realistic rate at idle.

Source: Treiber and Kesting 2013, Traffic Flow Dynamics, section 20.4: F = m a + c_r m g + 1/2 c_d rho A v^2,
power P_0 + v F, 300 ml/kWh, and no fuel during engine braking. The numbers are those of a mid-size petrol car.
"""

from typing import NamedTuple

from unjam.physics.arrays import Array, clamp_min

GRAVITY, AIR_DENSITY = 9.81, 1.2  # [m/s2], [kg/m3]
JOULES_PER_KWH = 3.6e6


class Car(NamedTuple):
    """Parameters of a car that determine its fuel rate."""

    mass: float = 1500.0  # mass with driver [kg]
    rolling_resistance: float = 0.015
    drag_area: float = 0.65  # drag coefficient times frontal area [m2]
    base_power: float = 3000.0  # power of engine and accessories at idle [W]: 0.9 l/h
    consumption: float = 300.0  # fuel of an engine per energy [ml/kWh]


MID_SIZE_CAR = Car()


def fuel_rate(speed: Array, acceleration: Array, car: Car = MID_SIZE_CAR) -> Array:
    """Return the fuel rate [ml/s] on a level road for speeds [m/s] and accelerations [m/s2] of the same shape."""
    drag = 0.5 * AIR_DENSITY * car.drag_area * speed * speed
    force = car.mass * (acceleration + car.rolling_resistance * GRAVITY) + drag
    return clamp_min(car.base_power + speed * force, 0.0) * (car.consumption / JOULES_PER_KWH)


def kinetic_fuel_rate(speed: Array, acceleration: Array, car: Car = MID_SIZE_CAR) -> Array:
    """Return the part of the fuel rate that becomes kinetic energy [ml/s]; negative while the car brakes."""
    return car.mass * acceleration * speed * (car.consumption / JOULES_PER_KWH)
