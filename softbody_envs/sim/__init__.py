"""Bullet: one client, and the objects the tasks are made of."""
