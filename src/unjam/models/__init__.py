"""The virtual environment: IDM plus residual networks, in which the policy learns between actual episodes."""
