"""The page about a results folder."""
