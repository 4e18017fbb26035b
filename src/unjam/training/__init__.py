"""Training, tuning, calibration, evaluation and assessment of drivers, with their configurations and folders."""
