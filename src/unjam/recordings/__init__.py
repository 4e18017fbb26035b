"""Recordings of real traffic: tables and car-following trajectories of files, and speeds of recorded leaders."""
