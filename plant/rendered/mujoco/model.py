"""MuJoCo models of the URDF files that PyBullet loads, too."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from servobench.plant.rendered.mujoco.engine import mujoco

# MuJoCo would leave out what is only drawn, and join what does not move against each other.
KEEP_ALL = '<mujoco><compiler discardvisual="false" fusestatic="{fuse}" strippath="true"/></mujoco>'


def read_urdf(text: str, meshes: Mapping[str, str] | None = None, *, fuse: bool = False) -> Any:  # noqa: ANN401
    """Return the editable model, an `MjSpec`, of a URDF.

    Args:
        text: the URDF.
        meshes: Wavefront OBJ text by the file names in the URDF; other files are left alone.
        fuse: join links that a fixed joint connects: a step takes less time, and they lose their names.

    Raises:
        ValueError: MuJoCo cannot read it.
    """
    head, tag, rest = text.partition(">")
    keep = KEEP_ALL.format(fuse=str(fuse).lower())
    spec = mujoco.MjSpec.from_string(
        f"{head}{tag}{keep}{rest}", assets={name: mesh.encode() for name, mesh in (meshes or {}).items()}
    )
    for mesh in spec.meshes:
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL  # a flat one has no volume
    return spec
