"""Worlds in which drivers drive CAVs, in SUMO or in batches, with the records and rewards of their episodes."""
