"""The arm, the camera and how the true robot differs from the nominal one."""
