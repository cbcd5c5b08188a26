"""Radial basis function networks: their formula, files, samples and offline fit."""
