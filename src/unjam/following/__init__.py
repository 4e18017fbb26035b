"""Learning how people follow the car ahead: data, calibration, networks, and how they are judged."""
