"""What is measured of episodes, and what may be said of it: metrics, statistics, verdicts. Draws nothing."""
