"""Demonstrations: recorded episodes in Minari's format, and replay buffers filled with them."""
