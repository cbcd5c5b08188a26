"""Export the UR5 as an FMU and simulate it with fmpy, once as its model and once with an error of 3° in joint 2."""

import math
from pathlib import Path

import numpy as np
from fmpy import simulate_fmu

from servobench.fmus.export import ExportOptions, export_fmu

path = export_fmu(Path("ur5.fmu"), ExportOptions(fmi_version=2))
outputs = [f"ball_position[{axis}]" for axis in (1, 2, 3)]
commands = [f"joint_velocity_command[{joint}]" for joint in range(1, 7)]
command = np.array(
    [(0.0, 0.0, 0.2, 0.0, 0.0, 0.0, 0.0)], dtype=[(name, float) for name in ("time", *commands)]
)

for name, parameters in {
    "nominal": {},
    "joint 2 off by 3°": {"joint_offset[2]": math.radians(3.0)},
}.items():
    result = simulate_fmu(
        str(path),
        stop_time=1.0,
        output_interval=0.05,
        start_values=parameters,
        input=command,
        output=outputs,
    )
    print(f"{name}: ball at {[round(float(result[name][-1]), 4) for name in outputs]} m after 1 s")
