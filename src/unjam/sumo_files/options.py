"""Which options of a .sumocfg file SUMO is told: those that only say how to simulate, and no others."""

PASSED = {
    *("begin", "end", "junction-taz", "weight-attribute", "step-method.ballistic", "extrapolate-departpos"),
    *("lateral-resolution", "route-steps", "no-internal-links", "ignore-junction-blocker"),
    *("ignore-route-errors", "ignore-accidents", "intermodal-collision.action", "collision.stoptime"),
    *("intermodal-collision.stoptime", "collision.check-junctions.mingap", "keep-after-arrival"),
    *("max-num-vehicles", "max-num-persons", "max-num-teleports", "scale", "scale-suffix"),
    *("max-depart-delay", "sloppy-insert", "eager-insert", "emergency-insert", "insertion-checks"),
    *("random-depart-offset", "waiting-time-memory", "startup-wait-threshold", "slope-centered"),
    *("time-to-impatience", "pedestrian.model", "pedestrian.timegap-crossing", "mesosim"),
    *("use-stop-ended", "use-stop-started", "routing-algorithm", "replay-rerouting", "time-to-teleport"),
}
"""options that only say how to simulate"""
PASSED_GROUPS = (
    *("time-to-teleport.", "lanechange.", "tls.", "railsignal.", "railsignal-moving-block", "default."),
    *("overhead-wire.", "emergencydecel.", "parking.", "pedestrian.striping.", "ride.", "mapmatch."),
    *("weights.", "persontrip.", "railway.", "device.rerouting.", "person-device.rerouting."),
    *("device.driverstate.", "device.bluelight.", "device.glosa.", "device.toc.", "device.taxi."),
    *("device.emissions.", "device.battery.", "device.friction.", "meso-"),
)
"""what the names of others of them begin with"""
OTHERWISE = {
    *("seed", "step-length", "collision.action", "collision.mingap-factor", "collision.check-junctions"),
    *("no-step-log", "no-warnings", "duration-log.disable", "duration-log.statistics", "verbose", "start"),
    *("xml-validation", "xml-validation.net", "xml-validation.routes", "gui-settings-file", "quit-on-end"),
    *("delay", "precision", "step-log.period", "print-options", "human-readable-time", "registry-viewport"),
}
"""options that unjam decides itself, or that change nothing: of no interest where they are left out"""
FILED = ("file", "output", "threads")
"""what is in the names of options that belong to these groups and are harmful all the same"""


def is_passed(name: str) -> bool:
    """Return whether SUMO may be told an option: it only says how to simulate."""
    return name in PASSED or (name.startswith(PASSED_GROUPS) and not any(word in name for word in FILED))


def is_missed(name: str) -> bool:
    """Return whether it matters that SUMO is not told an option."""
    return not is_passed(name) and name not in OTHERWISE
