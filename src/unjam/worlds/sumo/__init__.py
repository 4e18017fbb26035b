"""The actual environment: SUMO, episodes, worker processes."""
