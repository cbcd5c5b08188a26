"""A plant behind the sockets of a UR's controller, as far as one client needs them, or as a node of ROS 2."""
