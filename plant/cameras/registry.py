"""The sensing set-ups by name, and the words that name them with a mount: `pixel`, `stereo:hand`."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, Self

from servobench.plant.cameras.placement import (
    ON_HAND,
    OPTICAL,
    CameraDraws,
    draw_cameras,
    nominal_model,
    true_model,
)
from servobench.plant.cameras.setups import PIXEL, PLATE, POSITION, STEREO, SensingSetup
from servobench.plant.contract.settings import suggest
from servobench.plant.robot.hand_eye import HandEyeModel, Mount, RobotModel
from servobench.plant.robot.mismatch import Mismatch, MismatchSample
from servobench.plant.robot.robot import Robot

SETUPS = {setup.name: setup for setup in (POSITION, PIXEL, STEREO, PLATE)}
FIXED: Final = "fixed"
HAND: Final = "hand"
DEFAULT_SENSING = "position"


@dataclass(frozen=True)
class Sensing:
    """A set-up and the mount of its cameras; `str` returns the word that `parse` reads."""

    setup: SensingSetup = POSITION
    mount: Mount = "fixed"

    @classmethod
    def parse(cls, word: str, setups: Mapping[str, SensingSetup] = SETUPS) -> Self:
        """Return the sensing that a word such as `pixel` or `stereo:hand` stands for.

        Raises:
            ValueError: an unknown set-up or mount.
        """
        name, _, mount = word.strip().rpartition(":")
        if mount not in (FIXED, HAND):
            name, mount = word.strip(), FIXED
        if name not in setups:
            on_hand = [f"{key}:{HAND}" for key in setups]
            known = [*setups, *on_hand]
            raise ValueError(f"unknown sensing {word!r}: {suggest(word, known)}")
        return cls(setups[name], HAND if mount == HAND else FIXED)

    def __str__(self) -> str:
        """Return the word, as it stands in the column `sensing`; fixed cameras are not named."""
        if self.mount == FIXED:
            return self.setup.name
        return f"{self.setup.name}:{self.mount}"

    def _is_plain(self, robot: Robot) -> bool:
        """Return whether it is the ball in 3-D by the bench's fixed camera, for which the arm's own model serves."""
        return self == Sensing() and robot.camera is None

    def _check_axes(self, mismatch: Mismatch) -> None:
        """Refuse a mismatch with an axis that the cameras do not have."""
        for axis, _ in mismatch.axes:
            if axis in OPTICAL and self.setup.name == POSITION.name:
                raise ValueError(
                    f"mismatch axis {axis} needs a camera that sees pixels, such as the sensing pixel"
                )
            if axis == ON_HAND and self.mount != HAND:
                raise ValueError(
                    f"mismatch axis {axis} needs a camera on the hand, such as the sensing pixel:{HAND}"
                )

    def nominal(self, robot: Robot) -> RobotModel:
        """Return the nominal robot under this sensing, as planned, which controllers may know.

        Raises:
            ValueError: the arm has too few joints for the set-up.
        """
        if self._is_plain(robot):
            return robot.nominal
        return nominal_model(self.setup, self.mount, robot)

    def true(
        self,
        robot: Robot,
        true: HandEyeModel,
        sample: MismatchSample,
        mismatch: Mismatch,
        seed: int,
    ) -> tuple[RobotModel, CameraDraws | None]:
        """Return a true robot under this sensing, and the values drawn for its cameras; None for none.

        Args:
            robot: the nominal one.
            true: the true arm and the ball's fixed camera.
            sample: how they differ from the nominal ones.
            mismatch: the deviations of which they are drawn.
            seed: the seed of the same draw.

        Raises:
            ValueError: the arm has too few joints, or the mismatch names an axis that the cameras do not have.
        """
        self._check_axes(mismatch)
        if self._is_plain(robot):
            return true, None
        draws = draw_cameras(mismatch, self.setup.cameras, seed)
        turn = sample.camera_angle * sample.camera_axis
        model = true_model(self.setup, self.mount, robot, true.arm, turn, draws)
        return model, draws
