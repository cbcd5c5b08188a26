"""Meshes as Wavefront OBJ text: a finely meshed unit sphere and level rectangles.

PyBullet's own sphere is so coarse that its front lies 6 % of the radius too deep, and its boxes draw six faces of which
one is seen.
"""

from __future__ import annotations

from functools import lru_cache

BALL_MESH = "ball.obj"  # file in which URDFs look for the unit sphere
BALL_SUBDIVISIONS = 4  # 5120 triangles: the front lies 0.05 % of the radius too deep


@lru_cache(maxsize=4)
def sphere_obj(subdivisions: int = BALL_SUBDIVISIONS) -> str:
    """Return the unit sphere as a Wavefront OBJ file with normals, so that it is shaded smoothly.

    Args:
        subdivisions: how often the triangles of an icosahedron are split in four; 4 give 2562 vertices and a mean
            depth error of 0.05 % of the radius.
    """
    from trimesh.creation import icosphere  # noqa: PLC0415 - takes half a second

    sphere = icosphere(subdivisions)
    points = [f"{x!r} {y!r} {z!r}" for x, y, z in sphere.vertices.tolist()]
    lines = [f"v {point}" for point in points] + [f"vn {point}" for point in points]
    lines += [f"f {a}//{a} {b}//{b} {c}//{c}" for a, b, c in (sphere.faces + 1).tolist()]
    return "\n".join(lines) + "\n"


def rectangles_obj(rectangles: list[tuple[float, float, float, float]], height: float) -> str:
    """Return horizontal rectangles that face up as a Wavefront OBJ file.

    Args:
        rectangles: x_lower, y_lower, x_upper, y_upper of each, m.
        height: z of all, m.

    Returns:
        The file's text: four vertices and two triangles a rectangle.
    """
    lines = ["vn 0 0 1"]
    for x0, y0, x1, y1 in rectangles:
        lines += [f"v {x!r} {y!r} {height!r}" for x, y in ((x0, y0), (x1, y0), (x1, y1), (x0, y1))]
    for first in range(1, 4 * len(rectangles), 4):
        a, b, c, d = (f"{first + k}//1" for k in range(4))
        lines += [f"f {a} {b} {c}", f"f {a} {c} {d}"]
    return "\n".join(lines) + "\n"
