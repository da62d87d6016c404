"""Actor-critics that learn from images: Algorithm 1's outer loop."""
