"""The variables of an exported arm that are those of a sensing set-up: target, cameras, features.

They take the place of the ball, its fixed camera and its position in the table of `servobench.fmus.variables`.
"""

from __future__ import annotations

from typing import Final, NamedTuple, Self

import numpy as np

from servobench.plant.cameras.eye import Eye
from servobench.plant.cameras.model import EyeModel, Mount
from servobench.plant.contract.checks import FloatArray
from servobench.plant.robot.arm import rpy_from_rotation

FEATURE: Final = "feature"
SEEN: Final = "seen"


class View(NamedTuple):
    """What of a set-up is fixed in the equations; all else is a parameter.

    Attributes:
        eye: the set-up.
        mount: of its cameras.
        size: width and height of the images [px].
    """

    eye: Eye
    mount: Mount
    size: tuple[float, float]

    @classmethod
    def of(cls, model: EyeModel) -> Self:
        """Return the view of an arm and its cameras."""
        return cls(model.eye, model.mount, model.optics.size)

    @property
    def word(self) -> str:
        """Name of set-up and mount, as a word of C begins."""
        return self.eye.name if self.mount == "fixed" else f"{self.eye.name}_{self.mount}"

    @property
    def setting(self) -> str:
        """What is seen from where, for descriptions."""
        return f"{self.eye.summary}, {'beside the arm' if self.mount == 'fixed' else 'on the hand'}"

    def parameters(self) -> tuple[tuple[str, tuple[int, ...], str, str], ...]:
        """Return name, shape, unit and description of each kinematic parameter of target and cameras, in order."""
        c, p = self.eye.cameras, len(self.eye.target)
        on, off = ("base", "flange") if self.mount == "fixed" else ("flange", "base")
        return (
            ("target", (p, 3), "m", f"Points of the target in the {off} frame."),
            ("camera_position", (c, 3), "m", f"Cameras in the {on} frame."),
            ("camera_rpy", (c, 3), "rad", f"Roll, pitch and yaw of the cameras in the {on} frame."),
            ("focal_length", (c,), "px", "Focal length of each camera."),
            ("principal_point", (c, 2), "px", "Principal point, from the upper left corner of the image."),
            ("distortion", (c,), "1", "First coefficient of radial distortion."),
        )

    def outputs(self, n: int) -> tuple[tuple[str, tuple[int, ...], str, str], ...]:
        """Return the same of the outputs of an arm with `n` joints."""
        m, unit = self.eye.m, self.eye.unit
        names = ", ".join(self.eye.features)
        return (
            (FEATURE, (m,), unit, f"What is measured: {names}."),
            (SEEN, (m,), "1", "1 where a camera sees the feature, with nothing in between; 0 elsewhere."),
            ("jacobian", (m, n), f"{unit}/rad", "Derivative of feature by joint_position; for evaluation."),
        )


def view_parameters(model: EyeModel) -> dict[str, FloatArray]:
    """Return the values of these parameters by name, (..., size)."""

    def flat(values: FloatArray, axes: int) -> FloatArray:
        return np.reshape(values, (*values.shape[: values.ndim - axes], -1))

    optics = model.optics
    return {
        "target": flat(model.target, 2),
        "camera_position": flat(model.cameras[..., :3, 3], 2),
        "camera_rpy": flat(rpy_from_rotation(model.cameras[..., :3, :3]), 2),
        "focal_length": optics.focal,
        "principal_point": flat(optics.centre, 2),
        "distortion": optics.distortion,
    }
