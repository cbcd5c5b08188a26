"""Plants that render the images of their cameras: engines, drives, bodies and detectors."""
