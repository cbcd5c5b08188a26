"""The arm of a side in three dimensions, as films draw it, with its camera and its target.

What the camera measures lies below its node, whose pose it has.
"""

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, final

import viser
from viser.extras import ViserUrdf
from viser.transforms import SO3

from servobench.harness.apps.play.session import Session
from servobench.plant.bench.bench import turned_about_axis
from servobench.plant.contract.facts import read_beside
from servobench.plant.rendered.room import Room
from servobench.plant.robot.catalogue import find_robot

PAGE = read_beside(__file__, "page.toml")
SPACING = 1.9  # [m] between the bases of two arms


@final
class ArmScene:
    """The scene of a side.

    Attributes:
        bodies: what is drawn, by the names in `page.toml`.
    """

    def __init__(self, server: viser.ViserServer, index: int, session: Session) -> None:
        """Draw a side beside those of smaller indices."""
        self._side = session.sides[index]
        root = f"/{index}"
        server.scene.add_frame(root, show_axes=False, position=(0.0, index * SPACING, 0.0))
        room = Room(session.model.arm, scenery=True, robot=find_robot(session.request.robot))
        with TemporaryDirectory() as folder:
            for file, text in room.files().items():
                Path(folder, file).write_text(text)
            for part in ("bench", "arm"):
                urdf = Path(folder, f"{part}.urdf")
                self._arm = ViserUrdf(server, urdf, root_node_name=f"{root}/{part}")
        self.bodies: dict[str, Any] = {}
        for body, row in PAGE["bodies"].items():
            place = f"{root}/{body}"
            self.bodies[body] = getattr(server.scene, row["add"])(place, **row["given"])
        self.bodies["name"].text = self._side.name

    def show(self, session: Session) -> None:
        """Show the last period of the side."""
        period = self._side.period
        if period is None:
            return
        q = session.model.arm.joint_angle(period.observation.joint_position)
        self._arm.update_cfg(q)
        pose = turned_about_axis(
            session.model.camera, session.sensing.camera_turn * period.observation.time
        )
        self.bodies["camera"].wxyz = SO3.from_matrix(pose[:3, :3]).wxyz
        self.bodies["camera"].position = pose[:3, 3]
        self.bodies["camera/seen"].position = period.observation.feature
        if not session.held:
            self.bodies["camera/target"].position = period.reference[0]
