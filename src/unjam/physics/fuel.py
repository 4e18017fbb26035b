"""Fuel of a car from the power at its wheels: a model without maps of an engine, with a realistic idle rate.

Source: Treiber and Kesting 2013, Traffic Flow Dynamics, section 20.4: F = m a + c_r m g + 1/2 c_d rho A v^2,
power P_0 + v F, 300 ml/kWh, and no fuel while the car brakes with its engine. Numbers of a mid-size petrol car.
"""

from typing import NamedTuple

from unjam.physics.arrays import Array, clamp_min

GRAVITY, AIR_DENSITY = 9.81, 1.2  # [m/s2], [kg/m3]
JOULES_PER_KWH = 3.6e6


class Car(NamedTuple):
    """What the fuel of a car depends on."""

    mass: float = 1500.0  # mass with driver [kg]
    rolling_resistance: float = 0.015
    drag_area: float = 0.65  # drag coefficient times frontal area [m2]
    base_power: float = 3000.0  # power of engine and accessories at idle [W]: 0.9 l/h
    consumption: float = 300.0  # fuel of an engine per energy [ml/kWh]


MID_SIZE_CAR = Car()


def fuel_rate(speed: Array, acceleration: Array, car: Car = MID_SIZE_CAR) -> Array:
    """Return the fuel rate [ml/s] at a speed [m/s] and an acceleration [m/s2] on a level road, of their shape."""
    drag = 0.5 * AIR_DENSITY * car.drag_area * speed * speed
    force = car.mass * (acceleration + car.rolling_resistance * GRAVITY) + drag
    return clamp_min(car.base_power + speed * force, 0.0) * (car.consumption / JOULES_PER_KWH)


def kinetic_fuel_rate(speed: Array, acceleration: Array, car: Car = MID_SIZE_CAR) -> Array:
    """Return the part of the fuel rate that becomes kinetic energy [ml/s]; negative while the car brakes."""
    return car.mass * acceleration * speed * (car.consumption / JOULES_PER_KWH)
