"""Learners: the residual policy, and Stable-Baselines3 fed with whole episodes."""
