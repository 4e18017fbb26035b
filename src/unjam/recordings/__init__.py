"""Recordings of real traffic: tables, car-following trajectories, and speeds of recorded leaders."""
