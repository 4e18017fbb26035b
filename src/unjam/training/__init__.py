"""How we train and compare: configurations, runs, evaluations."""
