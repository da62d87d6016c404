"""Tasks, one per file: scene, reward, state vector and camera. Each class docstring is the page of its task."""
