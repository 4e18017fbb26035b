"""Models of the environment that are learned while a policy is trained."""
