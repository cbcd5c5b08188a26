"""Sweep the rotation of the camera and read the table with pandas: one row is one run."""

import subprocess
import sys

import pandas as pd

command = (
    "sweep --plants kinematic --controllers ukf_mfac,constant --seeds 3"
    " --vary camera_rotation=0:60:30deg --out turned"
)
subprocess.run(
    [sys.executable, "-m", "servobench", *command.split()], check=True, capture_output=True
)

runs = pd.read_parquet("turned/runs.parquet")
print(runs["status"].value_counts().to_string())
settled = runs["settling_time_s"].where(runs["status"] == "completed")
# of runs that never settled, which a median would leave out
runs["settling_time_s"] = settled.fillna(float("inf"))
print(
    runs.pivot_table(
        index="magnitude", columns="controller", values="settling_time_s", aggfunc="median"
    )
)
