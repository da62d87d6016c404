"""From runs to numbers and pictures."""
