"""Simulation: a Bullet world and the objects in it. No other package calls Bullet's physics."""
