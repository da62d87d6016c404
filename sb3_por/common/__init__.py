"""Helpers of every other package; they know none of them."""
