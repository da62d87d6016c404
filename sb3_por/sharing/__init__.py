"""Trained agents for others: those that come with the package, export of a run, and the hub."""
