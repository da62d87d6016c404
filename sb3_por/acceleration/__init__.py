"""The same numbers in less time; a reader of the method may skip it."""
