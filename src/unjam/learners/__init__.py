"""Learners: algorithms that train the residual policy on whole episodes, most of them from Stable-Baselines3."""
