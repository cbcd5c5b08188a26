"""Results folders made up for tests: quick, and with whatever oddity is wanted."""

import re
from pathlib import Path

import numpy as np
import pandas as pd

from servobench.harness.batch import results, store
from servobench.plant.contract.checksums import write_vouched

CONTROLLERS = ("rbfnn_mfac", "ukf_mfac", "someone_elses")
MANIFEST = {
    "created": "2026-01-01T00:00:00+00:00",
    "packages": {"servobench": "0.1.0"},
    "python": "3.11.0",
}


def made_up_steps(
    run_id: str, *, curve: bool = False, periods: int = 60, features=("x_m", "y_m", "z_m")
) -> pd.DataFrame:
    """Return steps whose feature comes to the reference within half a second."""
    k = np.arange(periods)
    decay = np.exp(-np.minimum(k, 600) / 10.0)
    table = pd.DataFrame({"run_id": run_id, "step": k, "time_s": k * 0.05})
    for i, name in enumerate(features):
        reference = 0.2 * np.cos(0.1 * k + i) if curve else np.full(periods, 0.1 * i)
        deviation = 0.3 * decay
        table[f"reference_{name}"] = reference
        table[f"feature_{name}"] = table[f"true_feature_{name}"] = reference + deviation
    for name in ("lift", "turn"):
        table[f"joint_position_{name}_rad"] = 0.01 * k
        table[f"joint_velocity_command_{name}_rad_s"] = 0.2
    table["error_norm"] = 0.5 * decay
    table["jacobian_error"] = 0.3
    table["feature_valid"] = True
    table["controller_time_us"] = 100.0 + k
    table["plant_time_us"] = 10.0
    return table


def made_up_row(run_id: str, **values: object) -> dict[str, object]:
    row: dict[str, object] = {
        "run_id": run_id, "plant": "kinematic", "controller": "ukf_mfac", "task": "exp1", "seed": 0,
        "mismatch": "moderate", "status": "completed", "settling_time_s": 1.5, "overshoot": 0.02,
        "steady_state_error": 0.001, "rms_error_evaluated": 0.002, "max_error": 0.5, "control_effort_rad": 3.0,
        "saturation_fraction": 0.1, "command_switches": 3.0, "joint_jerk_rms_rad_s3": 12.0,
        "joint_acceleration_rms_rad_s2": 1.5, "joint_acceleration_peak_rad_s2": 8.0, "controller_time_overruns": 0.0,
        "jacobian_error_mean": 0.3, "controller_time_median_us": 130.0,
        "controller_time_p99_us": 159.0, "periods": 60, "reason": "", "mismatch_values": "{}",
        "task_kind": "point_to_point", "feature_unit": "m", "settling_band": 0.005,
    }  # fmt: skip
    return row | values


def write_folder(folder: Path, rows: list[dict[str, object]], steps: list[pd.DataFrame]) -> Path:
    store.create_folder(folder, MANIFEST)
    (folder / results.PARTS).rmdir()
    write_vouched(folder, {results.RUNS: pd.DataFrame(rows).to_parquet})
    if steps:
        write_vouched(folder, {results.STEPS: pd.concat(steps, ignore_index=True).to_parquet})
    return folder


def comparison(folder: Path, controllers=CONTROLLERS, tasks=("exp1", "exp2", "circle")) -> Path:
    """Write a folder as `compare` leaves it."""
    rows, steps = [], []
    for task in tasks:
        for controller in controllers:
            run_id = re.sub(r"[^\w.-]", "_", f"kinematic-{controller}-{task}-moderate-0")
            curve = task == "circle"
            judged = (
                {"overshoot": np.nan, "settling_time_s": np.nan, "task_kind": "curve"}
                if curve
                else {}
            )
            rows.append(made_up_row(run_id, controller=controller, task=task, **judged))
            steps.append(made_up_steps(run_id, curve=curve))
    return write_folder(folder, rows, steps)


def sweep(folder: Path) -> Path:
    """Write a folder as `sweep` leaves it: no steps, more conditions; the larger the mismatch, the fewer settle."""
    rows = []
    for degrees in (0, 30, 60):
        for controller in CONTROLLERS:
            for seed in range(6):
                lost = seed < degrees / 20
                rows.append(
                    made_up_row(
                        f"{controller}-{degrees}-{seed}", controller=controller, task="random", seed=seed,
                        mismatch=f"camera_rotation={degrees}deg", noise_factor=1.0, latency_s=0.05 * (seed % 2),
                        period_s=None,
                        status="feature_lost" if lost else "completed",
                        reason="no valid feature for 20 periods" if lost else "",
                    )
                )  # fmt: skip
    return write_folder(folder, rows, [])


def failed_only(folder: Path) -> Path:
    """Write a folder whose runs all ended before their first period."""
    keys = ("run_id", "plant", "controller", "task", "seed", "mismatch", "mismatch_values")
    row = {key: made_up_row("kinematic-ukf_mfac-exp1-moderate-0")[key] for key in keys}
    return write_folder(
        folder,
        [row | {"status": "crashed", "periods": 0, "reason": "ValueError: no such thing"}],
        [],
    )
