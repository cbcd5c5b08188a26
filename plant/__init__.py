"""Everything that is controlled: arm and camera models and the plants built on them."""
