"""Car following of human drivers: recorded trajectories, calibration, networks, simulation behind recorded leaders."""
