"""One file a task: its scene, actions, state, performance and reward."""
