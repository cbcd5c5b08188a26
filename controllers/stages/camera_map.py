"""The contract of a map, by which the pair stage corrects the nominal camera, with a filter for each candidate delay.

Two forms exist: a matrix between features (`feature_map`), and the rotation of each camera before its interaction
matrix (`point_map`). For each candidate delay, both hold the map, the noise e of the last frame and their covariance.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, Generic, NamedTuple, TypeVar

import numpy.typing as npt

from servobench.controllers.aids import AidsConfig
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.lanes import map_arrays, pick
from servobench.plant.contract.signals import BoolArray

Bank = TypeVar("Bank")


class Step(NamedTuple):
    """A motion, and the prediction of it that a map corrects.

    Attributes:
        x: prediction of the model under each candidate delay, (..., D, columns).
        feature_step: Δy, (..., m).
        valid: features that were measured at both ends, (..., m).
        rates: L of the interaction matrix under each candidate delay, (..., D, c, p, k, 3); empty without one.
    """

    x: FloatArray
    feature_step: FloatArray
    valid: BoolArray
    rates: FloatArray


class Innovation(NamedTuple):
    """The innovation of one motion under each candidate delay, (..., D).

    Attributes:
        nis: νᵀS⁻¹ν.
        spread: ln det S.
        variance: mean of the diagonal of S.
        frames: the multiple of σ² in it.
    """

    nis: FloatArray
    spread: FloatArray
    variance: FloatArray
    frames: FloatArray


class CameraMap(ABC, Generic[Bank]):
    """A map and its covariance for each of D candidate delays; pure, over leading axes.

    Attributes:
        columns: entries of x, the motion that a model predicts and that the map turns.
    """

    columns: int

    def __init__(self, aids: AidsConfig) -> None:
        """Take the settings."""
        self._aids = aids

    @abstractmethod
    def start(self, lead: tuple[int, ...], candidates: int, frame: float) -> tuple[Bank, FloatArray]:
        """Return the bank in which any map is possible, for the variance σ² of a frame, and the first map."""

    @abstractmethod
    def unknown(self, bank: Bank, frame: FloatArray) -> Bank:
        """Return a bank with the same maps, in which any map is possible; σ² is (...)."""

    @abstractmethod
    def interrupted(self, bank: Bank, frame: FloatArray) -> Bank:
        """Return a bank without information about the noise of the last frame; σ² is (...)."""

    @abstractmethod
    def lengths(self, step: Step) -> FloatArray:
        """Return how far features move with x under any rotation, (..., D)."""

    @abstractmethod
    def walked(self, bank: Bank, step: Step, lengths: FloatArray) -> Bank:
        """Return the bank with the variance that a map gains during a motion, no larger than at first."""

    @abstractmethod
    def update(self, bank: Bank, step: Step, lengths: FloatArray, frame: FloatArray) -> tuple[Bank, Innovation]:
        """Return the bank after a motion, and its innovation; σ² is (...)."""

    @abstractmethod
    def completed(self, bank: Bank, rotation: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the map of one delay, regularised towards a rotation, and that rotation.

        Args:
            bank: of one delay, without the axis of candidates.
            rotation: the one before.
        """

    @abstractmethod
    def deviation(self, bank: Bank, rotation: FloatArray) -> FloatArray:
        """Return the uncertainty of the map of one delay, (...)."""

    @abstractmethod
    def explained(self, map_: FloatArray, x: FloatArray, rates: FloatArray) -> FloatArray:
        """Return the step of the features, (..., m), that the map predicts for x (..., columns)."""

    @abstractmethod
    def jacobian(self, map_: FloatArray, base: FloatArray, rates: FloatArray) -> FloatArray:
        """Return Ĵ, (..., m, n), of the map and a base (..., columns, n)."""


def of_delay(tree: Any, candidate: npt.NDArray[Any]) -> Any:  # noqa: ANN401 - any tree
    """Return the part of one candidate delay of a tree of arrays (..., D, *)."""
    return map_arrays(lambda array: pick(array, candidate), tree)
