"""Car following of human drivers: data, calibration, networks, and open-loop tests."""
