"""The UR5 in PyBullet, seen through a rendered camera."""
