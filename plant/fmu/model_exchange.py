"""An FMU that offers model exchange, read back into CasADi: feature and Jacobian are those of its own derivatives.

    q -> (y, ∂y/∂q)

The result answers like `plant.cameras.symbolic.symbolic_feature`, so that a model that is built on the project's
own equations (the true Jacobian, a calibrated nonlinear MPC) can be built on an FMU with unknown equations.
"""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import casadi
import numpy as np
import numpy.typing as npt

from servobench.plant.contract.checks import FloatArray, NamedArrays
from servobench.plant.fmu.archive import extract_fmu
from servobench.plant.fmu.description import FmuDescription, read_exchange
from servobench.plant.fmu.mapping import FmuMapping


class FmuModel:
    """y = h(q) of a model-exchange FMU, J = ∂h/∂q by its directional derivatives; other states rest at their start.

    It has an instance of the FMU of its own, so that it disturbs no run of the same FMU.

    Attributes:
        function: (n,) rad -> (m,) and (m, n), a `casadi.Function`.
    """

    def __init__(
        self,
        path: Path,
        joints: Sequence[str],
        features: Sequence[str],
        parameters: Mapping[str, float],
    ) -> None:
        """Load the FMU.

        Args:
            path: the .fmu file, of FMI 2 with model exchange.
            joints: names of states.
            features: names of outputs.
            parameters: values by name, instead of the start values.

        Raises:
            ValueError: not such an FMU, or a name that it does not have.
        """
        root = extract_fmu(path)
        read_exchange(path, root)
        self._feature = _feature_function(path, root, joints, features, parameters)
        q = casadi.MX.sym("joint_position", self._feature.size1_in(0))
        y = self._feature(q)
        outputs = [y, casadi.jacobian(y, q)]
        self.function = casadi.Function(
            "hand_eye", [q], outputs, ["joint_position"], ["feature", "jacobian"]
        )

    def symbolic(self, joint_position: Any) -> Any:  # noqa: ANN401 - CasADi expressions
        """Return the feature, (m, 1), as an expression of `joint_position`, an MX expression of shape (n, 1) in rad."""
        return self._feature(joint_position)

    def jacobian(self, joint_position: npt.ArrayLike) -> FloatArray:
        """Return ∂feature/∂(joint position), (..., m, n), at joint positions (..., n) in rad."""
        q = np.asarray(joint_position, dtype=np.float64)
        rows = [np.asarray(self.function(row)[1]) for row in q.reshape(-1, q.shape[-1])]
        return np.array(rows, dtype=np.float64).reshape(*q.shape[:-1], *rows[0].shape)


def build_model(
    mapping: FmuMapping,
    description: FmuDescription,
    parameters: NamedArrays | None = None,
) -> FmuModel:
    """Return the model of a mapped FMU.

    Args:
        mapping: names the features, the joints or the states behind them, and the parameters.
        description: of the FMU.
        parameters: values by name that go before those of the mapping.

    Raises:
        ValueError: see `FmuModel`; also a mapping that names neither joints nor states.
    """
    states = mapping.truth.states or mapping.joints
    if not states:
        raise ValueError(
            "truth.states must name the states of the FMU that are the joint positions, got none"
        )
    read_exchange(mapping.file, extract_fmu(mapping.file))
    values = {}
    for name, value in {**mapping.parameters, **(parameters or {})}.items():
        role = "nominal" if parameters and name in parameters else "parameters"
        variables = description.find(name, role, None)
        if variables[0].type == "String":
            raise ValueError(
                f"parameter {name!r} is a text, which CasADi cannot give to the FMU's model"
            )
        if np.shape(value) not in ((), (len(variables),)):
            raise ValueError(
                f"parameter {name!r} must have {len(variables)} values, got {np.size(value)}"
            )
        scalars = np.broadcast_to(value, (len(variables),)).tolist()
        for variable, scalar in zip(variables, scalars, strict=True):
            values[variable.name] = scalar
    joints = description.select(states, "truth.states" if mapping.truth.states else "joints")
    features = description.select(mapping.truth.features or mapping.features, "features")
    joint_names = [each.name for each in joints]
    feature_names = [each.name for each in features]
    return FmuModel(mapping.file, joint_names, feature_names, values)


def _feature_function(
    path: Path,
    root: Path,
    joints: Sequence[str],
    features: Sequence[str],
    parameters: Mapping[str, float],
) -> Any:  # noqa: ANN401 - a casadi.Function
    """Return q -> y with everything else at its start."""
    try:
        builder = casadi.DaeBuilder("fmu", str(root))
        states = list(builder.x())
        constants = list(builder.p())
        fixed = list(builder.c())
        settable = [*constants, *fixed]
        _check_names("parameters or nominal", parameters, settable, f"parameters of {path.name}")
        _check_names("joints", joints, states, f"states of {path.name}")
        _check_names("features", features, list(builder.y()), f"outputs of {path.name}")
        for name in set(fixed).intersection(parameters):
            builder.set(name, parameters[name])
        values = dict(zip(constants, _starts(builder, constants), strict=True))
        values.update(parameters)
        builder.set_y(list(features))
        whole = builder.create("fmu", ["x", "u", "p"], ["y"])
    except RuntimeError as error:
        # The other lines name places in CasADi's code.
        reason = str(error).strip().splitlines()[-1]
        raise ValueError(f"fmu file {path} cannot be read by CasADi: {reason}") from error
    q = casadi.MX.sym("joint_position", len(joints))
    place = {name: i for i, name in enumerate(joints)}
    rest = dict(zip(states, _starts(builder, states), strict=True))
    x = casadi.vertcat(*(q[place[name]] if name in place else rest[name] for name in states))
    inputs = casadi.DM(_starts(builder, list(builder.u())))
    constant_values = casadi.DM([float(values[name]) for name in constants])
    feature = whole(x, inputs, constant_values)
    return casadi.Function("feature", [q], [feature], ["joint_position"], ["feature"])


def _starts(builder: Any, names: list[str]) -> list[float]:  # noqa: ANN401 - a casadi.DaeBuilder
    """Return start values; a variable without one, such as a state that a parameter sets, starts at 0."""
    starts = [float(np.ravel(builder.start(name))[0]) for name in names]
    return [start if np.isfinite(start) else 0.0 for start in starts]


def _check_names(role: str, names: Iterable[str], known: list[str], group: str) -> None:
    for name in names:
        if name not in known:
            families = dict.fromkeys(each.partition("[")[0] for each in known)
            raise ValueError(
                f"{role} names {name!r}, which is none of the {group}: {', '.join(families) or 'none'}"
            )
