"""How SUMO's people change lanes on a motorway that a ramp joins, all of a step at once.

SUMO asks one vehicle after the other, from front to back; here those on the ramp's lane come first, who must
change, and then all who may gain by it, which is alike in distribution.
Source: SUMO's MSLCM_LC2013 (`_wantsChange`, `anticipateFollowSpeed`).
"""

from unjam.physics.arrays import Array, at_least, namespace
from unjam.worlds.batch.beside import Other, Scene, Stretch, scene_of
from unjam.worlds.batch.merging import HELP, UNCONGESTED, who_must
from unjam.worlds.batch.vehicles import FREELY, NOBODY, Vehicles, around, chosen

MEMORY = 0.9
"""what a second leaves of the speed with which somebody looks ahead"""
LEFT_THRESHOLD, RIGHT_THRESHOLD = 0.2, 2.0
"""gains at which one changes"""
LEAST_SPEED = 10.0
"""over which gains are relative at least [m/s]"""
RIGHT_IS_SLOWER = 5.0 / 3.6
"""by so much before it matters [m/s]"""
KEEPS_RIGHT, KEEP_RIGHT_TIME = 7.0, 5.0
"""[s]"""
REMAINS = 20.0
"""time that the other lane must go on for a change that is not needed [s]"""
SOON = 8.0
"""time before it would have to brake in which one begins to overtake [s]"""


def change_lanes(vehicles: Vehicles, stretch: Stretch, step: float) -> Vehicles:
    """Return the vehicles after all who want to and can have changed lanes, with advice for the next step."""
    xp, speed = namespace(vehicles.speed), vehicles.speed
    none = speed * 0.0 + FREELY
    kept = 1.0 - (1.0 - MEMORY) * step
    look = xp.where(speed > vehicles.look, speed, kept * vehicles.look + (1.0 - kept) * speed)
    vehicles = vehicles._replace(
        own_advice=none, told_advice=none + 0.0, beside_advice=none + 0.0, leans=speed * 0.0, look=look
    )
    scene = scene_of(vehicles, stretch, step)
    vehicles, urgent, help_wanted = who_must(vehicles, scene, stretch)
    free = ~(scene.by_leader | scene.by_follower) & (scene.target != NOBODY)
    vehicles, wants = _who_gains(vehicles, scene, stretch, ~urgent & (scene.target != NOBODY))
    helps = help_wanted & (vehicles.way > 0) & (scene.target > vehicles.way)
    goes = (urgent | wants | helps) & free
    held = helps & ~free
    leans = xp.where(held, xp.where(scene.by_leader, -1.0, 1.0), vehicles.leans)
    vehicles = vehicles._replace(leans=leans)
    goes = goes & ~_crosses(vehicles, scene, goes, stretch)
    return _moved(vehicles, goes, scene.target)


def _who_gains(vehicles: Vehicles, scene: Scene, stretch: Stretch, may: Array) -> tuple[Vehicles, Array]:
    """Return the vehicles with what they would gain, and who wants to change for it or to keep right."""
    xp, speed, place, step = namespace(vehicles.speed), vehicles.speed, vehicles.place, scene.step
    ahead, leader, drivers = scene.ahead, scene.leader, scene.drivers
    rises = scene.target > vehicles.way
    there = xp.minimum(stretch.limit * vehicles.factor, vehicles.cap)
    here = xp.where((vehicles.way == 0) & (place < stretch.merge), stretch.ramp_limit, stretch.limit)
    here = xp.minimum(here * vehicles.factor, vehicles.cap)
    goes_on = xp.where(place < stretch.merge, stretch.length, stretch.length - stretch.merge)
    goes_on = xp.where(place < stretch.closes, goes_on, stretch.length - stretch.closes)
    own_end = xp.where(vehicles.way == 0, stretch.closes - stretch.merge, goes_on)
    gain, keep, fast = vehicles.gain, vehicles.keep, speed >= UNCONGESTED
    # Nobody passes on the right: who comes up to somebody slower on the left holds back, or goes there.
    its = xp.minimum(stretch.limit * vehicles.factor[ahead.row], vehicles.cap[ahead.row])
    slower = xp.maximum(here - its, speed - ahead.speed)
    holds = may & rises & ahead.there & fast & (slower > 0.0)
    most, soon, advice = here, speed < 0.0, vehicles.beside_advice
    if bool(holds.any()):
        safe, soon_slow = _behind_left(vehicles, scene, holds, slower[holds])
        advice, most = advice + 0.0, here + 0.0
        advice[holds] = xp.minimum(advice[holds], (safe - speed[holds]) / step)
        soon[holds] = soon_slow
        most[holds] = xp.minimum(here[holds], safe)
        gain = gain + xp.where(soon, step * slower / at_least(here, LEAST_SPEED), 0.0 * gain)
    # How fast either lane will be.
    speeds_up = (ahead.there & (vehicles.acceleration[ahead.row] > 0.0)) | (
        leader.there & (vehicles.acceleration[leader.row] > 0.0)
    )

    def foreseen(other: Other, end: Array) -> Array:
        gap, its = xp.where(other.there, other.gap, end), xp.where(other.there, other.speed, 0.0 * speed)
        found = drivers.safe_speed(gap, its, vehicles.braking[other.row], step)
        later = (speed + vehicles.most * (1.0 - step))[speeds_up]
        gap = (gap + vehicles.gap)[speeds_up]
        found[speeds_up] = drivers.at(speeds_up).follow(later, gap, its[speeds_up], step)
        return found

    that = xp.minimum(there, foreseen(ahead, goes_on))
    # Speeds that are steady are compared as far as they are safe: there who holds back is not bound by it.
    this = xp.minimum(xp.where(speeds_up, most, here), foreseen(leader, own_end))
    relative = (that - this) / at_least(that, LEAST_SPEED)
    lasts = goes_on / at_least(speed, 0.1) > REMAINS
    # To the right.
    right = may & (scene.target < vehicles.way)
    bad = this - RIGHT_IS_SLOWER > that
    forgets = xp.where(right & bad & (gain < 0.0), 0.5**step, 1.0)
    good = right & ~bad
    gain = gain * forgets - xp.where(good & ((gain < 0.0) | (relative > 0.0)), step * relative, 0.0 * gain)
    accepted = KEEPS_RIGHT * (here / stretch.limit) * at_least(speed, 1.0)
    clear = at_least(goes_on - drivers.brake_gap(here, step), 0.0)
    seconds = xp.minimum(accepted, clear / here)
    closing = ahead.there & (ahead.speed < here)
    nearer = at_least(xp.minimum(clear, ahead.gap - drivers.secure_gap(here, ahead.speed)), 0.0)
    seconds = xp.where(closing, xp.minimum(seconds, nearer / at_least(here - ahead.speed, 1e-6)), seconds)
    clear = xp.where(closing, nearer, clear)
    wishes = xp.minimum(stretch.limit * vehicles.factor[leader.row], vehicles.cap[leader.row])
    behind = good & fast & leader.there & (wishes < here)
    slack = here - leader.speed
    slack = xp.where(slack * slack < 1e-12, 1e-6, slack)
    seconds = xp.where(behind, xp.minimum(seconds, xp.minimum(clear, leader.gap) / slack), seconds)
    keep = keep - xp.where(good, step * RIGHT_THRESHOLD * seconds / accepted / KEEP_RIGHT_TIME, 0.0 * keep)
    wants = (good & (keep < -RIGHT_THRESHOLD)) | (right & (gain < -RIGHT_THRESHOLD) & lasts)
    # To the left.
    left = may & rises
    forgets = xp.where(this > that, 0.5**step, 0.8**step)
    gain = xp.where(left & (this >= that) & (gain > 0.0), gain * forgets, gain)
    gain = gain + xp.where(left & (this < that), step * relative, 0.0 * gain)
    wants = wants | (left & (gain > LEFT_THRESHOLD) & ((relative > 1e-3) | soon) & lasts)
    wants = wants | (left & (vehicles.way == 0) & (relative >= 0.0) & (gain > 0.0))
    return vehicles._replace(gain=gain, keep=keep, beside_advice=advice), wants


def _behind_left(vehicles: Vehicles, scene: Scene, holds: Array, slower: Array) -> tuple[Array, Array]:
    """Return how fast those drive who do not pass somebody slower on the left, and who must brake soon."""
    speed, drivers, step = vehicles.speed[holds], scene.drivers.at(holds), scene.step
    xp, its, room = namespace(speed), scene.ahead.speed[holds], (scene.ahead.gap + vehicles.gap)[holds]
    brakes, safe = (
        at_least(speed - vehicles.braking[holds] * step, 0.0),
        drivers.follow(speed, room, its, step),
    )
    safe = xp.where(safe >= brakes, safe, xp.maximum(brakes, its - HELP))
    safe = xp.where(vehicles.gain[holds] < LEFT_THRESHOLD, xp.maximum(safe, its), safe)
    return safe, drivers.follow(speed, room - slower * SOON, its, step) < safe


def _crosses(vehicles: Vehicles, scene: Scene, goes: Array, stretch: Stretch) -> Array:
    """Return who would come into a gap of the right lane into which somebody comes from the ramp's lane."""
    xp, place = namespace(vehicles.place), vehicles.place
    coming = goes & (vehicles.way == 0)
    if not bool(coming.any()):
        return coming
    joined = vehicles._replace(way=xp.where(coming, 1, vehicles.way))
    near = around(joined, 2)
    there = 1 + 0 * vehicles.way
    ahead, behind = chosen(near.ahead, there), chosen(near.behind, there)
    least = stretch.vehicle_length + vehicles.gap
    tight = ((ahead >= 0) & coming[ahead] & (place[ahead] - place < 2.0 * least)) | (
        (behind >= 0) & coming[behind] & (place - place[behind] < 2.0 * least)
    )
    return goes & (vehicles.way == 2) & tight


def _moved(vehicles: Vehicles, goes: Array, target: Array) -> Vehicles:
    """Return the vehicles after changes; who has changed begins anew to wish for anything."""
    xp = namespace(vehicles.speed)

    def begun(values: Array, value: float) -> Array:
        return xp.where(goes, 0.0 * values + value, values)

    return vehicles._replace(
        way=xp.where(goes, target, vehicles.way),
        gain=begun(vehicles.gain, 0.0),
        keep=begun(vehicles.keep, 0.0),
        look=begun(vehicles.look, 0.0),
        own_advice=begun(vehicles.own_advice, FREELY),
        told_advice=begun(vehicles.told_advice, FREELY),
        beside_advice=begun(vehicles.beside_advice, FREELY),
        leans=begun(vehicles.leans, 0.0),
    )
