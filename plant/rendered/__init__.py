"""What the plants that render images have in common: the scene, the drives, and the ball found in an image."""
