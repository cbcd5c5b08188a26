"""Reads the model-exchange side of an FMU back into CasADi: the feature and its Jacobian by the FMU's own derivatives.

    q -> (y, ∂y/∂q)

The result has the signature of `plant.symbolic.symbolic_model`, so that whatever is built on the project's own
equations (the true Jacobian, a calibrated nonlinear MPC) can be built on an FMU whose equations nobody has.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import casadi
import numpy as np
import numpy.typing as npt

from plant.fmu_archive import FmuFolder
from plant.signals import FloatArray


class FmuModel:
    """y = h(q) of a model-exchange FMU, J = ∂h/∂q by its directional derivatives; other states rest at their start.

    Attributes:
        function: (n,) rad -> (m,) and (m, n), a `casadi.Function`; it lives as long as this object.
    """

    def __init__(
        self,
        path: Path,
        joints: Sequence[str] = ("joint_position",),
        features: Sequence[str] = ("ball_position",),
        parameters: Mapping[str, npt.ArrayLike] | None = None,
    ) -> None:
        """Load the FMU.

        Args:
            path: the .fmu file, of FMI 2 with model exchange.
            joints: names of states, or of families `name[1]`, `name[2]`, …
            features: names of outputs, likewise.
            parameters: values by name, instead of the start values.

        Raises:
            ValueError: not such an FMU, or a name that it does not have.
        """
        self._folder = FmuFolder(path)
        try:
            self.function = _model_function(path, self._folder.root, joints, features, dict(parameters or {}))
        except BaseException:
            self._folder.close()
            raise

    def symbolic(self, joint_position: Any) -> Any:  # noqa: ANN401 - CasADi expressions
        """Return the feature, (m, 1), as an expression of `joint_position`, an MX expression of shape (n, 1) in rad."""
        return self.function(joint_position)[0]

    def feature(self, joint_position: npt.ArrayLike) -> FloatArray:
        """Return the feature, (m,), at joint positions (n,) in rad."""
        return np.asarray(self.function(np.asarray(joint_position))[0], dtype=np.float64).ravel()

    def jacobian(self, joint_position: npt.ArrayLike) -> FloatArray:
        """Return ∂feature/∂(joint position), (..., m, n), at joint positions (..., n) in rad."""
        q = np.asarray(joint_position, dtype=np.float64)
        rows = [np.asarray(self.function(row)[1]) for row in q.reshape(-1, q.shape[-1])]
        return np.array(rows, dtype=np.float64).reshape(*q.shape[:-1], *rows[0].shape)

    def close(self) -> None:
        """Remove the extracted files; the function must not be used any more. Calling it twice is allowed."""
        self._folder.close()


def _model_function(
    path: Path, root: Path, joints: Sequence[str], features: Sequence[str], parameters: dict[str, npt.ArrayLike]
) -> Any:  # noqa: ANN401 - a casadi.Function
    try:
        builder = casadi.DaeBuilder("fmu", str(root))
        states, outputs, constants = list(builder.x()), list(builder.y()), list(builder.p())
    except RuntimeError as error:
        raise ValueError(f"fmu file {path} cannot be read by CasADi: {' '.join(str(error).split())[:200]}") from error
    chosen = _resolve("joints", joints, states)
    builder.set_y(_resolve("features", features, outputs))
    try:
        whole = builder.create("fmu", ["x", "u", "p"], ["y"])
    except RuntimeError as error:
        raise ValueError(
            f"fmu file {path} cannot be used by CasADi; wanted FMI 2 with model exchange: "
            f"{' '.join(str(error).split())[:200]}"
        ) from error
    values = dict(zip(constants, _starts(builder, constants), strict=True))
    for name, value in parameters.items():
        names = _resolve("parameters", [name], constants)
        values.update(zip(names, np.broadcast_to(np.ravel(value), (len(names),)), strict=True))
    q = casadi.MX.sym("joint_position", len(chosen))
    place = {name: i for i, name in enumerate(chosen)}
    rest = dict(zip(states, _starts(builder, states), strict=True))
    x = casadi.vertcat(*(q[place[name]] if name in place else rest[name] for name in states))
    inputs = casadi.DM(_starts(builder, list(builder.u())))
    feature = whole(x, inputs, casadi.DM([float(values[name]) for name in constants]))
    results: list[Any] = [feature, casadi.jacobian(feature, q)]
    create: Any = casadi.Function  # its annotations do not know MX
    return create("hand_eye", [q], results, ["joint_position"], ["feature", "jacobian"])


def _starts(builder: Any, names: list[str]) -> list[float]:  # noqa: ANN401 - a casadi.DaeBuilder
    """Return start values; what has none, such as a state that a parameter places, starts at 0."""
    starts = [float(np.ravel(builder.start(name))[0]) for name in names]
    return [start if np.isfinite(start) else 0.0 for start in starts]


def _resolve(role: str, names: Sequence[str], known: list[str]) -> list[str]:
    """Return the variables that `names` stand for, in the FMU's order of each family."""
    found: list[str] = []
    for name in names:
        members = [name] if name in known else [each for each in known if each.startswith(f"{name}[")]
        if not members:
            families = dict.fromkeys(each.partition("[")[0] for each in known)
            raise ValueError(f"{role} names {name!r}, which the FMU does not have; it has: {', '.join(families)}")
        found += members
    return found
