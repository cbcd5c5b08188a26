"""The sensing set-ups by name, one line each, and the words that name them with a mount: `pixel`, `stereo:hand`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, Self

from servobench.plant.cameras.eye import Eye
from servobench.plant.cameras.model import Mount
from servobench.plant.cameras.placement import ON_HAND, OPTICAL, CameraDraws, draw_cameras, nominal_model, true_model
from servobench.plant.cameras.setups import PIXEL, PLATE, POSITION, STEREO
from servobench.plant.contract.settings import suggest
from servobench.plant.robot.hand_eye import HandEyeModel, SensedArm
from servobench.plant.robot.mismatch import Mismatch, MismatchSample
from servobench.plant.robot.robot import Robot

EYES: Final[Mapping[str, Eye]] = {eye.name: eye for eye in (POSITION, PIXEL, STEREO, PLATE)}
FIXED: Final = "fixed"
HAND: Final = "hand"
DEFAULT_SENSING: Final = "position"


@dataclass(frozen=True)
class Sensing:
    """A set-up and how its cameras are mounted; `str` gives back the word that `parse` reads."""

    eye: Eye = POSITION
    mount: Mount = "fixed"

    @classmethod
    def parse(cls, word: str, eyes: Mapping[str, Eye] = EYES) -> Self:
        """Return the sensing that a word such as `pixel` or `stereo:hand` stands for.

        Raises:
            ValueError: an unknown set-up or mount.
        """
        name, _, mount = word.strip().rpartition(":")
        if mount not in (FIXED, HAND):
            name, mount = word.strip(), FIXED
        if name not in eyes:
            known = suggest(name.partition(":")[0], eyes)
            raise ValueError(
                f"unknown sensing {word!r}: {known}; each also with the camera on the hand, as pixel:{HAND}"
            )
        return cls(eyes[name], HAND if mount == HAND else FIXED)

    def __str__(self) -> str:
        """Return the word, as it stands in the column `sensing`; fixed cameras are not named."""
        return self.eye.name if self.mount == FIXED else f"{self.eye.name}:{self.mount}"

    @property
    def plain(self) -> bool:
        """Whether it is the ball in 3-D by a fixed camera, for which the arm's own model serves."""
        return self == Sensing()

    def nominal(self, robot: Robot) -> SensedArm:
        """Return the nominal robot under this sensing, as planned, which controllers may know.

        Raises:
            ValueError: the arm has too few joints for the set-up.
        """
        return robot.nominal if self.plain else nominal_model(self.eye, self.mount, robot)

    def true(
        self, robot: Robot, true: HandEyeModel, sample: MismatchSample, mismatch: Mismatch, seed: int
    ) -> tuple[SensedArm, CameraDraws | None]:
        """Return a true robot under this sensing and what was drawn for its cameras; None for none.

        Args:
            robot: the nominal one.
            true: the true arm and the ball's fixed camera.
            sample: how they differ from the nominal ones.
            mismatch: of which they are drawn.
            seed: of the same draw.

        Raises:
            ValueError: the arm has too few joints, or the mismatch names an axis that the cameras do not have.
        """
        self._check(mismatch)
        if self.plain:
            return true, None
        draws = draw_cameras(mismatch, self.eye.cameras, seed)
        turn = sample.camera_angle * sample.camera_axis
        return true_model(self.eye, self.mount, robot, true.arm, turn, draws), draws

    def _check(self, mismatch: Mismatch) -> None:
        for axis, _ in mismatch.axes:
            if axis in OPTICAL and self.eye.name == POSITION.name:
                raise ValueError(f"mismatch axis {axis} needs a camera that sees pixels, such as --sensing pixel")
            if axis == ON_HAND and self.mount != HAND:
                raise ValueError(f"mismatch axis {axis} needs a camera on the hand, such as --sensing pixel:{HAND}")
