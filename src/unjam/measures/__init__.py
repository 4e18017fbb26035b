"""Metrics of episodes, their statistics, and verdicts on drivers. Nothing here draws figures."""
