"""Trained networks and the file that holds them: an .npz without pickles, written at once or not at all."""

import struct
import tokenize
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np

from servobench.controllers.networks.rbf import ControllerNetwork, JacobianNetwork, Kernel
from servobench.plant.contract.faults import configuration_errors
from servobench.plant.contract.files import write_atomically

FORMAT = "servobench networks"
FORMAT_VERSION = 2
# [bytes] Largest sum of all arrays; trained networks have less than a hundredth of it.
MAX_UNPACKED = 256_000_000
READ_ERRORS = (  # exceptions of numpy's reader for a damaged file, or one that is no .npz
    ArithmeticError, AttributeError, EOFError, LookupError, MemoryError, NotImplementedError, OSError, RuntimeError,
    SyntaxError, TypeError, ValueError, struct.error, tokenize.TokenError, zipfile.BadZipFile, zlib.error,
)  # fmt: skip
ARRAYS = ("centres", "widths", "weights")  # names of the arrays of either network


@dataclass(frozen=True, eq=False)
class TrainedNetworks:
    """Both networks as the offline training left them."""

    jacobian: JacobianNetwork  # the Jacobian network
    controller: ControllerNetwork  # the controller network
    jacobian_error: float  # held-out RMS of ‖Ĵ − J‖ over that of ‖J‖
    controller_error: float  # held-out RMS over joints of ψ ξ − q_cmd, rad
    digest: str  # hash of the configuration and of the model

    def __post_init__(self) -> None:
        """Check that both networks are of the same robot."""
        one = (self.jacobian.n, self.jacobian.m)
        other = (self.controller.n, self.controller.m)
        if one != other:
            raise ValueError(
                f"both networks must have the same sizes (n, m), got {one} and {other}"
            )


def save_networks(networks: TrainedNetworks, path: Path) -> None:
    """Write `networks` to `path`; a reader sees the old file or the whole new one, never a part.

    Args:
        networks: to be stored.
        path: the .npz file; its folder is made where absent.
    """
    path.parent.mkdir(parents=True, exist_ok=True)

    def write(partial: Path) -> None:
        with partial.open("wb") as file:
            np.savez(file, **_as_arrays(networks))

    write_atomically(path, write)


def load_networks(path: Path, digest: str | None = None) -> TrainedNetworks:
    """Read networks from `path`.

    Args:
        path: as written by `save_networks`.
        digest: wanted hash of configuration, sizes and model; None for any.

    Raises:
        ValueError: missing, corrupt, foreign, of another format version, or of another robot or configuration.
    """
    arrays = _read_arrays(path)
    with configuration_errors(f"network file {path} is corrupt: ", KeyError, TypeError):
        networks = _from_arrays(arrays)
    if digest is not None and digest != networks.digest:
        raise ValueError(
            f"network file {path} is of another robot or configuration: training digest {networks.digest}, "
            f"wanted {digest}"
        )
    return networks


def _read_arrays(path: Path) -> dict[str, Any]:
    """Return all arrays of the file after its format and version have been checked."""
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
            unpacked = sum(entry.file_size for entry in archive.zip.infolist())
            if unpacked > MAX_UNPACKED:
                raise ValueError(
                    f"it unpacks to {unpacked:,} bytes, at most {MAX_UNPACKED:,} are read"
                )
            arrays = {name: archive[name] for name in archive.files}
    except FileNotFoundError as error:
        raise ValueError(f"network file {path} does not exist") from error
    except READ_ERRORS as error:
        raise ValueError(
            f"network file {path} is corrupt or not a network file: {error}"
        ) from error
    if str(arrays.get("format")) != FORMAT:
        raise ValueError(f"network file {path} is not a network file of servobench")
    version = str(arrays.get("format_version"))
    if version != str(FORMAT_VERSION):
        raise ValueError(
            f"network file {path} has format version {version}, wanted {FORMAT_VERSION}; train it again"
        )
    return arrays


def _as_arrays(networks: TrainedNetworks) -> dict[str, Any]:
    jacobian = networks.jacobian
    controller = networks.controller
    return {
        "format": np.array(FORMAT),
        "format_version": np.array(FORMAT_VERSION),
        "digest": np.array(networks.digest),
        "sizes": np.array([jacobian.n, jacobian.m]),
        "history": np.array([controller.error_history, controller.position_history]),
        "kernel": np.array(controller.kernel),
        "step": np.array(controller.step),
        "held_out_error": np.array([networks.jacobian_error, networks.controller_error]),
        **{f"jacobian_{name}": getattr(jacobian, name) for name in ARRAYS},
        **{f"controller_{name}": getattr(controller, name) for name in ARRAYS},
    }


def _from_arrays(arrays: dict[str, Any]) -> TrainedNetworks:
    error_history, position_history = (int(value) for value in arrays["history"])
    jacobian_error, controller_error = (float(value) for value in arrays["held_out_error"])
    jacobian = JacobianNetwork(*(arrays[f"jacobian_{name}"] for name in ARRAYS))
    sizes = arrays["sizes"].tolist()
    wanted = (jacobian.n, jacobian.m)
    if tuple(sizes) != wanted:
        raise ValueError(f"sizes must be {wanted}, got {sizes}")
    centres, widths, weights = (arrays[f"controller_{name}"] for name in ARRAYS)
    kernel = cast(Kernel, str(arrays["kernel"]))
    step = float(arrays["step"])
    controller = ControllerNetwork(
        centres, widths, weights, error_history, position_history, kernel, step
    )
    return TrainedNetworks(
        jacobian, controller, jacobian_error, controller_error, str(arrays["digest"])
    )
