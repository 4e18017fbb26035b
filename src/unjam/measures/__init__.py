"""What is measured of episodes, and what may be said of it: metrics, statistics, waves. Draws nothing."""
