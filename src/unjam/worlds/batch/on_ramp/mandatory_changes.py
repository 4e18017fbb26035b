"""Mandatory lane changes from the ramp's lane, and requests to other vehicles to make room, to go, or to change, too.

Source: SUMO's MSLCM_LC2013 (`_wantsChange`, `informLeader`, `informFollower`, `slowDownForBlocked`).
"""

from unjam.physics.arrays import Array, clamp_min, namespace, scatter_minimum
from unjam.worlds.batch.on_ramp.lane_change_context import LaneChangeContext, MotorwayGeometry, Neighbor
from unjam.worlds.batch.on_ramp.vehicles import NO_ADVICE, NO_VEHICLE, MotorwayVehicles, copy_array

MERGE_LOOK_AHEAD_TIME, LEFT_LOOK_AHEAD_FACTOR = 10.0, 2.0
"""look-ahead time of a mandatory change [s], and its factor for changes to the left"""
URGENCY_FACTOR = 2.0
"""factor by which the remaining time is shorter than at the look-ahead speed"""
HELP_SPEED_DIFFERENCE, MIN_FALL_BEHIND_BRAKING = 10.0 / 3.6, 7.0 / 3.6
"""speed difference with which vehicles overtake to help [m/s], minimum braking to fall behind a leader [m/s2]"""
UNCONGESTED_SPEED = 60.0 / 3.6
"""speed above which vehicles do not pass on the right [m/s]"""
SUMO_POSITION_TOLERANCE = 0.1
"""SUMO's POSITION_EPS [m]"""


def mandatory_lane_changes(
    vehicles: MotorwayVehicles, context: LaneChangeContext, geometry: MotorwayGeometry
) -> tuple[MotorwayVehicles, Array, Array]:
    """Return the vehicles with advice, whether each must change now, and whether it is asked to make room."""
    xp, position, step = namespace(vehicles.speed), vehicles.position, context.step
    is_on_lane = (vehicles.lane == 0) & (context.target_lane != NO_VEHICLE)
    occupies = (vehicles.lane == 1) & (position >= geometry.merge_start)
    lengths = xp.where(occupies, vehicles.minimum_gap + geometry.vehicle_length, 0.0 * position)
    total = lengths.cumsum(0)
    first = xp.searchsorted(vehicles.road, vehicles.road)
    occupied = total - xp.where(first > 0, total[first - 1], 0.0 * position)
    needed = vehicles.look_ahead_speed * (MERGE_LOOK_AHEAD_TIME * LEFT_LOOK_AHEAD_FACTOR)
    needed = needed + 2.0 * (vehicles.minimum_gap + geometry.vehicle_length)
    is_urgent = is_on_lane & (geometry.merge_end - position - occupied < needed)
    is_asked = vehicles.speed < 0.0
    rows = xp.arange(len(position))[is_urgent]
    if len(rows) == 0:
        return vehicles, is_urgent, is_asked
    own, cooperative, bias = map(copy_array, (vehicles.own_advice, vehicles.cooperative_advice, vehicles.speed_bias))
    merging = _MergingVehicles(vehicles, context, geometry, rows)
    leader, follower = merging.leader, merging.follower
    planned, own_advice, overtakes = merging.plan_with_leader()
    is_blocked = merging.is_leader_blocking & leader.is_present
    bias[leader.row[is_blocked]] = 1.0
    overtakes_leader = is_blocked & overtakes
    scatter_minimum(cooperative, leader.row[overtakes_leader], 0.0 * merging.speed[overtakes_leader])
    is_request, speeds, more_advice, asks_for_change = merging.request_from_follower(planned, ~overtakes_leader)
    own[rows] = xp.minimum(own_advice, more_advice)
    scatter_minimum(cooperative, follower.row[is_request], (speeds - follower.speed)[is_request] / step)
    is_asked[follower.row[asks_for_change]] = True
    stuck_rows = rows[merging.is_leader_blocking | merging.is_follower_blocking]
    bias[stuck_rows] = 1.0
    vehicles = vehicles._replace(own_advice=own, cooperative_advice=cooperative, speed_bias=bias)
    return _yield_to_stuck(vehicles, context, geometry, stuck_rows), is_urgent, is_asked


class _MergingVehicles:
    """Vehicles that must leave the ramp's lane, and their requests."""

    def __init__(
        self, vehicles: MotorwayVehicles, context: LaneChangeContext, geometry: MotorwayGeometry, rows: Array
    ) -> None:
        self.speed, self._step = vehicles.speed[rows], context.step
        self._remaining_distance = geometry.merge_end - vehicles.position[rows]
        self._vehicle_length, self._minimum_gap = geometry.vehicle_length, vehicles.minimum_gap[rows]
        self.leader = Neighbor(*(each[rows] for each in context.target_leader))
        self.follower = Neighbor(*(each[rows] for each in context.target_follower))
        self.is_leader_blocking = context.is_leader_blocking[rows]
        self.is_follower_blocking = context.is_follower_blocking[rows]
        self._drivers, self._follower_drivers = context.drivers.select(rows), context.follower_drivers.select(rows)
        self._leader_drivers = context.drivers.select(self.leader.row)
        self._leader_acceleration = vehicles.acceleration[self.leader.row]
        self._braking = vehicles.braking[rows]
        look_ahead_speed = clamp_min(vehicles.look_ahead_speed[rows], 1e-3)
        self._remaining_time = clamp_min(self._remaining_distance / look_ahead_speed / URGENCY_FACTOR, context.step)

    def plan_with_leader(self) -> tuple[Array, Array, Array]:
        """Return planned speeds, advised accelerations [m/s2], and whether each vehicle overtakes its leader."""
        xp, speed, step, leader = namespace(self.speed), self.speed, self._step, self.leader
        planned = xp.minimum(speed, self._drivers.stop_speed(speed, self._remaining_distance, step))
        leader_speed = leader.speed - step * clamp_min(-self._leader_acceleration, 1.0)
        gap = leader.gap + step * (leader_speed - planned)
        follow = self._drivers.follow_speed(speed, gap + self._minimum_gap, leader_speed, step)
        follow = xp.maximum(clamp_min(speed - self._braking * step, 0.0), follow)
        way = leader.gap + 2.0 * self._vehicle_length + self._leader_drivers.parameters.minimum_gap
        way = clamp_min(way + self._leader_drivers.secure_gap(leader.speed, speed), 0.0)
        surplus = planned - leader.speed
        duration = xp.where(surplus > 0.0, way / clamp_min(surplus, 1e-6), self._remaining_time + 1.0)
        has_room = self._remaining_distance - self._drivers.brake_gap(speed, step) >= way
        overtakes = (surplus >= 0.0) & (speed < UNCONGESTED_SPEED) & has_room & (duration <= self._remaining_time)
        braking = clamp_min((speed - follow) / self._remaining_time, MIN_FALL_BEHIND_BRAKING)
        behind = xp.minimum(planned, clamp_min(speed - step * xp.minimum(self._braking, braking), 0.0))
        is_blocked = self.is_leader_blocking & leader.is_present
        falls_behind = is_blocked & ~overtakes & (follow < speed)
        advice = (xp.where(falls_behind, behind, follow) - speed) / step
        advice = xp.where(leader.is_present & ~(is_blocked & overtakes), advice, NO_ADVICE)
        is_free = leader.is_present & ~self.is_leader_blocking
        planned = xp.where(is_free, xp.minimum(follow, planned), planned)
        return xp.where(falls_behind, behind, planned), advice, overtakes

    def request_from_follower(self, planned_speed: Array, may_request: Array) -> tuple[Array, Array, Array, Array]:
        """Return whether each follower is asked for a speed, the speed, own advice, and if it is asked to change."""
        xp, speed, step, follower = namespace(self.speed), self.speed, self._step, self.follower
        may_ask, drivers, seconds = may_request & follower.is_present, self._follower_drivers, self._remaining_time
        braking, minimum_gap = drivers.parameters.comfortable_deceleration, drivers.parameters.minimum_gap
        slower, after_second = clamp_min(follower.speed - step * braking, 0.0), clamp_min(follower.speed - braking, 0.0)
        surplus, room = planned_speed - after_second, follower.gap + planned_speed - after_second
        needed = drivers.secure_gap(after_second, clamp_min(planned_speed, 0.0))

        def follower_speed(slack: Array) -> Array:
            gap = follower.gap + minimum_gap + step * slack
            return drivers.follow_speed(follower.speed, gap, planned_speed, step)

        behind = follower_speed(planned_speed - xp.maximum(slower, follower_speed(planned_speed)))
        difference = planned_speed - follower.speed
        missing = drivers.secure_gap(follower.speed, planned_speed) - follower.gap
        opens_alone = (difference >= HELP_SPEED_DIFFERENCE) & (missing < difference * seconds)
        can_brake = (room > 0.0) & (room >= needed)
        is_in_time = (surplus > 0.0) & (surplus * seconds > needed - room + SUMO_POSITION_TOLERANCE)
        is_faster = follower.speed > speed
        passing = speed + HELP_SPEED_DIFFERENCE
        passing = xp.where(is_faster, xp.maximum(slower, passing), xp.maximum(follower.speed, passing))
        requested = xp.where(can_brake, xp.maximum(slower, behind), xp.where(is_in_time, slower, passing))
        requested = xp.where(opens_alone, planned_speed - HELP_SPEED_DIFFERENCE, requested)
        is_passed = ~opens_alone & ~can_brake & ~is_in_time
        is_passed = is_passed & ~(is_faster & ((follower.speed - speed) / braking < seconds))
        way = follower.gap + 2.0 * self._vehicle_length + self._minimum_gap
        way = clamp_min(way + self._drivers.secure_gap(planned_speed, passing), 0.0)
        own_speed = xp.maximum(passing - way / seconds, speed - step * self._braking)
        is_blocked = may_ask & self.is_follower_blocking
        own_advice = xp.where(is_blocked & is_passed, (own_speed - speed) / step, NO_ADVICE)
        keeps_gap = may_ask & ~self.is_follower_blocking & self.is_leader_blocking
        keeping = follower_speed(planned_speed - follower_speed(planned_speed))
        return is_blocked | keeps_gap, xp.where(is_blocked, requested, keeping), own_advice, is_blocked


def _yield_to_stuck(
    vehicles: MotorwayVehicles, context: LaneChangeContext, geometry: MotorwayGeometry, stuck_rows: Array
) -> MotorwayVehicles:
    """Return the vehicles with advice to those that crawl next to the ramp's lane: each lets one stuck vehicle in."""
    if len(stuck_rows) == 0:
        return vehicles
    xp, position, speed = namespace(vehicles.position), vehicles.position, vehicles.speed
    is_adjacent = (vehicles.lane == 1) & (position >= geometry.merge_start) & (position < geometry.merge_end)
    crawls = is_adjacent & (speed < vehicles.braking)
    if not bool(crawls.any()):
        return vehicles
    index = xp.searchsorted(stuck_rows, xp.arange(len(position))) - 1
    stuck = stuck_rows[clamp_min(index, 0)]
    gap = position[stuck] - geometry.vehicle_length - position - vehicles.minimum_gap
    yields = crawls & (index >= 0) & (vehicles.road[stuck] == vehicles.road) & (gap > SUMO_POSITION_TOLERANCE)
    if not bool(yields.any()):
        return vehicles
    gap = (gap + vehicles.minimum_gap)[yields] - SUMO_POSITION_TOLERANCE
    own_speed = context.drivers.select(yields).follow_speed(speed[yields], gap, speed[stuck][yields], context.step)
    return vehicles.replace_rows(yields, adjacent_advice=(own_speed - speed[yields]) / context.step)
