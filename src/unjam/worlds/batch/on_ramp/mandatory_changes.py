"""Who must leave the lane that ends, and what they ask of others: to make room, to go, or to change too.

Source: SUMO's MSLCM_LC2013 (`_wantsChange`, `informLeader`, `informFollower`, `slowDownForBlocked`).
"""

from unjam.physics.arrays import Array, clamp_min, namespace, scatter_minimum
from unjam.worlds.batch.on_ramp.lane_change_context import LaneChangeContext, MotorwayGeometry, Neighbor
from unjam.worlds.batch.on_ramp.vehicles import NO_ADVICE, NO_VEHICLE, MotorwayVehicles

MERGE_LOOK_AHEAD_TIME, LEFT_LOOK_AHEAD_FACTOR = 10.0, 2.0
"""how long somebody looks ahead for a change that must be made [s], and how much longer to the left"""
URGENCY_FACTOR = 2.0
"""how many times over the way that is left would be driven in the time that is left"""
HELP_SPEED_DIFFERENCE, MIN_FALL_BEHIND_BRAKING = 10.0 / 3.6, 7.0 / 3.6
"""speed by which one overtakes to help [m/s], braking at least to fall behind [m/s2]"""
UNCONGESTED_SPEED = 60.0 / 3.6
"""speed above which nobody passes on the right [m/s]"""
SUMO_POSITION_TOLERANCE = 0.1
"""SUMO's POSITION_EPS [m]"""


def mandatory_lane_changes(
    vehicles: MotorwayVehicles, context: LaneChangeContext, geometry: MotorwayGeometry
) -> tuple[MotorwayVehicles, Array, Array]:
    """Return the vehicles with advice, who must change now, and who is asked to make room."""
    xp, place = namespace(vehicles.speed), vehicles.position
    on_lane = (vehicles.lane == 0) & (context.target_lane != NO_VEHICLE)
    ahead_sum = (vehicles.lane == 1) & (place >= geometry.merge_start)
    lengths = xp.where(ahead_sum, vehicles.minimum_gap + geometry.vehicle_length, 0.0 * place)
    so_far = lengths.cumsum(0)
    first = namespace(place).searchsorted(vehicles.road, vehicles.road)
    occupied = so_far - xp.where(first > 0, so_far[first - 1], 0.0 * place)
    left = geometry.merge_end - place
    needed = vehicles.look_ahead_speed * (MERGE_LOOK_AHEAD_TIME * LEFT_LOOK_AHEAD_FACTOR) + 2.0 * (
        vehicles.minimum_gap + geometry.vehicle_length
    )
    urgent = on_lane & (left - occupied < needed)
    helps = vehicles.speed < 0.0
    rows = xp.arange(len(place))[urgent]
    if len(rows) == 0:
        return vehicles, urgent, helps
    own, told, leans = vehicles.own_advice, vehicles.cooperative_advice, vehicles.speed_bias
    one = MergingVehicles(vehicles, context, geometry, rows, left[rows])
    planned, mine, passes = one.plan_with_leader()
    own[rows] = mine
    blocked = one.is_leader_blocking & one.target_leader.is_present
    leans[one.target_leader.row[blocked]] = 1.0
    over = blocked & passes
    scatter_minimum(told, one.target_leader.row[over], 0.0 * one.speed[over])
    asked, speeds, more, wishes = one.request_from_follower(planned, ~over)
    own[rows] = xp.minimum(own[rows], more)
    step = context.step
    scatter_minimum(told, one.target_follower.row[asked], (speeds - one.target_follower.speed)[asked] / step)
    helps[one.target_follower.row[wishes]] = True
    stuck = one.is_leader_blocking | one.is_follower_blocking
    leans[rows[stuck]] = 1.0
    vehicles = vehicles._replace(own_advice=own, cooperative_advice=told, speed_bias=leans)
    return _yield_to_stuck(vehicles, context, geometry, rows[stuck]), urgent, helps


class MergingVehicles:
    """Those who must leave the ramp's lane, and what they ask of others."""

    def __init__(
        self,
        vehicles: MotorwayVehicles,
        context: LaneChangeContext,
        geometry: MotorwayGeometry,
        rows: Array,
        remaining_distance: Array,
    ) -> None:
        """Take their rows, and how much of the lane is left to each [m]."""
        self.speed, self.remaining_distance, self._step = vehicles.speed[rows], remaining_distance, context.step
        self._vehicle_length, self._minimum_gap = geometry.vehicle_length, vehicles.minimum_gap[rows]
        self.target_leader, self.target_follower = (
            Neighbor(*(each[rows] for each in other)) for other in (context.target_leader, context.target_follower)
        )
        self.is_leader_blocking, self.is_follower_blocking = (
            context.is_leader_blocking[rows],
            context.is_follower_blocking[rows],
        )
        self._drivers, self._follower_drivers = context.drivers.select(rows), context.follower_drivers.select(rows)
        self._leader_drivers, self._leader_minimum_gap = (
            context.drivers.select(self.target_leader.row),
            vehicles.minimum_gap[self.target_leader.row],
        )
        self._braking, self._leader_acceleration = vehicles.braking[rows], vehicles.acceleration[self.target_leader.row]
        self._remaining_time = clamp_min(
            remaining_distance / clamp_min(vehicles.look_ahead_speed[rows], 1e-3) / URGENCY_FACTOR, context.step
        )

    def plan_with_leader(self) -> tuple[Array, Array, Array]:
        """Return the speeds that they plan, accelerations for that [m/s2], and who passes the leader."""
        xp, speed, step, leader = namespace(self.speed), self.speed, self._step, self.target_leader
        planned = xp.minimum(speed, self._drivers.stop_speed(speed, self.remaining_distance, step))
        slower = leader.speed - step * clamp_min(-self._leader_acceleration, 1.0)
        gap = leader.gap + step * (slower - planned)
        follow = self._drivers.follow_speed(speed, gap + self._minimum_gap, slower, step)
        follow = xp.maximum(clamp_min(speed - self._braking * step, 0.0), follow)
        room = leader.gap + 2.0 * self._vehicle_length + self._leader_minimum_gap
        room = clamp_min(room + self._leader_drivers.secure_gap(leader.speed, speed), 0.0)
        faster = planned - leader.speed
        lasts = xp.where(faster > 0.0, room / clamp_min(faster, 1e-6), self._remaining_time + 1.0)
        within = self.remaining_distance - self._drivers.brake_gap(speed, step) >= room
        passes = (faster >= 0.0) & (speed < UNCONGESTED_SPEED) & within & (lasts <= self._remaining_time)
        braking = xp.minimum(self._braking, clamp_min((speed - follow) / self._remaining_time, MIN_FALL_BEHIND_BRAKING))
        behind = xp.minimum(planned, clamp_min(speed - step * braking, 0.0))
        blocked = self.is_leader_blocking & leader.is_present
        falls = blocked & ~passes & (follow < speed)
        told = xp.where(falls, behind, follow)
        mine = xp.where(leader.is_present & ~(blocked & passes), (told - speed) / step, NO_ADVICE)
        unblocked = leader.is_present & ~self.is_leader_blocking
        planned = xp.where(falls, behind, xp.where(unblocked, xp.minimum(follow, planned), planned))
        return planned, mine, passes

    def request_from_follower(self, planned_speed: Array, may_request: Array) -> tuple[Array, Array, Array, Array]:
        """Return who asks its follower for a speed, which, own accelerations, and who asks it to change."""
        xp, speed, step, other = namespace(self.speed), self.speed, self._step, self.target_follower
        there, drivers, seconds = may_request & other.is_present, self._follower_drivers, self._remaining_time
        hard = drivers.parameters.comfortable_deceleration
        slower, second = clamp_min(other.speed - step * hard, 0.0), clamp_min(other.speed - hard, 0.0)
        faster, room = planned_speed - second, other.gap + planned_speed - second
        needed = drivers.secure_gap(second, clamp_min(planned_speed, 0.0))
        keeps = drivers.parameters.minimum_gap

        def follower_speed(slack: Array) -> Array:
            return drivers.follow_speed(other.speed, other.gap + keeps + step * slack, planned_speed, step)

        follows = follower_speed(planned_speed - xp.maximum(slower, follower_speed(planned_speed)))
        alone = planned_speed - other.speed >= HELP_SPEED_DIFFERENCE
        enough = drivers.secure_gap(other.speed, planned_speed) - other.gap < (planned_speed - other.speed) * seconds
        brakes = (room > 0.0) & (room >= needed)
        in_time = (faster > 0.0) & (faster * seconds > needed - room + SUMO_POSITION_TOLERANCE)
        slow = other.speed > speed
        lets = xp.where(
            slow,
            xp.maximum(slower, speed + HELP_SPEED_DIFFERENCE),
            xp.maximum(other.speed, speed + HELP_SPEED_DIFFERENCE),
        )
        asked = xp.where(brakes, xp.maximum(slower, follows), xp.where(in_time, slower, lets))
        asked = xp.where(alone & enough, planned_speed - HELP_SPEED_DIFFERENCE, asked)
        passed = ~(alone & enough) & ~brakes & ~in_time
        overtaken = passed & ~(slow & ((other.speed - speed) / hard < seconds))
        length = other.gap + 2.0 * self._vehicle_length + self._minimum_gap
        length = clamp_min(length + self._drivers.secure_gap(planned_speed, lets), 0.0)
        mine = xp.maximum(lets - length / seconds, speed - step * self._braking)
        blocked = there & self.is_follower_blocking
        own = xp.where(blocked & overtaken, (mine - speed) / step, NO_ADVICE)
        stays = there & ~self.is_follower_blocking & self.is_leader_blocking
        follows = follower_speed(planned_speed - follower_speed(planned_speed))
        return blocked | stays, xp.where(blocked, asked, follows), own, blocked


def _yield_to_stuck(
    vehicles: MotorwayVehicles, context: LaneChangeContext, geometry: MotorwayGeometry, stuck_rows: Array
) -> MotorwayVehicles:
    """Return the vehicles, those who crawl beside the ramp's lane letting in the next one that is stuck."""
    if len(stuck_rows) == 0:
        return vehicles
    xp, place, speed = namespace(vehicles.position), vehicles.position, vehicles.speed
    crawls = (vehicles.lane == 1) & (place >= geometry.merge_start) & (place < geometry.merge_end)
    crawls = crawls & (speed < vehicles.braking)
    if not bool(crawls.any()):
        return vehicles
    next_one = xp.searchsorted(stuck_rows, xp.arange(len(place))) - 1
    other = stuck_rows[clamp_min(next_one, 0)]
    gap = place[other] - geometry.vehicle_length - place - vehicles.minimum_gap
    lets = crawls & (next_one >= 0) & (vehicles.road[other] == vehicles.road) & (gap > SUMO_POSITION_TOLERANCE)
    if not bool(lets.any()):
        return vehicles
    drivers, advice = context.drivers.select(lets), vehicles.adjacent_advice
    wanted = drivers.follow_speed(
        speed[lets], (gap + vehicles.minimum_gap)[lets] - SUMO_POSITION_TOLERANCE, speed[other][lets], context.step
    )
    advice[lets] = (wanted - speed[lets]) / context.step
    return vehicles._replace(adjacent_advice=advice)
