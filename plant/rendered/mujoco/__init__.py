"""The UR5 in MuJoCo, seen through a rendered camera."""
